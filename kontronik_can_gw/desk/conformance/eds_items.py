"""The EDS of the slave: CiA 306."""

import configparser
import re

from kontronik_can_gw.desk.conformance.items import item, require
from kontronik_can_gw.desk.conformance.slave import Slave

_LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
_SECTIONS = ("FileInfo", "DeviceInfo", *_LISTS)
_MANDATORY = (0x1000, 0x1001, 0x1018)
_ACCESS_TYPES = ("ro", "wo", "rw", "rwr", "rww", "const")
_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_LONGEST_NAME = 241


def sections_of(slave: Slave) -> configparser.ConfigParser:
    sections = configparser.ConfigParser(interpolation=None, strict=False)
    sections.read_string(slave.eds_text)
    return sections


def number_of(text: str) -> int:
    return int(text.partition(";")[0].strip() or "0", 0)


@item("CiA 306 (test tool EDS checker 01)", "sections of the EDS", ", ".join(_SECTIONS))
def eds_sections(slave: Slave) -> str:
    sections = sections_of(slave)
    names = {name.upper() for name in sections.sections()}
    missing = [name for name in _SECTIONS if name.upper() not in names]
    required = [name for name in missing if name not in ("OptionalObjects", "ManufacturerObjects")]
    require(not required, f"missing: {', '.join(required)}")
    return f"{len(_SECTIONS) - len(missing)} of {len(_SECTIONS)}"


def _listed(slave: Slave) -> dict[str, list[int]]:
    sections = sections_of(slave)
    found = {}
    for name in _LISTS:
        if sections.has_section(name):
            rows = dict(sections[name])
            rows.pop("supportedobjects", None)
            found[name] = [number_of(value) for value in rows.values()]
    return found


@item(
    "CiA 306",
    "the lists of objects",
    "SupportedObjects is their number, each object is in one list and has a section",
)
def eds_lists_of_objects(slave: Slave) -> str:
    sections = sections_of(slave)
    upper = {name.upper() for name in sections.sections()}
    total: list[int] = []
    for name, indices in _listed(slave).items():
        stated = number_of(sections[name].get("SupportedObjects", "0"))
        require(stated == len(indices), f"{name}: SupportedObjects={stated}, {len(indices)} listed")
        total += indices
    require(len(set(total)) == len(total), "an object is in two lists")
    without = [index for index in total if f"{index:04X}" not in upper]
    require(not without, f"no section: {', '.join(f'{index:04X}h' for index in without[:4])}")
    written = {int(name, 16) for name in upper if re.fullmatch(r"[0-9A-F]{4}", name)}
    unlisted = sorted(written - set(total))
    require(not unlisted, f"in no list: {', '.join(f'{index:04X}h' for index in unlisted[:4])}")
    return f"{len(total)} objects"


@item("CiA 301, 7.5.2; CiA 306", "mandatory objects", "1000h, 1001h and 1018h")
def eds_mandatory_objects(slave: Slave) -> str:
    missing = [f"{index:04X}h" for index in _MANDATORY if index not in slave.dictionary]
    require(not missing, f"missing: {', '.join(missing)}")
    listed = _listed(slave).get("MandatoryObjects", [])
    wrong = [f"{index:04X}h" for index in _MANDATORY if index not in listed]
    require(not wrong, f"not in [MandatoryObjects]: {', '.join(wrong)}")
    return "all three"


@item(
    "CiA 306",
    "keys of each object",
    "ParameterName of at most 241 characters, DataType and AccessType of each variable",
)
def eds_keys_of_objects(slave: Slave) -> str:
    sections = sections_of(slave)
    wrong = []
    count = 0
    for name in sections.sections():
        if not re.fullmatch(r"[0-9A-Fa-f]{4}(sub[0-9A-Fa-f]{1,2})?", name):
            continue
        count += 1
        keys = sections[name]
        title = keys.get("ParameterName", "")
        if not 0 < len(title) <= _LONGEST_NAME:
            wrong.append(f"[{name}] ParameterName")
        object_type = number_of(keys.get("ObjectType", "7"))
        if object_type in (8, 9):
            continue
        if "DataType" not in keys:
            wrong.append(f"[{name}] DataType")
        access = keys.get("AccessType", "").split(";")[0].strip().lower()
        if access not in _ACCESS_TYPES:
            wrong.append(f"[{name}] AccessType={access}")
    require(not wrong, "; ".join(wrong[:4]))
    return f"{count} sections"


@item(
    "CiA 306",
    "NrOfTXPDO and NrOfRXPDO of [DeviceInfo]",
    "the numbers of 18xxh and 14xxh objects",
)
def eds_numbers_of_pdos(slave: Slave) -> str:
    keys = sections_of(slave)["DeviceInfo"]
    answers = []
    for name, begin in (("NrOfTXPDO", 0x1800), ("NrOfRXPDO", 0x1400)):
        stated = number_of(keys.get(name, "0"))
        found = sum(begin <= index < begin + 0x200 for index in slave.dictionary)
        require(stated == found, f"{name}={stated}, and {found} objects")
        answers.append(f"{name}={stated}")
    return ", ".join(answers)


@item("CiA 306", "BaudRate entries of [DeviceInfo]", "at least one bit rate is supported")
def eds_bit_rates(slave: Slave) -> str:
    keys = sections_of(slave)["DeviceInfo"]
    rates = [rate for rate in _RATES if number_of(keys.get(f"BaudRate_{rate}", "0"))]
    require(bool(rates), "none")
    return f"{', '.join(map(str, rates))} kbit/s"
