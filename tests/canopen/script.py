"""Reads dialogues from files and plays them with a talker. dialogues/README.md has the format."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import ndiff
from itertools import zip_longest
from pathlib import Path

MS = 1_000_000
Line = tuple[str, str]
"""The place of a line of a dialogue, and the line."""


class Talker:
    """The partner of a dialogue, which executes its lines."""

    now = 0

    def __init__(self) -> None:
        self._lines: list[str] = []

    def pass_time(self, until: int) -> None:
        """Let time pass until this time in ns. Serve each deadline."""
        self.now = until

    def jump(self, now: int) -> None:
        """Let time pass until this time in ns. Serve the deadlines only once, at its end."""
        self.now = now

    def say(self, what: str) -> str:
        """Execute a line. Return the line with the actual values instead of the expected ones."""
        raise NotImplementedError

    def hear(self, now: int, frame: str) -> None:
        """Note a frame that was sent."""
        self._lines.append(f"{ms(now)} -> {frame}".rstrip())

    def heard_lines(self) -> list[str]:
        """Return the lines "time -> ..." of the frames that were sent since the last call."""
        lines = self._lines
        self._lines = []
        return lines


@dataclass
class Dialogue:
    """One dialogue of a file: its name, its options, and its lines with their places."""

    name: str
    options: list[str]
    lines: list[Line]


def read_dialogues(path: Path) -> list[Dialogue]:
    """Return all dialogues of a file. A table gives a dialogue for each row."""
    blocks: list[tuple[str, list[Line]]] = [("", [])]
    for number, raw in enumerate(path.read_text("utf-8").splitlines(), 1):
        line = raw.partition(";")[0].strip()
        if line.startswith("=="):
            blocks.append((line[2:].strip(), []))
        elif line:
            blocks[-1][1].append((f"{path.name}:{number}", line))
    head = []
    texts = {}
    parts = dict[str, list[Line]]()
    for place, line in blocks.pop(0)[1]:
        verb, _, rest = line.partition(" ")
        if verb == "with":
            head.append(rest)
        elif verb == "let":
            name, _, text = rest.partition("=")
            texts[name.strip()] = text.strip()
        elif verb == "part":
            parts[rest] = []
        else:
            list(parts.values())[-1].append((place, line))
    found = []
    for title, block in blocks:
        rows: list[tuple[str, ...]] = []
        for _, line in block:
            if line.startswith(("each", "|")):
                rows.append(tuple(cell.strip() for cell in line.split("|")[1:]))
        if not rows:
            rows = [(), ()]
        names = rows[0]
        values = rows[1:]
        lines = []
        for place, line in block:
            verb, _, rest = line.partition(" ")
            if verb == "use":
                lines += parts[rest]
            elif not line.startswith(("each", "|")):
                lines.append((place, line))
        for row in values:
            row_texts = {**texts, **dict(zip(names, row, strict=True))}
            name = f"{path.stem}: {title}"
            if row:
                name += f" [{', '.join(row)}]"
            dialogue = Dialogue(name, list(head), [])
            for place, line in lines:
                text = _filled(line, row_texts)
                if text.startswith("with "):
                    dialogue.options.append(text.partition(" ")[2])
                elif text:
                    dialogue.lines.append((place, text))
            found.append(dialogue)
    return found


def _filled(line: str, texts: Mapping[str, str]) -> str:
    return re.sub(r"\{([^{}]+)\}", lambda match: texts[match[1]], line)


def play_lines(talker: Talker, lines: Sequence[Line]) -> None:
    """Execute the lines at their times, and compare all sent frames with the expected ones.

    A line without a time has the time of the line before it.
    """
    expected: list[Line] = []
    actual: list[str] = []
    time = ms(talker.now)
    for place, raw in lines:
        line = raw.partition(";")[0].strip()
        match = re.fullmatch(r"(?:(\d+(?:\.\d+)?)\s+)?(\S.*)", line)
        if match is None:
            continue
        time = match[1] or time
        what = " ".join(match[2].split())
        now = round(float(time) * MS)
        if what == "hung":
            talker.jump(now)
        else:
            talker.pass_time(max(talker.now, now))
        actual += talker.heard_lines()
        if what == "hung" or what == "-":
            assert now == talker.now, f"{place}: lines are not in the order of time"
            continue
        expected.append((place, f"{float(time):g} {what}"))
        if what.startswith("->"):
            continue
        assert now == talker.now, f"{place}: lines are not in the order of time"
        actual.append(f"{float(time):g} {talker.say(what)}")
        time = ms(talker.now)  # a restart begins with 0
        actual += talker.heard_lines()
    _compare(expected, actual)


def _compare(expected: Sequence[Line], actual: Sequence[str]) -> None:
    """Raise AssertionError with the first line that differs."""
    wanted = [_padded(line) for _, line in expected]
    got = [_with_wildcards(*pair) for pair in zip(actual, wanted, strict=False)]
    got += actual[len(wanted) :]
    pairs = zip_longest(wanted, got, fillvalue="nothing")
    for number, (line, other) in enumerate(pairs):
        if line != other:
            last = expected[-1][0] if expected else "the begin"
            place = expected[number][0] if number < len(expected) else f"after {last}"
            diff = "\n".join(ndiff(wanted, got))
            text = f"expected {line!r}, got {other!r}; expected (-), got (+):\n{diff}"
            raise AssertionError(f"{place}: {text}")


def bytes_of(text: str) -> bytes:
    """Return bytes of hexadecimal text. ``00*`` at the end means zeros up to the eighth byte."""
    data = bytes.fromhex(text.removesuffix("00*"))
    if text.endswith("00*"):
        data = data.ljust(8, b"\0")
    return data


def _padded(line: str) -> str:
    """Return an expected frame with ``00*`` replaced by zeros."""
    time, arrow, *words = line.split()
    if arrow != "->" or words[-1:] != ["00*"]:
        return line
    data = [word for word in words[:-1] if len(word) == 2]
    return " ".join([time, arrow, *words[:-1], *["00"] * (8 - len(data))])


def ms(time: int) -> str:
    if time >= 100_000 * MS:
        return f"{time // MS}"
    return f"{round(time / MS, 3):g}"


def hexadecimal(data: bytes) -> str:
    return data.hex(" ").upper()


def _with_wildcards(was: str, wanted: str) -> str:
    """Return ``was`` with each word replaced by ".." that is ".." in ``wanted``."""
    actual = was.split()
    expected = wanted.split()
    if len(actual) != len(expected) or ".." not in expected:
        return was
    words = []
    for word, pattern in zip(actual, expected, strict=True):
        words.append(".." if pattern == ".." else word)
    return " ".join(words)
