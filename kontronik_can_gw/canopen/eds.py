"""Electronic data sheets of CiA 306: what a node is built from. Text in, entries out.

Refused is what cannot be read, or only in several ways: limits, types, defaults that do not fit, what stands there twice; by file, section,
key and remedy, one mistake of each section at once. What concerns other readers of the file only (lists of objects, counts, ObjectType,
[DeviceInfo]) is not looked at. ``check`` judges whether a node can be built from the entries.

Files of usual Windows editors are read too: with a byte order mark, with letters beyond ASCII in names and comments, with CR as line end,
with a trailing Ctrl-Z. Such letters are replaced by ASCII ones; 1021h has the file as it is.

Choices where CiA 306 leaves room: section and key names in any case; LF and CR as well as CR LF; a key without a value is a key that is not
there; an object has sub-indices where it has sections of them, else it is a variable; section names that it does not know are ignored.
Types of 24, 40, 48 and 56 bits and times are refused.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from kontronik_can_gw.canopen.eds_text import decode_text, to_ascii
from kontronik_can_gw.errors import UserError

# --- data types of CiA 301 (table 44) that the object dictionary can have

BOOLEAN = 0x01
U8, U16, U32 = 0x05, 0x06, 0x07
VISIBLE_STRING, OCTET_STRING, UNICODE_STRING, DOMAIN_TYPE = 0x09, 0x0A, 0x0B, 0x0F
REAL32, REAL64 = 0x08, 0x11
_TYPES = {
    BOOLEAN: ("BOOLEAN", "?"),
    0x02: ("INTEGER8", "b"),
    0x03: ("INTEGER16", "h"),
    0x04: ("INTEGER32", "i"),
    U8: ("UNSIGNED8", "B"),
    U16: ("UNSIGNED16", "H"),
    U32: ("UNSIGNED32", "I"),
    REAL32: ("REAL32", "f"),
    VISIBLE_STRING: ("VISIBLE_STRING", ""),
    OCTET_STRING: ("OCTET_STRING", ""),
    UNICODE_STRING: ("UNICODE_STRING", ""),
    DOMAIN_TYPE: ("DOMAIN", ""),
    REAL64: ("REAL64", "d"),
    0x15: ("INTEGER64", "q"),
    0x1B: ("UNSIGNED64", "Q"),
}
"""Name, and of a number its struct code."""
TYPE_NAMES = {code: name for code, (name, _) in _TYPES.items()}
SIGNED = frozenset(code for code, (_, form) in _TYPES.items() if form and form in "bhiq")
FLOATS = frozenset({REAL32, REAL64})
CODECS = {code: struct.Struct(f"<{form}") for code, (_, form) in _TYPES.items() if form}
"""Of the number types, by their codes."""
TYPE_BITS = {code: 8 * found.size for code, found in CODECS.items()} | {BOOLEAN: 1}
"""Bits of a number type."""
WHOLE = TYPE_BITS.keys() - FLOATS - {BOOLEAN}
"""The types of whole numbers."""


def range_of(data_type: int) -> tuple[int, int]:
    """Smallest and greatest value of a type of whole numbers, or BOOLEAN."""
    bits = TYPE_BITS.get(data_type, 0)
    if data_type in SIGNED:
        return -(1 << bits - 1), (1 << bits - 1) - 1
    return 0, (1 << bits) - 1


# --- the text: sections, keys, values, there and back (CiA 306, clause 4)

_HEADING = re.compile(r"\s*\[([^\]]*)\]")
_COMMENT = re.compile(r"(?:^|\s);.*|^\s*#.*")
OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$", re.IGNORECASE)
"""The section of an object or of one of its sub-indices."""
_EXACT_KEYS = frozenset({"defaultvalue", "parametervalue"})
"""Keys whose values nodes send: no letter of them may be replaced."""
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
    for line in decode_text(data).split("\n"):
        if heading := _HEADING.match(line):
            section = Section(to_ascii(heading[1].strip()))
            where = f"[{section.name}] "
            if found.setdefault(_spelling(section.name), section) is not section:
                problems.append(f"{where}this section is there twice. Remove one.")
        elif text := bare(line):
            key, equals, value = (part.strip() for part in text.partition("="))
            if not value.isascii():
                if key.lower() in _EXACT_KEYS:
                    what = f"{_quoted(text)} has letters beyond ASCII. Write it in plain letters."
                    problems.append(where + what)
                value = to_ascii(value)
            if not (equals and key and where):
                what = f"'{_quoted(text)}' is neither a section, nor key=value, nor a comment after ';'."
                problems.append(where + what)
            elif key.lower() in section.keys:
                problems.append(f"{where}{_quoted(key)}: this key is there twice. Remove one.")
            else:
                section.set(key, value)
    return found


def _quoted(text: str) -> str:
    """A text of the file as a mistake quotes it."""
    return text.encode("ascii", "backslashreplace").decode("ascii")


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


# --- entries

MAX_BYTES = 2_000_000
"""Of an EDS; the shipped one has 60 kB, 250 entries, 2 200 lines."""
_MAX_PROBLEMS = 20
_MAX_SAID = 500
"""Characters of a mistake: it quotes the file."""
_DOMAIN_OBJECT = 2
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_NODE_ID = re.compile(
    r"\$NODEID(?:\+(?P<after>[^+]+))?$|(?P<before>[^+]+)\+\$NODEID$", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of the object dictionary, as the EDS describes it.

    ``access`` is ro, wo, rw, rwr, rww or const. ``default`` is an int, a float, or bytes for texts and domains; with ``relative`` the
    node-ID is still to be added to it.
    """

    index: int
    sub: int
    name: str
    data_type: int
    access: str
    mappable: bool
    low: int | None
    high: int | None
    default: int | float | bytes | None
    relative: bool

    @property
    def place(self) -> str:
        return f"{self.index:04X}h:{self.sub:02X}"


