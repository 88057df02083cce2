"""Sums of one ESC: counters that reset or overflow, time, energy, load and resistance. One pass."""

import statistics
from collections import deque
from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Any, NamedTuple

from kontronik_can_gw.desk.report.flight import EscFlight, Extreme, Number, Resistance
from kontronik_can_gw.esc.telemetry import SECOND

HOUR_NS = 3600 * SECOND
REST_CURRENT = 1.0
"""A: below this magnitude the battery is at rest."""
LOAD_CURRENT = 5.0
"""A: at or above it the battery is under load."""
REST_NS = 2 * SECOND
"""The rest voltage is the mean over at most this time before the first load."""
STRETCH_NS = 10 * SECOND
MIN_PAIRS = 20
MIN_SPREAD = 2.0
"""A: minimum standard deviation of the current in a stretch."""
MIN_STRETCHES = 3


class Counter:
    """Total increase of a counter, across resets and overflows at ``top``."""

    def __init__(self, top: float) -> None:
        self._top = top
        self._last: Number = None
        self.total = 0.0
        self.resets = 0
        self.seen = False

    def take(self, values: Sequence[Number]) -> None:
        """Take the next values."""
        if values.count(self._last) == len(values):
            return
        for value in values:
            if value is None or value == self._last:
                continue
            last = value if self._last is None else self._last
            if value >= last:
                self.total += value - last
            elif last > self._top * 7 / 8 and value < self._top / 8:  # an overflow
                self.total += self._top + 1 - last + value
            else:
                self.total += value
                self.resets += 1
            self.seen = True
            self._last = value


class Load(NamedTuple):
    """What the ledger needs of a row. ``present``: None where telemetry is lost."""

    present: Any
    voltage: Number
    current: Number
    power: Number
    speed: Number


class Ledger:
    """Time and energy of one ESC; values hold from row to row."""

    def __init__(self, found: EscFlight) -> None:
        self._found = found
        self._battery = Battery(found)
        self._last: Load | None = None
        self._since_ns = 0
        self._turning_ns = 0
        self._drawn = self._returned = self._turning_power = 0.0  # W ns

    def take(self, times: Sequence[int], rows: Iterable[Load]) -> None:
        """Take the next rows."""
        for time_ns, row in zip(times, rows, strict=True):
            if row == self._last:
                continue
            self._account(time_ns)
            self._last = row
            voltage, current = row.voltage, row.current
            if voltage is not None and current is not None and isfinite(voltage + current):
                self._battery.take(time_ns, voltage, current)

    def finish(self, end_ns: int, *, has_power: bool, has_speed: bool) -> None:
        """Account for the time until the end."""
        self._account(end_ns)
        self._battery.finish()
        found = self._found
        if has_speed:
            found.turning_ns = self._turning_ns
        if has_power:
            found.energy_drawn = self._drawn / HOUR_NS
            found.energy_returned = self._returned / HOUR_NS
            if self._turning_ns:
                found.power_turning = self._turning_power / self._turning_ns

    def _account(self, until_ns: int) -> None:
        """Add what the last row held until now."""
        length_ns, self._since_ns = until_ns - self._since_ns, until_ns
        if self._last is None or self._last.present is None:
            return
        power = self._last.power or 0
        self._found.telemetry_ns += length_ns
        self._drawn += max(power, 0) * length_ns
        self._returned += max(-power, 0) * length_ns
        if self._last.speed:
            self._turning_ns += length_ns
            self._turning_power += power * length_ns


class Battery:
    """Voltage at rest and under load, and an estimate of the internal resistance with all leads up to the ESC.

    The open-circuit voltage falls as the battery empties, so one line through a whole flight would count that as resistance. So a line
    is fitted to voltage over current in each ten seconds in which the current varies enough. The result is the median of the slopes,
    with half of their interquartile range as spread.
    """

    def __init__(self, found: EscFlight) -> None:
        self._found = found
        self._rest: deque[tuple[int, float]] = deque()
        self._loaded = False
        self._begin_ns = 0
        self._voltages: list[float] = []
        self._currents: list[float] = []
        self._slopes: list[float] = []

    def take(self, time_ns: int, voltage: float, current: float) -> None:
        """Take a pair (V, A)."""
        if not self._voltages or time_ns - self._begin_ns >= STRETCH_NS:
            self._fit()
            self._begin_ns = time_ns
        self._voltages.append(voltage)
        self._currents.append(current)
        if current >= LOAD_CURRENT:
            if self._rest and not self._loaded:
                self._found.rest_voltage = statistics.fmean(v for _, v in self._rest)
            self._loaded = True
            lowest = self._found.load_voltage
            if lowest is None or voltage < lowest.value:
                self._found.load_voltage = Extreme(voltage, time_ns)
        elif not self._loaded and abs(current) <= REST_CURRENT and voltage > 0:
            self._rest.append((time_ns, voltage))
            while self._rest[0][0] < time_ns - REST_NS:
                self._rest.popleft()

    def finish(self) -> None:
        """Estimate the resistance, where the data are sufficient."""
        self._fit()
        if len(self._slopes) < MIN_STRETCHES:
            return
        low, middle, high = statistics.quantiles(self._slopes, n=4, method="inclusive")
        if middle > 0:
            self._found.resistance = Resistance(middle, (high - low) / 2, len(self._slopes))

    def _fit(self) -> None:
        """Add the slope of the stretch that ends."""
        voltages, self._voltages = self._voltages, []
        currents, self._currents = self._currents, []
        if len(currents) < MIN_PAIRS:
            return
        mean = statistics.fmean(currents)
        spread = statistics.fmean((current - mean) ** 2 for current in currents) ** 0.5
        if spread >= MIN_SPREAD:
            self._slopes.append(-statistics.linear_regression(currents, voltages).slope)
