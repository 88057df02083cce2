"""Reader of electronic data sheets (CiA 306), from which nodes are built.

A text is refused if it cannot be read, or only in several ways: limits, types and defaults that do
not fit, and duplicates. Mistakes name the file, section, key and remedy, with one mistake of each
section at once. Ignored is everything that only other readers need (lists of objects, counts,
ObjectType, [DeviceInfo]). ``check`` decides whether a node can be built from the entries.

Files of usual Windows editors are accepted: with a byte order mark, with letters beyond ASCII in
names and comments, with CR as line end, and with a trailing Ctrl-Z. Such letters are replaced by
ASCII ones. 1021h returns the file unchanged.

CiA 306 leaves room for these choices:

* Section and key names may be in any case.
* Lines may end in LF, CR or CR LF.
* A key without a value counts as absent.
* An object has sub-indices if it has sections for them, else it is a variable.
* Section names that CiA 306 does not define are ignored.
* Types of 24, 40, 48 and 56 bits, and times, are refused.
"""

import codecs
import re
import struct
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from kontronik_can_gw.errors import UserError

# --- data types of CiA 301 (table 44) that are supported

BOOLEAN = 0x01
U8 = 0x05
U16 = 0x06
U32 = 0x07
REAL32 = 0x08
VISIBLE_STRING = 0x09
OCTET_STRING = 0x0A
UNICODE_STRING = 0x0B
DOMAIN_TYPE = 0x0F
REAL64 = 0x11
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
"""Name and struct code of each type. The code is empty for texts and domains."""
TYPE_NAMES = {code: name for code, (name, _) in _TYPES.items()}
_SIGNED_FORMS = ("b", "h", "i", "q")
SIGNED = frozenset(code for code, (_, form) in _TYPES.items() if form in _SIGNED_FORMS)
FLOATS = frozenset({REAL32, REAL64})
CODECS = {
    code: struct.Struct(f"<{form}")  # little endian
    for code, (_, form) in _TYPES.items()
    if form
}
"""Codecs of the number types."""
TYPE_BITS = {code: 8 * codec.size for code, codec in CODECS.items()} | {BOOLEAN: 1}
"""Numbers of bits of the number types."""
WHOLE = TYPE_BITS.keys() - FLOATS - {BOOLEAN}
"""The types of whole numbers."""


def range_of(data_type: int) -> tuple[int, int]:
    """Return the lowest and highest value of a whole-number type or BOOLEAN."""
    bits = TYPE_BITS.get(data_type, 0)
    if data_type in SIGNED:
        half = 1 << bits - 1
        return -half, half - 1
    return 0, (1 << bits) - 1


# --- decoding of texts, which Windows editors may have written

_CTRL_Z = re.compile(r"[\s\x1a]*\x1a[\s\0\x1a]*\Z")
"""End of a file as DOS editors mark it, with or without the padding of a block."""
_PLAIN_LETTERS = {"\u00b5": "u", "\u03bc": "u", "\u00b0": "deg", "\u00df": "ss"}


