"""The battery's internal resistance from voltage over current.

The open voltage falls as the battery empties, so one line through a whole flight would count that as resistance. So a line is fitted
through each stretch of ten seconds, if the current moves enough in it, and the median of the slopes is given, with the half width of the
middle half of them as spread. With fewer than three such stretches nothing is said. Leads and plugs between battery and ESC are part of it.
"""

from typing import NamedTuple

from kontronik_can_gw.esc.telemetry import SECOND

STRETCH_NS = 10 * SECOND
MIN_PAIRS = 20
MIN_SPREAD = 2.0
"""A: standard deviation of the current that a stretch needs."""
MIN_STRETCHES = 3


class Resistance(NamedTuple):
    """In ohm."""

    value: float
    spread: float
    stretches: int


class ResistanceFit:
    """Takes pairs of V and A in order of time."""

    def __init__(self) -> None:
        self._slopes: list[float] = []
        self._begin_ns: int | None = None
        self._restart(0.0, 0.0)

    def take(self, time_ns: int, voltage: float, current: float) -> None:
        """A pair."""
        if self._begin_ns is None or time_ns - self._begin_ns >= STRETCH_NS:
            self._close()
            self._begin_ns = time_ns
            self._restart(voltage, current)
        x, y = current - self._x0, voltage - self._y0
        self._n += 1
        self._x += x
        self._y += y
        self._xx += x * x
        self._xy += x * y

    def finish(self) -> Resistance | None:
        """None where the data do not tell."""
        self._close()
        self._restart(0.0, 0.0)
        slopes = sorted(self._slopes)
        if len(slopes) < MIN_STRETCHES:
            return None
        middle = _quantile(slopes, 0.5)
        if middle <= 0:
            return None
        return Resistance(
            middle, (_quantile(slopes, 0.75) - _quantile(slopes, 0.25)) / 2, len(slopes)
        )

    def _restart(self, voltage: float, current: float) -> None:
        self._x0, self._y0 = current, voltage  # sums around these lose no digits
        self._n = 0
        self._x = self._y = self._xx = self._xy = 0.0

    def _close(self) -> None:
        n = self._n
        if n < MIN_PAIRS:
            return
        moved = self._xx - self._x * self._x / n
        if moved >= n * MIN_SPREAD**2:
            self._slopes.append(-(self._xy - self._x * self._y / n) / moved)


def _quantile(ordered: list[float], share: float) -> float:
    """Between neighbours by a line, as numpy does."""
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)
