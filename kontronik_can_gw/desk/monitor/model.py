"""The model of the live screen for one to eight ESCs: newest values, extremes, state, errors, link. Pure; time is an argument.

Values are addressed by the names of sources (values.py), not of signals, so any DBC works, and units are those of the sources. A value
that is not available is None, never an old one.
"""

import re
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from enum import Enum
from typing import Any, NamedTuple

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    ErrorBit,
    OperatingError,
    SelfTestError,
    Severity,
    device_text,
    state_text,
)
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings, LinkState
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import CanState, GatewayState
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.unpacker import SignalReader, Value

SILENCE_NS = 5 * SECOND
"""After this time without a frame the screen shows possible causes."""
_WORKING = ("ok", "degraded")
_BELIEVED = 2
_RATE_NS = 2 * SECOND
_RATE_STEP_NS = 100 * MS


class Zone(Enum):
    """A value's relation to its limits."""

    GOOD = 0
    WARNING = 1
    ALARM = 2


class Scale(NamedTuple):
    """A bar from ``low`` to ``high`` with limits for a warning and an alarm; if ``alarm`` is below ``warning`` they are lower limits."""

    low: float
    high: float
    warning: float | None = None
    alarm: float | None = None

    def share(self, value: float) -> float:
        """The filled part of the bar, 0 to 1."""
        return min(1.0, max(0.0, (value - self.low) / (self.high - self.low)))

    def zone(self, value: float) -> Zone:
        if self.warning is None or self.alarm is None:
            return Zone.GOOD
        sign = 1 if self.alarm >= self.warning else -1
        if sign * value >= sign * self.alarm:
            return Zone.ALARM
        return Zone.WARNING if sign * value >= sign * self.warning else Zone.GOOD


PERCENT = Scale(0, 100)
TEMPERATURE = Scale(0, 110, 80, 100)
"""degC. The ESC does not report its own limits; above these the cooling should be checked."""
CELL = Scale(3.0, 4.2, 3.5, 3.3)
"""V of a lithium polymer cell: under load it is nearly empty below 3.5 V and is damaged below 3.3 V."""


class Quantity(NamedTuple):
    """A measured value with its extremes. ``rank``: the greatest is left out first where there is no room."""

    source: str
    label: str
    unit: str
    digits: int
    rank: int
    scale: Scale | None = None


QUANTITIES = (
    Quantity("electrical_speed", "electrical speed", "1/min", 0, 8),
    Quantity("motor_speed", "motor speed", "1/min", 0, 1),
    Quantity("output_speed", "output speed", "1/min", 0, 6),
    Quantity("battery_voltage", "battery voltage", "V", 2, 0),
    Quantity("mean_cell_voltage", "cell voltage", "V", 2, 4, CELL),
    Quantity("battery_current", "battery current", "A", 1, 0),
    Quantity("motor_current", "motor current", "A", 1, 5),
    Quantity("peak_current", "peak current", "A", 1, 7),
    Quantity("battery_power", "power", "W", 0, 3),
    Quantity("power_stage_temperature", "power stage", "degC", 0, 0, TEMPERATURE),
    Quantity("bec_temperature", "BEC", "degC", 0, 4, TEMPERATURE),
    Quantity("bec_voltage", "BEC voltage", "V", 2, 9),
    Quantity("bec_current", "BEC current", "A", 2, 10),
    Quantity("throttle", "throttle", "%", 0, 2, PERCENT),
    Quantity("output_opening", "opening", "%", 0, 5, PERCENT),
)
QUANTITY = {quantity.source: quantity for quantity in QUANTITIES}
_SUMMARIES = {
    OperatingError.OPERATING_ERROR_FOUND.text,
    OperatingError.OPERATING_WARNING_FOUND.text,
}
_NO_ALARM = {OperatingError.PROGRAMMING_ALLOWED.text}


class Spread:
    """Minimum and maximum so far; None before the first value."""

    __slots__ = ("high", "low")

    def __init__(self) -> None:
        self.low: float | None = None
        self.high: float | None = None

    def take(self, value: float) -> None:
        if self.low is None or value < self.low:
            self.low = value
        if self.high is None or value > self.high:
            self.high = value


