"""The text of an EDS or DCF (CiA 306, clause 4): sections, keys, values, and what is wrong with them.

Choices where CiA 306 leaves room: section and key names in any case; LF as well as CR LF; a key without a value is a key that is not there.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

_MAX_SAID = 400
"""Characters of a mistake: it quotes the file."""

_HEADING = re.compile(r"\s*\[([^\]]*)\]")
_COMMENT = re.compile(r"(?:^|\s);.*")
OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$", re.IGNORECASE)
"""The section of an object or of one of its sub-indices."""
_NUMBER = re.compile(r"-?(?:0x[0-9a-f]{1,20}|0|[1-9][0-9]{0,20})$", re.IGNORECASE)


class Problems:
    """The mistakes of one file, each by section and key."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.found: list[str] = []

    def add(self, section: str, text: str) -> None:
        section = section[:_MAX_SAID]
        if len(text) > _MAX_SAID:  # what is wrong and the remedy stand at its ends
            text = f"{text[: _MAX_SAID // 2]} ... {text[-_MAX_SAID // 2 :]}"
        self.found.append(f"{self.file}: [{section}] {text}" if section else f"{self.file}: {text}")


@dataclass
class Section:
    """One section: its name as written, and its keys in lower case with their values."""

    name: str
    problems: Problems
    values: dict[str, str] = field(default_factory=dict)

    def get(self, key: str) -> str:
        return self.values.get(key.lower(), "")

    def said(self, key: str) -> str:
        """A key as a mistake quotes it."""
        return f"{key}={self.get(key)}"

    def wrong(self, text: str) -> None:
        """Report a mistake."""
        self.problems.add(self.name, text)

    def number(self, key: str, otherwise: int | None = None) -> int | None:
        """The number of a key; ``otherwise`` where it has no value; None, after a complaint, where that is no number."""
        text = self.get(key)
        if not text:
            return otherwise
        number = integer(text)
        if number is None:
            self.wrong(f"{key}={text}: not a number. Write 0x1F or 31.")
        return number


def read_sections(data: bytes, problems: Problems) -> dict[str, Section]:
    """The sections by their names in lower case, those of objects in one spelling."""
    for number, raw in enumerate(data.split(b"\n"), 1):
        if not raw.isascii():
            text = raw.decode("ascii", "backslashreplace").strip()
            problems.add("", f"line {number} is not ASCII: {text}. Write it in plain letters.")
    found: dict[str, Section] = {}
    for name, lines in blocks(data.decode("ascii", "replace")):
        section = Section(name, problems)
        for line in lines[1:] if name else lines:
            _read_line(section, line)
        if not name:
            continue
        match = OBJECT.match(name)
        same = (
            spelling(int(match[1], 16), int(match[2], 16) if match[2] else None) if match else name
        )
        if same.lower() in found:
            section.wrong("this section is there twice. Remove one.")
        else:
            found[same.lower()] = section
    return found


def _read_line(section: Section, line: str) -> None:
    text = bare(line)
    if not text:
        return
    key, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not key or not section.name:
        section.wrong(f"'{text}' is neither a section, nor key=value, nor a comment after ';'.")
    elif key.lower() in section.values:
        section.wrong(f"{key}: this key is there twice. Remove one.")
    else:
        section.values[key.lower()] = value


def blocks(text: str) -> list[tuple[str, list[str]]]:
    """Section names, each with its lines from the heading on; first "" with the lines before all sections."""
    blocks: list[tuple[str, list[str]]] = [("", [])]
    for line in text.replace("\r\n", "\n").split("\n"):
        if match := _HEADING.match(line):
            blocks.append((match[1].strip(), []))
        blocks[-1][1].append(line)
    return blocks


def bare(line: str) -> str:
    """A line without comment and surrounding blanks."""
    return "" if line.lstrip().startswith("#") else _COMMENT.sub("", line).strip()


def key(line: str) -> str:
    """The key of a line, in lower case."""
    return bare(line).partition("=")[0].strip().lower()


def value(line: str) -> str:
    """The value of a line."""
    return bare(line).partition("=")[2].strip()


def integer(text: str) -> int | None:
    """A decimal or hexadecimal number; None for any other text."""
    return int(text, 0) if _NUMBER.match(text) else None


def spelling(index: int, sub: int | None) -> str:
    """The name of the section of an object or sub-index."""
    return f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"


def choices(names: Mapping[int, str]) -> str:
    """What a number can be, for a message."""
    return ", ".join(f"0x{code:X} {name}" for code, name in names.items())
