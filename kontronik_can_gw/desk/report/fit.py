"""Estimates the battery's internal resistance from voltage over current.

The open-circuit voltage falls as the battery empties, so one line through a whole flight would count that as resistance. So a line is
fitted through each ten seconds in which the current varies enough. The result is the median of the slopes, with half of their
interquartile range as spread; with fewer than three slopes there is none. It includes leads and plugs between battery and ESC.
"""

from typing import NamedTuple

from kontronik_can_gw.esc.telemetry import SECOND

STRETCH_NS = 10 * SECOND
MIN_PAIRS = 20
MIN_SPREAD = 2.0
"""A: minimum standard deviation of the current in an interval."""
MIN_STRETCHES = 3


class Resistance(NamedTuple):
    """A resistance and its spread in ohm."""

    value: float
    spread: float
    stretches: int


class ResistanceFit:
    """Takes pairs of voltage and current in order of time."""

    def __init__(self) -> None:
        self._slopes: list[float] = []
        self._begin_ns: int | None = None
        self._restart(0.0, 0.0)

    def take(self, time_ns: int, voltage: float, current: float) -> None:
        """Take a pair (V, A)."""
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
        """The resistance; None where the data are not sufficient."""
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
    """A quantile, interpolated linearly as numpy does."""
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)
