"""Sums of one ESC: counters that reset or overflow, time, energy, voltage at rest and under load. One pass."""

import statistics
from collections import deque
from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Any, NamedTuple

from kontronik_can_gw.desk.report.flight import EscFlight, Extreme, Number
from kontronik_can_gw.esc.telemetry import SECOND

HOUR_NS = 3600 * SECOND
REST_CURRENT = 1.0
"""A: below this magnitude the battery is at rest."""
LOAD_CURRENT = 5.0
"""A: at or above it the battery is under load."""
REST_NS = 2 * SECOND
"""The rest voltage is the mean over at most this time before the first load."""


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
        self._rest: deque[tuple[int, float]] = deque()
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
                self._weigh(time_ns, voltage, current)

    def finish(self, end_ns: int, *, has_power: bool, has_speed: bool) -> None:
        """Account for the time until the end."""
        self._account(end_ns)
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

    def _weigh(self, time_ns: int, voltage: float, current: float) -> None:
        """The battery's voltage (V) at rest before the first load, and the lowest under load."""
        found, lowest = self._found, self._found.load_voltage
        if current >= LOAD_CURRENT:
            if lowest is None and self._rest:
                found.rest_voltage = statistics.fmean(v for _, v in self._rest)
            if lowest is None or voltage < lowest.value:
                found.load_voltage = Extreme(voltage, time_ns)
        elif lowest is None and abs(current) <= REST_CURRENT and voltage > 0:
            self._rest.append((time_ns, voltage))
            while self._rest[0][0] < time_ns - REST_NS:
                self._rest.popleft()
