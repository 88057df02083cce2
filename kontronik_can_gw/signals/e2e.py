"""End-to-end protection of AUTOSAR (PRS_E2EProtocol): an alive counter and a CRC in a frame.

The profiles differ only in the numbers of ``PROFILES``. Both cores compute CRCs from these numbers
(native/tables.py passes them to the core in C).
"""

from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, cached_property

DATA_IDS = 16
"""Number of data IDs of a profile with a list. The counter selects one of them."""


class DataIdMode(Enum):
    """Bytes of the data ID in the CRC."""

    BOTH = (16, 2, False)
    """Both bytes before the frame, the low byte first."""
    ALTERNATING = (16, 1, False)
    """One byte before the frame: the low byte with an even counter, else the high byte."""
    NIBBLE = (12, 2, False)
    """The low byte and a 0 before the frame, which contains the other 4 bits."""
    LIST = (8, 1, True)
    """The counter's entry of a data ID list of 16, after the frame."""
    LAST = (16, 2, True)
    """Both bytes after the frame, the low byte first."""

    def __init__(self, id_bits: int, id_bytes: int, is_id_last: bool) -> None:
        self.id_bits = id_bits
        self.id_bytes = id_bytes
        """Number of bytes of the data ID in the CRC."""
        self.is_id_last = is_id_last
        """True if the data ID follows the frame in the CRC, False if it precedes the frame."""


@dataclass(frozen=True)
class Profile:
    """The numbers of a profile."""

    name: str
    polynomial: int
    """Polynomial of the CRC, whose most significant bit is first."""
    crc_bits: int
    start: int
    """Start value of the CRC."""
    final_xor: int
    counters: int
    """Number of values of the counter, which begins at 0."""
    mode: DataIdMode
    crc_byte: int | None = None
    """The CRC's byte in the frame. None: any."""
    counter_bits: int | None = None
    """Length of the counter, which begins in the byte after the CRC. None: any length and place."""
    max_bytes: int = 30
    """The longest message that the specification allows."""

    @property
    def crc_bytes(self) -> int:
        return self.crc_bits // 8

    @property
    def ids(self) -> int:
        """Number of data IDs that a message needs."""
        return DATA_IDS if self.mode is DataIdMode.LIST else 1

    @property
    def largest_id(self) -> int:
        """The largest data ID."""
        return (1 << self.mode.id_bits) - 1


_P1 = Profile(
    name="1A",
    polynomial=0x1D,
    crc_bits=8,
    start=0,
    final_xor=0,
    counters=15,
    mode=DataIdMode.BOTH,
)
_P5 = Profile(
    name="5",
    polynomial=0x1021,
    crc_bits=16,
    start=0xFFFF,
    final_xor=0,
    counters=256,
    mode=DataIdMode.LAST,
    counter_bits=8,
    max_bytes=4096,
)
_P22 = Profile(
    name="22",
    polynomial=0x2F,
    crc_bits=8,
    start=0xFF,
    final_xor=0xFF,
    counters=16,
    mode=DataIdMode.LIST,
    counter_bits=4,
    max_bytes=32,
)
_ALL = (
    _P1,
    replace(_P1, name="1B", mode=DataIdMode.ALTERNATING),
    replace(_P1, name="1C", mode=DataIdMode.NIBBLE),
    replace(_P22, name="2", crc_byte=0),
    _P5,
    replace(_P1, name="11A"),
    replace(_P1, name="11C", mode=DataIdMode.NIBBLE),
    _P22,
)
PROFILES = {profile.name: profile for profile in _ALL}
"""The supported profiles by name. The letter is the variant, which defines the data ID's mode.

Profiles 1 and 11 give equal frames. Profiles 2 and 22 give equal frames, but only profile 22 allows
the CRC in any byte.
"""


@dataclass(frozen=True)
class Protection:
    """Profile and data IDs of a message."""

    profile: Profile
    data_ids: tuple[int, ...]

    def __str__(self) -> str:
        digits = 2 if self.profile.ids > 1 else 4
        ids = " ".join(f"{data_id:0{digits}X}" for data_id in self.data_ids)
        noun = "data ID" if len(self.data_ids) == 1 else "data IDs"
        return f"AUTOSAR E2E profile {self.profile.name}, {noun} {ids}h"

    @property
    def nibble(self) -> int:
        """Bits 8 to 11 of the data ID, which a frame contains with DataIdMode.NIBBLE."""
        return self.data_ids[0] >> 8 & 0xF

    @cached_property
    def ids_by_counter(self) -> tuple[int, ...]:
        """The number whose lowest ``mode.id_bytes`` bytes enter the CRC, by counter modulo 16."""
        mode = self.profile.mode
        if mode is DataIdMode.LIST:
            return self.data_ids
        (data_id,) = self.data_ids
        if mode is DataIdMode.NIBBLE:
            return (data_id & 0xFF,) * DATA_IDS
        if mode is DataIdMode.ALTERNATING:
            return (data_id & 0xFF, data_id >> 8) * (DATA_IDS // 2)
        return (data_id,) * DATA_IDS

    def crc(self, data: bytes, at: int, counter: int) -> int:
        """Return the CRC of a frame with this counter. ``at`` is the first byte of the CRC."""
        mode = self.profile.mode
        data_id = self.ids_by_counter[counter % DATA_IDS].to_bytes(2, "little")[: mode.id_bytes]
        covered = data[:at] + data[at + self.profile.crc_bytes :]
        covered = covered + data_id if mode.is_id_last else data_id + covered
        bits = self.profile.crc_bits
        table = _crc_table(self.profile.polynomial, bits)
        mask = (1 << bits) - 1
        value = self.profile.start
        for byte in covered:
            value = value << 8 & mask ^ table[value >> bits - 8 ^ byte]
        return value ^ self.profile.final_xor

    def insert_crc(self, data: bytes, at: int, counter: int) -> bytes:
        """Return the frame with its CRC from byte ``at`` on, the low byte first."""
        size = self.profile.crc_bytes
        crc = self.crc(data, at, counter).to_bytes(size, "little")
        return data[:at] + crc + data[at + size :]


@cache
def _crc_table(polynomial: int, bits: int) -> tuple[int, ...]:
    """Return the CRC of each byte, with a start value of 0."""
    table = []
    for byte in range(256):
        value = byte << bits - 8
        for _ in range(8):
            value <<= 1
            if value >> bits:
                value ^= 1 << bits | polynomial
        table.append(value)
    return tuple(table)
