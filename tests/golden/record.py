"""``make golden``: record the golden set and print the changes.

With ``--check`` nothing is written, and the exit code is 1 if anything has changed. Names of files
or parts of names restrict the run: ``python tests/golden/record.py flights/v4 refusals``.
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from difflib import unified_diff
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [
    str(HERE),
    str(HERE.parent),
    str(HERE.parents[1]),
]

import commands  # noqa: E402
import scenario  # noqa: E402

KINDS = ("captures", "commands", "dialogues", "flights")
LINES = 12
"""Most lines of one difference that are printed."""


def files(words: Sequence[str] = ()) -> list[Path]:
    """Return the golden files whose names contain one of the words. No words: all files."""
    found: list[Path] = []
    for kind in KINDS:
        found += HERE.glob(f"{kind}/*.txt")
    chosen = []
    for file in sorted(found):
        name = str(file.relative_to(HERE))
        if not words or any(word in name for word in words):
            chosen.append(file)
    return chosen


def made(file: Path) -> str:
    """Return the text that the file would have if it were recorded now."""
    kind = file.parent.name
    if kind == "captures":
        return scenario.replay(file.with_suffix(".kcap"))
    text = file.read_text(encoding="utf-8")
    if kind == "commands":
        return commands.play(text)
    return scenario.play(text)


def changes(file: Path, new: str) -> list[str]:
    """Return the differences as readable lines: for each case its title and its changed lines.

    Returns an empty list if nothing has changed.
    """
    old = file.read_text(encoding="utf-8") if file.exists() else ""
    before = commands.cases(old)
    after = commands.cases(new)
    found = []
    for title in dict.fromkeys([*before, *after]):
        old_lines = before.get(title, [])
        new_lines = after.get(title, [])
        difference = unified_diff(old_lines, new_lines, n=0, lineterm="")
        lines = [repr(line)[1:-1] for line in difference][3:]
        if not lines:
            continue
        found.append(f"{file.relative_to(HERE)}: {title}")
        found += [f"    {line[:300]}" for line in lines[:LINES]]
        if len(lines) > LINES:
            found.append(f"    ... and {len(lines) - LINES} more lines")
    return found


def main() -> int:
    """Record or check the files that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--check",
        action="store_true",
        help="write nothing; exit code 1 if anything is different",
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
        for line in found:
            print(line)
        if found and not args.check:
            file.write_text(new, encoding="utf-8")
    done = "differ" if args.check else "were written"
    used = time.process_time() - begun
    print(f"{differing} of {len(chosen)} golden files {done} ({used:.0f} s of CPU)")
    return int(args.check and differing > 0)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONHASHSEED", "0")
    sys.exit(main())
