"""Electronic data sheets of CiA 306: what a node is built from. Text in, checked entries out.

Refused is what a node could not be run with: limits, types, defaults that do not fit, what stands there twice; by file, section, key and
remedy, all at once. What concerns other readers of the file only (lists of objects, counts, [DeviceInfo]) is not looked at.

Choices where CiA 306 leaves room: section names that it does not know are ignored. Types of 24, 40, 48 and 56 bits and times are refused;
64-bit types are plain storage, so they are taken from 2000h on only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from kontronik_can_gw.canopen import eds_rules
from kontronik_can_gw.canopen.data_types import ARRAY, DOMAIN, KINDS, RECORD, U8, VAR
from kontronik_can_gw.canopen.eds_object import EdsObject, Entry
from kontronik_can_gw.canopen.eds_sections import OBJECT, Problems, Section, choices, read_sections
from kontronik_can_gw.canopen.eds_values import data_type_of, default_value, limits
from kontronik_can_gw.errors import UserError

MAX_BYTES = 2_000_000
"""Of an EDS; the shipped one has 60 kB, 250 entries, 2 200 lines."""
_MAX_LINES = 100_000
_MAX_ENTRIES = 10_000
_MAX_PROBLEMS = 20
_MAX_NAME = 241
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")


@dataclass(frozen=True)
class Eds:
    """A checked EDS. ``data`` are the bytes as given, ``entries`` are in the order of index and sub-index."""

    data: bytes
    name: str
    entries: tuple[Entry, ...]
    object_names: dict[int, str]


def load(data: bytes, name: str) -> Eds:
    """Check and read an EDS by CiA 306. UserError with every mistake at once: file, section, key, what is wrong and what to do."""
    known = (b"[fileinfo]", b"[deviceinfo]", b"[mandatoryobjects]")
    if not any(section in data.lower() for section in known):
        raise UserError(
            f"{name}: is no EDS: it has none of the sections [FileInfo], [DeviceInfo], [MandatoryObjects]."
        )
    if len(data) > MAX_BYTES or data.count(b"\n") > _MAX_LINES:
        raise UserError(
            f"{name}: is larger than {MAX_BYTES // 1_000_000} MB or {_MAX_LINES} lines. Is it an EDS?"
        )
    problems = Problems(name)
    objects = _Reader(read_sections(data, problems), problems).read()
    eds_rules.check(objects, problems.add)
    if problems.found:
        more = len(problems.found) - _MAX_PROBLEMS
        rest = [f"{name}: and {more} more mistakes."] if more > 0 else []
        raise UserError(*problems.found[:_MAX_PROBLEMS], *rest)
    ordered = [objects[index] for index in sorted(objects)]
    entries = tuple(item.subs[sub] for item in ordered for sub in sorted(item.subs))
    return Eds(data, name, entries, {item.index: item.name for item in ordered})


class _Reader:
    """Reads the sections of objects and collects mistakes."""

    def __init__(self, sections: Mapping[str, Section], problems: Problems) -> None:
        self._sections = sections
        self._problems = problems

    def read(self) -> dict[int, EdsObject]:
        """All objects."""
        self._check_header()
        members: dict[int, dict[int, Section]] = {}
        for section in self._sections.values():
            if match := OBJECT.match(section.name):
                of_object = members.setdefault(int(match[1], 16), {})
                if match[2] is not None:
                    of_object[int(match[2], 16)] = section
        objects: dict[int, EdsObject] = {}
        count = 0
        for index, subs in members.items():
            section_of_index = self._sections.get(f"{index:04x}")
            if section_of_index is None:
                for sub in subs.values():
                    sub.wrong(f"there is no section [{index:04X}]. Add it or remove this one.")
                continue
            objects[index] = self._read_object(index, section_of_index, subs)
            count += len(objects[index].subs)
            if count > _MAX_ENTRIES:
                raise UserError(
                    f"{self._problems.file}: has more than {_MAX_ENTRIES} objects and sub-indices. Remove some."
                )
        return objects

    def _check_header(self) -> None:
        if "devicecomissioning" in self._sections:
            self._problems.add(
                "DeviceComissioning",
                "this is a DCF, the file of one node. Give the EDS it was made from.",
            )
        section = self._sections.get("deviceinfo")
        if section is not None and section.number("CompactPDO"):
            section.wrong(
                "CompactPDO: not supported. Describe each PDO by its own sections and write 0."
            )

    def _read_object(self, index: int, section: Section, subs: Mapping[int, Section]) -> EdsObject:
        kind = section.number("ObjectType", VAR)
        item = EdsObject(index, kind or 0, _parameter_name(section), {})
        if kind in (DOMAIN, VAR):
            for sub in subs.values():
                sub.wrong(
                    f"[{index:04X}] is a {KINDS[kind]} and has no sub-indices. Remove this section."
                )
            item.subs[0] = _entry(section, item, 0, item.name, kind)
        elif kind in (ARRAY, RECORD):
            self._read_members(item, section, subs)
        elif kind is not None:
            section.wrong(f"ObjectType=0x{kind:X}: not one of {choices(KINDS)}.")
        return item

    def _read_members(self, item: EdsObject, section: Section, subs: Mapping[int, Section]) -> None:
        compact = section.number("CompactSubObj", 0)
        if compact and not subs:
            self._read_compact(item, section, compact)
            return
        if compact:
            section.wrong("CompactSubObj excludes sections of sub-indices. Keep one way.")
        for sub in sorted(subs):
            member = subs[sub]
            kind = member.number("ObjectType", VAR)
            if kind not in (None, DOMAIN, VAR):
                member.wrong(f"ObjectType=0x{kind:X}: a sub-index is a VAR, 0x7.")
            if sub > 0xFE:
                member.wrong("sub-indices end at FE. Remove this section.")
            item.subs[sub] = _entry(member, item, sub, _parameter_name(member), kind or VAR)
        self._check_sub0(item)

    def _check_sub0(self, item: EdsObject) -> None:
        """Sub-index 0 is what masters read first (CiA 301, 7.4.5.2)."""
        wrong = self._problems.add
        first = item.subs.get(0)
        if first is None:
            wrong(
                f"{item.index:04X}",
                "sub-index 0 is missing. Add it with the highest sub-index as DefaultValue.",
            )
            return
        where, highest = item.section(0), max(item.subs)
        if first.data_type != U8:
            wrong(where, f"DataType=0x{first.data_type:04X}: sub-index 0 is an UNSIGNED8, 0x0005.")
        elif not eds_rules.counts(item.index) and first.default != highest:
            wrong(
                where, f"DefaultValue: the highest sub-index is {highest}. Write 0x{highest:02X}."
            )

    def _read_compact(self, item: EdsObject, section: Section, count: int) -> None:
        """CiA 306, CompactSubObj: sub-index 0 and ``count`` alike ones. Their names are the object's and a number, or in [xxxxName]."""
        if not 1 <= count <= 0xFE:
            section.wrong(f"CompactSubObj={count}: not 1 to 254.")
            return
        first = _entry(section, item, 1, item.name, VAR)
        names = {sub: f"{item.name}{sub}" for sub in range(1, count + 1)}
        if given := self._sections.get(f"{item.index:04x}name"):
            for key, name in given.values.items():
                number = int(key) if key.isdigit() and len(key) < 10 else 0
                if number in names:
                    names[number] = name or names[number]
                elif key != "nrofentries":
                    given.wrong(f"{key}: not a sub-index from 1 to {count}.")
        counts = eds_rules.counts(item.index)
        about = f"{item.name} highest sub-index", U8, "rw" if counts else "const"
        default = 0 if counts else count
        item.subs[0] = Entry(item.index, 0, *about, False, None, None, default, False)
        for sub, name in names.items():
            item.subs[sub] = replace(first, sub=sub, name=name)


def _parameter_name(section: Section) -> str:
    name = section.get("ParameterName")
    if not name:
        section.wrong("ParameterName: missing. Name it.")
    elif len(name) > _MAX_NAME:
        section.wrong(f"ParameterName: longer than {_MAX_NAME} characters. Shorten it.")
    return name


def _entry(section: Section, item: EdsObject, sub: int, name: str, kind: int) -> Entry:
    data_type = data_type_of(section, kind, item.index)
    access = section.get("AccessType").lower() or ("rw" if kind == DOMAIN else "")
    if access not in _ACCESS:
        section.wrong(f"{section.said('AccessType')}: not one of {', '.join(_ACCESS)}.")
    mappable = bool(section.number("PDOMapping", 0))
    if section.get("ParameterValue"):
        section.wrong("ParameterValue: values belong in a DCF. Write DefaultValue.")
    limit = limits(section, data_type)
    default = default_value(section, data_type, *limit)
    return Entry(item.index, sub, name, data_type, access, mappable, *limit, *default)
