"""The measured values on the screens: names, units, limits; extremes and a short history of each. Pure."""

from collections import deque
from typing import NamedTuple

HISTORY_S = 60
"""Length of a history, one value each second."""


class Quantity(NamedTuple):
    """A measured value by its source. Limits are lower ones if ``alarm`` is below ``warning``."""

    source: str
    label: str
    unit: str
    digits: int
    head: str = ""
    """Head of its column in the table of all ESCs; empty: only on an ESC's own page."""
    warning: float | None = None
    alarm: float | None = None
    falls: bool = False
    """True where its minimum is of interest in the table, not its maximum."""

    def mark(self, value: float) -> str:
        """``!!`` or ``!`` for a value beyond its limit for an alarm or a warning."""
        if self.warning is None or self.alarm is None:
            return ""
        sign = 1 if self.alarm >= self.warning else -1
        if sign * value >= sign * self.alarm:
            return "!!"
        return "!" if sign * value >= sign * self.warning else ""


# The most important first: what does not fit on the screen is left out from the end.
# The ESC does not report its limits. A lithium polymer cell is nearly empty below 3.5 V under load, and damaged below 3.3 V.
QUANTITIES = (
    Quantity("motor_speed", "motor speed", "1/min", 0, "1/min"),
    Quantity("battery_voltage", "battery voltage", "V", 2, "V", falls=True),
    Quantity("battery_current", "battery current", "A", 1, "A"),
    Quantity("power_stage_temperature", "power stage", "degC", 0, "degC", 80, 100),
    Quantity("battery_power", "power", "W", 0, "W"),
    Quantity("mean_cell_voltage", "cell voltage", "V", 2, "V cell", 3.5, 3.3, falls=True),
    Quantity("throttle", "throttle", "%", 0, "thr %"),
    Quantity("consumed_charge", "charge", "mAh", 0, "mAh"),
    Quantity("bec_temperature", "BEC", "degC", 0, "BEC degC", 80, 100),
    Quantity("output_opening", "opening", "%", 0, "open %"),
    Quantity("motor_current", "motor current", "A", 1, "A motor"),
    Quantity("peak_current", "peak current", "A", 1, "A peak"),
    Quantity("energy_used", "energy", "Wh", 1, "Wh"),
    Quantity("output_speed", "output speed", "1/min", 0, "1/min"),
    Quantity("electrical_speed", "electrical speed", "1/min", 0, "1/min"),
    Quantity("bec_voltage", "BEC voltage", "V", 2),
    Quantity("bec_current", "BEC current", "A", 2),
)


class Track:
    """Minimum, maximum and history of a value; the history has None for seconds in which it was not available."""

    __slots__ = ("high", "history", "low")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.low: float | None = None
        self.high: float | None = None
        self.history: deque[float | None] = deque(maxlen=HISTORY_S)

    def take(self, value: float) -> None:
        if self.low is None or value < self.low:
            self.low = value
        if self.high is None or value > self.high:
            self.high = value