class Active(NamedTuple):
    """A bit that an ESC has set."""

    name: str
    severity: Severity
    meaning: str


def words(text: str) -> str:
    """A name as people write it: ``SpoolUpFromStill`` -> ``spool up from still``, ``RpmControl`` -> ``RPM control``."""
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W_]", text)
    return " ".join(
        part if len(part) > 1 and part.isupper() else part.lower() for part in parts
    ).replace("rpm", "RPM")


class EscMonitor:
    """One ESC as seen on the bus. All values are those of the last ``Monitor.advance``."""

    def __init__(self, settings: EscSettings, index: int, view: View) -> None:
        self.name = settings.name
        self.spreads = {quantity.source: Spread() for quantity in QUANTITIES}
        self._settings = settings
        self._view = view
        columns = [(name, view.reader.column_of(name, index)) for name in VALUES]
        self._columns = {name: column for name, column in columns if column is not None}
        self._factors = {
            name: _to_source(view.reader.columns[column].unit, VALUES[name].unit)
            for name, column in self._columns.items()
        }
        flags = {bit.text for kind in (OperatingError, SelfTestError) for bit in kind}
        self._plain = {
            group: [
                column
                for name, column in self._columns.items()
                if VALUES[name].group is group and name not in flags
            ]
            for group in (Group.LIVE, Group.INFO)
        }
        self.units = {
            name: VALUES[name].unit
            for name in self._columns
            if name not in {*flags, "operating_errors", "selftest_errors"}
        }
        """Unit of each source in the DBC, in the order of the sources, except flags and words of flags."""
        link = self._columns.get("link_state", -1)
        self._link_part = next(
            (p.first for p in view.reader.parts if p.first <= link < p.first + p.count), None
        )
        self._link_reports = 0
        """Number of link state messages since the first values after a gap."""

    def has(self, source: str) -> bool:
        """True where the DBC has a signal for the source."""
        return source in self._columns

    def value(self, source: str) -> Value:
        """The value in the source's unit; None where it is not available."""
        column = self._columns.get(source)
        if column is None:
            return None
        value = self._view.values[column]
        if value is None or isinstance(value, str):
            return value
        return _converted(value, self._factors[source])

    def number(self, source: str) -> float | None:
        """The value of a numeric source. The cell voltage is computed if the DBC has none and the number of cells is known."""
        value = self.value(source)
        if value is None and source == "mean_cell_voltage":
            cells = self._settings.cell_count or self.number("cell_count")
            voltage = self.value("battery_voltage")
            if cells and isinstance(voltage, (int, float)):
                value = voltage / cells
        return value if isinstance(value, (int, float)) else None

    @property
    def is_fresh(self) -> bool:
        """True while any measured value is available."""
        return any(self._view.values[column] is not None for column in self._plain[Group.LIVE])

    @property
    def state(self) -> str | None:
        """The operating state's name, or its number if it has none; None where it is not available."""
        value = self.value("operating_state")
        if value is None:
            value = self.value("operating_state_raw")
        if isinstance(value, (int, float)):
            return state_text(int(value)) or f"state {int(value)}"
        return value

    @property
    def link(self) -> str | None:
        """The link state's name; None where it is not available.

        It has its own message, which comes up to a cycle later than the first values after a gap and may have been sent before them:
        until its second reception the values show that the link is good.
        """
        value = self.value("link_state")
        if isinstance(value, (int, float)):
            value = _enumerated(LinkState, value)
        if (
            value is None
            or normalize(value) in _WORKING
            or self._link_reports >= _BELIEVED
            or not self.is_fresh
        ):
            return value
        return _enumerated(LinkState, LinkState.OK)

    def note(self, firsts: Collection[int], was_fresh: bool) -> None:
        """Take note of a frame with the parts that begin at these columns."""
        if not was_fresh and self.is_fresh:
            self._link_reports = 0
        elif self._link_part is not None and self._link_part in firsts:
            self._link_reports += 1

    @property
    def device(self) -> str:
        """Device, variant and firmware; empty where not available."""
        value = self.value("device")
        if value is None:
            value = self.value("device_raw")
        if isinstance(value, (int, float)):
            value = device_text(int(value)) or f"device {int(value)}"
        if value is None:
            return ""
        value = next(
            (device.text for device in Device if normalize(device.text) == normalize(value)), value
        )
        variant, main, sub = (
            self.number(name) for name in ("variant", "firmware_main", "firmware_sub")
        )
        text = value if variant is None else f"{value} {variant:.0f}"
        return text if main is None or sub is None else f"{text}, firmware {main:.0f}.{sub:.0f}"

    @property
    def active(self) -> list[Active]:
        """The bits that are set, errors first. A flag counts only while another value of its frame is available."""
        found = [
            *self._active(OperatingError, "operating_errors", Group.LIVE),
            *self._active(SelfTestError, "selftest_errors", Group.INFO),
        ]
        return sorted(found, key=lambda active: list(Severity).index(active.severity))

    @property
    def alarms(self) -> list[Active]:
        """The active bits to show: without those that are no alarm, and without a summary of bits that are shown anyway."""
        alarms = [active for active in self.active if active.name not in _NO_ALARM]
        plain = {active.severity for active in alarms if active.name not in _SUMMARIES}
        return [
            active
            for active in alarms
            if active.name not in _SUMMARIES or active.severity not in plain
        ]

    def _active(self, kind: type[ErrorBit], word_source: str, group: Group) -> Iterable[Active]:
        plain = self._plain[group]
        if plain and all(self._view.values[column] is None for column in plain):
            return
        word_value = self.number(word_source)
        word = int(word_value) if word_value is not None else 0
        for bit in kind:
            if word >> int(bit) & 1 or self.value(bit.text) == 1:
                yield Active(bit.text, bit.severity, bit.meaning)
        named = {int(bit) for bit in kind}
        for number in range(32):
            if word >> number & 1 and number not in named:
                yield Active(
                    f"bit{number}",
                    Severity.WARNING,
                    f"bit {number} of {word_source}, which has no name",
                )


