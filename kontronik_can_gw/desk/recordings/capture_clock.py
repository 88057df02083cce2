"""The wall clock of a capture: its state in a header, and its steps."""

from collections.abc import Mapping
from typing import Any

from kontronik_can_gw.desk.recordings.recording import ClockStep
from kontronik_can_gw.runtime.system.clock import ClockFacts

_STEP_NS = 100_000_000
"""A smaller change of the wall clock is a correction and not reported."""


def clock_facts(header: Mapping[str, Any]) -> ClockFacts:
    """Return the state of the wall clock in a header.

    Values that are missing or make no sense are unknown.
    """
    clock = header.get("clock")
    if not isinstance(clock, dict):
        return ClockFacts()
    synchronized = clock.get("synchronized")
    hardware = clock.get("hardware")
    return ClockFacts(
        synchronized=synchronized if isinstance(synchronized, bool) else None,
        hardware=hardware if isinstance(hardware, str) else None,
    )


def clock_steps(begun: int, offsets: list[tuple[int, int]]) -> list[ClockStep]:
    """Return the steps of the wall clock, from its offset at the beginning and the later ones."""
    steps = []
    offset = begun
    for time_ns, after in offsets:
        if abs(after - offset) > _STEP_NS:
            steps.append(ClockStep(time_ns, after - offset))
        offset = after
    return steps
