"""Checks the numbers in a capture. A damaged or hostile capture can contain any number."""

from collections.abc import Mapping, Sequence
from typing import Any

from kontronik_can_gw.capture.format import COUNTERS
from kontronik_can_gw.core.header_parts import whole_number
from kontronik_can_gw.esc.telemetry import MAX_COUNT, MAX_ENERGY
from kontronik_can_gw.times import END_OF_TIME, SECOND

_MAX_MW_NS = MAX_ENERGY * SECOND


def check_time(time_ns: int) -> None:
    """Raise ValueError for a time that no gateway has."""
    if not 0 <= time_ns < END_OF_TIME:
        raise ValueError(f"time {time_ns}")


def check_counters(counters: Sequence[int]) -> None:
    """Raise ValueError for numbers that are impossible in a COUNTERS entry."""
    if len(counters) not in (len(COUNTERS), len(COUNTERS) - 1):
        raise ValueError("has an unexpected number of counters")
    for name, counter in zip(COUNTERS, counters, strict=False):
        if name == "started_ns":
            check_time(counter)
        elif counter >= MAX_COUNT:
            raise ValueError(f"counter {counter}")


_LIMITS_OF_ESC = {
    "energy": _MAX_MW_NS,
    "run_time": END_OF_TIME - 1,
    "losses": MAX_COUNT - 1,
}
_LIMITS_OF_GATEWAY = {
    "started_ns": END_OF_TIME - 1,
    "can_state": 5,
    "is_held": 1,
    "heard_ns": END_OF_TIME - 1,
}


def check_state(state: Mapping[str, Any]) -> None:
    """Raise HeaderError for a state in a header or a STATE entry that no gateway has."""
    for esc in state.get("escs", ()):
        for name, high in _LIMITS_OF_ESC.items():
            whole_number(esc[name], 0, high)
    for name, high in _LIMITS_OF_GATEWAY.items():
        if name in state:
            whole_number(state[name], 0, high)
