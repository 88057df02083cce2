"""EDS texts made from an EDS: without some objects, and as the DCF of one node (CiA 306, clause 5)."""

import re
from collections.abc import Container, Mapping
from pathlib import PurePath

from kontronik_can_gw.canopen.eds import (
    DOMAIN_TYPE,
    OBJECT,
    OCTET_STRING,
    TYPE_BITS,
    UNICODE_STRING,
    Eds,
    Entry,
    Section,
    bare,
    integer,
    read_sections,
    text_of,
)
from kontronik_can_gw.errors import UserError

_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_OF_OBJECT = re.compile(r"([0-9a-f]{4})(sub[0-9a-f]+|denotation|objectlinks)?$", re.IGNORECASE)


def without(eds_data: bytes, indices: Container[int]) -> bytes:
    """The EDS without these objects: their sections and list entries removed, lists renumbered."""
    sections = {
        name: section
        for name, section in read_sections(eds_data, []).items()
        if not (match := _OF_OBJECT.match(name)) or int(match[1], 16) not in indices
    }
    for section in (sections[name] for name in _LISTS if name in sections):
        listed = [value for key, (_, value) in section.keys.items() if key.isdigit()]
        left = [value for value in listed if integer(value) not in indices]
        section.keys = {}
        section.set("SupportedObjects", len(left))
        for number, value in enumerate(left, 1):
            section.set(str(number), value)
    return text_of(sections).encode("ascii", "replace")


def dcf(
    eds: Eds,
    node_id: int,
    bitrate: int,
    values: Mapping[tuple[int, int], int | float | bytes],
    node_name: str,
    file_name: str,
) -> str:
    """The EDS as the DCF of one node (CiA 306, clause 5): with a ParameterValue for each of ``values``, and [DeviceComissioning].

    ``bitrate`` in bit/s. ``file_name`` is the DCF's; LastEDS names the EDS. Values are as they are in the node, with the node-ID worked in.
    Domains are left out: a DCF names files for them. Real numbers are written as decimals, which the canopen package reads. Lines end in
    CR LF. KeyError for a value that has no entry, UserError for a text that an INI file cannot hold.
    """
    entries = {(entry.index, entry.sub): entry for entry in eds.entries}
    texts = {
        at: _value_text(eds.name, entries[at], value)
        for at, value in values.items()
        if entries[at].data_type != DOMAIN_TYPE
    }
    sections = read_sections(eds.data, [])
    for name, section in sections.items():
        section.keys.pop("parametervalue", None)
        if match := OBJECT.match(name):
            at = int(match[1], 16), int(match[2] or "0", 16)
            if at in texts:
                section.set("ParameterValue", texts[at])
    if (about := sections.get("fileinfo")) is not None:
        about.set("FileName", file_name)
        about.set("LastEDS", PurePath(eds.name).name.encode("ascii", "replace").decode("ascii"))
    node = sections["devicecomissioning"] = Section("DeviceComissioning")  # CiA 306 spells it so
    node.set("NodeID", f"0x{node_id:02X}")
    node.set("NodeName", node_name)
    node.set("Baudrate", bitrate // 1000)
    node.set("NetNumber", 0)
    node.set("CANopenManager", 0)
    # 0: not known, so nothing that an LSS master could look for
    if isinstance(serial := values.get((0x1018, 4)), int) and serial:
        node.set("LSS_SerialNumber", f"0x{serial:08X}")
    return text_of(sections)


def _value_text(name: str, entry: Entry, value: float | bytes) -> str:
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        return str(value) if value < 0 else f"0x{value:0{TYPE_BITS[entry.data_type] // 4 or 1}X}"
    if entry.data_type == OCTET_STRING:
        return value.hex()
    text = value.decode("utf-16-le" if entry.data_type == UNICODE_STRING else "latin-1")
    if not (text.isascii() and text.isprintable()) or bare(f"={text}")[1:].strip() != text:
        what = f"the text {text!r} of {entry.name} cannot stand in a DCF."
        raise UserError(f"{name}: {entry.place} {what}")
    return text
