"""The EDS of the slave: CiA 306."""

from kontronik_can_gw.canopen.eds import OBJECT
from kontronik_can_gw.desk.conformance.eds_file import LISTS, section_of
from kontronik_can_gw.desk.conformance.items import require
from kontronik_can_gw.desk.conformance.slave import Slave

_SECTIONS = ("FileInfo", "DeviceInfo", *LISTS)
_MANDATORY = (0x1000, 0x1001, 0x1018)
_ACCESS_TYPES = ("ro", "wo", "rw", "rwr", "rww", "const")
_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_LONGEST_NAME = 241


def eds_sections(slave: Slave) -> str:
    missing = [name for name in _SECTIONS if name.lower() not in slave.eds]
    required = [name for name in missing if name not in ("OptionalObjects", "ManufacturerObjects")]
    require(not required, f"missing: {', '.join(required)}")
    return f"{len(_SECTIONS) - len(missing)} of {len(_SECTIONS)}"


def _listed(slave: Slave) -> dict[str, list[int]]:
    """Return the indices in each list of objects."""
    found = {}
    for name in LISTS:
        section = section_of(slave.eds, name)
        keys = section.keys.keys() - {"supportedobjects"}
        found[name] = sorted(section.number(key) for key in keys)
    return found


def eds_lists_of_objects(slave: Slave) -> str:
    total: list[int] = []
    for name, indices in _listed(slave).items():
        stated = section_of(slave.eds, name).number("SupportedObjects")
        require(stated == len(indices), f"{name}: SupportedObjects={stated}, {len(indices)} listed")
        total += indices
    require(len(set(total)) == len(total), "an object is in two lists")
    without = [index for index in total if f"{index:04x}" not in slave.eds]
    require(not without, f"no section: {', '.join(f'{index:04X}h' for index in without[:4])}")
    written = {int(match[1], 16) for match in map(OBJECT.match, slave.eds) if match}
    unlisted = sorted(written - set(total))
    require(not unlisted, f"in no list: {', '.join(f'{index:04X}h' for index in unlisted[:4])}")
    return f"{len(total)} objects"


def eds_mandatory_objects(slave: Slave) -> str:
    missing = [f"{index:04X}h" for index in _MANDATORY if index not in slave.dictionary]
    require(not missing, f"missing: {', '.join(missing)}")
    listed = _listed(slave).get("MandatoryObjects", [])
    wrong = [f"{index:04X}h" for index in _MANDATORY if index not in listed]
    require(not wrong, f"not in [MandatoryObjects]: {', '.join(wrong)}")
    return "all three"


def eds_keys_of_objects(slave: Slave) -> str:
    sections = [section for name, section in slave.eds.items() if OBJECT.match(name)]
    wrong = []
    for section in sections:
        if not 0 < len(section.get("ParameterName")) <= _LONGEST_NAME:
            wrong.append(f"[{section.name}] ParameterName")
        is_variable = section.number("ObjectType", 7) not in (8, 9)
        if is_variable and section.get("AccessType").lower() not in _ACCESS_TYPES:
            wrong.append(f"[{section.name}] {section.quoted('AccessType')}")
    require(not wrong, "; ".join(wrong[:4]))
    return f"{len(sections)} sections"


def eds_numbers_of_pdos(slave: Slave) -> str:
    info = section_of(slave.eds, "DeviceInfo")
    answers = []
    for name, begin in (("NrOfTXPDO", 0x1800), ("NrOfRXPDO", 0x1400)):
        stated = info.number(name)
        found = sum(begin <= index < begin + 0x200 for index in slave.dictionary)
        require(stated == found, f"{name}={stated}, and {found} objects")
        answers.append(f"{name}={stated}")
    return ", ".join(answers)


def eds_bit_rates(slave: Slave) -> str:
    info = section_of(slave.eds, "DeviceInfo")
    rates = [rate for rate in _RATES if info.number(f"BaudRate_{rate}")]
    require(bool(rates), "none")
    return f"{', '.join(map(str, rates))} kbit/s"
