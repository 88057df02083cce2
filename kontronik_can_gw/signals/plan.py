"""Compiled messages: bits and sources of their signals, and when the messages are sent.

They are made from a DBC (dbc/prepare.py) or from the mapping of a PDO.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, Flag
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple
from zlib import crc32

from kontronik_can_gw.esc.values import Group, Value
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.signals.e2e import Protection


class SendType(Flag):
    """When a message is sent. Several can be combined."""

    CYCLIC = 1
    EVENT = 2
    """With each UART frame, or change of the link, that updates one of its signals."""
    ON_CHANGE = 4
    """When one of its values has changed."""


SEND_TYPES = {
    "Cyclic": SendType.CYCLIC,
    "Event": SendType.EVENT,
    "OnChange": SendType.ON_CHANGE,
    "CyclicAndEvent": SendType.CYCLIC | SendType.EVENT,
    "CyclicAndOnChange": SendType.CYCLIC | SendType.ON_CHANGE,
}
"""Send types by their names in a configuration."""
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Possible numbers of data bytes of a CAN FD frame."""

EXPECTED_LIVE_HZ = 100
"""Expected live frames per second and UART. It is used only to compute the bus load."""


class Role(Enum):
    """The origin of a signal's raw value."""

    SOURCE = "source"
    ALIVE = "alive counter"
    CRC = "CRC"
    DATA_ID = "E2E data ID"
    """Bits 8 to 11 of the data ID, a constant."""
    CONSTANT = "constant"
    MULTIPLEXER = "multiplexer"


class Piece(NamedTuple):
    """Neighbouring bits of a signal: ``(raw >> shift & (1 << width) - 1) << at``."""

    shift: int
    width: int
    at: int
    """Position in the frame, counted upward from bit 0 of byte 0."""


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """One signal and its source.

    The raw value of x steps of the source is ``x / divisor * slope + intercept``, rounded once.
    """

    name: str
    length: int
    signed: bool
    is_float: bool
    pieces: tuple[Piece, ...]
    low: int
    """Smallest raw value that is not a code."""
    high: int
    """Greatest raw value that is not a code."""
    not_available: int
    """Code that is sent while the value is not available."""
    error: int
    """Code that is sent if the value does not fit."""
    unit: str = ""
    role: Role = Role.SOURCE
    slope: Fraction = Fraction(1)
    intercept: Fraction = Fraction(0)
    source: Value | None = None
    esc: int | None = None
    """Index of the source's ESC. None for a value of the gateway."""
    numbers: Mapping[int, int] | None = None
    """For an enumeration, raw values by number of the source. Other numbers are sent as Error."""
    constant: int = 0
    saturates: bool = False
    """A value below ``low`` is sent as ``low``, one above ``high`` as Error, which is ``high``."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and greatest raw value of a float. Its codes are bit patterns."""
    page: int | None = None
    """Value of the multiplexer with which the signal is sent. None: with every value."""
    factor: Fraction = Fraction(1)
    offset: Fraction = Fraction(0)
    """The physical value in ``unit`` is ``raw * factor + offset``."""
    texts: Mapping[int, str] = field(default_factory=dict)
    """Texts of the value table by raw value, without the codes for not available and error."""
    notes: tuple[str, ...] = ()
    """For the user: lost resolution and range."""
    is_unbound: bool = False
    """True if the signal is a constant because it has no source."""


def classic_bits(length: int, extended: bool = False) -> int:
    """Return the bits of a classic CAN frame with ``length`` data bytes.

    The greatest possible number of stuff bits is included.
    """
    head = 54 if extended else 34  # without data, but with the CRC
    tail = 13  # delimiters, acknowledgement, end of frame and pause, all without stuff bits
    stuffed = head + 8 * length
    return stuffed + tail + (stuffed - 1) // 4


