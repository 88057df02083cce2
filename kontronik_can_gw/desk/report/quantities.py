"""Defines the plots, extremes and phases of a report: titles, order and decimals.

Colours are in page.css.
"""

from typing import NamedTuple


class Plot(NamedTuple):
    """A plot."""

    key: str
    """The plot's name in the page."""
    title: str
    digits: int
    """Decimals of the values that are shown."""
    lines: dict[str, str]
    """Label of each line, by source."""
    has_one_shape: bool = False
    """True if the lines differ only by a factor.

    Only one of them is drawn. The cursor shows the values of all.
    """
    is_noisy: bool = False
    """True if the values vary so fast that ESCs would cover each other. Each has its own plot."""


# fmt: off
PLOTS = (
    Plot("battery_voltage", "Battery voltage", 2, {"battery_voltage": "Battery"}),
    Plot("cell_voltage", "Mean cell voltage", 3, {"mean_cell_voltage": "Cell"}),
    Plot(
        "current", "Current", 1,
        {"battery_current": "Battery", "motor_current": "Motor", "peak_current": "Peak (held)"},
    ),
    Plot("power", "Battery power", 0, {"battery_power": "Power"}),
    Plot(
        "speed", "Speed", 0,
        {"output_speed": "Output", "motor_speed": "Motor", "electrical_speed": "Electrical"},
        has_one_shape=True,
    ),
    Plot(
        "temperature", "Temperature", 0,
        {"power_stage_temperature": "Power stage", "bec_temperature": "BEC"},
    ),
    Plot(
        "throttle", "Throttle and output stage opening", 0,
        {"throttle": "Throttle", "output_opening": "Opening"},
    ),
    Plot("pwm", "PWM input", 0, {"pwm_input": "PWM input"}),
    Plot("bec_voltage", "BEC voltage", 3, {"bec_voltage": "BEC voltage"}, is_noisy=True),
    Plot("bec_current", "BEC current", 3, {"bec_current": "BEC current"}, is_noisy=True),
)
# fmt: on
DRAWN = tuple(source for plot in PLOTS for source in plot.lines)

MAXIMA = {
    "battery_power": ("Battery power", 0),
    "battery_current": ("Battery current", 1),
    "motor_current": ("Motor current", 1),
    "peak_current": ("Peak current (held by the ESC)", 1),
    "output_speed": ("Output speed", 0),
    "motor_speed": ("Motor speed", 0),
    "electrical_speed": ("Electrical speed", 0),
    "power_stage_temperature": ("Power stage temperature", 0),
    "bec_temperature": ("BEC temperature", 0),
    "bec_current": ("BEC current", 3),
    "output_opening": ("Output stage opening", 0),
}
"""Label and decimals by source."""
MINIMA = {
    "battery_voltage": ("Lowest battery voltage", 2),
    "mean_cell_voltage": ("Lowest mean cell voltage", 3),
    "bec_voltage": ("Lowest BEC voltage", 3),
}
COUNTERS = {
    "consumed_charge": "Charge used",
    "losses": "Link losses",
    "crc_errors": "CRC errors",
    "dropped_bytes": "Bytes dropped",
}
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
