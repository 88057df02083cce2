"""What one node keeps over a restart, and the text of the file that it is kept in (objects 1010h, 1011h and the LSS node-ID).

Two lines of JSON, each ended by a line feed, in one form only::

    {"format":"kontronik-can-gw parameters","version":1,"crc32":"5D8B2C1F"}
    {"node_id":7,"communication":{"1017:00":"F401"},"application":{"2100:01":"07"}}

``crc32`` is the CRC-32 (zlib) of the second line with its line feed. Keys are index:sub-index in hexadecimal, in ascending
order; values are the raw little-endian bytes in hexadecimal; ``node_id`` is null if none was set over the bus.
"""

import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from kontronik_can_gw.node_state import UNCONFIGURED

VERSION = 1
VERIFY = 0x1020
COMMUNICATION = range(0x1000, 0x2000)
APPLICATION = range(0x2000, 0x10000)
_WITH_COB_ID = frozenset({0x1005, 0x1014, *range(0x1800, 0x1A00)})

_HEADER_START = re.compile(rb'\{"format":"kontronik-can-gw parameters","version":([0-9]{1,9})[,}]')
_CRC = re.compile(rb'"crc32":"([0-9A-F]{8})"\}')


@dataclass(frozen=True)
class Stored:
    """What one node keeps over a restart. Keys of both mappings: index << 8 | sub-index; values: raw little-endian bytes."""

    node_id: int | None = None
    """1..127, or 255 (unconfigured), as set over the bus; None: as configured."""
    communication: Mapping[int, bytes] = field(default_factory=dict)
    """Objects 1000h..1FFFh."""
    application: Mapping[int, bytes] = field(default_factory=dict)
    """Objects 2000h..FFFFh."""

    @property
    def has_ids(self) -> bool:
        """Whether a node-ID or COB-IDs are in it."""
        return self.node_id is not None or any(
            key >> 8 in _WITH_COB_ID for key in self.communication
        )

    def without_ids(self) -> "Stored":
        """Without the node-ID and COB-IDs."""
        left = {k: data for k, data in self.communication.items() if k >> 8 not in _WITH_COB_ID}
        return replace(self, node_id=None, communication=left).unverified()

    def unverified(self) -> "Stored":
        """Without 1020h: these parameters are not, or no longer, all of the configuration that it names."""
        left = {key: data for key, data in self.communication.items() if key >> 8 != VERIFY}
        return replace(self, communication=left)


def encode(stored: Stored) -> bytes:
    """Write the file's text: ASCII, the same for equal content. ValueError for what is no node-ID, or no key of its mapping."""
    node_id = stored.node_id
    if node_id is not None and (
        type(node_id) is not int or not (1 <= node_id <= 127 or node_id == UNCONFIGURED)
    ):
        raise ValueError(f"node_id {node_id!r} is not 1..127, 255 or null")
    content = {
        "node_id": node_id,
        "communication": _texts(stored.communication, COMMUNICATION),
        "application": _texts(stored.application, APPLICATION),
    }
    body = _line(content)
    header = {
        "format": "kontronik-can-gw parameters",
        "version": VERSION,
        "crc32": f"{zlib.crc32(body):08X}",
    }
    return _line(header) + body


def decode(data: bytes) -> Stored:
    """Read the file's text. ValueError with the reason for everything that ``encode`` of this version does not write."""
    if not data:
        raise ValueError("the file is empty")
    start = _HEADER_START.match(data)
    if start is None:
        raise ValueError("the first line is not that of a parameter file")
    if int(start[1]) != VERSION:
        raise ValueError(
            f"format version {int(start[1])} is unknown, this program knows version {VERSION}"
        )
    header, _, body = data.partition(b"\n")
    crc = _CRC.fullmatch(header, start.end())
    if crc is None:
        raise ValueError("the first line is damaged")
    if int(crc[1], 16) != zlib.crc32(body):
        raise ValueError("the content does not fit its CRC-32: damaged or truncated")
    try:
        content = json.loads(body)
        values = [_values(content[profile]) for profile in ("communication", "application")]
        stored = Stored(content["node_id"], *values)
        if encode(stored) == data:
            return stored
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        pass  # written by hand or by another program, for the CRC fits
    raise ValueError("the content is not in the form in which this program writes it")


def _line(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode("ascii") + b"\n"


def _texts(values: Mapping[int, bytes], indices: range) -> dict[str, str]:
    for key in values:
        if key >> 8 not in indices:
            raise ValueError(f"{key >> 8:04X}h is not {indices[0]:04X}h to {indices[-1]:04X}h")
    return {f"{key >> 8:04X}:{key & 0xFF:02X}": values[key].hex().upper() for key in sorted(values)}


def _values(texts: Mapping[str, str]) -> dict[int, bytes]:
    return {int(key.replace(":", ""), 16): bytes.fromhex(text) for key, text in texts.items()}