class Monitor:
    """The ESCs and the gateway of a layout. ``now``: nanoseconds on the clock of the frames."""

    def __init__(self, bus: BusLayout) -> None:
        self.bus = bus
        self.view = View(SignalReader(bus.layout))
        self.escs = tuple(
            EscMonitor(settings, index, self.view) for index, settings in enumerate(bus.escs)
        )
        self.start_ns: int | None = None
        """Time of the start, or of the last reset of the extremes."""
        self._now = 0
        self._samples: deque[tuple[int, int]] = deque()
        parts = self.view.reader.parts
        self._tracked = {part.first: self._tracked_of(part.first, part.count) for part in parts}
        cyclic = {part.first for part in parts if part.plan.cycle_ns}
        self._missing = cyclic or {part.first for part in parts}

    @property
    def keys(self) -> frozenset[int]:
        """CAN ids of the layout, with EXTENDED for 29 bits."""
        return self.view.reader.keys

    @property
    def is_complete(self) -> bool:
        """True once every cyclic message has come."""
        return not self._missing

    @property
    def frames(self) -> int:
        return self.view.frames

    def take(self, frame: CanFrame, now: int) -> None:
        """Take a frame that came at ``now``; frames outside the layout are ignored."""
        if frame.remote:
            return
        self._now = now = max(now, self._now)
        self.view.expire(now)
        fresh = [esc.is_fresh for esc in self.escs]
        chunks = self.view.take(frame.key, frame.data, now)
        if chunks is not None:
            firsts = [first for first, _ in chunks]
            for esc, was_fresh in zip(self.escs, fresh, strict=True):
                esc.note(firsts, was_fresh)
        for first, values in chunks or ():
            self._missing.discard(first)
            for offset, spread, factor in self._tracked[first]:
                value = values[offset]
                if value is not None and not isinstance(value, str):
                    spread.take(_converted(value, factor))

    def advance(self, now: int) -> None:
        """Advance the time: values of missing messages become not available."""
        self._now = now = max(now, self._now)
        if self.start_ns is None:
            self.start_ns = now
        self.view.expire(now)
        samples = self._samples
        if not samples or now - samples[-1][0] >= _RATE_STEP_NS:
            samples.append((now, self.view.frames))
            while now - samples[0][0] > _RATE_NS:
                samples.popleft()

    def reset(self) -> None:
        """Restart the extremes."""
        for esc in self.escs:
            for spread in esc.spreads.values():
                spread.low = spread.high = None
        self.start_ns = self._now

    @property
    def frame_rate(self) -> float | None:
        """Frames of the layout per second; None during the first second."""
        if len(self._samples) < 2:
            return None
        (begin, first), (end, last) = self._samples[0], self._samples[-1]
        return (last - first) * SECOND / (end - begin) if end - begin >= SECOND // 2 else None

    @property
    def watched_s(self) -> float:
        """Seconds since the start, or since the extremes were reset."""
        return 0.0 if self.start_ns is None else (self._now - self.start_ns) / SECOND

    @property
    def silent_ns(self) -> int:
        """Time since the last frame, or since the start before the first one."""
        last = self.view.last_ns if self.view.last_ns is not None else self.start_ns
        return 0 if last is None else max(0, self._now - last)

    @property
    def gateway_state(self) -> str | None:
        """Name of the gateway's state; None where it is not available."""
        return self._gateway("gateway_state", GatewayState)

    @property
    def can_state(self) -> str | None:
        """Name of the state of the gateway's CAN controller; None where it is not available."""
        return self._gateway("can_state", CanState)

    @property
    def is_replay(self) -> bool:
        """True where the gateway reports that it plays a recording."""
        return normalize(self.gateway_state or "") == "replay"

    def gateway_number(self, source: str) -> float | None:
        """A numeric value of the gateway itself, as ``esc_count``."""
        value = self.view.value(source)
        return value if isinstance(value, (int, float)) else None

    def document(self) -> dict[str, Any]:
        """Everything as JSON: source names, values and their units; None for what is not available."""
        return {
            "frames": self.frames,
            "gateway": {
                "state": self.gateway_state,
                "can_state": self.can_state,
                "uptime_s": self.gateway_number("uptime"),
            },
            "units": {name: unit for esc in self.escs for name, unit in esc.units.items() if unit},
            "escs": [
                {
                    "name": esc.name,
                    "link": esc.link,
                    "state": esc.state,
                    "device": esc.device or None,
                    "errors": [
                        active.name for active in esc.active if active.severity is Severity.ERROR
                    ],
                    "warnings": [
                        active.name for active in esc.active if active.severity is Severity.WARNING
                    ],
                    "status": [
                        active.name for active in esc.active if active.severity is Severity.STATUS
                    ],
                    "values": {name: esc.value(name) for name in esc.units},
                }
                for esc in self.escs
            ],
        }

    def _gateway(self, source: str, kind: type[GatewayState] | type[CanState]) -> str | None:
        value = self.view.value(source)
        return _enumerated(kind, value) if isinstance(value, (int, float)) else value

    def _tracked_of(
        self, first: int, count: int
    ) -> list[tuple[int, Spread, tuple[float, float] | None]]:
        """The values of a part that have extremes, and where these are kept."""
        found = []
        for offset in range(count):
            column = self.view.reader.columns[first + offset]
            if column.esc is None or column.source not in QUANTITY:
                continue
            if self.view.reader.column_of(column.source, column.esc) == first + offset:
                esc = self.escs[column.esc]
                factor = _to_source(column.unit, VALUES[column.source].unit)
                found.append((offset, esc.spreads[column.source], factor))
        return found


def _to_source(unit: str, source_unit: str) -> tuple[float, float] | None:
    """Factor and offset from a signal's unit to that of its source; None where the units are equal."""
    found = units.conversion(unit or source_unit, source_unit)
    if found is None:
        return None
    factor, offset = found
    return None if factor == 1 and offset == 0 else (float(factor), float(offset))


def _converted(value: float, factor: tuple[float, float] | None) -> float:
    return value if factor is None else round(value * factor[0] + factor[1], 9)


def _enumerated(kind: type[LinkState] | type[GatewayState] | type[CanState], number: float) -> str:
    names: Mapping[int, str] = {
        int(member): member.name.title().replace("_", "") for member in kind
    }
    return names.get(int(number), str(int(number)))