def decode_text(data: bytes) -> str:
    """Return the text of an EDS with LF as line end.

    The text is UTF-16 with a byte order mark, UTF-8, or else Windows-1252.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = data.decode("utf-16", "replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("cp1252", "replace")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return _CTRL_Z.sub("", text)


def to_ascii(text: str) -> str:
    """Return the text with letters beyond ASCII replaced by the nearest ones, or by "?"."""
    if text.isascii():
        return text
    for letter, plain in _PLAIN_LETTERS.items():
        text = text.replace(letter, plain)
    parts = unicodedata.normalize("NFKD", text)
    bare_letters = "".join(each for each in parts if not unicodedata.combining(each))
    return bare_letters.encode("ascii", "replace").decode("ascii")


# --- reading and writing of sections, keys and values (CiA 306, clause 4)

_HEADING = re.compile(r"\s*\[([^\]]*)\]")
_COMMENT = re.compile(r"(?:^|\s);.*|^\s*#.*")
OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$", re.IGNORECASE)
"""Name of the section of an object or of one of its sub-indices."""
_EXACT_KEYS = frozenset({"defaultvalue", "parametervalue"})
"""Keys whose values nodes send, so that no letter may be replaced."""
_NUMBER = re.compile(r"-?(?:0x[0-9a-f]{1,20}|0|[1-9][0-9]{0,20})$", re.IGNORECASE)


@dataclass
class Section:
    """One section with its name as written.

    ``keys`` maps each key in lower case to the key as written and its value.
    """

    name: str
    keys: dict[str, tuple[str, str]] = field(default_factory=dict)

    def get(self, key: str) -> str:
        _, value = self.keys.get(key.lower(), ("", ""))
        return value

    def set(self, key: str, value: object) -> None:
        self.keys[key.lower()] = (key, str(value))

    def quoted(self, key: str) -> str:
        """Return a key with its value, to be quoted in a mistake."""
        return f"{key}={self.get(key)}"

    def number(self, key: str, otherwise: int = 0) -> int:
        """Return the number of a key, or ``otherwise`` without a value.

        ValueError if the value is not a number.
        """
        return self.number_of(key, self.get(key) or str(otherwise))

    def number_of(self, key: str, text: str) -> int:
        """Return the number of a text that is a part of a key's value. ValueError if it is none."""
        number = integer(text)
        if number is None:
            raise ValueError(f"{self.quoted(key)}: not a number. Use the form 0x1F or 31.")
        return number


def read_sections(data: bytes, problems: list[str]) -> dict[str, Section]:
    """Return the sections by name in lower case, with one spelling for each object.

    Mistakes are added to ``problems``.
    """
    sections: dict[str, Section] = {}
    section = Section("")
    where = ""
    for line in decode_text(data).split("\n"):
        heading = _HEADING.match(line)
        if heading:
            section = Section(to_ascii(heading[1].strip()))
            where = f"[{section.name}] "
            if sections.setdefault(_spelling(section.name), section) is not section:
                problems.append(f"{where}this section occurs twice. Remove one.")
            continue
        text = bare(line)
        if text:
            problems += [where + problem for problem in _read_key(section, text, bool(where))]
    return sections


def _read_key(
    section: Section,
    text: str,
    has_heading: bool,
) -> Iterator[str]:
    """Add a line ``key=value`` to its section, and yield its mistakes."""
    key, equals, value = (part.strip() for part in text.partition("="))
    if not value.isascii():
        if key.lower() in _EXACT_KEYS:
            yield f"{_quoted(text)} has characters outside ASCII. Use ASCII only."
        value = to_ascii(value)
    if not (equals and key and has_heading):
        yield f"'{_quoted(text)}' is neither a section, nor key=value, nor a comment after ';'."
    elif key.lower() in section.keys:
        yield f"{_quoted(key)}: this key occurs twice. Remove one."
    else:
        section.set(key, value)


def _quoted(text: str) -> str:
    """Return a text of the file in ASCII, to be quoted in a mistake."""
    return text.encode("ascii", "backslashreplace").decode("ascii")


def text_of(sections: Mapping[str, Section]) -> str:
    """Return the text of sections, without comments. Lines end in CR LF."""
    lines: list[str] = []
    for section in sections.values():
        lines.append(f"[{section.name}]")
        lines += [f"{key}={value}" for key, value in section.keys.values()]
        lines.append("")
    return "\r\n".join(lines)


def bare(line: str) -> str:
    """Return a line without its comment and surrounding blanks."""
    return _COMMENT.sub("", line).strip()


def integer(text: str) -> int | None:
    """Return a decimal or hexadecimal number. None for any other text."""
    return int(text, 0) if _NUMBER.match(text) else None


def _spelling(name: str) -> str:
    """Return the one spelling of a section name: ``1018sub1`` for ``1018SUB01``."""
    match = OBJECT.match(name)
    if match is None or match[2] is None:
        return name.lower()
    return f"{match[1]}sub{int(match[2], 16):x}".lower()


# --- entries

