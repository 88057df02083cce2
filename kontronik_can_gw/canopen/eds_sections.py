"""The text of an EDS or DCF (CiA 306, clause 4): sections, keys, values, there and back.

Choices where CiA 306 leaves room: section and key names in any case; LF as well as CR LF; a key without a value is a key that is not there.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

_HEADING = re.compile(r"\s*\[([^\]]*)\]")
_COMMENT = re.compile(r"(?:^|\s);.*|^\s*#.*")
OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$", re.IGNORECASE)
"""The section of an object or of one of its sub-indices."""
_NUMBER = re.compile(r"-?(?:0x[0-9a-f]{1,20}|0|[1-9][0-9]{0,20})$", re.IGNORECASE)


@dataclass
class Section:
    """One section: its name as written, and by keys in lower case each key as written and its value."""

    name: str
    keys: dict[str, tuple[str, str]] = field(default_factory=dict)

    def get(self, key: str) -> str:
        return self.keys.get(key.lower(), ("", ""))[1]

    def set(self, key: str, value: object) -> None:
        self.keys[key.lower()] = key, str(value)

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
    found: dict[str, Section] = {}
    section, where = Section(""), ""
    for number, raw in enumerate(data.split(b"\n"), 1):
        if not raw.isascii():
            text = raw.decode("ascii", "backslashreplace").strip()
            problems.append(f"line {number} is not ASCII: {text}. Write it in plain letters.")
        line = raw.decode("ascii", "replace")
        if heading := _HEADING.match(line):
            section = Section(heading[1].strip())
            where = f"[{section.name}] "
            if found.setdefault(_spelling(section.name), section) is not section:
                problems.append(f"{where}this section is there twice. Remove one.")
        elif text := bare(line):
            key, equals, value = (part.strip() for part in text.partition("="))
            if not (equals and key and where):
                what = f"'{text}' is neither a section, nor key=value, nor a comment after ';'."
                problems.append(where + what)
            elif key.lower() in section.keys:
                problems.append(f"{where}{key}: this key is there twice. Remove one.")
            else:
                section.set(key, value)
    return found


def text_of(sections: Mapping[str, Section]) -> str:
    """The text of sections, without comments; lines end in CR LF."""
    lines: list[str] = []
    for section in sections.values():
        lines += [f"[{section.name}]", *(f"{key}={value}" for key, value in section.keys.values())]
        lines.append("")
    return "\r\n".join(lines)


def bare(line: str) -> str:
    """A line without comment and surrounding blanks."""
    return _COMMENT.sub("", line).strip()


def integer(text: str) -> int | None:
    """A decimal or hexadecimal number; None for any other text."""
    return int(text, 0) if _NUMBER.match(text) else None


def _spelling(name: str) -> str:
    """``1018SUB01`` is ``1018sub1``."""
    match = OBJECT.match(name)
    return f"{match[1]}sub{int(match[2], 16):x}".lower() if match and match[2] else name.lower()
