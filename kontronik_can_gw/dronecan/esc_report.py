"""Reports the measurements of one ESC, and the begin and end of its errors.

Measurements are plans for slots of the core, which sends them while they are fresh. The layouts are
defined by the DSDL. A value that the device does not supply is NaN, or 0 if the type has no NaN. A
value out of range is replaced by the limit, except a throttle beyond 127 %, which is replaced by 0.
No ESC sends such a throttle.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

from kontronik_can_gw.core.slots import Slot, SlotPlan, SlotSettings
from kontronik_can_gw.dronecan import wire
from kontronik_can_gw.dronecan.wire import LOW, DataType, message_id
from kontronik_can_gw.esc.decoder import ErrorBit, EscProtocol, Severity
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group, Value, steps_of, values_of, with_direction
from kontronik_can_gw.frames import FIRST_PART, PARTS
from kontronik_can_gw.signals.packer import compile_pack, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SignalPlan
from kontronik_can_gw.times import SECOND

SPEEDS = {"motor": "motor_speed", "output": "output_speed", "electrical": "electrical_speed"}
"""The value to send for each choice of the configuration's key ``rpm``."""
_QUIET_NS = 10 * SECOND
"""Shortest interval between two log messages about one error bit."""
_PARTS = re.compile(rf"\S(?:.{{0,{wire.MAX_TEXT - 1}}}(?!\S)|.{{0,{wire.MAX_TEXT - 1}}})")
"""Finds the parts of a text, which end between two words if possible.

The module textwrap is not used, because it would be loaded only for this.
"""
_LEVELS = {Severity.ERROR: 3, Severity.WARNING: 2}
MAX_RPM = (1 << 17) - 1
MAX_ESC_INDEX = 31
_KELVIN = Fraction("273.15")
# Numbers of 16-bit floats
_MAX_HALF = 65504.0
_MAX_HALF_BITS = 0x7BFF
_NAN = 0x7E00
_NO_BITS = 1 << 40
"""Stands for an integer that is not available. It is sent as 0, and differs from every value."""
_UNKNOWN_MOTOR_TEMPERATURE = -256
"""Sent because StatusExtended has no number for an unknown temperature. It is no real one."""


class _Part(NamedTuple):
    """A value in a message. Parts at the same position are combined by OR."""

    name: str
    """Empty for the speed that the configuration chooses."""
    at: int
    """Position of the first bit."""
    bits: int
    """Number of bits. 16 bits are a float, 18 bits are a signed integer."""
    slope: Fraction = Fraction(1)
    intercept: Fraction = Fraction(0)
    error: int | None = None
    """Number that replaces a value out of range. None: the greatest number."""
    is_cut: bool = False
    """True if only the low bits are sent."""


class _DsdlType(NamedTuple):
    """The layout of a message."""

    length: int
    """Number of bytes."""
    index_bits: tuple[int, int]
    """Position and number of bits of the ESC's index."""
    parts: Sequence[_Part]
    """The values. If the ESC does not supply the first one, the message is not sent."""


_SLOPE_HIGHER = Fraction(1, 1 << 18)
"""Slope that, with the intercept, is 1 if a bit from the 18th of the error word is set."""
_INTERCEPT_HIGHER = Fraction(-1, 2)
_DSDL_TYPES: Mapping[DataType, _DsdlType] = {
    wire.STATUS: _DsdlType(
        length=14,
        index_bits=(105, 5),
        parts=(
            _Part("", 80, 18),
            _Part("battery_voltage", 32, 16),
            _Part("battery_current", 48, 16),
            _Part("power_stage_temperature", 64, 16),
            _Part("output_opening", 98, 7),
        ),
    ),
    wire.STATUS_EXTENDED: _DsdlType(
        length=7,
        index_bits=(51, 5),
        parts=(
            _Part("output_opening", 7, 7),
            _Part("throttle", 0, 7, error=0),
            _Part("throttle", 0, 7, Fraction(-1), error=0),
            _Part("operating_errors", 32, 19, is_cut=True),
            _Part("operating_errors", 48, 1, _SLOPE_HIGHER, _INTERCEPT_HIGHER),
        ),
    ),
    wire.CIRCUIT_STATUS: _DsdlType(
        length=7,
        index_bits=(0, 16),
        parts=(
            _Part("bec_voltage", 16, 16),
            _Part("bec_current", 32, 16),
            _Part("bec_overcurrent", 53, 1),
            _Part("bec_undervoltage", 54, 1),
            _Part("bec_overvoltage", 55, 1),
        ),
    ),
    wire.TEMPERATURE: _DsdlType(
        length=5,
        index_bits=(0, 16),
        parts=(
            _Part("bec_temperature", 16, 16),
            _Part("bec_overtemperature", 39, 1),
        ),
    ),
}


