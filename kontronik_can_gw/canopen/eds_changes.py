"""EDS texts with few changes."""

import re
from collections.abc import Container

from kontronik_can_gw.canopen.eds import Section, integer, read_sections, text_of

_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_NO_VENDOR = " (no CiA vendor-ID)"
"""End of the VendorName in the shipped EDS."""
_OF_OBJECT = re.compile(r"([0-9a-f]{4})(sub[0-9a-f]+|denotation|objectlinks)?$", re.IGNORECASE)


def without(eds_data: bytes, indices: Container[int]) -> bytes:
    """Return the EDS without the objects of these indices. Its lists are numbered again."""
    sections: dict[str, Section] = {}
    for name, section in read_sections(eds_data, []).items():
        match = _OF_OBJECT.match(name)
        if match is None or int(match[1], 16) not in indices:
            sections[name] = section
    for name in _LISTS:
        if name in sections:
            _remove_from_list(sections[name], indices)
    text = text_of(sections)
    return text.encode("ascii", "replace")


def with_vendor_id(eds_data: bytes, vendor_id: int) -> bytes:
    """Return the EDS with this vendor-ID in [DeviceInfo] and as the default of 1018h:1."""
    sections = read_sections(eds_data, [])
    text = f"0x{vendor_id:08X}"
    for name, key in (("deviceinfo", "VendorNumber"), ("1018sub1", "DefaultValue")):
        if name in sections:
            sections[name].set(key, text)
    device = sections.get("deviceinfo")
    if device is not None:
        device.set("VendorName", device.get("VendorName").removesuffix(_NO_VENDOR))
    return text_of(sections).encode("ascii", "replace")


def _remove_from_list(section: Section, indices: Container[int]) -> None:
    left = []
    for key, (_, value) in section.keys.items():
        if key.isdigit() and integer(value) not in indices:
            left.append(value)
    section.keys = {}
    section.set("SupportedObjects", len(left))
    for number, value in enumerate(left, 1):
        section.set(str(number), value)
