"""The quantities that monitor, live page and report show: labels, decimals, limits, plots.

They stand in quantities.toml. Colours are in page.css.
"""

import tomllib
from pathlib import Path
from typing import NamedTuple

from kontronik_can_gw.esc.values import VALUES

_FILE = Path(__file__).with_name("quantities.toml")
_TABLES = tomllib.loads(_FILE.read_text(encoding="utf-8"))


class Quantity(NamedTuple):
    """A measured value. Its limits are lower limits if ``alarm`` is below ``warning``."""

    source: str
    label: str
    digits: int
    head: str = ""
    """Head of its column in the table of all ESCs. Empty: shown only on an ESC's own page."""
    warning: float | None = None
    alarm: float | None = None

    @property
    def unit(self) -> str:
        return VALUES[self.source].unit

    def mark(self, value: float) -> str:
        """Return ``!!`` for a value beyond its alarm limit, ``!`` beyond its warning limit."""
        if self.warning is None or self.alarm is None:
            return ""
        sign = 1 if self.alarm >= self.warning else -1
        if sign * value >= sign * self.alarm:
            return "!!"
        if sign * value >= sign * self.warning:
            return "!"
        return ""


class Plot(NamedTuple):
    """A plot."""

    key: str
    """The plot's name in the page."""
    title: str
    digits: int
    """Decimals of the values that are shown."""
    lines: dict[str, str]
    """Label of each line, by source."""
    live_lines: int = 0
    """Number of its lines on the live page."""
    has_one_shape: bool = False
    """True if the lines differ only by a factor.

    Only one of them is drawn. The cursor shows the values of all.
    """
    is_noisy: bool = False
    """True if the values vary so fast that ESCs would cover each other. Each has its own plot."""


QUANTITIES = tuple(Quantity(source, **row) for source, row in _TABLES["monitor"].items())
PLOTS = tuple(Plot(key, **row) for key, row in _TABLES["plots"].items())
DRAWN = tuple(source for plot in PLOTS for source in plot.lines)
MAXIMA = {source: (label, digits) for source, (label, digits) in _TABLES["maxima"].items()}
"""Label and decimals by source."""
MINIMA = {source: (label, digits) for source, (label, digits) in _TABLES["minima"].items()}
TILES: dict[str, str] = _TABLES["tiles"]
"""Label by source."""
COUNTERS: dict[str, str] = _TABLES["counters"]
COMPUTED_FROM = {
    "battery_power": ("battery_voltage", "battery_current"),
    "mean_cell_voltage": ("battery_voltage",),
}
"""Values that follow from others. ``mean_cell_voltage`` also needs the number of cells."""
SPEEDS = ("electrical_speed", "motor_speed", "output_speed")

PHASES = (
    "Motor off, standby",
    "Waiting",
    "Self-test, signal",
    "Spooling up, synchronising",
    "Running",
    "Braking",
    "Programming",
    "Fault",
    "Unknown to this program",
)
"""Phases of operating states. All states of a phase have its colour in page.css, in this order."""
