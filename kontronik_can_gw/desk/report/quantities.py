"""Plots, extremes and classes of operating states of the report: titles, order and decimals. Colours are in page.css."""

from typing import NamedTuple

from kontronik_can_gw.esc.kontronik.states import OperatingState


class Plot(NamedTuple):
    """A plot. ``key`` names it in the page; ``lines``: label by source; ``digits``: decimals of values shown."""

    key: str
    title: str
    digits: int
    lines: dict[str, str]


PLOTS = (
    Plot(
        *("speed", "Speed", 0),
        {"output_speed": "Output", "motor_speed": "Motor", "electrical_speed": "Electrical"},
    ),
    Plot("battery_voltage", "Battery voltage", 2, {"battery_voltage": "Battery"}),
    Plot("cell_voltage", "Mean cell voltage", 3, {"mean_cell_voltage": "Cell"}),
    Plot(
        *("current", "Current", 1),
        {"battery_current": "Battery", "motor_current": "Motor", "peak_current": "Peak (held)"},
    ),
    Plot("power", "Battery power", 0, {"battery_power": "Power"}),
    Plot(
        *("temperature", "Temperature", 0),
        {"power_stage_temperature": "Power stage", "bec_temperature": "BEC"},
    ),
    Plot(
        *("throttle", "Throttle and output stage opening", 0),
        {"throttle": "Throttle", "output_opening": "Opening"},
    ),
    Plot("pwm", "PWM input", 0, {"pwm_input": "PWM input"}),
    Plot("bec_voltage", "BEC voltage", 3, {"bec_voltage": "BEC voltage"}),
    Plot("bec_current", "BEC current", 3, {"bec_current": "BEC current"}),
)

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

_S = OperatingState
STATE_CLASSES = (
    ("Motor off, standby", (_S.MotorOff, _S.StandBy)),
    ("Waiting", (_S.WaitForSignal, _S.WaitForMotorOff, _S.WaitForMotorOn)),
    ("Self-test, signal", (_S.Selftest, _S.AcousticSignal)),
    (
        "Spooling up, synchronising",
        (
            *(_S.SpoolUpFromStill, _S.SpoolUpFromTurn, _S.SpoolUpQuick),
            *(_S.Sync_Forward, _S.Sync_Backward, _S.Sync_StandBy),
        ),
    ),
    ("Running", (_S.Forward, _S.Backward, _S.RPMControl)),
    ("Braking", (_S.Brake, _S.BrakeTargetBackward, _S.BrakeTargetForward)),
    ("Programming", (_S.Programming,)),
    ("Fault", (_S.Error_Selftest, _S.CutOffDuringOperation)),
    ("Unknown to this program", ()),
)
"""Operating states shown alike, with a label; page.css has a colour for each, in this order."""
UNKNOWN_CLASS = len(STATE_CLASSES) - 1
_CLASS_OF = {
    int(state): index for index, (_, states) in enumerate(STATE_CLASSES) for state in states
}


def class_of(state: int) -> int:
    """Index in STATE_CLASSES of an operating state's number."""
    return _CLASS_OF.get(state, UNKNOWN_CLASS)
