"""The DCF of a node, made from its EDS (CiA 306, 5)."""

from collections.abc import Mapping
from pathlib import PurePath

from kontronik_can_gw.canopen.eds import (
    DOMAIN_TYPE,
    OBJECT,
    OCTET_STRING,
    TYPE_BITS,
    UNICODE_STRING,
    Eds,
    EdsEntry,
    Section,
    bare,
    read_sections,
    text_of,
)
from kontronik_can_gw.errors import UserError


def dcf(
    eds: Eds,
    node_id: int,
    bitrate: int,
    values: Mapping[tuple[int, int], int | float | bytes],
    node_name: str,
    file_name: str,
) -> str:
    """Return the DCF of one node, made from its EDS (CiA 306, clause 5).

    The DCF has a ParameterValue for each of ``values``, and [DeviceComissioning]. Lines end in
    CR LF.

    ``bitrate`` is in bit/s. ``file_name`` is the name of the DCF. LastEDS holds the name of the
    EDS. Values are as in the node, with the node-ID added. Domains are left out, because a DCF
    refers to files for them. Real numbers are written as decimals, which the canopen package reads.

    KeyError for a value without an entry. UserError for a text that an INI file cannot hold.
    """
    entries = {(entry.index, entry.sub): entry for entry in eds.entries}
    texts: dict[tuple[int, int], str] = {}
    for place, value in values.items():
        if entries[place].data_type != DOMAIN_TYPE:
            texts[place] = _value_text(eds.name, entries[place], value)
    sections = read_sections(eds.data, [])
    for name, section in sections.items():
        section.keys.pop("parametervalue", None)
        match = OBJECT.match(name)
        if match is not None:
            index = int(match[1], 16)
            sub = int(match[2] or "0", 16)
            text = texts.get((index, sub))
            if text is not None:
                section.set("ParameterValue", text)
    file_info = sections.get("fileinfo")
    if file_info is not None:
        eds_name = PurePath(eds.name).name
        ascii_name = eds_name.encode("ascii", "replace").decode("ascii")
        file_info.set("FileName", file_name)
        file_info.set("LastEDS", ascii_name)
    sections["devicecomissioning"] = _device_commissioning(
        node_id,
        bitrate,
        node_name,
        values.get((0x1018, 4)),
    )
    return text_of(sections)


def _device_commissioning(
    node_id: int,
    bitrate: int,
    node_name: str,
    serial: float | bytes | None,
) -> Section:
    node = Section("DeviceComissioning")  # the spelling of CiA 306
    node.set("NodeID", f"0x{node_id:02X}")
    node.set("NodeName", node_name)
    node.set("Baudrate", bitrate // 1000)
    node.set("NetNumber", 0)
    node.set("CANopenManager", 0)
    # 0 means unknown, and an LSS master could not search for it
    if isinstance(serial, int) and serial:
        node.set("LSS_SerialNumber", f"0x{serial:08X}")
    return node


def _value_text(name: str, entry: EdsEntry, value: float | bytes) -> str:
    """Return the text of a ParameterValue. UserError if an INI file cannot hold it."""
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        if value < 0:
            return str(value)
        digits = TYPE_BITS[entry.data_type] // 4 or 1
        return f"0x{value:0{digits}X}"
    if entry.data_type == OCTET_STRING:
        return value.hex()
    coding = "utf-16-le" if entry.data_type == UNICODE_STRING else "latin-1"
    text = value.decode(coding)
    is_plain = text.isascii() and text.isprintable()
    if not is_plain or bare(f"={text}")[1:].strip() != text:
        problem = f"the text {text!r} of {entry.name} cannot be written in a DCF."
        raise UserError(f"{name}: {entry.place} {problem}")
    return text
