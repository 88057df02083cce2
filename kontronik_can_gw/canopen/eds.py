"""Electronic data sheets of CiA 306: reading with every check, writing a DCF, dropping objects. Text in, objects or text out.

Refusals name file, section, key and remedy, all at once.

Choices where CiA 306 leaves room: section and key names in any case; LF as well as CR LF; a key without a value is a key that is not there;
section names that CiA 306 does not know are passed over. Types of 24, 40, 48 and 56 bits and times are refused; 64-bit types are plain
storage, so they are taken from 2000h on only.
"""

import codecs
import re
import struct
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import PurePath

from kontronik_can_gw.errors import UserError

DOMAIN, VAR, ARRAY, RECORD = 2, 7, 8, 9
"""Object codes (CiA 301, table 42)."""

_U8, _U16, _U32 = 0x05, 0x06, 0x07
_VISIBLE_STRING, _OCTET_STRING, _UNICODE_STRING, _DOMAIN_TYPE = 0x09, 0x0A, 0x0B, 0x0F
_FLOATS = (0x08, 0x11)
_SIGNED = (0x02, 0x03, 0x04, 0x15)
_BITS = {
    0x01: 1,
    0x02: 8,
    0x03: 16,
    0x04: 32,
    _U8: 8,
    _U16: 16,
    _U32: 32,
    0x08: 32,
    0x11: 64,
    0x15: 64,
    0x1B: 64,
}
_TYPE_NAMES = {
    0x01: "BOOLEAN",
    0x02: "INTEGER8",
    0x03: "INTEGER16",
    0x04: "INTEGER32",
    _U8: "UNSIGNED8",
    _U16: "UNSIGNED16",
    _U32: "UNSIGNED32",
    0x08: "REAL32",
    _VISIBLE_STRING: "VISIBLE_STRING",
    _OCTET_STRING: "OCTET_STRING",
    _UNICODE_STRING: "UNICODE_STRING",
    _DOMAIN_TYPE: "DOMAIN",
    0x11: "REAL64",
    0x15: "INTEGER64",
    0x1B: "UNSIGNED64",
}
_KINDS = {DOMAIN: "DOMAIN", VAR: "VAR", ARRAY: "ARRAY", RECORD: "RECORD"}
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
_MANDATORY = (0x1000, 0x1001, 0x1018)
_LONGEST_NAME = 241
MAX_BYTES = 2_000_000
"""Of an EDS; the shipped one has 60 kB, 250 entries, 2 200 lines."""
_MAX_LINES = 100_000
_MAX_ENTRIES = 10_000
_MAX_MAPPED = 0x40
_MAX_SAID = 400
"""Characters of a mistake: it quotes the file."""
_MAX_PROBLEMS = 20
_PDO_BITS = 64