@dataclass(frozen=True)
class Eds:
    """What was read of an EDS. ``data`` are the bytes as given, ``entries`` are in the order of index and sub-index."""

    data: bytes
    name: str
    entries: tuple[Entry, ...]
    object_names: dict[int, str]


def load(data: bytes, name: str) -> Eds:
    """Read an EDS by CiA 306. UserError with the mistakes: file, section, key, what is wrong and what to do."""
    known = ("[fileinfo]", "[deviceinfo]", "[mandatoryobjects]")
    text = decode_text(data[: MAX_BYTES + 1]).lower()
    if not any(section in text for section in known):
        raise UserError(
            f"{name}: is no EDS: it has none of the sections [FileInfo], [DeviceInfo], [MandatoryObjects]."
        )
    if len(data) > MAX_BYTES:
        raise UserError(f"{name}: is larger than {MAX_BYTES // 1_000_000} MB. Is it an EDS?")
    problems: list[str] = []
    sections = read_sections(data, problems)
    entries, names = [], {}
    for index, sub, section in _entry_sections(sections, problems):
        try:
            entries.append(_entry(section, index, sub))
        except ValueError as error:
            problems.append(f"[{section.name}] {error}")
        names[index] = sections[f"{index:04x}"].get("ParameterName")
    if problems:
        more = len(problems) - _MAX_PROBLEMS
        rest = [f"{name}: and {more} more mistakes."] if more > 0 else []
        raise UserError(*(f"{name}: {_cut(text)}" for text in problems[:_MAX_PROBLEMS]), *rest)
    return Eds(data, name, tuple(entries), names)


def _cut(text: str) -> str:
    """A mistake without its middle, if it is long: what is wrong and the remedy stand at its ends."""
    half = _MAX_SAID // 2
    return text if len(text) <= _MAX_SAID else f"{text[:half]} ... {text[-half:]}"


def _entry_sections(
    sections: Mapping[str, Section], problems: list[str]
) -> Iterator[tuple[int, int, Section]]:
    """Index, sub-index and section of each entry."""
    if "devicecomissioning" in sections:
        what = "this is a DCF, the file of one node. Give the EDS it was made from."
        problems.append(f"[DeviceComissioning] {what}")
    if integer(sections.get("deviceinfo", Section("")).get("CompactPDO") or "0") != 0:
        what = "not supported. Describe each PDO by its own sections and write 0."
        problems.append(f"[DeviceInfo] CompactPDO: {what}")
    members: dict[int, dict[int, Section]] = {}
    for section in sections.values():
        if match := OBJECT.match(section.name):
            of_object = members.setdefault(int(match[1], 16), {})
            if match[2] is not None:
                of_object[int(match[2], 16)] = section
    for index, subs in sorted(members.items()):
        head = sections.get(f"{index:04x}")
        if head is None:
            what = f"there is no section [{index:04X}]. Add it or remove this one."
            problems += [f"[{section.name}] {what}" for section in subs.values()]
        elif integer(head.get("CompactSubObj") or "0") != 0:
            what = "CompactSubObj: not supported. Let the EDS editor expand it, a section for each sub-index."
            problems.append(f"[{head.name}] {what}")
        else:
            for sub, section in sorted((subs or {0: head}).items()):
                yield index, sub, section


