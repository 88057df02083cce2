"""Sums of one ESC: counters that reset or overflow, time, energy, load and resistance. One pass."""

from collections import deque
from collections.abc import Sequence

from kontronik_can_gw.desk.report.decimate import Number
from kontronik_can_gw.desk.report.fit import ResistanceFit
from kontronik_can_gw.desk.report.flight import Extreme, Summary
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.signals.unpacker import Value

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
        last = self._last
        if last is not None and values.count(last) == len(values):
            return
        for value in values:
            if value is None or value == last:
                continue
            if last is not None:
                if value > last:
                    self.total += value - last
                elif self._rolls(last, value):
                    self.total += self._top + 1 - last + value
                else:
                    self.total += value
                    self.resets += 1
            self.seen = True
            last = value
        self._last = last

    def _rolls(self, last: float, value: float) -> bool:
        """True for an overflow: from the last eighth of the range to the first."""
        return last > self._top * 7 / 8 and value < self._top / 8


class Ledger:
    """Time, energy, load and resistance of one ESC; values hold from row to row."""

    def __init__(self, summary: Summary) -> None:
        self._summary = summary
        self._last: tuple[Value, Number, Number, Number, Number] | None = None
        self._since = 0
        self._turning_ns = 0
        self._drawn = 0.0
        self._returned = 0.0
        self._turning_power = 0.0
        self._rest: deque[tuple[int, float]] = deque()
        self._loaded = False
        self._fit = ResistanceFit()

    def take(
        self,
        times: Sequence[int],
        present: Sequence[Value],
        voltage: Sequence[Number],
        current: Sequence[Number],
        power: Sequence[Number],
        speed: Sequence[Number],
    ) -> None:
        last, since = self._last, self._since
        for time_ns, now in zip(
            times, zip(present, voltage, current, power, speed, strict=True), strict=True
        ):
            if now == last:
                continue
            if last is not None:
                self._account(time_ns - since, last)
            last, since = now, time_ns
            v, i = now[1], now[2]
            if v is not None and i is not None:
                self._load(time_ns, v, i)
        self._last, self._since = last, since

    def finish(self, end_ns: int, *, has_power: bool, has_speed: bool) -> None:
        if self._last is not None:
            self._account(end_ns - self._since, self._last)
        summary = self._summary
        if has_speed:
            summary.turning_ns = self._turning_ns
        if has_power:
            summary.energy_drawn = self._drawn / HOUR_NS
            summary.energy_returned = self._returned / HOUR_NS
            if self._turning_ns:
                summary.power_turning = self._turning_power / self._turning_ns
        summary.resistance = self._fit.finish()

    def _account(self, length_ns: int, state: tuple[Value, Number, Number, Number, Number]) -> None:
        present, _, _, power, speed = state
        if present is None:
            return
        self._summary.telemetry_ns += length_ns
        if power is not None:
            if power > 0:
                self._drawn += power * length_ns
            else:
                self._returned -= power * length_ns
        if speed:
            self._turning_ns += length_ns
            self._turning_power += (power or 0) * length_ns

    def _load(self, time_ns: int, voltage: float, current: float) -> None:
        self._fit.take(time_ns, voltage, current)
        if current >= LOAD_CURRENT:
            if not self._loaded:
                self._loaded = True
                if self._rest:
                    self._summary.rest_voltage = sum(v for _, v in self._rest) / len(self._rest)
                    self._rest.clear()
            lowest = self._summary.load_voltage
            if lowest is None or voltage < lowest.value:
                self._summary.load_voltage = Extreme(voltage, time_ns)
        elif not self._loaded and abs(current) <= REST_CURRENT and voltage > 0:
            self._rest.append((time_ns, voltage))
            while self._rest[0][0] < time_ns - REST_NS:
                self._rest.popleft()