_HEADING = re.compile(r"\s*\[([^\]]*)\]")
_COMMENT = re.compile(r"(?:^|\s);.*")
_OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?$", re.IGNORECASE)
_OF_OBJECT = re.compile(
    r"([0-9a-f]{4})(sub[0-9a-f]+|name|value|denotation|objectlinks)?$", re.IGNORECASE
)
_NUMBER = re.compile(r"-?(?:0x[0-9a-f]{1,20}|0|[1-9][0-9]{0,20})$", re.IGNORECASE)
_NODE_ID = re.compile(
    r"\$NODEID(?:\+(?P<after>[^+]+))?$|(?P<before>[^+]+)\+\$NODEID$", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of the object dictionary, as the EDS describes it.

    ``access`` is ro, wo, rw, rwr, rww or const. ``default`` is an int, a float, or bytes for texts and domains; with ``relative`` the
    node-ID is still to be added to it. ``object_type``: DOMAIN, VAR, ARRAY or RECORD, of the object it belongs to.
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
    object_type: int


@dataclass(frozen=True)
class DeviceInfo:
    """The numbers of [DeviceInfo]; ``bit_rates`` in bit/s."""

    vendor_number: int
    product_number: int
    revision_number: int
    bit_rates: tuple[int, ...]
    tx_pdos: int
    rx_pdos: int
    lss: bool


@dataclass(frozen=True)
class Eds:
    """A checked EDS. ``data`` are the bytes as given, ``entries`` are in the order of index and sub-index."""

    data: bytes
    name: str
    entries: tuple[Entry, ...]
    object_names: dict[int, str]
    device: DeviceInfo


@dataclass(frozen=True)
class _Shape:
    """What CiA 301 and 302 ask of a communication object: object codes, types by sub-index, sub-indices it cannot be without."""

    kinds: tuple[int, ...]
    types: Mapping[int, tuple[int, ...]]
    needed: tuple[int, ...] = ()


def _var(*types: int) -> _Shape:
    return _Shape((VAR,), {0: types})


def _list(kind: int, data_type: int, last: int, *needed: int) -> _Shape:
    return _Shape((kind,), {0: (_U8,)} | dict.fromkeys(range(1, last + 1), (data_type,)), needed)


_COMMUNICATION: Mapping[int, _Shape] = {
    0x1000: _var(_U32),
    0x1001: _var(_U8),
    0x1002: _var(_U32),
    0x1003: _list(ARRAY, _U32, 0xFE, 1),
    0x1005: _var(_U32),
    0x1008: _var(_VISIBLE_STRING),
    0x1009: _var(_VISIBLE_STRING),
    0x100A: _var(_VISIBLE_STRING),
    0x1010: _list(ARRAY, _U32, 0x7F, 1),
    0x1011: _list(ARRAY, _U32, 0x7F, 1),
    0x1014: _var(_U32),
    0x1015: _var(_U16),
    0x1016: _list(ARRAY, _U32, 0x7F, 1),
    0x1017: _var(_U16),
    0x1018: _list(RECORD, _U32, 4, 1),
    0x1019: _var(_U8),
    0x1020: _list(ARRAY, _U32, 2, 1, 2),
    0x1021: _Shape((DOMAIN, VAR), {0: (_DOMAIN_TYPE,)}),
    0x1022: _var(_U8, _U16),  # copies of the table differ in the width
    0x1029: _list(ARRAY, _U8, 0xFE, 1),
    0x1200: _list(RECORD, _U32, 2, 1, 2),
    0x1F80: _var(_U32),
}
# Sub-index 4 is reserved.
_PDO_COMMUNICATION = _Shape(
    (RECORD,), {0: (_U8,), 1: (_U32,), 2: (_U8,), 3: (_U16,), 5: (_U16,), 6: (_U8,)}, (1, 2)
)
_PDO_MAPPING = _Shape((RECORD, ARRAY), _list(RECORD, _U32, 0x40).types)
_PDO_COMMUNICATIONS, _PDO_MAPPINGS = range(0x1800, 0x1A00), range(0x1A00, 0x1C00)


def _counts(index: int) -> bool:
    """Whether sub-index 0 is a count that changes: errors kept, objects mapped."""
    return index == 0x1003 or index in _PDO_MAPPINGS


def _shape(index: int) -> _Shape | None:
    if index in _PDO_COMMUNICATIONS:
        return _PDO_COMMUNICATION
    if index in _PDO_MAPPINGS:
        return _PDO_MAPPING
    return _COMMUNICATION.get(index)


@dataclass
class _Section:
    """One section: its name as written, and its keys in lower case with what stands behind them."""

    name: str
    values: dict[str, str] = field(default_factory=dict)

    def get(self, key: str) -> str:
        return self.values.get(key.lower(), "")


@dataclass
class _Variable:
    """A section of one entry after its checks; numbers are None where there is none or it was refused."""

    section: str
    name: str
    data_type: int
    access: str
    mappable: bool
    low: int | None
    high: int | None
    default: int | float | bytes | None
    relative: bool


@dataclass
class _Object:
    """An object after its checks."""

    index: int
    kind: int
    name: str
    subs: dict[int, _Variable]


def load(data: bytes, name: str) -> Eds:
    """Check and read an EDS by CiA 306. UserError with every mistake at once: file, section, key, what is wrong and what to do."""
    if not any(
        section in data.lower()
        for section in (b"[fileinfo]", b"[deviceinfo]", b"[mandatoryobjects]")
    ):
        raise UserError(
            f"{name}: is no EDS: it has none of the sections [FileInfo], [DeviceInfo], [MandatoryObjects]."
        )
    if len(data) > MAX_BYTES or data.count(b"\n") > _MAX_LINES:
        raise UserError(
            f"{name}: is larger than {MAX_BYTES // 1_000_000} MB or {_MAX_LINES} lines. Is it an EDS?"
        )
    checker = _Checker(name)
    checker.read(data)
    if len(checker.problems) > _MAX_PROBLEMS:
        more = len(checker.problems) - _MAX_PROBLEMS
        raise UserError(*checker.problems[:_MAX_PROBLEMS], f"{name}: and {more} more mistakes.")
    if checker.problems:
        raise UserError(*checker.problems)
    objects = checker.objects
    return Eds(
        data,
        name,
        tuple(_entries(objects)),
        {index: objects[index].name for index in sorted(objects)},
        checker.device_info(),
    )


class _Checker:
    """Reads sections and collects mistakes."""

    def __init__(self, name: str) -> None:
        self.problems: list[str] = []
        self.objects: dict[int, _Object] = {}
        self._name = name
        self._sections: dict[str, _Section] = {}

    def read(self, data: bytes) -> None:
        self._read_sections(self._decode(data))
        self._check_header()
        self._read_objects()
        self._check_lists()
        for index in _MANDATORY:
            if index not in self.objects:
                self._say(f"{index:04X}", "this object is mandatory and is not there. Add it.")
        for index in sorted(self.objects):
            self._check_communication(self.objects[index])
        self._check_pdos()

    def device_info(self) -> DeviceInfo:
        section = self._sections["deviceinfo"]

        def number(key: str) -> int:
            return _integer(section.get(key)) or 0

        return DeviceInfo(
            number("VendorNumber"),
            number("ProductNumber"),
            number("RevisionNumber"),
            tuple(1000 * rate for rate in _BIT_RATES if number(f"BaudRate_{rate}")),
            number("NrOfTXPDO"),
            number("NrOfRXPDO"),
            bool(number("LSS_Supported")),
        )

    # --- text

    def _say(self, section: str, text: str) -> None:
        section = section[:_MAX_SAID]
        if len(text) > _MAX_SAID:  # what is wrong and the remedy stand at its ends
            text = f"{text[: _MAX_SAID // 2]} ... {text[-_MAX_SAID // 2 :]}"
        self.problems.append(
            f"{self._name}: [{section}] {text}" if section else f"{self._name}: {text}"
        )

    def _decode(self, data: bytes) -> str:
        if data.startswith(codecs.BOM_UTF8):
            self._say("", "begins with a byte order mark. Save it as plain ASCII, without one.")
            data = data.removeprefix(codecs.BOM_UTF8)
        for number, line in enumerate(data.split(b"\n"), 1):
            if not line.isascii():
                text = line.decode("ascii", "backslashreplace").strip()
                self._say("", f"line {number} is not ASCII: {text}. Write it in plain letters.")
        return data.decode("ascii", "replace")

    def _read_sections(self, text: str) -> None:
        for name, lines in _blocks(text):
            section = _Section(name)
            for line in lines[1:] if name else lines:
                self._read_line(section, line)
            if not name:
                continue
            match = _OBJECT.match(name)
            same = (
                _spelling(int(match[1], 16), int(match[2], 16) if match[2] else None).lower()
                if match
                else name.lower()
            )
            if same in self._sections:
                self._say(name, "this section is there twice. Remove one.")
            else:
                self._sections[same] = section

    def _read_line(self, section: _Section, line: str) -> None:
        bare = _bare(line)
        if not bare:
            return
        key, equals, value = (part.strip() for part in bare.partition("="))
        if not equals or not key or not section.name:
            self._say(
                section.name,
                f"'{bare}' is neither a section, nor key=value, nor a comment behind ';'.",
            )
        elif line[0].isspace():
            self._say(section.name, f"'{bare}' begins with a blank. Remove the blank.")
        elif key.lower() in section.values:
            self._say(section.name, f"{key}: this key is there twice. Remove one.")
        else:
            section.values[key.lower()] = value

    def _number(self, section: _Section, key: str, otherwise: int | None = None) -> int | None:
        """The number of a key; ``otherwise`` where it has no value; None, after a complaint, where that is no number."""
        text = section.get(key)
        if not text:
            return otherwise
        number = _integer(text)
        if number is None:
            self._say(section.name, f"{key}={text}: not a number. Write 0x1F or 31.")
        return number

    # --- [FileInfo], [DeviceInfo], lists

    def _check_header(self) -> None:
        for name in ("FileInfo", "DeviceInfo", "MandatoryObjects"):
            if name.lower() not in self._sections:
                self._say(name, "this section is mandatory and is not there. Add it.")
        if "devicecomissioning" in self._sections:
            self._say(
                "DeviceComissioning",
                "this is a DCF, the file of one node. Give the EDS it was made from.",
            )
        section = self._sections.get("deviceinfo")
        if section is None:
            return
        numbers = (
            "VendorNumber",
            "ProductNumber",
            "RevisionNumber",
            "NrOfRXPDO",
            "LSS_Supported",
            "Granularity",
        )
        for key in (*numbers, *(f"BaudRate_{rate}" for rate in _BIT_RATES)):
            self._number(section, key)
        if self._number(section, "CompactPDO"):
            self._say(
                "DeviceInfo",
                "CompactPDO: not supported. Describe each PDO by its own sections and write 0.",
            )
        given = sum(
            _OBJECT.match(name) is not None and int(name, 16) in _PDO_COMMUNICATIONS
            for name in self._plain()
        )
        stated = self._number(section, "NrOfTXPDO")
        if stated is not None and stated != given:
            self._say(
                "DeviceInfo",
                f"NrOfTXPDO={stated}, but {given} of 1800h to 19FFh are there. Write {given}.",
            )

    def _plain(self) -> list[str]:
        """Names of the sections of objects, without those of their sub-indices."""
        return [
            name for name in self._sections if (match := _OBJECT.match(name)) and match[2] is None
        ]

    def _check_lists(self) -> None:
        listed: dict[int, str] = {}
        for name in _LISTS:
            section = self._sections.get(name.lower())
            if section is not None:
                self._check_list(name, section, listed)
        for index, item in self.objects.items():
            if index not in listed:
                right = _right_list(index)
                self._say(
                    f"{index:04X}", f"{item.name} is in none of the lists. Add it to [{right}]."
                )

    def _check_list(self, name: str, section: _Section, listed: dict[int, str]) -> None:
        count = self._number(section, "SupportedObjects")
        if not section.get("SupportedObjects"):
            self._say(name, "SupportedObjects: missing. Write the number of objects.")
        numbers = [key for key in section.values if key != "supportedobjects"]
        for key in numbers:
            if not key.isdigit() or not section.get(key):
                self._say(
                    name, f"{key}={section.get(key)}: not an entry of a list. Write 1=0x1000."
                )
                continue
            index = self._number(section, key)
            if index is None:
                continue
            if index in listed:
                self._say(
                    name, f"{key}=0x{index:04X}: listed before, in [{listed[index]}]. Remove one."
                )
            listed[index] = name
            if index not in self.objects:
                self._say(
                    name,
                    f"{key}=0x{index:04X}: there is no section [{index:04X}]. Add it or remove this line.",
                )
            right = _right_list(index)
            if right != name and (right == _LISTS[2] or name != _LISTS[1]):
                self._say(name, f"{key}=0x{index:04X}: belongs into [{right}].")
        digits = sorted(number for key in numbers if (number := _place(key)) is not None)
        if count is not None and (
            count != len(digits) or digits != list(range(1, len(digits) + 1))
        ):
            self._say(
                name,
                f"SupportedObjects={count}, but {len(digits)} are listed, or their numbers have gaps. "
                f"Number them from 1 and write {len(digits)}.",
            )

    # --- objects

    def _read_objects(self) -> None:
        members: dict[int, dict[int, _Section]] = {}
        for section in self._sections.values():
            if match := _OBJECT.match(section.name):
                index = int(match[1], 16)
                of_object = members.setdefault(index, {})
                if match[2] is not None:
                    of_object[int(match[2], 16)] = section
            elif (match := _OF_OBJECT.match(section.name)) and match[2].lower() == "value":
                self._say(
                    section.name,
                    "values belong in a DCF. Write DefaultValue in the object's section.",
                )
        count = 0
        for index, subs in members.items():
            section_of_index = self._sections.get(f"{index:04x}")
            if section_of_index is None:
                for sub in subs.values():
                    self._say(
                        sub.name, f"there is no section [{index:04X}]. Add it or remove this one."
                    )
                continue
            self._read_object(index, section_of_index, subs)
            count += len(self.objects[index].subs)
            if count > _MAX_ENTRIES:
                raise UserError(
                    f"{self._name}: has more than {_MAX_ENTRIES} objects and sub-indices. Remove some."
                )

    def _read_object(self, index: int, section: _Section, subs: Mapping[int, _Section]) -> None:
        kind = self._number(section, "ObjectType", VAR)
        name = self._parameter_name(section)
        variables: dict[int, _Variable] = {}
        if kind in (DOMAIN, VAR):
            for sub in subs.values():
                self._say(
                    sub.name,
                    f"[{index:04X}] is a {_KINDS[kind]} and has no sub-indices. Remove this section.",
                )
            variables = {0: self._variable(section, name, kind, index)}
        elif kind in (ARRAY, RECORD):
            variables = self._members(index, name, section, subs)
        elif kind is not None:
            self._say(section.name, f"ObjectType=0x{kind:X}: not one of {_choices(_KINDS)}.")
        self.objects[index] = _Object(index, kind or 0, name, variables)

    def _members(
        self, index: int, name: str, section: _Section, subs: Mapping[int, _Section]
    ) -> dict[int, _Variable]:
        compact = self._number(section, "CompactSubObj", 0)
        count = self._number(section, "SubNumber", 0)
        if compact:
            if not subs and not count:
                return self._compact(index, name, section, compact)
            self._say(
                section.name,
                "CompactSubObj excludes SubNumber and sections of sub-indices. Keep one way.",
            )
        if count is not None and count != len(subs):
            self._say(
                section.name,
                f"SubNumber={count}, but {len(subs)} sub-indices are there. Write {len(subs)}.",
            )
        variables = {}
        for sub in sorted(subs):
            member = subs[sub]
            kind = self._number(member, "ObjectType", VAR)
            if kind not in (None, DOMAIN, VAR):
                self._say(member.name, f"ObjectType=0x{kind:X}: a sub-index is a VAR, 0x7.")
            if sub > 0xFE:
                self._say(member.name, "sub-indices end at FE. Remove this section.")
            variables[sub] = self._variable(
                member, self._parameter_name(member), kind or VAR, index
            )
        self._check_sub0(index, variables)
        return variables

    def _check_sub0(self, index: int, variables: Mapping[int, _Variable]) -> None:
        first = variables.get(0)
        if first is None:
            self._say(
                f"{index:04X}",
                "sub-index 0 is missing. Add it with the highest sub-index as DefaultValue.",
            )
            return
        highest = max(variables)
        if first.data_type != _U8:
            self._say(
                first.section,
                f"DataType=0x{first.data_type:04X}: sub-index 0 is an UNSIGNED8, 0x0005.",
            )
        elif _counts(index):
            if isinstance(first.default, int) and first.default > highest:
                self._say(
                    first.section,
                    f"DefaultValue: the highest sub-index is {highest}. Write that or less.",
                )
        elif first.default != highest:
            self._say(
                first.section,
                f"DefaultValue: the highest sub-index is {highest}. Write 0x{highest:02X}.",
            )

    def _compact(
        self, index: int, name: str, section: _Section, count: int
    ) -> dict[int, _Variable]:
        """CiA 306, CompactSubObj: sub-index 0 and ``count`` alike ones. Their names are the object's and a number, or in [xxxxName]."""
        if not 1 <= count <= 0xFE:
            self._say(section.name, f"CompactSubObj={count}: not 1 to 254.")
            return {}
        variable = self._variable(section, name, VAR, index)
        count_name = f"{name} highest sub-index"
        access, highest = ("rw", 0) if _counts(index) else ("const", count)
        variables = {
            0: _Variable(section.name, count_name, _U8, access, False, None, None, highest, False)
        }
        for sub in range(1, count + 1):
            variables[sub] = _Variable(**{**vars(variable), "name": f"{name}{sub}"})
        names = self._sections.get(f"{index:04x}name")
        if names is None:
            return variables
        given = [key for key in names.values if key != "nrofentries"]
        stated = self._number(names, "NrOfEntries", 0)
        if stated is not None and stated != len(given):
            self._say(
                names.name,
                f"NrOfEntries={stated}, but {len(given)} names are there. Write {len(given)}.",
            )
        for key in given:
            number = _place(key)
            if number is None or not 1 <= number <= count:
                self._say(names.name, f"{key}: not a sub-index from 1 to {count}.")
            elif names.get(key):
                variables[number].name = names.get(key)
        return variables

    def _parameter_name(self, section: _Section) -> str:
        name = section.get("ParameterName")
        if not name:
            self._say(section.name, "ParameterName: missing. Name it.")
        elif len(name) > _LONGEST_NAME:
            self._say(
                section.name, f"ParameterName: longer than {_LONGEST_NAME} characters. Shorten it."
            )
        return name

    def _variable(self, section: _Section, name: str, kind: int, index: int) -> _Variable:
        where = section.name
        data_type = self._data_type(section, kind, index)
        access = section.get("AccessType").lower() or ("rw" if kind == DOMAIN else "")
        if access not in _ACCESS:
            self._say(
                where, f"AccessType={section.get('AccessType')}: not one of {', '.join(_ACCESS)}."
            )
        mappable = bool(self._number(section, "PDOMapping", 0))
        if mappable and (access == "wo" or (data_type and data_type not in _BITS)):
            what = "a write-only object" if access == "wo" else f"a {_TYPE_NAMES[data_type]}"
            self._say(
                where,
                f"PDOMapping={section.get('PDOMapping')}: {what} has no place in a TPDO. Write 0.",
            )
        if section.get("ParameterValue"):
            self._say(where, "ParameterValue: values belong in a DCF. Write DefaultValue.")
        low, high = (
            self._limit(section, "LowLimit", data_type),
            self._limit(section, "HighLimit", data_type),
        )
        if low is not None and high is not None and low > high:
            self._say(
                where,
                f"LowLimit={section.get('LowLimit')}: above HighLimit={section.get('HighLimit')}.",
            )
            low = high = None
        default, relative = self._default(section, data_type)
        if isinstance(default, int) and not relative:
            if low is not None and default < low:
                self._say(
                    where,
                    f"DefaultValue={section.get('DefaultValue')}: below LowLimit={section.get('LowLimit')}.",
                )
            if high is not None and default > high:
                self._say(
                    where,
                    f"DefaultValue={section.get('DefaultValue')}: above HighLimit={section.get('HighLimit')}.",
                )
        return _Variable(where, name, data_type, access, mappable, low, high, default, relative)

    def _data_type(self, section: _Section, kind: int, index: int) -> int:
        """The type; 0, after a complaint, where it is refused."""
        data_type = self._number(section, "DataType", _DOMAIN_TYPE if kind == DOMAIN else None)
        if data_type is None:
            if not section.get("DataType"):
                self._say(section.name, "DataType: missing. Write 0x0005 for UNSIGNED8 and so on.")
            return 0
        if kind == DOMAIN and data_type != _DOMAIN_TYPE:
            self._say(section.name, f"DataType=0x{data_type:04X}: the type of a DOMAIN is 0x000F.")
            return 0
        if data_type not in _TYPE_NAMES:
            self._say(
                section.name,
                f"DataType=0x{data_type:04X}: not supported. Take one of {_choices(_TYPE_NAMES)}.",
            )
            return 0
        if _BITS.get(data_type, 0) > 32 and index < 0x2000:
            self._say(
                section.name, f"DataType=0x{data_type:04X}: 64 bits are for objects from 2000h on."
            )
            return 0
        return data_type

    def _limit(self, section: _Section, key: str, data_type: int) -> int | None:
        text = section.get(key)
        if not text or not data_type:
            return None
        if data_type not in _BITS or data_type in _FLOATS:
            self._say(
                section.name, f"{key}={text}: only whole numbers have limits. Leave it empty."
            )
            return None
        return self._fitting(section, key, text, data_type)

    def _fitting(
        self, section: _Section, key: str, text: str, data_type: int, room: int = 0
    ) -> int | None:
        """A whole number that fits its type with ``room`` above it. Signed ones may be hexadecimal in two's complement."""
        number = _integer(text)
        if number is None:
            self._say(section.name, f"{key}={section.get(key)}: not a number. Write 0x1F or 31.")
            return None
        bits = _BITS[data_type]
        low, high = (
            (-(1 << bits - 1), (1 << bits - 1) - 1)
            if data_type in _SIGNED
            else (0, (1 << bits) - 1)
        )
        if data_type in _SIGNED and "x" in text.lower() and high < number < 1 << bits:
            number -= 1 << bits
        if low <= number <= high - room:
            return number
        self._say(
            section.name,
            f"{key}={section.get(key)}: does not fit {_TYPE_NAMES[data_type]}, {low} to {high}.",
        )
        return None

    def _default(
        self, section: _Section, data_type: int
    ) -> tuple[int | float | bytes | None, bool]:
        """The default, and whether the node-ID is to be added to it."""
        text = section.get("DefaultValue")
        if not text or not data_type:
            return None, False
        if data_type in (_VISIBLE_STRING, _UNICODE_STRING):
            coding = "utf-16-le" if data_type == _UNICODE_STRING else "ascii"
            return text.encode(coding, "replace"), False
        if data_type in (_OCTET_STRING, _DOMAIN_TYPE):
            try:
                return bytes.fromhex(text), False
            except ValueError:
                self._say(
                    section.name,
                    f"DefaultValue={text}: not bytes. Write pairs of hexadecimal digits, or nothing.",
                )
                return None, False
        if data_type in _FLOATS:
            return self._real(section, text, data_type), False
        if match := _NODE_ID.match(text.replace(" ", "")):
            value = match["after"] or match["before"] or "0"
            return self._fitting(section, "DefaultValue", value, data_type, room=127), True
        return self._fitting(section, "DefaultValue", text, data_type), False

    def _real(self, section: _Section, text: str, data_type: int) -> float | None:
        """A decimal, or the hexadecimal bits of the IEEE number that CiA 306 writes."""
        try:
            if "x" not in text.lower():
                return float(text)
            size, code = (4, ">f") if data_type == _FLOATS[0] else (8, ">d")
            number: float = struct.unpack(code, int(text, 16).to_bytes(size, "big"))[0]
            return number
        except (ValueError, OverflowError):
            self._say(section.name, f"DefaultValue={text}: not a number. Write 1.5.")
            return None

    # --- communication objects and PDOs

    def _check_communication(self, item: _Object) -> None:
        index = item.index
        if index >= 0x2000:
            return
        shape = _shape(index)
        if shape is None:
            self._say(
                f"{index:04X}", f"{item.name}: this node has no such service. Remove the object."
            )
            return
        if item.kind not in _KINDS:
            return
        if item.kind not in shape.kinds:
            kind = shape.kinds[0]
            self._say(
                f"{index:04X}",
                f"ObjectType=0x{item.kind:X}: this object is of type {_KINDS[kind]}, 0x{kind:X}.",
            )
            return
        for sub in shape.needed:
            if sub not in item.subs:
                self._say(
                    f"{index:04X}", f"sub-index {sub:X} is mandatory and is not there. Add it."
                )
        for sub, variable in item.subs.items():
            types = shape.types.get(sub)
            if types is None:
                self._say(variable.section, f"{index:04X}h has no sub-index {sub:X}. Remove it.")
            elif (
                variable.data_type
                and variable.data_type not in types
                and (sub or item.kind in (VAR, DOMAIN))
            ):
                name = _TYPE_NAMES[types[0]]
                self._say(
                    variable.section,
                    f"DataType=0x{variable.data_type:04X}: this one is of type {name}, 0x{types[0]:04X}.",
                )

    def _check_pdos(self) -> None:
        for index in sorted(self.objects):
            partner = index + 0x200 if index in _PDO_COMMUNICATIONS else index - 0x200
            if index in range(0x1800, 0x1C00) and partner not in self.objects:
                self._say(
                    f"{index:04X}",
                    f"[{partner:04X}] of the same PDO is not there. Add it or remove this object.",
                )
            if index in _PDO_MAPPINGS:
                self._check_mapping(self.objects[index])

    def _check_mapping(self, item: _Object) -> None:
        count = item.subs[0].default if 0 in item.subs else 0
        bits = 0
        for sub in range(1, min(count, _MAX_MAPPED) + 1) if isinstance(count, int) else ():
            mapping = item.subs.get(sub)
            value = mapping.default if mapping else None
            if mapping is None or not isinstance(value, int) or mapping.relative:
                self._say(
                    f"{item.index:04X}sub{sub:X}",
                    "DefaultValue: this part of the mapping is not there.",
                )
                continue
            bits += value & 0xFF
            if problem := self._mapping_problem(value):
                self._say(mapping.section, f"DefaultValue=0x{value:08X}: {problem}")
        if bits > _PDO_BITS:
            self._say(
                f"{item.index:04X}",
                f"{bits} bits are mapped, a PDO has {_PDO_BITS}. Map fewer objects.",
            )

    def _mapping_problem(self, value: int) -> str | None:
        index, sub, bits = value >> 16, value >> 8 & 0xFF, value & 0xFF
        item = self.objects.get(index)
        target = item.subs.get(sub) if item else None
        if target is None:
            return f"there is no {index:04X}h:{sub:02X}. Add it or map another."
        if not target.mappable or target.access == "rww":
            return (
                f"{index:04X}h:{sub:02X} is not for TPDOs. Write PDOMapping=1 there or map another."
            )
        length = _BITS.get(target.data_type)
        if target.data_type and length != bits:
            return f"{index:04X}h:{sub:02X} has {length} bits. Write 0x{value & ~0xFF | (length or 0):08X}."
        return None


def _entries(objects: Mapping[int, _Object]) -> Iterator[Entry]:
    for index in sorted(objects):
        item = objects[index]
        for sub in sorted(item.subs):
            variable = item.subs[sub]
            yield Entry(
                index,
                sub,
                variable.name,
                variable.data_type,
                variable.access,
                variable.mappable,
                variable.low,
                variable.high,
                variable.default,
                variable.relative,
                item.kind,
            )


def _blocks(text: str) -> list[tuple[str, list[str]]]:
    """Section names, each with its lines from the heading on; first "" with what stands before all sections."""
    blocks: list[tuple[str, list[str]]] = [("", [])]
    for line in text.replace("\r\n", "\n").split("\n"):
        if match := _HEADING.match(line):
            blocks.append((match[1].strip(), []))
        blocks[-1][1].append(line)
    return blocks


def _bare(line: str) -> str:
    """A line without comment and surrounding blanks."""
    return "" if line.lstrip().startswith("#") else _COMMENT.sub("", line).strip()


def _key(line: str) -> str:
    return _bare(line).partition("=")[0].strip().lower()


def _value(line: str) -> str:
    return _bare(line).partition("=")[2].strip()


def _integer(text: str) -> int | None:
    return int(text, 0) if _NUMBER.match(text) else None


def _place(key: str) -> int | None:
    """The number of a line in a list."""
    return int(key) if key.isdigit() and len(key) < 10 else None


def _spelling(index: int, sub: int | None) -> str:
    return f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"


def _right_list(index: int) -> str:
    if index in _MANDATORY:
        return _LISTS[0]
    return _LISTS[2] if 0x2000 <= index < 0x6000 else _LISTS[1]


def _choices(names: Mapping[int, str]) -> str:
    return ", ".join(f"0x{code:X} {name}" for code, name in names.items())


def without(eds_data: bytes, indices: Container[int]) -> bytes:
    """The EDS without these objects: their sections and list entries removed, lists renumbered, NrOfTXPDO counted anew."""
    text = eds_data.decode("latin-1")
    end = "\r\n" if "\r\n" in text else "\n"
    blocks = [
        block
        for block in _blocks(text)
        if not (match := _OF_OBJECT.match(block[0])) or int(match[1], 16) not in indices
    ]
    left = {name.lower() for name, _ in blocks}
    pdos = sum(f"{index:04x}" in left for index in _PDO_COMMUNICATIONS)
    kept: list[str] = []
    for name, lines in blocks:
        if name.lower() in (each.lower() for each in _LISTS):
            kept += _shorter_list(lines, indices)
        elif name.lower() == "deviceinfo":
            kept += [f"NrOfTXPDO={pdos}" if _key(line) == "nroftxpdo" else line for line in lines]
        else:
            kept += lines
    return end.join(kept).encode("latin-1")


def _shorter_list(lines: list[str], indices: Container[int]) -> list[str]:
    kept: list[str] = []
    count = 0
    for line in lines:
        if not _key(line).isdigit():
            kept.append(line)
            continue
        if _integer(_value(line)) in indices:
            continue
        count += 1
        kept.append(f"{count}={_value(line)}")
    return [
        f"SupportedObjects={count}" if _key(line) == "supportedobjects" else line for line in kept
    ]


def dcf(
    eds: Eds,
    node_id: int,
    bitrate: int,
    values: Mapping[tuple[int, int], int | float | bytes],
    node_name: str,
    file_name: str,
) -> str:
    """The EDS as the DCF of one node (CiA 306, clause 5): its text with a ParameterValue for each of ``values``, and [DeviceComissioning].

    ``bitrate`` in bit/s. ``file_name`` is the DCF's; LastEDS names the EDS. Values are as they are in the node, with the node-ID worked in.
    Domains are left out: a DCF names files for them. Real numbers are written as decimals, which the canopen library reads. Lines end in
    CR LF. KeyError for a value that has no entry, UserError for a text that an INI file cannot hold.
    """
    entries = {(entry.index, entry.sub): entry for entry in eds.entries}
    texts = {
        at: _value_text(eds.name, entries[at], value)
        for at, value in values.items()
        if entries[at].data_type != _DOMAIN_TYPE
    }
    result: list[str] = []
    for name, lines in _blocks(eds.data.decode("ascii")):
        added: list[str] = []
        if name.lower() == "fileinfo":
            last = PurePath(eds.name).name.encode("ascii", "replace").decode("ascii")
            lines = [line for line in lines if _key(line) not in ("filename", "lasteds")]
            lines[1:1] = [f"FileName={file_name}", f"LastEDS={last}"]
        elif name.lower() == "deviceinfo":
            added = _commissioning(node_id, bitrate, values.get((0x1018, 4)), node_name)
        elif match := _OBJECT.match(name):
            index, sub = int(match[1], 16), int(match[2] or "0", 16)
            if any(
                _key(line) == "compactsubobj" and _value(line) not in ("", "0") for line in lines
            ):
                added = _compact_values(index, texts)
            elif (index, sub) in texts:
                added = [f"ParameterValue={texts[index, sub]}"]
        end = max((number for number, line in enumerate(lines, 1) if line.strip()), default=0)
        result += lines[:end] + added + lines[end:]
    return "\r\n".join(result)


def _commissioning(
    node_id: int, bitrate: int, serial: float | bytes | None, node_name: str
) -> list[str]:
    """[DeviceComissioning]: CiA 306 spells it so."""
    lines = [
        "",
        "[DeviceComissioning]",
        f"NodeID=0x{node_id:02X}",
        f"NodeName={node_name}",
        f"Baudrate={bitrate // 1000}",
        "NetNumber=0",
        "CANopenManager=0",
    ]
    # 0: not known, so nothing that an LSS master could look for
    return (
        [*lines, f"LSS_SerialNumber=0x{serial:08X}"]
        if isinstance(serial, int) and serial
        else lines
    )


def _compact_values(index: int, texts: Mapping[tuple[int, int], str]) -> list[str]:
    """The values of an object with CompactSubObj stand in a section of their own (which the canopen library passes over)."""
    values = [f"{at[1]}={text}" for at, text in sorted(texts.items()) if at[0] == index and at[1]]
    return ["", f"[{index:04X}Value]", f"NrOfEntries={len(values)}", *values] if values else []


def _value_text(name: str, entry: Entry, value: float | bytes) -> str:
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        return str(value) if value < 0 else f"0x{value:0{_BITS[entry.data_type] // 4 or 1}X}"
    if entry.data_type == _OCTET_STRING:
        return value.hex()
    text = value.decode("utf-16-le" if entry.data_type == _UNICODE_STRING else "latin-1")
    if (
        not text.isascii()
        or text != text.strip()
        or (text and not text.isprintable())
        or _bare(f"={text}") != f"={text}"
    ):
        where = _spelling(entry.index, entry.sub)
        raise UserError(
            f"{name}: [{where}] the text {text!r} of {entry.name} cannot stand in a DCF."
        )
    return text
