"""Plots and their lines, and classes of operating states in the report: the only place of titles, order and colours."""

from dataclasses import dataclass

from kontronik_can_gw.esc.kontronik.states import OperatingState


@dataclass(frozen=True)
class Quantity:
    """A line of a plot: a source of values.py, in the source's unit whatever the unit in the DBC."""

    source: str
    label: str


@dataclass(frozen=True)
class Plot:
    """A plot. ``key`` names it in the page and as a file; ``digits``: decimals of values shown."""

    key: str
    title: str
    unit: str
    digits: int
    lines: tuple[Quantity, ...]


PLOTS = (
    Plot(
        "speed",
        "Speed",
        "1/min",
        0,
        (
            Quantity("output_speed", "Output"),
            Quantity("motor_speed", "Motor"),
            Quantity("electrical_speed", "Electrical"),
        ),
    ),
    Plot("battery_voltage", "Battery voltage", "V", 2, (Quantity("battery_voltage", "Battery"),)),
    Plot("cell_voltage", "Mean cell voltage", "V", 3, (Quantity("mean_cell_voltage", "Cell"),)),
    Plot(
        "current",
        "Current",
        "A",
        1,
        (
            Quantity("battery_current", "Battery"),
            Quantity("motor_current", "Motor"),
            Quantity("peak_current", "Peak (held)"),
        ),
    ),
    Plot("power", "Battery power", "W", 0, (Quantity("battery_power", "Power"),)),
    Plot(
        "temperature",
        "Temperature",
        "°C",
        0,
        (Quantity("power_stage_temperature", "Power stage"), Quantity("bec_temperature", "BEC")),
    ),
    Plot(
        "throttle",
        "Throttle and output stage opening",
        "%",
        0,
        (Quantity("throttle", "Throttle"), Quantity("output_opening", "Opening")),
    ),
    Plot("pwm", "PWM input", "µs", 0, (Quantity("pwm_input", "PWM input"),)),
    Plot("bec_voltage", "BEC voltage", "V", 3, (Quantity("bec_voltage", "BEC voltage"),)),
    Plot("bec_current", "BEC current", "A", 3, (Quantity("bec_current", "BEC current"),)),
)


@dataclass(frozen=True)
class StateClass:
    """Operating states shown alike. Colours: for a light and for a dark page."""

    key: str
    label: str
    light: str
    dark: str
    states: frozenset[OperatingState]


_S = OperatingState
STATE_CLASSES = (
    StateClass(
        "off", "Motor off, standby", "#c9ced6", "#4a515c", frozenset({_S.MotorOff, _S.StandBy})
    ),
    StateClass(
        "waiting",
        "Waiting",
        "#9ecae9",
        "#31638a",
        frozenset({_S.WaitForSignal, _S.WaitForMotorOff, _S.WaitForMotorOn}),
    ),
    StateClass(
        "start",
        "Self-test, signal",
        "#cab8e6",
        "#6a4f93",
        frozenset({_S.Selftest, _S.AcousticSignal}),
    ),
    StateClass(
        "spool",
        "Spooling up, synchronising",
        "#f4d35e",
        "#8f7514",
        frozenset(
            {
                *(_S.SpoolUpFromStill, _S.SpoolUpFromTurn, _S.SpoolUpQuick),
                *(_S.Sync_Forward, _S.Sync_Backward, _S.Sync_StandBy),
            }
        ),
    ),
    StateClass(
        "running",
        "Running",
        "#6fcf9f",
        "#1d7a51",
        frozenset({_S.Forward, _S.Backward, _S.RPMControl}),
    ),
    StateClass(
        "braking",
        "Braking",
        "#f0a56b",
        "#a3571a",
        frozenset({_S.Brake, _S.BrakeTargetBackward, _S.BrakeTargetForward}),
    ),
    StateClass("programming", "Programming", "#e5b3d0", "#8a4a70", frozenset({_S.Programming})),
    StateClass(
        "fault",
        "Fault",
        "#e0413a",
        "#d64b44",
        frozenset({_S.Error_Selftest, _S.CutOffDuringOperation}),
    ),
    StateClass("unknown", "Unknown to this program", "#ffffff", "#15181d", frozenset()),
)
CLASS_OF = {
    int(state): index for index, group in enumerate(STATE_CLASSES) for state in group.states
}
UNKNOWN_CLASS = len(STATE_CLASSES) - 1


def class_of(state: int) -> int:
    """Index in STATE_CLASSES of an operating state's number."""
    return CLASS_OF.get(state, UNKNOWN_CLASS)


@dataclass(frozen=True)
class LineStyle:
    """Style of a line: colour on a light and on a dark page, dashes in pixels (distinguishable without colour)."""

    light: str
    dark: str
    dash: tuple[int, ...]


# Palette of Okabe and Ito for all kinds of colour vision, darkened or lightened for the background.
STYLES = (
    LineStyle("#0072b2", "#4aa8e0", ()),
    LineStyle("#d55e00", "#ff8c42", (8, 4)),
    LineStyle("#009e73", "#2fd0a0", (2, 3)),
    LineStyle("#b34c8a", "#e39ac4", (9, 3, 2, 3)),
    LineStyle("#8c6d00", "#e8d34a", (14, 5)),
    LineStyle("#3a9bd9", "#9bd5ff", (5, 2)),
    LineStyle("#444444", "#dddddd", (12, 3, 2, 3, 2, 3)),
    LineStyle("#7b3294", "#b98be0", (2, 2, 6, 2)),
)
