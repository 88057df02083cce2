"""Makes texts from an EDS: a shorter EDS, and the DCF of one node (CiA 306, clause 5)."""

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
    """Return the EDS without these objects. The remaining entries of its lists are renumbered."""
    sections = {}
    for name, section in read_sections(eds_data, []).items():
        match = _OF_OBJECT.match(name)
        if match is None or int(match[1], 16) not in indices:
            sections[name] = section
    for name in _LISTS:
        if name not in sections:
            continue
        section = sections[name]
        listed = [value for key, (_, value) in section.keys.items() if key.isdigit()]
        kept = [value for value in listed if integer(value) not in indices]
        section.keys = {}
        section.set("SupportedObjects", len(kept))
        for number, value in enumerate(kept, 1):
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
    """Return the EDS as the DCF of one node (CiA 306, clause 5).

    It has a ParameterValue for each of ``values``, and the section [DeviceComissioning]. The node's
    values already include the node-ID. ``bitrate`` is in bit/s. ``file_name`` is the name of the
    DCF, and LastEDS has the name of the EDS. Lines end in CR LF.

    Domains are left out, because a DCF has file names for them. Real numbers are written as
    decimals, which the package canopen can read. Raises KeyError for a value without an entry, and
    UserError for a text that an INI file cannot contain.
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
        match = OBJECT.match(name)
        if match is not None:
            at = (int(match[1], 16), int(match[2] or "0", 16))
            if at in texts:
                section.set("ParameterValue", texts[at])
    file_info = sections.get("fileinfo")
    if file_info is not None:
        eds_name = PurePath(eds.name).name
        file_info.set("FileName", file_name)
        file_info.set("LastEDS", eds_name.encode("ascii", "replace").decode("ascii"))
    node = Section("DeviceComissioning")  # this is the spelling of CiA 306
    sections["devicecomissioning"] = node
    node.set("NodeID", f"0x{node_id:02X}")
    node.set("NodeName", node_name)
    node.set("Baudrate", bitrate // 1000)
    node.set("NetNumber", 0)
    node.set("CANopenManager", 0)
    serial = values.get((0x1018, 4))
    if isinstance(serial, int) and serial != 0:  # 0: unknown, so an LSS master cannot search for it
        node.set("LSS_SerialNumber", f"0x{serial:08X}")
    return text_of(sections)


def _value_text(name: str, entry: Entry, value: float | bytes) -> str:
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        if value < 0:
            return str(value)
        digits = TYPE_BITS[entry.data_type] // 4 or 1
        return f"0x{value:0{digits}X}"
    if entry.data_type == OCTET_STRING:
        return value.hex()
    text = value.decode("utf-16-le" if entry.data_type == UNICODE_STRING else "latin-1")
    is_plain = text.isascii() and text.isprintable()
    if not is_plain or bare(f"={text}")[1:].strip() != text:
        problem = f"the text {text!r} of {entry.name} cannot stand in a DCF."
        raise UserError(f"{name}: {entry.place} {problem}")
    return text
