"""``make golden``: record the golden set anew and say what changed. With ``--check`` nothing is written, and a change is exit code 1.

Names of files, or parts of them, restrict it: ``python tests/golden/record.py flights/v4 refusals``.
"""

import argparse
import os
import re
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from difflib import unified_diff
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[1])]

import commands  # noqa: E402
import scenario  # noqa: E402

LINES = 12
"""Lines of a difference that are shown."""


def files(words: Sequence[str] = ()) -> list[Path]:
    """The golden files, those whose names hold one of the words."""
    found = [*HERE.glob("flights/*.txt"), *HERE.glob("dialogues/*.txt"), *HERE.glob("commands/*.txt")]
    found += [capture.with_suffix(".txt") for capture in HERE.glob("captures/*.kcap")]
    return [file for file in sorted(found) if not words or any(word in str(file.relative_to(HERE)) for word in words)]


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
    return [f"{name}: {line}" for line in [*_in_frames(old, new), *_in_lines(_others(old), _others(new))]]


_FRAME = re.compile(r"([\d.]+) -> (\w+)(#.*)")


def _frames(text: str) -> list[tuple[str, str, str]]:
    return [(m[1], m[2], m[3]) for line in text.splitlines() if (m := _FRAME.match(line))]


def _others(text: str) -> list[str]:
    return [line for line in text.splitlines() if not _FRAME.match(line)]


def _in_frames(old: str, new: str) -> Iterator[str]:
    before, after = _frames(old), _frames(new)
    if before == after:
        return
    now = defaultdict(list)
    for at, can_id, data in after:
        now[at, can_id].append(data)
    differ: list[tuple[str, str]] = []
    gone: list[tuple[str, str]] = []
    for at, can_id, data in before:
        if not now[at, can_id]:
            gone.append((f"{can_id}{data}", at))
        elif (other := now[at, can_id].pop(0)) != data:
            differ.append((can_id, f"at {at} s: {can_id}{data} -> {can_id}{other}"))
    added = [(f"{can_id}{data}", at) for (at, can_id), rest in now.items() for data in rest]
    total = f"of {len(before)} frames"
    if differ:
        ids = ", ".join(f"{can_id} {count}x" for can_id, count in Counter(can_id for can_id, _ in differ).items())
        yield f"{len(differ)} {total} differ ({ids}), first {differ[0][1]}"
    moved_to = defaultdict(list)
    for frame, at in added:
        moved_to[frame].append(at)
    moved = [(frame, at, moved_to[frame].pop(0)) for frame, at in gone if moved_to[frame]]
    if moved:
        yield f"{len(moved)} {total} come at another time, first {moved[0][0]} at {moved[0][1]} s -> {moved[0][2]} s"
    lost = Counter(frame for frame, _ in gone) - Counter(frame for frame, _, _ in moved)
    if lost:
        frame, at = next((f, at) for f, at in gone if lost[f])
        yield f"{lost.total()} {total} are gone, first {frame} at {at} s"
    more = [(frame, at) for frame, times in moved_to.items() for at in times]
    if more:
        frame, at = min(more, key=lambda item: float(item[1]))
        yield f"{len(more)} frames are new, first {frame} at {at} s"
    if not (differ or gone or added):
        at = next(a for a, b in zip(before, after, strict=True) if a != b)[0]
        yield f"the order of frames is another, first at {at} s"


def _in_lines(old: Sequence[str], new: Sequence[str]) -> Iterator[str]:
    found = [line for line in unified_diff(old, new, n=0, lineterm="") if not re.match(r"---|\+\+\+|@@", line)]
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
            yield from (f"    {line}" for line in _in_lines(before.get(title, []), after.get(title, [])))


def main() -> int:
    """Record, or check."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if anything is different")
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
    print(f"{differing} of {len(chosen)} golden files {done} ({time.process_time() - begun:.0f} s of CPU)")
    return int(args.check and differing > 0)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONHASHSEED", "0")
    sys.exit(main())
