"""Compiled messages: their signals, bits, what fills them and when they are sent. Made from a DBC (dbc/prepare.py) or a PDO mapping."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, Flag
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple
from zlib import crc32

from kontronik_can_gw.esc.values import Group, Value


class SendType(Flag):
    """When a message is sent. Several may hold."""

    CYCLIC = 1
    EVENT = 2
    """With each UART frame (or change of the link) that brings one of its signals."""
    ON_CHANGE = 4


SEND_TYPES = {
    "Cyclic": SendType.CYCLIC,
    "Event": SendType.EVENT,
    "OnChange": SendType.ON_CHANGE,
    "CyclicAndEvent": SendType.CYCLIC | SendType.EVENT,
    "CyclicAndOnChange": SendType.CYCLIC | SendType.ON_CHANGE,
}
"""Send types by the names that a configuration has for them."""
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)

EXPECTED_LIVE_HZ = 100
"""What a UART is expected to bring, for the computed bus load only; the gateway sends as frames come."""


class Role(Enum):
    """What fills a signal."""

    SOURCE = "source"
    ALIVE = "alive counter"
    CRC = "CRC"
    CONSTANT = "constant"
    MULTIPLEXER = "multiplexer"


class Piece(NamedTuple):
    """``(raw >> shift & (1 << width) - 1) << at``, ``at`` counted from bit 0 of byte 0 upward."""

    shift: int
    width: int
    at: int


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One signal with what fills it. Raw value of a source in steps x: ``x * slope + intercept``, rounded."""

    name: str
    unit: str
    role: Role
    length: int
    signed: bool
    is_float: bool
    pieces: tuple[Piece, ...]
    low: int
    high: int
    not_available: int
    error: int
    slope: Fraction = Fraction(1)
    intercept: Fraction = Fraction(0)
    source: Value | None = None
    esc: int | None = None
    """Index of the ESC the source is read from; None for the gateway."""
    numbers: Mapping[int, int] | None = None
    """Source number to raw value for an enumeration; what is missing is sent as Error."""
    constant: int = 0
    saturates: bool = False
    """A value below ``low`` is sent as ``low``; one above ``high`` as Error, which then is ``high``."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Of a float, in raw values; its codes are bit patterns."""
    page: int | None = None
    """The multiplexer value under which the signal is sent; None: always."""
    factor: Fraction = Fraction(1)
    offset: Fraction = Fraction(0)
    """Physical value of a raw one: ``raw * factor + offset``, in ``unit``."""
    texts: Mapping[int, str] = field(default_factory=dict)
    """Value table, raw value to text, without the codes for not available and error."""
    notes: tuple[str, ...] = ()
    """What resolution or range is lost, for people."""
    unbound: bool = False
    """A constant because it is bound to nothing."""


def classic_bits(length: int, extended: bool = False) -> int:
    """Bits of a classic CAN frame with ``length`` data bytes and the most stuffing that is possible."""
    head = 54 if extended else 34
    return head + 13 + 8 * length + (head + 8 * length - 1) // 4


@dataclass(frozen=True, slots=True)
class MessagePlan:
    """One message of ours, as it is sent."""

    name: str
    can_id: int
    extended: bool
    fd: bool
    length: int
    send_type: SendType
    cycle_ns: int
    """0: not cyclic."""
    delay_ns: int
    """Minimum distance between two frames."""
    compiled: tuple[SignalPlan, ...]
    """Its signals, or those of the message that it is a copy of."""
    escs: frozenset[int]
    paces: frozenset[Group]
    """What the message's values change with."""
    pages: tuple[int | None, ...] = (None,)
    data_id: int = 0
    """AUTOSAR E2E profile 1 data id, used where the message has a CRC signal."""
    renamed: tuple[str, str] | None = None
    """Of a copy for another ESC: with what names of signals begin in ``compiled``, and with what here."""

    @property
    def signals(self) -> tuple[SignalPlan, ...]:
        """Those of a copy are made when they are asked for: with many ESCs they would be most of the memory."""
        if self.renamed is None:
            return self.compiled
        (esc,), (old, new) = self.escs, self.renamed
        return tuple(
            replace(s, name=new + s.name.removeprefix(old), esc=None if s.esc is None else esc)
            for s in self.compiled
        )

    @property
    def bits(self) -> tuple[int, int]:
        """Bits on the bus at the nominal rate and at CAN FD's data rate, with the most stuffing that is possible."""
        if self.fd:
            head = 36 if self.extended else 17
            data = 5 + 8 * self.length
            return head + head // 4 + 13, data + data // 4 + (33 if self.length > 16 else 28)
        return classic_bits(self.length, self.extended), 0

    @property
    def rate_hz(self) -> float:
        """Usual frames a second with all UARTs at 100 Hz. Frames sent on change are not counted."""
        return self._rate_hz(SendType.EVENT)

    @property
    def worst_rate_hz(self) -> float:
        """The same if every value that is sent on change changes all the time."""
        return self._rate_hz(SendType.EVENT | SendType.ON_CHANGE)

    def _rate_hz(self, counted: SendType) -> float:
        events = 0.0
        if counted & self.send_type:
            if Group.LIVE in self.paces:
                events = EXPECTED_LIVE_HZ * len(self.escs)
            else:
                events = 1.0 * max(1, len(self.escs))
        if self.cycle_ns:
            events += 1e9 / self.cycle_ns
        return min(events, 1e9 / self.delay_ns) if self.delay_ns else events


@dataclass(frozen=True)
class Layout:
    """All messages of ours and what should be said about them."""

    file: str
    node: str
    messages: tuple[MessagePlan, ...]
    warnings: tuple[str, ...] = ()

    @cached_property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits that differ where a receiver would read frames otherwise: ids, bits, scaling, units, texts, names."""
        crc, comma = crc32(b"["), ""
        for message in self.messages:  # of all of them at once the memory would not come back
            found = (
                *(message.name, message.can_id, message.extended, message.fd, message.length),
                [
                    (
                        *(s.name, s.unit, s.page, s.length, s.signed, s.is_float),
                        *(tuple(map(tuple, s.pieces)), str(s.factor), str(s.offset)),
                        sorted(s.texts.items()),
                    )
                    for s in message.signals
                ],
            )
            crc, comma = crc32(f"{comma}{found!r}".encode(), crc), ", "
        return f"{crc32(b']', crc):08X}"

    def bus_load(
        self, bitrate: int, data_bitrate: int = 2_000_000, is_worst: bool = False
    ) -> float:
        """Share of the bus, 0 to 1 and above, that the messages need at these rates in bit/s.

        ``is_worst``: with ``worst_rate_hz`` instead of ``rate_hz``.
        """
        load = 0.0
        for message in self.messages:
            nominal, at_data_rate = message.bits
            rate_hz = message.worst_rate_hz if is_worst else message.rate_hz
            load += rate_hz * (nominal / bitrate + at_data_rate / data_bitrate)
        return load
