"""The text of an EDS or DCF (CiA 306, clause 4): sections, keys, values.

Choices where CiA 306 leaves room: section and key names in any case; LF as well as CR LF; a key without a value is a key that is not there.
"""

import re
from dataclasses import dataclass, field

_HEADING = re.compile(r"\s*\[([^\]]*)\]")
_COMMENT = re.compile(r"(?:^|\s);.*")
OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$", re.IGNORECASE)
"""The section of an object or of one of its sub-indices."""
_NUMBER = re.compile(r"-?(?:0x[0-9a-f]{1,20}|0|[1-9][0-9]{0,20})$", re.IGNORECASE)


@dataclass
class Section:
    """One section: its name as written, and its keys in lower case with their values."""

    name: str
    values: dict[str, str] = field(default_factory=dict)

    def get(self, key: str) -> str:
        return self.values.get(key.lower(), "")

    def said(self, key: str) -> str:
        """A key as a mistake quotes it."""
        return f"{key}={self.get(key)}"

    def number(self, key: str, otherwise: int = 0) -> int:
        """The number of a key; ``otherwise`` where it has no value. ValueError for what is no number."""
        text = self.get(key)
        found = integer(text) if text else otherwise
        if found is None:
            raise ValueError(f"{self.said(key)}: not a number. Write 0x1F or 31.")
        return found


def read_sections(data: bytes, problems: list[str]) -> dict[str, Section]:
    """The sections by their names in lower case, those of objects in one spelling. What is wrong is added to ``problems``."""
    for number, raw in enumerate(data.split(b"\n"), 1):
        if not raw.isascii():
            text = raw.decode("ascii", "backslashreplace").strip()
            problems.append(f"line {number} is not ASCII: {text}. Write it in plain letters.")
    found: dict[str, Section] = {}
    for name, lines in blocks(data.decode("ascii", "replace")):
        where = f"[{name}] " if name else ""
        section = Section(name)
        for line in lines[1:] if name else lines:
            if text := bare(line):
                key, equals, value = (part.strip() for part in text.partition("="))
                if not (equals and key and name):
                    what = f"'{text}' is neither a section, nor key=value, nor a comment after ';'."
                    problems.append(where + what)
                elif key.lower() in section.values:
                    problems.append(f"{where}{key}: this key is there twice. Remove one.")
                else:
                    section.values[key.lower()] = value
        match = OBJECT.match(name)
        sub = int(match[2], 16) if match and match[2] else None
        same = spelling(int(match[1], 16), sub) if match else name
        if found.setdefault(same.lower(), section) is not section:
            problems.append(f"{where}this section is there twice. Remove one.")
    return found


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


def pair(line: str) -> tuple[str, str]:
    """Key, in lower case, and value of a line."""
    key, _, value = bare(line).partition("=")
    return key.strip().lower(), value.strip()


def integer(text: str) -> int | None:
    """A decimal or hexadecimal number; None for any other text."""
    return int(text, 0) if _NUMBER.match(text) else None


def spelling(index: int, sub: int | None) -> str:
    """The name of the section of an object or sub-index."""
    return f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"