def _entry(section: Section, index: int, sub: int) -> Entry:
    """ValueError for what is wrong."""
    is_domain = section.number("ObjectType") == _DOMAIN_OBJECT
    data_type = section.number("DataType", DOMAIN_TYPE if is_domain else 0)
    if data_type not in TYPE_NAMES:
        known = ", ".join(f"0x{code:X} {name}" for code, name in TYPE_NAMES.items())
        raise ValueError(f"{section.said('DataType')}: not supported. Take one of {known}.")
    access = section.get("AccessType").lower() or ("rw" if is_domain else "")
    if access not in _ACCESS:
        raise ValueError(f"{section.said('AccessType')}: not one of {', '.join(_ACCESS)}.")
    low, high = _limit(section, "LowLimit", data_type), _limit(section, "HighLimit", data_type)
    default, relative = _default(section, data_type)
    if isinstance(default, int) and not relative:
        if low is not None and default < low:
            raise ValueError(f"{section.said('DefaultValue')}: below {section.said('LowLimit')}.")
        if high is not None and default > high:
            raise ValueError(f"{section.said('DefaultValue')}: above {section.said('HighLimit')}.")
    mappable = bool(section.number("PDOMapping"))
    about = section.get("ParameterName"), data_type, access, mappable
    return Entry(index, sub, *about, low, high, default, relative)


def _limit(section: Section, key: str, data_type: int) -> int | None:
    text = section.get(key)
    if not text:
        return None
    if data_type not in WHOLE | {BOOLEAN}:
        raise ValueError(f"{key}={text}: only whole numbers have limits. Leave it empty.")
    return _fitting(section, key, text, data_type)


def _fitting(section: Section, key: str, text: str, data_type: int, room: int = 0) -> int:
    """A whole number that fits its type with ``room`` above it. Signed ones may be hexadecimal in two's complement."""
    number = integer(text)
    if number is None:
        raise ValueError(f"{section.said(key)}: not a number. Write 0x1F or 31.")
    low, high = range_of(data_type)
    if data_type in SIGNED and "x" in text.lower() and high < number <= high - low:
        number -= high - low + 1
    if not low <= number <= high - room:
        of_type = f"{TYPE_NAMES[data_type]}, {low} to {high}"
        raise ValueError(f"{section.said(key)}: does not fit {of_type}.")
    return number


def _default(section: Section, data_type: int) -> tuple[int | float | bytes | None, bool]:
    """The default, and whether the node-ID is to be added to it."""
    text = section.get("DefaultValue")
    if not text:
        return None, False
    if data_type in (VISIBLE_STRING, UNICODE_STRING):
        coding = "utf-16-le" if data_type == UNICODE_STRING else "ascii"
        return text.encode(coding, "replace"), False
    if data_type in (OCTET_STRING, DOMAIN_TYPE):
        try:
            return bytes.fromhex(text), False
        except ValueError:
            what = "not bytes. Write pairs of hexadecimal digits, or nothing."
            raise ValueError(f"DefaultValue={text}: {what}") from None
    if data_type in FLOATS:
        return _real(text, data_type), False
    if match := _NODE_ID.match(text.replace(" ", "")):
        value = match["after"] or match["before"] or "0"
        return _fitting(section, "DefaultValue", value, data_type, room=127), True
    return _fitting(section, "DefaultValue", text, data_type), False


def _real(text: str, data_type: int) -> float:
    """A decimal, or the hexadecimal bits of the IEEE number that CiA 306 writes."""
    codec = CODECS[data_type]
    try:
        if "x" not in text.lower():
            return float(text)
        number: float = codec.unpack(int(text, 16).to_bytes(codec.size, "little"))[0]
        return number
    except (ValueError, OverflowError):
        raise ValueError(f"DefaultValue={text}: not a number. Write 1.5.") from None