@dataclass(frozen=True, slots=True)
class MessagePlan:
    """One message that the gateway sends."""

    name: str
    can_id: int
    length: int
    compiled: tuple[SignalPlan, ...]
    """Signals of this message. For a copy, the signals of the original message."""
    escs: frozenset[int]
    """Indices of the ESCs whose values the message contains."""
    paces: frozenset[Group]
    """Groups whose data changes the message's values."""
    extended: bool = False
    fd: bool = False
    send_type: SendType = SendType.EVENT
    cycle_ns: int = 0
    """Period of a cyclic message. 0: not cyclic."""
    delay_ns: int = 0
    """Minimum time between two frames. 0: no minimum."""
    pages: tuple[int | None, ...] = (None,)
    """Values of the multiplexer, one frame for each. None: without a multiplexer."""
    e2e: Protection | None = None
    """AUTOSAR E2E protection. None: the message has no CRC signal."""
    renamed: tuple[str, str] | None = None
    """For a copy for another ESC: prefix of the signals' names in ``compiled``, and prefix here."""

    @property
    def key(self) -> int:
        """The id, with ``EXTENDED`` if it has 29 bits."""
        return self.can_id | EXTENDED if self.extended else self.can_id

    @property
    def can_stop(self) -> bool:
        """True if it stops while telemetry is lost, if the gateway is configured so.

        Messages with the state of the link are always sent.
        """
        has_telemetry = not self.paces.isdisjoint({Group.LIVE, Group.INFO})
        return has_telemetry and Group.LINK not in self.paces

    @property
    def signals(self) -> tuple[SignalPlan, ...]:
        """The signals of this message.

        The signals of a copy are made at each call. With many ESCs, they would otherwise take most
        of the memory.
        """
        if self.renamed is None:
            return self.compiled
        (esc,) = self.escs
        old, new = self.renamed
        return tuple(
            replace(
                signal,
                name=new + signal.name.removeprefix(old),
                esc=None if signal.esc is None else esc,
            )
            for signal in self.compiled
        )

    @property
    def bits(self) -> tuple[int, int]:
        """Bits of a frame at the nominal bit rate, and at CAN FD's data bit rate.

        The greatest possible number of stuff bits is included.
        """
        if not self.fd:
            return classic_bits(self.length, self.extended), 0
        head = 36 if self.extended else 17
        tail = 13
        nominal = head + head // 4 + tail
        data = 5 + 8 * self.length
        crc = 33 if self.length > 16 else 28  # with its fixed stuff bits
        return nominal, data + data // 4 + crc

    def rate_hz(self, is_worst: bool = False) -> float:
        """Return the usual frames per second with EXPECTED_LIVE_HZ at every UART.

        Frames that are sent because a value changed are counted only with ``is_worst``, which means
        that every value that is sent on change changes all the time.
        """
        counted = SendType.EVENT | SendType.ON_CHANGE if is_worst else SendType.EVENT
        rate = 0.0
        if counted & self.send_type:
            if Group.LIVE in self.paces:
                rate = EXPECTED_LIVE_HZ * len(self.escs)
            else:
                rate = 1.0 * max(1, len(self.escs))
        if self.cycle_ns:
            rate += 1e9 / self.cycle_ns
        if self.delay_ns:
            rate = min(rate, 1e9 / self.delay_ns)
        return rate


@dataclass(frozen=True)
class MessageLayout:
    """All messages that the gateway sends, and warnings about them."""

    file: str
    """Name of the DBC."""
    node: str
    """Node of the DBC whose messages the gateway sends."""
    messages: tuple[MessagePlan, ...]
    warnings: tuple[str, ...] = ()

    @property
    def data_ids(self) -> dict[int, tuple[int, ...]]:
        """The data IDs of protected messages, by id. The id has EXTENDED for 29 bits."""
        found = {}
        for message in self.messages:
            if message.e2e is not None:
                found[message.key] = message.e2e.data_ids
        return found

    @cached_property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits that identify everything by which a receiver reads the frames.

        That is ids, bits, scaling, units, texts and names. The digits are a CRC over the text of a
        list. Changing that text changes the fingerprint of every layout.
        """
        crc = crc32(b"[")
        comma = ""
        # One message at a time: the memory for the text of all would not be given back.
        for message in self.messages:
            crc = crc32(f"{comma}{_identity_of_message(message)!r}".encode(), crc)
            comma = ", "
        crc = crc32(b"]", crc)
        return f"{crc:08X}"

    def bus_load(
        self,
        bitrate: int,
        data_bitrate: int = 2_000_000,
        is_worst: bool = False,
    ) -> float:
        """Return the share of the bus that the messages need at these rates in bit/s.

        1 is the whole bus. The result can be greater. ``is_worst`` as in ``MessagePlan.rate_hz``.
        """
        load = 0.0
        for message in self.messages:
            nominal, at_data_rate = message.bits
            load += message.rate_hz(is_worst) * (nominal / bitrate + at_data_rate / data_bitrate)
        return load


def _identity_of_message(message: MessagePlan) -> tuple[object, ...]:
    return (
        message.name,
        message.can_id,
        message.extended,
        message.fd,
        message.length,
        [_identity_of_signal(signal) for signal in message.signals],
    )


def _identity_of_signal(signal: SignalPlan) -> tuple[object, ...]:
    return (
        signal.name,
        signal.unit,
        signal.page,
        signal.length,
        signal.signed,
        signal.is_float,
        tuple(tuple(piece) for piece in signal.pieces),
        str(signal.factor),
        str(signal.offset),
        sorted(signal.texts.items()),
    )