@cache
def plans_of(
    protocol: EscProtocol,
    speed: str,
    has_direction: bool,
) -> Mapping[DataType, SlotPlan]:
    """Return the messages that an ESC of this protocol supplies.

    ``speed`` is the value that is sent as rpm. With ``has_direction``, it is negative while the
    motor turns backward.
    """
    values = values_of(protocol)
    rpm = values[speed]
    if has_direction:
        rpm = with_direction(protocol, rpm)
    found = {}
    for kind, layout in _DSDL_TYPES.items():
        signals = []
        for part in layout.parts:
            value = values[part.name] if part.name else rpm
            signals.append(_signal(part, value))
        if signals[0].source is None or not signals[0].source.supplied:
            continue
        found[kind] = _slot_plan(kind, layout.length, tuple(signals))
    return found


def _slot_plan(
    kind: DataType,
    length: int,
    signals: tuple[SignalPlan, ...],
) -> SlotPlan:
    plan = MessagePlan(
        name="transfer",
        can_id=0,
        extended=True,
        length=length,
        compiled=signals,
        escs=frozenset({0}),
        paces=frozenset({Group.LIVE}),
    )
    return SlotPlan(
        message=plan,
        pack=compile_pack(plan),
        triggers=Event.LIVE,
        seed=kind.seed,
        is_paced=True,
    )


def fill(kind: DataType, index: int, errors: int) -> int:
    """Return the bits of a message that are not values of the ESC.

    ``errors`` is the number of errors since the motor was started.
    """
    position, bits = _DSDL_TYPES[kind].index_bits
    found = place(pieces(position, bits), index)
    if kind is wire.STATUS:
        found |= errors & 0xFFFF_FFFF
    elif kind is wire.STATUS_EXTENDED:
        found |= place(pieces(14, 9), _UNKNOWN_MOTOR_TEMPERATURE)
    return found


def pieces(at: int, bits: int) -> tuple[Piece, ...]:
    """Return the pieces of a number that begins at bit ``at`` of the message.

    The low byte is first, and in each byte the most significant bit is first.
    """
    whole = 0 if at % 8 else bits // 8 * 8
    found = [Piece(0, whole, at)] if whole else []
    at += whole
    for shift in range(whole, bits, 8):
        left = min(8, bits - shift)
        while left:
            width = min(left, 8 - at % 8)
            left -= width
            next_byte = at // 8 * 8 + 8
            low_bit = next_byte - at % 8 - width
            found.append(Piece(shift + left, width, low_bit))
            at += width
    return tuple(found)


def _signal(part: _Part, value: Value) -> SignalPlan:
    is_float = part.bits == 16
    is_signed = part.bits == 18
    high = (1 << part.bits - is_signed) - 1
    if part.is_cut:
        high = 0xFFFF_FFFF
    intercept = part.intercept
    not_available = _NO_BITS
    error = high if part.error is None else part.error
    if is_float:
        not_available = _NAN
        error = _MAX_HALF_BITS
        if value.unit == "°C":
            intercept = _KELVIN
    return SignalPlan(
        name=part.name,
        unit=value.unit,
        role=Role.SOURCE,
        length=high.bit_length() + is_signed,
        signed=is_signed,
        is_float=is_float,
        pieces=pieces(part.at, part.bits),
        low=-high - 1 if is_signed else 0,
        high=high,
        not_available=not_available,
        error=error,
        slope=part.slope / value.per_unit,
        intercept=intercept,
        source=value,
        esc=0,
        saturates=is_signed,
        limits=(-_MAX_HALF, _MAX_HALF),
    )


