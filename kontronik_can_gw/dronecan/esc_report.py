"""What is reported of one ESC: its measurements while they are fresh, and the errors that begin and end."""

from collections.abc import Callable, Iterator
from fractions import Fraction

from kontronik_can_gw.dronecan import types
from kontronik_can_gw.esc.decoder import Data, ErrorBit, Severity
from kontronik_can_gw.esc.telemetry import SECOND, EscTelemetry, Event
from kontronik_can_gw.esc.values import Kind, Value, scaled, steps_of, values_of

SPEEDS = {"motor": "motor_speed", "output": "output_speed", "electrical": "electrical_speed"}
"""Key ``rpm`` of the configuration to the value that is sent."""
_MEASURED = (
    *("battery_voltage", "battery_current", "power_stage_temperature"),
    *("output_opening", "throttle"),
)
_BEC = ("bec_voltage", "bec_current", "bec_temperature")
_BEC_FLAGS = {"bec_overvoltage": 1, "bec_undervoltage": 2, "bec_overcurrent": 4}
_QUIET_NS = 10 * SECOND
"""A bit is logged at most this often."""
_LEVELS = {Severity.ERROR: 3, Severity.WARNING: 2}
_FLAG_BITS = 18
"""Bits of the error word in StatusExtended; another flag says that there is a higher one."""


class EscReport:
    """One ESC with its index on the bus. ``rpm``: a key of SPEEDS."""

    def __init__(self, esc: EscTelemetry, index: int, rpm: str) -> None:
        self.esc = esc
        self.index = index
        values = values_of(esc.protocol)
        self._word = values["operating_errors"]
        self._measured = [_reader(values[name], esc) for name in _MEASURED]
        self._bec = [_reader(values[name], esc) for name in (*_BEC, "bec_overtemperature")]
        self._bec_flags = [(_reader(values[n], esc), flag) for n, flag in _BEC_FLAGS.items()]
        self._speed = values[SPEEDS[rpm]]
        self._slope = Fraction(1, self._speed.per_unit)
        self._bits = [
            bit
            for bit in esc.protocol.errors.get("operating_errors", ())
            if bit.severity in _LEVELS and not bit.is_summary
        ]
        self._errors = sum(1 << bit for bit in self._bits if bit.severity is Severity.ERROR)
        self._before = self._logged = self._onsets = 0
        self._turns = False
        self._quiet_until: dict[int, int] = {}

    @property
    def word(self) -> int:
        """The operating errors; 0 while they are not known."""
        return steps_of(self._word, self.esc, self.esc.live) or 0

    @property
    def health(self) -> int:
        """Of the ESC, as NodeStatus has it."""
        word = self.word
        if word & self._errors:
            return types.ERROR
        is_well = self.esc.up and not any(word >> bit & 1 for bit in self._bits)
        return types.OK if is_well else types.WARNING

    def follow(self, events: int) -> None:
        """Count errors that begin; not those of the link's return, which may be old. ``events``: bits of Event."""
        word = self.word
        if not events & Event.LINK:
            self._onsets += (word & ~self._before & self._errors).bit_count()
        self._before = word

    def status(self) -> bytes | None:
        """esc.Status; None without fresh telemetry: its speed has no value for that, so silence it is."""
        live = self.esc.live
        if live is None:
            return None
        rpm = scaled(self._speed, self.esc, steps_of(self._speed, self.esc, live), self._slope)
        if rpm is None:
            return None
        if rpm and not self._turns:
            self._onsets = 0  # errors since the motor was started
        self._turns = bool(rpm)
        volts, amperes, celsius, opening, _ = self._measured
        v, a, c, percent = volts(live), amperes(live), celsius(live), int(opening(live) or 0)
        return types.status(self._onsets, v, a, c, rpm, percent, self.index)

    def status_extended(self) -> bytes | None:
        """esc.StatusExtended; None without fresh telemetry."""
        live = self.esc.live
        if live is None:
            return None
        word = self.word
        flags = word & (1 << _FLAG_BITS) - 1 | (word >> _FLAG_BITS != 0) << _FLAG_BITS
        opening, throttle = (int(read(live) or 0) for read in self._measured[3:])
        unknown = types.UNKNOWN_MOTOR_TEMPERATURE
        return types.status_extended(abs(throttle), opening, unknown, 0, flags, self.index)

    def bec(self) -> tuple[bytes, bytes] | None:
        """CircuitStatus and Temperature of the BEC; None without fresh telemetry, and of an ESC that measures nothing there."""
        live = self.esc.live
        if live is None:
            return None
        volts, amperes, celsius, is_hot = (read(live) for read in self._bec)
        if volts is None and amperes is None and celsius is None:
            return None
        flags, half = sum(flag for is_set, flag in self._bec_flags if is_set(live)), types.half
        circuit = types.CIRCUIT_STATUS.pack(self.index, half(volts), half(amperes), flags)
        return circuit, types.TEMPERATURE.pack(self.index, types.kelvin(celsius), bool(is_hot))

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
        head, rest = types.LOG_MESSAGE.pack(level << 5 | len(source)) + source, text
        while rest:  # textwrap would be loaded for this alone
            end = len(rest)
            if end > types.MAX_TEXT:
                end = rest.rfind(" ", 1, types.MAX_TEXT + 1)
                end = end if end > 0 else types.MAX_TEXT
            yield head + rest[:end].encode("ascii", "replace")
            rest = rest[end:].lstrip()


def _reader(value: Value, esc: EscTelemetry) -> Callable[[Data], float | None]:
    """What reads a value of live data, in its unit; None: not available."""
    if not value.supplied:
        return lambda _live: None
    word, per_unit = value.words[0], value.per_unit
    if value.kind is Kind.WIRE and not value.not_on:
        return lambda live: live[word] / per_unit

    def read(live: Data) -> float | None:
        found = steps_of(value, esc, live)
        return None if found is None else found / per_unit

    return read
