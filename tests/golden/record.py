"""``make golden``: record the golden set anew and say what changed. With ``--check`` nothing is written, and a change is exit code 1.

Names of files, or parts of them, restrict it: ``python tests/golden/record.py flights/v4 refusals``.
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence
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
    """What is different, for people: of each case its title, and lines; empty where nothing is."""
    old = file.read_text(encoding="utf-8") if file.exists() else ""
    before, after = commands.cases(old), commands.cases(new)
    found = []
    for title in dict.fromkeys([*before, *after]):
        pair = before.get(title, []), after.get(title, [])
        lines = [repr(line)[1:-1] for line in unified_diff(*pair, n=0, lineterm="")][3:]
        if lines:
            found.append(f"{file.relative_to(HERE)}: {title}")
            found += [f"    {line[:300]}" for line in lines[:LINES]]
            found += [f"    ... and {len(lines) - LINES} more lines"] * (len(lines) > LINES)
    return found


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
