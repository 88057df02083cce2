"""EDS texts made from an EDS: without some objects, and as the DCF of one node (CiA 306, clause 5)."""

import re
from collections.abc import Container, Mapping
from pathlib import PurePath

from kontronik_can_gw.canopen.data_types import DOMAIN_TYPE, OCTET_STRING, TYPE_BITS, UNICODE_STRING
from kontronik_can_gw.canopen.eds import Eds
from kontronik_can_gw.canopen.eds_object import Entry
from kontronik_can_gw.canopen.eds_sections import (
    OBJECT,
    bare,
    blocks,
    integer,
    key,
    spelling,
    value,
)
from kontronik_can_gw.errors import UserError

_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_OF_OBJECT = re.compile(
    r"([0-9a-f]{4})(sub[0-9a-f]+|name|value|denotation|objectlinks)?$", re.IGNORECASE
)


def without(eds_data: bytes, indices: Container[int]) -> bytes:
    """The EDS without these objects: their sections and list entries removed, lists renumbered, NrOfTXPDO counted anew."""
    text = eds_data.decode("latin-1")
    end = "\r\n" if "\r\n" in text else "\n"
    kept_blocks = [
        block
        for block in blocks(text)
        if not (match := _OF_OBJECT.match(block[0])) or int(match[1], 16) not in indices
    ]
    left = {name.lower() for name, _ in kept_blocks}
    pdos = sum(f"{index:04x}" in left for index in range(0x1800, 0x1A00))
    kept: list[str] = []
    for name, lines in kept_blocks:
        if name.lower() in _LISTS:
            kept += _shorter_list(lines, indices)
        elif name.lower() == "deviceinfo":
            kept += [f"NrOfTXPDO={pdos}" if key(line) == "nroftxpdo" else line for line in lines]
        else:
            kept += lines
    return end.join(kept).encode("latin-1")


def _shorter_list(lines: list[str], indices: Container[int]) -> list[str]:
    kept: list[str] = []
    count = 0
    for line in lines:
        if not key(line).isdigit():
            kept.append(line)
            continue
        if integer(value(line)) in indices:
            continue
        count += 1
        kept.append(f"{count}={value(line)}")
    return [
        f"SupportedObjects={count}" if key(line) == "supportedobjects" else line for line in kept
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
    Domains are left out: a DCF names files for them. Real numbers are written as decimals, which the canopen package reads. Lines end in
    CR LF. KeyError for a value that has no entry, UserError for a text that an INI file cannot hold.
    """
    entries = {(entry.index, entry.sub): entry for entry in eds.entries}
    texts = {
        at: _value_text(eds.name, entries[at], value)
        for at, value in values.items()
        if entries[at].data_type != DOMAIN_TYPE
    }
    result: list[str] = []
    for name, lines in blocks(eds.data.decode("ascii")):
        added: list[str] = []
        if name.lower() == "fileinfo":
            last = PurePath(eds.name).name.encode("ascii", "replace").decode("ascii")
            lines = [line for line in lines if key(line) not in ("filename", "lasteds")]
            lines[1:1] = [f"FileName={file_name}", f"LastEDS={last}"]
        elif name.lower() == "deviceinfo":
            added = _commissioning(node_id, bitrate, values.get((0x1018, 4)), node_name)
        elif match := OBJECT.match(name):
            index, sub = int(match[1], 16), int(match[2] or "0", 16)
            if any(key(line) == "compactsubobj" and value(line) not in ("", "0") for line in lines):
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
    if (
        isinstance(serial, int) and serial
    ):  # 0: not known, so nothing that an LSS master could look for
        lines.append(f"LSS_SerialNumber=0x{serial:08X}")
    return lines


def _compact_values(index: int, texts: Mapping[tuple[int, int], str]) -> list[str]:
    """The values of an object with CompactSubObj stand in a section of their own (which the canopen package ignores)."""
    values = [f"{at[1]}={text}" for at, text in sorted(texts.items()) if at[0] == index and at[1]]
    return ["", f"[{index:04X}Value]", f"NrOfEntries={len(values)}", *values] if values else []


def _value_text(name: str, entry: Entry, value: float | bytes) -> str:
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        return str(value) if value < 0 else f"0x{value:0{TYPE_BITS[entry.data_type] // 4 or 1}X}"
    if entry.data_type == OCTET_STRING:
        return value.hex()
    text = value.decode("utf-16-le" if entry.data_type == UNICODE_STRING else "latin-1")
    if (
        not text.isascii()
        or text != text.strip()
        or (text and not text.isprintable())
        or bare(f"={text}") != f"={text}"
    ):
        where = spelling(entry.index, entry.sub)
        raise UserError(
            f"{name}: [{where}] the text {text!r} of {entry.name} cannot stand in a DCF."
        )
    return text
