"""EDS texts made from an EDS: without some objects, and as the DCF of one node (CiA 306, clause 5)."""

import re
from collections.abc import Container, Mapping
from pathlib import PurePath

from kontronik_can_gw.canopen.data_types import DOMAIN_TYPE, OCTET_STRING, TYPE_BITS, UNICODE_STRING
from kontronik_can_gw.canopen.eds import Eds, Entry
from kontronik_can_gw.canopen.eds_sections import (
    OBJECT,
    blocks,
    integer,
    pair,
)
from kontronik_can_gw.errors import UserError

_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_OF_OBJECT = re.compile(r"([0-9a-f]{4})(sub[0-9a-f]+|denotation|objectlinks)?$", re.IGNORECASE)


def without(eds_data: bytes, indices: Container[int]) -> bytes:
    """The EDS without these objects: their sections and list entries removed, lists renumbered."""
    text = eds_data.decode("latin-1")
    end = "\r\n" if "\r\n" in text else "\n"
    left = [
        block
        for block in blocks(text)
        if not (match := _OF_OBJECT.match(block[0])) or int(match[1], 16) not in indices
    ]
    kept = [
        _shorter_list(lines, indices) if name.lower() in _LISTS else lines for name, lines in left
    ]
    return end.join(line for lines in kept for line in lines).encode("latin-1")


def _shorter_list(lines: list[str], indices: Container[int]) -> list[str]:
    kept: list[str] = []
    count = 0
    for line in lines:
        key, value = pair(line)
        if key.isdigit() and integer(value) in indices:
            continue
        count += key.isdigit()
        kept.append(f"{count}={value}" if key.isdigit() else line)
    total = f"SupportedObjects={count}"
    return [total if pair(line)[0] == "supportedobjects" else line for line in kept]


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
            lines = [line for line in lines if pair(line)[0] not in ("filename", "lasteds")]
            lines[1:1] = [f"FileName={file_name}", f"LastEDS={last}"]
        elif name.lower() == "deviceinfo":
            added = _commissioning(node_id, bitrate, values.get((0x1018, 4)), node_name)
        elif match := OBJECT.match(name):
            index, sub = int(match[1], 16), int(match[2] or "0", 16)
            lines = [line for line in lines if pair(line)[0] != "parametervalue"]
            if (index, sub) in texts:
                added = [f"ParameterValue={texts[index, sub]}"]
        end = max((number for number, line in enumerate(lines, 1) if line.strip()), default=0)
        result += lines[:end] + added + lines[end:]
    return "\r\n".join(result)


def _commissioning(
    node_id: int, bitrate: int, serial: float | bytes | None, node_name: str
) -> list[str]:
    """[DeviceComissioning]: CiA 306 spells it so."""
    lines = ["", "[DeviceComissioning]", f"NodeID=0x{node_id:02X}", f"NodeName={node_name}"]
    lines += [f"Baudrate={bitrate // 1000}", "NetNumber=0", "CANopenManager=0"]
    # 0: not known, so nothing that an LSS master could look for
    return lines + (
        [f"LSS_SerialNumber=0x{serial:08X}"] if isinstance(serial, int) and serial else []
    )


def _value_text(name: str, entry: Entry, value: float | bytes) -> str:
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        return str(value) if value < 0 else f"0x{value:0{TYPE_BITS[entry.data_type] // 4 or 1}X}"
    if entry.data_type == OCTET_STRING:
        return value.hex()
    text = value.decode("utf-16-le" if entry.data_type == UNICODE_STRING else "latin-1")
    if not (text.isascii() and text.isprintable()) or pair(f"={text}")[1] != text:
        what = f"the text {text!r} of {entry.name} cannot stand in a DCF."
        raise UserError(f"{name}: {entry.place} {what}")
    return text