class EscReport:
    """One ESC with its index on the bus. ``table`` is the configuration's table [dronecan]."""

    def __init__(self, esc: EscTelemetry, index: int, table: Any) -> None:
        self.esc = esc
        self.index = index
        self._rates = {
            wire.STATUS: table.rate_hz,
            wire.STATUS_EXTENDED: table.extended_hz,
            wire.CIRCUIT_STATUS: 1,
            wire.TEMPERATURE: 1,
        }
        self._plans = plans_of(esc.protocol, SPEEDS[table.rpm], table.negative_rpm)
        self._slots: dict[wire.DataType, Slot] = {}
        self._node_id = 0
        self._page = 0
        values = values_of(esc.protocol)
        self._word = values["operating_errors"]
        self._speed = values["electrical_speed"]
        self._bits: list[ErrorBit] = []
        """The bits that are reported."""
        self._errors = 0
        """The bits of errors in the word."""
        for bit in esc.protocol.errors.get("operating_errors", ()):
            if bit.is_summary or bit.severity not in _LEVELS:
                continue
            self._bits.append(bit)
            if bit.severity is Severity.ERROR:
                self._errors |= 1 << bit
        self._before = 0
        """The word at the last call of ``update``."""
        self._logged = 0
        """The bits whose begin was logged, and whose end was not."""
        self._onsets = 0
        """Number of errors since the motor was started."""
        self._is_turning = False
        self._quiet_until: dict[int, int] = {}
        """Time until which a bit is not logged again."""

    # --- measurements

    def take_slots(self, slot: Callable[[], Slot]) -> None:
        """Take a slot for each message that is sent. ``slot`` returns a new slot of the ESC."""
        self._slots = {}
        for kind in self._plans:
            if self._rates[kind]:
                self._slots[kind] = slot()

    def start(self, node_id: int, place: int, now: int) -> None:
        """Send measurements as this node. ``place`` is the ESC's position among the node's ESCs."""
        self._node_id = node_id
        self._page = FIRST_PART + PARTS * place
        self._configure(now)
        for slot in self._slots.values():
            slot.start(now)

    def stop(self) -> None:
        """Stop sending measurements."""
        for slot in self._slots.values():
            slot.stop()

    @property
    def status_sent(self) -> int:
        """Number of sent esc.Status messages."""
        slot = self._slots.get(wire.STATUS)
        return 0 if slot is None else slot.sent

    def _configure(self, now: int) -> None:
        for kind, slot in self._slots.items():
            period = SECOND // self._rates[kind]
            can_id = message_id(kind.number, self._node_id, LOW)
            bits = fill(kind, self.index, self._onsets)
            settings = SlotSettings(
                plan=self._plans[kind],
                can_id=can_id,
                by_event=True,
                inhibit_ns=period * 3 // 4,
                timer_ns=period * 5 // 4,
                fill=bits,
                page=self._page,
            )
            slot.configure(settings, now)

    # --- errors

    @property
    def word(self) -> int:
        """The operating errors. 0 if unknown."""
        return steps_of(self._word, self.esc, self.esc.live) or 0

    @property
    def health(self) -> int:
        """The health of the ESC, as in NodeStatus."""
        word = self.word
        if word & self._errors:
            return wire.ERROR
        has_bits = any(word >> bit & 1 for bit in self._bits)
        return wire.WARNING if has_bits or not self.esc.up else wire.OK

    def update(self, events: int, now: int) -> None:
        """Count errors that have begun. ``events`` are bits of Event, or 0 once a second.

        Errors that exist when the link returns are not counted, because they may be old.
        """
        onsets = self._onsets
        word = self.word
        if self.esc.up:
            is_turning = bool(steps_of(self._speed, self.esc, self.esc.live))
            if is_turning and not self._is_turning:
                self._onsets = 0  # the motor was started
            self._is_turning = is_turning
        if not events & Event.LINK:
            self._onsets += (word & ~self._before & self._errors).bit_count()
        self._before = word
        if self._onsets != onsets and self._node_id:
            self._configure(now)

    def log(self, now: int) -> Iterator[bytes]:
        """Yield the LogMessages of an error or warning that has begun or ended.

        Each call yields the messages of at most one. While the errors are unknown, it yields none.
        """
        if not self.esc.up:
            return
        word = self.word
        for bit in self._bits:
            mask = 1 << bit
            if (word ^ self._logged) & mask and now >= self._quiet_until.get(bit, 0):
                self._logged ^= mask
                self._quiet_until[bit] = now + _QUIET_NS
                yield from self._texts(bit, bool(word & mask))
                return

    def log_again(self) -> None:
        """Log the present errors again, because the messages may not have reached the bus."""
        self._logged = 0

    def _texts(self, bit: ErrorBit, begins: bool) -> Iterator[bytes]:
        name = self.esc.settings.name
        if begins:
            level = _LEVELS[bit.severity]
            text = f"{name}: {bit.meaning}. {bit.remedy}"
        else:
            level = 1
            text = f"{name}: over: {bit.meaning}"
        source = name.encode("ascii", "replace")
        head = wire.LOG_MESSAGE.pack(level << 5 | len(source)) + source
        for part in _PARTS.findall(text):
            yield head + part.encode("ascii", "replace")
