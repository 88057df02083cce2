"""The types that a node sends or answers (DSDL of github.com/dronecan/DSDL, b4653c7 of 2026-02-05)."""

import struct
from binascii import crc_hqx
from collections.abc import Callable
from typing import NamedTuple


class DataType(NamedTuple):
    """A type of messages or of a service. ``seed``: the CRC of its signature, which that of a transfer begins with."""

    number: int
    seed: int
    pack: Callable[..., bytes]
    """Its fields as bytes: of those with a text or an array at the end what comes before that."""


def _type(number: int, signature: int, form: str = "") -> DataType:
    seed = crc_hqx(signature.to_bytes(8, "little"), 0xFFFF)
    return DataType(number, seed, struct.Struct("<" + form).pack)


# fmt: off
# made by the core: measured.py
STATUS          = _type(1034,  0xA9AF28AEA2FBB254)
STATUS_EXTENDED = _type(1036,  0x02DC203C50960EDC)
CIRCUIT_STATUS  = _type(1091,  0x8313D33D0DDDA115)
TEMPERATURE     = _type(1110,  0x70261C28A94144C6)
# made here
NODE_STATUS     = _type(341,   0x0F0868D0C1A7C6F1, "IBH")      # uptime in s, health << 6 | mode << 3, code of the manufacturer's own
LOG_MESSAGE     = _type(16383, 0xD654A48E0C049D75, "B")        # level << 5 | length of the source; source, text
ALLOCATION      = _type(1,     0x0B2A812620A11D40, "B")        # node-ID << 1 | is first; unique id or a part
GET_NODE_INFO   = _type(1,     0xEE468A8121C46A9E, "7sBBBIQBB16sB")  # NodeStatus, software, nothing, hardware, unique id, nothing; name
RESTART_NODE    = _type(5,     0x569E05394A3017F0, "B")        # is ok << 7
GET_SET         = _type(11,    0xA7B622F939D1A4D5)             # node.py
# fmt: on

OK, WARNING, ERROR = 0, 1, 2
"""Health of NodeStatus."""
OPERATIONAL, OFFLINE = 0, 7
"""Mode of NodeStatus."""
MAX_TEXT = 90
"""Of a LogMessage."""
