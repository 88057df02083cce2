"""Dialogues in files: reading them, and playing them with a talker. The format is in dialogues/README.md."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import ndiff
from itertools import zip_longest
from pathlib import Path

MS = 1_000_000
Line = tuple[str, str]
"""Where a line of a dialogue stands, and the line."""


class Talker:
    """What dialogues are played with."""

    now = 0

    def __init__(self) -> None:
        self._lines: list[str] = []

    def pass_time(self, until: int) -> None:
        """Let time pass, ns, serving each deadline."""
        self.now = until

    def jump(self, now: int) -> None:
        """Let time pass and serve what is due once, at its end."""
        self.now = now

    def say(self, what: str) -> str:
        """Do what a line says; the line with what really is in place of what is expected."""
        raise NotImplementedError

    def hear(self, now: int, frame: str) -> None:
        """Note a frame that was sent."""
        self._lines.append(f"{ms(now)} -> {frame}".rstrip())

    def heard_lines(self) -> list[str]:
        """What was sent since the last call, "time -> ...": lines."""
        lines = self._lines
        self._lines = []
        return lines


@dataclass
class Dialogue:
    """One dialogue of a file: its name, options, and lines with their places."""

    name: str
    options: list[str]
    lines: list[Line]


def read_dialogues(path: Path) -> list[Dialogue]:
    """All dialogues of a file, tables worked in."""
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
        rows = [
            tuple(cell.strip() for cell in line.split("|")[1:])
            for _, line in block
            if line.startswith(("each", "|"))
        ]
        names, values = (rows[0], rows[1:]) if rows else ((), [()])
        lines = []
        for place, line in block:
            verb, _, rest = line.partition(" ")
            if verb == "use":
                lines += parts[rest]
            elif not line.startswith(("each", "|")):
                lines.append((place, line))
        for row in values:
            row_texts = {**texts, **dict(zip(names, row, strict=True))}
            filled = [(place, text) for place, line in lines if (text := _filled(line, row_texts))]
            found.append(
                Dialogue(
                    f"{path.stem}: {title}" + (f" [{', '.join(row)}]" if row else ""),
                    head
                    + [line.partition(" ")[2] for _, line in filled if line.startswith("with ")],
                    [(place, line) for place, line in filled if not line.startswith("with ")],
                )
            )
    return found


def _filled(line: str, texts: Mapping[str, str]) -> str:
    return re.sub(r"\{([^{}]+)\}", lambda match: texts[match[1]], line)


def play_lines(talker: Talker, lines: Sequence[Line]) -> None:
    """Say the lines at their times (none: that of the line before) and hear exactly what they expect, no more and no other."""
    expected: list[Line] = []
    actual: list[str] = []
    time = ms(talker.now)
    for place, raw in lines:
        match = re.fullmatch(r"(?:(\d+(?:\.\d+)?)\s+)?(\S.*)", raw.partition(";")[0].strip())
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
    wanted = [_padded(line) for _, line in expected]
    got = [_with_wildcards(*pair) for pair in zip(actual, wanted, strict=False)]
    got += actual[len(wanted) :]
    pairs = zip_longest(wanted, got, fillvalue="nothing")
    for at, (line, other) in enumerate(pairs):
        if line != other:
            last = expected[-1][0] if expected else "the begin"
            place = expected[at][0] if at < len(expected) else f"after {last}"
            diff = "\n".join(ndiff(wanted, got))
            text = f"expected {line!r}, got {other!r}; expected (-), got (+):\n{diff}"
            raise AssertionError(f"{place}: {text}")


def bytes_of(text: str) -> bytes:
    """Bytes in hexadecimal; ``00*`` at the end: zeros up to the eighth."""
    return bytes.fromhex(text.removesuffix("00*")).ljust(8 if text.endswith("00*") else 0, b"\0")


def _padded(line: str) -> str:
    """An expected frame with its ``00*`` written out."""
    time, arrow, *words = line.split()
    if arrow != "->" or words[-1:] != ["00*"]:
        return line
    data = [word for word in words[:-1] if len(word) == 2]
    return " ".join([time, arrow, *words[:-1], *["00"] * (8 - len(data))])


def ms(time: int) -> str:
    return f"{round(time / MS, 3):g}" if time < 100_000 * MS else f"{time // MS}"


def hexadecimal(data: bytes) -> str:
    return data.hex(" ").upper()


def _with_wildcards(was: str, wanted: str) -> str:
    """``was`` with ".." where ``wanted`` has it, and without the answer that a line does not ask for."""
    one = was.split()
    other = wanted.split()
    if len(one) != len(other) or ".." not in other:
        return was
    return " ".join(".." if b == ".." else a for a, b in zip(one, other, strict=True))
