"""What is reported of one ESC: its measurements, which the core sends while they are fresh, and the errors that begin and end.

Measurements are plans for slots of the core. Layouts as in the DSDL. What a device does not supply is NaN, or 0 where the type has no
such thing; what is out of range is the limit (a throttle beyond 127 %, which no ESC sends, is 0).
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
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SendType, SignalPlan
from kontronik_can_gw.times import SECOND

SPEEDS = {"motor": "motor_speed", "output": "output_speed", "electrical": "electrical_speed"}
"""Key ``rpm`` of the configuration to the value that is sent."""
_QUIET_NS = 10 * SECOND
"""A bit is logged at most this often."""
_PARTS = re.compile(rf"\S(?:.{{0,{wire.MAX_TEXT - 1}}}(?!\S)|.{{0,{wire.MAX_TEXT - 1}}})")
"""A text in parts that end with a word, where there is one; textwrap would be loaded for this alone."""
_LEVELS = {Severity.ERROR: 3, Severity.WARNING: 2}
MAX_RPM, MAX_ESC_INDEX = (1 << 17) - 1, 31
_KELVIN = Fraction("273.15")
_MAX_HALF, _MAX_HALF_BITS, _NAN = 65504.0, 0x7BFF, 0x7E00
_NO_BITS = 1 << 40
"""What of an integer is not available: 0 at its place, and like no value."""
_UNKNOWN_MOTOR_TEMPERATURE = -256
"""StatusExtended has no such thing: what is certainly no temperature."""


class _Part(NamedTuple):
    """A value in a message: from which bit on, how many; 16 are a float, 18 have a sign. Parts at one place are ORed."""

    name: str
    """Empty: the speed that the configuration chooses."""
    at: int
    bits: int
    slope: Fraction = Fraction(1)
    intercept: Fraction = Fraction(0)
    error: int | None = None
    """What is sent instead of what is out of range; None: the greatest number."""
    is_cut: bool = False
    """Its low bits are sent."""


_ANY_HIGHER = Fraction(1, 1 << 18), Fraction(-1, 2)
"""Of the error word: 1 where a bit from the 18th on is set."""
_LAYOUTS: Mapping[DataType, tuple[int, tuple[int, int], Sequence[_Part]]] = {
    # bytes, place and bits of the index, values: without the first one there is no message
    wire.STATUS: (14, (105, 5), (
        _Part("", 80, 18), _Part("battery_voltage", 32, 16), _Part("battery_current", 48, 16),
        _Part("power_stage_temperature", 64, 16), _Part("output_opening", 98, 7),
    )),
    wire.STATUS_EXTENDED: (7, (51, 5), (
        _Part("output_opening", 7, 7), _Part("throttle", 0, 7, error=0), _Part("throttle", 0, 7, Fraction(-1), error=0),
        _Part("operating_errors", 32, 19, is_cut=True), _Part("operating_errors", 48, 1, *_ANY_HIGHER),
    )),
    wire.CIRCUIT_STATUS: (7, (0, 16), (
        _Part("bec_voltage", 16, 16), _Part("bec_current", 32, 16),
        _Part("bec_overcurrent", 53, 1), _Part("bec_undervoltage", 54, 1), _Part("bec_overvoltage", 55, 1),
    )),
    wire.TEMPERATURE: (5, (0, 16), (_Part("bec_temperature", 16, 16), _Part("bec_overtemperature", 39, 1))),
}  # fmt: skip


@cache
def plans_of(protocol: EscProtocol, speed: str, has_direction: bool) -> Mapping[DataType, SlotPlan]:
    """The messages that an ESC of this protocol supplies.

    ``speed`` is the value that is sent as rpm, negative while the motor turns backward if
    ``has_direction``.
    """
    values, found = values_of(protocol), {}
    rpm = with_direction(protocol, values[speed]) if has_direction else values[speed]
    for kind, (length, _, parts) in _LAYOUTS.items():
        signals = tuple(_signal(part, values[part.name] if part.name else rpm) for part in parts)
        if signals[0].source is None or not signals[0].source.supplied:
            continue
        plan = MessagePlan(
            *("transfer", 0, True, False, length, SendType.EVENT, 0, 0, signals),
            *(frozenset({0}), frozenset({Group.LIVE})),
        )
        pack = compile_pack(plan)
        found[kind] = SlotPlan(plan, pack, Event.LIVE, 0, None, False, "", kind.seed, True)
    return found


def fill(kind: DataType, index: int, errors: int) -> int:
    """The bits of a message that are no value of the ESC. ``errors``: since the motor was started."""
    found = place(pieces(*_LAYOUTS[kind][1]), index)
    if kind is wire.STATUS:
        found |= errors & 0xFFFF_FFFF
    elif kind is wire.STATUS_EXTENDED:
        found |= place(pieces(14, 9), _UNKNOWN_MOTOR_TEMPERATURE)
    return found


def pieces(at: int, bits: int) -> tuple[Piece, ...]:
    """Where a number is, from bit ``at`` of the message on: its low byte first, in each byte the most significant bit."""
    whole = 0 if at % 8 else bits // 8 * 8
    found = [Piece(0, whole, at)] if whole else []
    at += whole
    for shift in range(whole, bits, 8):
        left = min(8, bits - shift)
        while left:
            width = min(left, 8 - at % 8)
            left -= width
            found.append(Piece(shift + left, width, at // 8 * 8 + 8 - at % 8 - width))
            at += width
    return tuple(found)


def _signal(part: _Part, value: Value) -> SignalPlan:
    is_float, signed = part.bits == 16, part.bits == 18
    intercept, not_available, error = part.intercept, _NO_BITS, part.error
    high = 0xFFFF_FFFF if part.is_cut else (1 << part.bits - signed) - 1
    if is_float:
        not_available, error = _NAN, _MAX_HALF_BITS
        intercept = _KELVIN if value.unit == "°C" else intercept
    return SignalPlan(
        *(part.name, value.unit, Role.SOURCE, high.bit_length() + signed, signed, is_float),
        *(pieces(part.at, part.bits), -high - 1 if signed else 0, high),
        *(not_available, high if error is None else error),
        slope=part.slope / value.per_unit,
        intercept=intercept,
        source=value,
        esc=0,
        saturates=signed,
        limits=(-_MAX_HALF, _MAX_HALF),
    )


class EscReport:
    """One ESC with its index on the bus. ``table``: of the configuration."""

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
        self._node_id = self._page = 0
        values = values_of(esc.protocol)
        self._word, self._speed = values["operating_errors"], values["electrical_speed"]
        self._bits = [
            bit
            for bit in esc.protocol.errors.get("operating_errors", ())
            if bit.severity in _LEVELS and not bit.is_summary
        ]
        self._errors = sum(1 << bit for bit in self._bits if bit.severity is Severity.ERROR)
        self._before = self._logged = self._onsets = 0
        self._turns = False
        self._quiet_until: dict[int, int] = {}

    # --- measurements

    def take_slots(self, slot: Callable[[], Slot]) -> None:
        """Take a slot for each message that is sent. ``slot`` returns a new slot of the ESC."""
        self._slots = {kind: slot() for kind in self._plans if self._rates[kind]}

    def start(self, node_id: int, place: int, now: int) -> None:
        """Send measurements as this node; ``place`` of the ESC among its."""
        self._node_id, self._page = node_id, FIRST_PART + PARTS * place
        self._configure(now)
        for slot in self._slots.values():
            slot.start(now)

    def stop(self) -> None:
        """Send none any more."""
        for slot in self._slots.values():
            slot.stop()

    @property
    def status_sent(self) -> int:
        """esc.Status so far."""
        slot = self._slots.get(wire.STATUS)
        return 0 if slot is None else slot.sent

    def _configure(self, now: int) -> None:
        for kind, slot in self._slots.items():
            period = SECOND // self._rates[kind]
            can_id = message_id(kind.number, self._node_id, LOW)
            bits = fill(kind, self.index, self._onsets)
            times = period * 3 // 4, period * 5 // 4
            slot.configure(
                SlotSettings(self._plans[kind], can_id, True, *times, bits, self._page), now
            )

    # --- errors

    @property
    def word(self) -> int:
        """The operating errors; 0 while they are not known."""
        return steps_of(self._word, self.esc, self.esc.live) or 0

    @property
    def health(self) -> int:
        """Of the ESC, as NodeStatus has it."""
        word = self.word
        if word & self._errors:
            return wire.ERROR
        is_well = self.esc.up and not any(word >> bit & 1 for bit in self._bits)
        return wire.OK if is_well else wire.WARNING

    def follow(self, events: int, now: int) -> None:
        """Count errors that begin; not those of the link's return, which may be old. ``events``: bits of Event, or each second none."""
        onsets, word = self._onsets, self.word
        if self.esc.up:
            turns = bool(steps_of(self._speed, self.esc, self.esc.live))
            if turns and not self._turns:
                self._onsets = 0  # errors since the motor was started
            self._turns = turns
        if not events & Event.LINK:
            self._onsets += (word & ~self._before & self._errors).bit_count()
        self._before = word
        if self._onsets != onsets and self._node_id:
            self._configure(now)

    def log(self, now: int) -> Iterator[bytes]:
        """LogMessages of an error or warning that has begun or ended; of one at a time, and none of what is not known now."""
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

    def log_anew(self) -> None:
        """Log what is on once more: what was logged may never have reached the bus."""
        self._logged = 0

    def _texts(self, bit: ErrorBit, begins: bool) -> Iterator[bytes]:
        name = self.esc.settings.name
        level, text = _LEVELS[bit.severity], f"{name}: {bit.meaning}. {bit.remedy}"
        if not begins:
            level, text = 1, f"{name}: over: {bit.meaning}"
        source = name.encode("ascii", "replace")
        head = wire.LOG_MESSAGE.pack(level << 5 | len(source)) + source
        for part in _PARTS.findall(text):
            yield head + part.encode("ascii", "replace")
