"""``make golden``: record the golden set anew and say what changed. With ``--check`` nothing is written, and a change is exit code 1.

Names of files, or parts of them, restrict it: ``python tests/golden/record.py flights/v4 refusals``.
"""

import argparse
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from difflib import unified_diff
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[1])]

import commands  # noqa: E402
import scenario  # noqa: E402

KINDS = ("captures", "commands", "dialogues", "flights")
LINES = 12
"""Lines of a difference that are shown."""


def files(words: Sequence[str] = ()) -> list[Path]:
    """The golden files, those whose names hold one of the words."""
    found = [file for kind in KINDS for file in HERE.glob(f"{kind}/*.txt")]
    named = [(file, str(file.relative_to(HERE))) for file in sorted(found)]
    return [file for file, name in named if not words or any(word in name for word in words)]


def made(file: Path) -> str:
    """What the file would hold if it were recorded now."""
    if file.parent.name == "captures":
        return scenario.replay(file.with_suffix(".kcap"))
    text = file.read_text(encoding="utf-8")
    return commands.play(text) if file.parent.name == "commands" else scenario.play(text)


def changes(file: Path, new: str) -> list[str]:
    """What is different, for people; empty where nothing is."""
    return differences(file, file.read_text(encoding="utf-8") if file.exists() else "", new)


def differences(file: Path, old: str, new: str) -> list[str]:
    """The same of two texts for a file."""
    if old == new:
        return []
    name = str(file.relative_to(HERE))
    if file.parent.name == "commands":
        return [f"{name}: {line}" for line in _in_cases(old, new)]
    lines = [*_in_frames(old, new), *_in_lines(old.splitlines(), new.splitlines())]
    return [f"{name}: {line}" for line in lines]


def _in_frames(old: str, new: str) -> Iterator[str]:
    """How many frames of which ids are gone or new."""
    before, after = (
        Counter(re.findall(r"^[\d.]+ -> \w+#.*", text, re.MULTILINE)) for text in (old, new)
    )
    for what, lines in (("gone", before - after), ("new", after - before)):
        if lines:
            ids = Counter(re.findall(r"-> (\w+)", " ".join(lines)))
            counts = ", ".join(f"{can_id} {count}x" for can_id, count in ids.items())
            yield f"{len(lines)} of {before.total()} frames are {what} ({counts})"


def _in_lines(old: Sequence[str], new: Sequence[str]) -> Iterator[str]:
    found = [
        line
        for line in unified_diff(old, new, n=0, lineterm="")
        if not re.match(r"---|\+\+\+|@@", line)
    ]
    for line in found[:LINES]:
        shown = "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in line)
        yield shown if len(shown) < 300 else shown[:297] + "..."
    if len(found) > LINES:
        yield f"... and {len(found) - LINES} more lines"


def _in_cases(old: str, new: str) -> Iterator[str]:
    before, after = commands.cases(old), commands.cases(new)
    for title in dict.fromkeys([*before, *after]):
        if before.get(title) != after.get(title):
            yield title
            yield from (
                f"    {line}" for line in _in_lines(before.get(title, []), after.get(title, []))
            )


def main() -> int:
    """Record, or check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit code 1 if anything is different"
    )
    parser.add_argument("words", nargs="*", help="only files whose names hold one of these")
    args = parser.parse_args()
    begun = time.process_time()
    differing = 0
    chosen = files(args.words)
    for file in chosen:
        new = made(file)
        found = changes(file, new)
        differing += bool(found)
        print("".join(f"{line}\n" for line in found), end="")
        if found and not args.check:
            file.write_text(new, encoding="utf-8")
    done = "differ" if args.check else "were written"
    print(
        f"{differing} of {len(chosen)} golden files {done} ({time.process_time() - begun:.0f} s of CPU)"
    )
    return int(args.check and differing > 0)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONHASHSEED", "0")
    sys.exit(main())