MAX_BYTES = 2_000_000
"""Maximum size of an EDS. The shipped one has 60 kB, 250 entries and 2 200 lines."""
_MAX_PROBLEMS = 20
_MAX_LENGTH = 500
"""Maximum number of characters of a mistake, which quotes the file."""
_DOMAIN_OBJECT = 2
"""ObjectType of a domain."""
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_NODE_ID = re.compile(
    r"\$NODEID(?:\+(?P<after>[^+]+))?$|(?P<before>[^+]+)\+\$NODEID$", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class EdsEntry:
    """One entry of the object dictionary, as the EDS describes it.

    ``access`` is ro, wo, rw, rwr, rww or const. ``default`` is an int, a float, or bytes for texts
    and domains. If ``is_relative``, the node-ID must be added to it.
    """

    index: int
    sub: int
    name: str
    data_type: int
    access: str
    is_mappable: bool
    low: int | None
    high: int | None
    default: int | float | bytes | None
    is_relative: bool

    @property
    def place(self) -> str:
        return f"{self.index:04X}h:{self.sub:02X}"


@dataclass(frozen=True)
class Eds:
    """A parsed EDS. ``data`` is the unchanged file."""

    data: bytes
    name: str
    entries: tuple[EdsEntry, ...]
    """All entries, ordered by index and sub-index."""
    object_names: dict[int, str]


def load(data: bytes, name: str) -> Eds:
    """Return a parsed EDS.

    UserError with the mistakes: file, section, key, reason and remedy.
    """
    known = ("[fileinfo]", "[deviceinfo]", "[mandatoryobjects]")
    text = decode_text(data[: MAX_BYTES + 1]).lower()
    if not any(section in text for section in known):
        raise UserError(
            f"{name}: is not an EDS: "
            "it has no section [FileInfo], [DeviceInfo] or [MandatoryObjects]."
        )
    if len(data) > MAX_BYTES:
        raise UserError(f"{name}: is larger than {MAX_BYTES // 1_000_000} MB. Is it an EDS?")
    problems: list[str] = []
    sections = read_sections(data, problems)
    entries: list[EdsEntry] = []
    object_names: dict[int, str] = {}
    for index, sub, section in _entry_sections(sections, problems):
        try:
            entries.append(_entry(section, index, sub))
        except ValueError as error:
            problems.append(f"[{section.name}] {error}")
        object_names[index] = sections[f"{index:04x}"].get("ParameterName")
    if problems:
        lines = [f"{name}: {_cut(problem)}" for problem in problems[:_MAX_PROBLEMS]]
        more = len(problems) - _MAX_PROBLEMS
        if more > 0:
            lines.append(f"{name}: and {more} more mistakes.")
        raise UserError(*lines)
    return Eds(data, name, tuple(entries), object_names)


def _cut(text: str) -> str:
    """Return a mistake without its middle if it is long.

    The reason and the remedy are at its ends.
    """
    if len(text) <= _MAX_LENGTH:
        return text
    half = _MAX_LENGTH // 2
    return f"{text[:half]} ... {text[-half:]}"


def _entry_sections(
    sections: Mapping[str, Section], problems: list[str]
) -> Iterator[tuple[int, int, Section]]:
    """Yield index, sub-index and section of each entry, and add mistakes to ``problems``."""
    if "devicecomissioning" in sections:
        problem = "this is a DCF, the file of one node. Use the EDS from which it was made."
        problems.append(f"[DeviceComissioning] {problem}")
    device_info = sections.get("deviceinfo", Section(""))
    if _is_set(device_info, "CompactPDO"):
        problem = "not supported. Describe each PDO in its own sections and set this to 0."
        problems.append(f"[DeviceInfo] CompactPDO: {problem}")
    for index, subs in sorted(_objects(sections).items()):
        head = sections.get(f"{index:04x}")
        if head is None:
            problem = f"there is no section [{index:04X}]. Add it or remove this one."
            problems += [f"[{section.name}] {problem}" for section in subs.values()]
        elif _is_set(head, "CompactSubObj"):
            problem = (
                "CompactSubObj: not supported. "
                "Let the EDS editor expand it into a section for each sub-index."
            )
            problems.append(f"[{head.name}] {problem}")
        else:
            members = subs or {0: head}
            for sub, section in sorted(members.items()):
                yield index, sub, section


def _is_set(section: Section, key: str) -> bool:
    """Return True unless the key is absent or 0."""
    return integer(section.get(key) or "0") != 0


def _objects(sections: Mapping[str, Section]) -> dict[int, dict[int, Section]]:
    """Return the sections of sub-indices of each object by index and sub-index."""
    objects: dict[int, dict[int, Section]] = {}
    for section in sections.values():
        match = OBJECT.match(section.name)
        if match is None:
            continue
        subs = objects.setdefault(int(match[1], 16), {})
        if match[2] is not None:
            subs[int(match[2], 16)] = section
    return objects


def _entry(section: Section, index: int, sub: int) -> EdsEntry:
    """Return the entry of a section. ValueError for a mistake."""
    is_domain = section.number("ObjectType") == _DOMAIN_OBJECT
    data_type = section.number("DataType", DOMAIN_TYPE if is_domain else 0)
    if data_type not in TYPE_NAMES:
        known = ", ".join(f"0x{code:X} {name}" for code, name in TYPE_NAMES.items())
        raise ValueError(f"{section.quoted('DataType')}: not supported. Use one of {known}.")
    access = section.get("AccessType").lower() or ("rw" if is_domain else "")
    if access not in _ACCESS:
        raise ValueError(f"{section.quoted('AccessType')}: not one of {', '.join(_ACCESS)}.")
    low = _limit(section, "LowLimit", data_type)
    high = _limit(section, "HighLimit", data_type)
    default, is_relative = _default(section, data_type)
    if isinstance(default, int) and not is_relative:
        _check_limits(section, default, low, high)
    return EdsEntry(
        index=index,
        sub=sub,
        name=section.get("ParameterName"),
        data_type=data_type,
        access=access,
        is_mappable=bool(section.number("PDOMapping")),
        low=low,
        high=high,
        default=default,
        is_relative=is_relative,
    )


def _check_limits(section: Section, default: int, low: int | None, high: int | None) -> None:
    """Raise ValueError for a default beyond its limits."""
    if low is not None and default < low:
        raise ValueError(f"{section.quoted('DefaultValue')}: below {section.quoted('LowLimit')}.")
    if high is not None and default > high:
        raise ValueError(f"{section.quoted('DefaultValue')}: above {section.quoted('HighLimit')}.")


def _limit(section: Section, key: str, data_type: int) -> int | None:
    """Return a limit, or None without a value. ValueError for a mistake."""
    text = section.get(key)
    if not text:
        return None
    if data_type not in WHOLE | {BOOLEAN}:
        raise ValueError(f"{key}={text}: only whole numbers have limits. Leave it empty.")
    return _fitting(section, key, text, data_type)


def _fitting(
    section: Section,
    key: str,
    text: str,
    data_type: int,
    room: int = 0,
) -> int:
    """Return a whole number that fits its type with ``room`` above it.

    Signed numbers may be hexadecimal in two's complement. ValueError for a mistake.
    """
    number = section.number_of(key, text)
    low, high = range_of(data_type)
    is_hexadecimal = "x" in text.lower()
    if data_type in SIGNED and is_hexadecimal and high < number <= high - low:
        number -= high - low + 1
    if not low <= number <= high - room:
        of_type = f"{TYPE_NAMES[data_type]}, {low} to {high}"
        raise ValueError(f"{section.quoted(key)}: does not fit {of_type}.")
    return number


def _default(
    section: Section,
    data_type: int,
) -> tuple[int | float | bytes | None, bool]:
    """Return the default, and True if the node-ID must be added to it."""
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
            problem = "not bytes. Write pairs of hexadecimal digits, or leave it empty."
            raise ValueError(f"DefaultValue={text}: {problem}") from None
    if data_type in FLOATS:
        return _real(text, data_type), False
    match = _NODE_ID.match(text.replace(" ", ""))
    if match:
        value = match["after"] or match["before"] or "0"
        default = _fitting(section, "DefaultValue", value, data_type, room=127)
        return default, True
    return _fitting(section, "DefaultValue", text, data_type), False


def _real(text: str, data_type: int) -> float:
    """Return a real number, written as a decimal or as the hexadecimal bits of CiA 306."""
    codec = CODECS[data_type]
    try:
        if "x" not in text.lower():
            return float(text)
        number: float
        data = int(text, 16).to_bytes(codec.size, "little")
        (number,) = codec.unpack(data)
        return number
    except (ValueError, OverflowError):
        raise ValueError(f"DefaultValue={text}: not a number. Use the form 1.5.") from None
