"""Checks the numbers in a capture. A damaged or hostile capture can contain any number."""

from collections.abc import Mapping, Sequence
from typing import Any

from kontronik_can_gw.capture.format import RECORDED_COUNTERS
from kontronik_can_gw.core.header_parts import whole_number
from kontronik_can_gw.esc.telemetry import MAX_COUNT, MAX_ENERGY
from kontronik_can_gw.times import END_OF_TIME, SECOND


def check_time(time_ns: int | None) -> None:
    """Raise ValueError for a time that no gateway has."""
    if time_ns is not None and not 0 <= time_ns < END_OF_TIME:
        raise ValueError(f"time {time_ns}")


def check_counters(counters: Sequence[int]) -> None:
    """Raise ValueError for numbers that are impossible in a COUNTERS entry."""
    if len(counters) not in (len(RECORDED_COUNTERS), len(RECORDED_COUNTERS) - 1):
        raise ValueError("has an unexpected number of counters")
    for name, counter in zip(RECORDED_COUNTERS, counters, strict=False):
        if name == "started_ns":
            check_time(counter)
        elif counter >= MAX_COUNT:
            raise ValueError(f"counter {counter}")


COUNTERS_OF_ESC = {
    "energy": ("energy_mw_ns", MAX_ENERGY * SECOND),
    "run_time": ("run_time_ns", END_OF_TIME - 1),
    "losses": ("losses", MAX_COUNT - 1),
    "late_frames": ("late_frames", MAX_COUNT - 1),
    "suspect_frames": ("suspect_frames", MAX_COUNT - 1),
    "line_errors": ("line_errors", MAX_COUNT - 1),
}
"""Counters in the state of an ESC: their attributes of ``EscTelemetry``, and their limits."""
_LATER = {"late_frames": 0, "suspect_frames": 0, "line_errors": 0}
"""Counters that captures before 0.6 do not have."""
_COUNT = (0, MAX_COUNT - 1)
_LIMITS_OF_WINDOW = (
    (0, END_OF_TIME - 1),
    *(_COUNT, _COUNT, _COUNT, _COUNT),
    (-1, (1 << 31) - 1),
    (0, END_OF_TIME - 1),
)
"""Limits of the numbers of ``EscTelemetry.window``."""
_LIMITS_OF_PLACE = (
    (0, 0xFFFF),
    (0, 0xFF),
    (-1, END_OF_TIME - 1),
    (-1, END_OF_TIME - 1),
    (0, 1),
)
"""Limits of the numbers of ``core.interface.SchedulePosition``."""
_MAX_HELD = 0xFF
"""Limit of the bytes that a decoder holds."""
_LIMITS_OF_GATEWAY = {
    "started_ns": END_OF_TIME - 1,
    "can_state": 5,
    "is_held": 1,
    "is_limited": 1,
    "heard_ns": END_OF_TIME - 1,
}


def check_state(state: Mapping[str, Any]) -> None:
    """Raise HeaderError for a state in a header or a STATE entry that no gateway has."""
    for esc in state.get("escs", ()):
        counters = _LATER | esc
        for name, (_, high) in COUNTERS_OF_ESC.items():
            whole_number(counters[name], 0, high)
        if "counters" in esc:
            whole_number(esc["held"], 0, _MAX_HELD)
            for counter in esc["counters"]:
                whole_number(counter, *_COUNT)
            _check_numbers(esc["window"], _LIMITS_OF_WINDOW)
    for place in state.get("messages", ()):
        _check_numbers(place, _LIMITS_OF_PLACE)
    if "counters" in state:
        check_counters([whole_number(each, 0, END_OF_TIME) for each in state["counters"]])
    for name in _LIMITS_OF_GATEWAY.keys() & state.keys():
        whole_number(state[name], 0, _LIMITS_OF_GATEWAY[name])


def _check_numbers(numbers: Sequence[Any], limits: Sequence[tuple[int, int]]) -> None:
    for number, (low, high) in zip(numbers, limits, strict=True):
        whole_number(number, low, high)
