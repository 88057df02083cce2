"""Reads the EDS of the slave under test (CiA 306).

The object dictionary is made by the canopen package. It gets a cleaned copy of the text: without
comments, empty entries and dummy objects, which CiA 301 defines for mapping only. The items of the
EDS judge the sections as they are in the file.
"""

import io
import logging
import re
from collections.abc import Iterator
from configparser import NoOptionError
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from kontronik_can_gw.canopen.eds import OBJECT, Section, read_sections, text_of
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.light_imports import without_asammdf

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary

LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
_DEVICE_INFO = re.compile(
    r"(vendornumber|productnumber|revisionnumber|baudrate_\d+|simplebootup(master|slave)|"
    r"granularity|dynamicchannelssupported|groupmessaging|nrof[rt]xpdo|lss_supported)$"
)
_OBJECT_NUMBERS = ("objecttype", "datatype", "pdomapping", "subnumber", "compactsubobj")
_FIRST_OBJECT = 0x1000
"""Lower indices are data types, which [DummyUsage] permits as entries of a mapping."""
_VARIABLES = (2, 7)
"""ObjectType of a domain and of a variable."""
_OBJECT_TYPES = (*_VARIABLES, 8, 9)
"""Also an array and a record. The others of CiA 301 are types, which have lower indices."""


class EdsFile(NamedTuple):
    """A parsed EDS."""

    sections: dict[str, Section]
    """The sections by name in lower case, as the file has them."""
    dictionary: "ObjectDictionary"


def read_eds(path: Path, node_id: int) -> EdsFile:
    """Return the EDS of a node. Raises UserError with the section and key of each mistake."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}.") from None
    problems: list[str] = []
    sections = read_sections(data, problems)
    problems += _problems(sections)
    if "1000" not in sections:
        raise UserError(f"{path}: does not have the object 1000h, so it is not an EDS.")
    if problems:
        raise UserError(*(f"{path}: {problem}" for problem in problems[:20]))
    return EdsFile(sections, _dictionary(path, sections, node_id))


def section_of(sections: dict[str, Section], name: str) -> Section:
    """Return a section, or an empty one if the file does not have it."""
    return sections.get(name.lower(), Section(name))


def _problems(sections: dict[str, Section]) -> Iterator[str]:
    """Yield the mistakes that prevent an object dictionary."""
    missing = set()
    for name, section in sections.items():
        yield from _wrong_numbers(name, section)
        match = OBJECT.match(name)
        if match is None:
            continue
        if match[1] not in sections and match[1] not in missing:
            missing.add(match[1])
            yield f"[{section.name}] there is no section [{match[1].upper()}]. Add it."
        is_variable = False
        with suppress(ValueError):  # reported as a wrong number
            object_type = section.number("ObjectType", 7)
            is_variable = object_type in _VARIABLES
            is_head = match[2] is None and int(match[1], 16) >= _FIRST_OBJECT
            if is_head and object_type not in _OBJECT_TYPES:
                problem = "not the type of an object. Use 0x2, 0x7, 0x8 or 0x9."
                yield f"[{section.name}] {section.quoted('ObjectType')}: {problem}"
        if (match[2] or is_variable) and not section.get("DataType"):
            yield f"[{section.name}] DataType: missing. Add it."


def _wrong_numbers(name: str, section: Section) -> Iterator[str]:
    """Yield the entries of a section that must be numbers and are not."""
    is_list = name in (each.lower() for each in LISTS)
    is_object = OBJECT.match(name) is not None
    for key, (written, _) in section.keys.items():
        is_number = is_list or (is_object and key in _OBJECT_NUMBERS)
        if not is_number and not (name == "deviceinfo" and _DEVICE_INFO.match(key)):
            continue
        try:
            section.number(written)
        except ValueError as error:
            yield f"[{section.name}] {error}"


def _dictionary(path: Path, sections: dict[str, Section], node_id: int) -> "ObjectDictionary":
    with without_asammdf():
        import canopen
    # the items judge the values of the EDS themselves
    logging.getLogger("canopen").addHandler(logging.NullHandler())
    named = io.StringIO(text_of(_cleaned(sections)))
    named.name = path.name
    try:
        return canopen.import_od(named, node_id)
    except NoOptionError as error:
        raise UserError(f"{path}: [{error.section}] {error.option}: missing. Add it.") from None
    except Exception as error:  # the library raises exceptions of any kind
        raise UserError(f"{path}: is not a valid EDS: {error}.") from None


def _cleaned(sections: dict[str, Section]) -> dict[str, Section]:
    """Return the sections that the library needs, objects before their sub-indices."""
    cleaned = {}
    for name in sorted(sections):
        match = OBJECT.match(name)
        if name in ("comments", "dummyusage") or (match and int(match[1], 16) < _FIRST_OBJECT):
            continue
        section = sections[name]
        title = name.upper().replace("SUB", "sub") if match else section.name
        cleaned[name] = Section(title)
        for key, value in section.keys.values():
            if value:
                cleaned[name].set(key, value)
        if match:
            # absent ones are judged by an item
            cleaned[name].set("ParameterName", section.get("ParameterName"))
            cleaned[name].set("AccessType", section.get("AccessType"))
    return cleaned
