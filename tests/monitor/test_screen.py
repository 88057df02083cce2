"""The screen: fits any terminal, shows what matters at 60x20, 80x24 and 120x40 for one to eight ESCs, with and without colour and UTF-8."""

import re
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_bus import Timed, flight, layout_of, with_errors

from kontronik_can_gw.cli.monitor_screen import (
    UNICODE,
    Choice,
    Where,
    number,
    screen,
)
from kontronik_can_gw.desk.monitor.model import Monitor
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS, EscOptions
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError

LIVE = Where("can0", hints=("Is the gateway running?",))


KINDS = ["good", "errors", "lost", "silent", "replay", "none"]


@cache
def seen(count: int, kind: str = "good") -> Monitor:
    """A monitor of ``count`` ESCs in flight; the first with errors, silent, or all without faults."""
    bus = layout_of([f"esc{index + 1}" for index in range(count)])
    errors = with_errors(OperatingError.UNDERVOLTAGE, OperatingError.BEC_OVERCURRENT)
    first = errors if kind == "errors" else EscOptions(device=Device.JIVEPRO)
    monitor = Monitor(bus)
    monitor.advance(0)
    frames: Timed = []
    if kind != "none":
        frames = flight(
            bus, 3.2, [first], replay=kind == "replay", until=1.5 if kind == "lost" else 9
        )
    for now, frame in frames:
        monitor.take(frame, now)
        monitor.advance(now)
    monitor.advance(round(({"silent": 10.4, "none": 1}.get(kind, 3.2)) * SECOND_NS))
    return monitor


def texts(
    monitor: Monitor, size: tuple[int, int], where: Where = LIVE, choice: Choice | None = None
) -> list[str]:
    """The words alone."""
    lines = screen(monitor, where, size, choice or Choice(), UNICODE)
    return ["".join(piece.text for piece in line).rstrip() for line in lines]


@given(
    st.tuples(st.integers(1, 150), st.integers(1, 60)), st.sampled_from([1, 2, 8]), st.sampled_from(KINDS),
    st.integers(-3, 9), st.none() | st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=30, deadline=None)
def test_any_size_page_and_choice_is_borne(
    size: tuple[int, int], count: int, kind: str, page: int, esc: int | None
) -> None:
    lines = texts(seen(count, kind), size, choice=Choice(page, esc))
    assert len(lines) <= max(4, size[1])
    assert max(map(len, lines)) <= max(20, size[0])


@pytest.mark.parametrize(("count", "size"), [(1, (60, 20)), (2, (120, 40)), (8, (80, 24))])
def test_what_matters_is_never_cut(size: tuple[int, int], count: int) -> None:
    monitor = seen(count, "errors")
    lines = texts(monitor, size)
    whole = "\n".join(lines)
    for esc in monitor.escs:
        assert esc.name in whole
        for source, digits in (
            ("motor_speed", 0),
            ("battery_voltage", 2),
            ("battery_current", 1),
            ("power_stage_temperature", 0),
        ):
            assert re.search(
                rf"(?<![\d.]){re.escape(number(esc.number(source), digits))}(?![\d.])", whole
            ), source
    assert whole.count("spool up") + whole.count("RPM control") == count
    assert "…" not in whole
    assert "ERROR: battery voltage too low" in whole
    assert "ERROR: BEC current too high" in whole


def test_a_value_that_is_not_available_is_a_dash() -> None:
    lines = texts(seen(1, "lost"), (80, 24))
    (voltage,) = [line for line in lines if line.startswith("battery voltage")]
    assert voltage.split()[3] == "-"
    assert voltage.split()[4] != "-", "the extremes stay"
    assert any("lost" in line for line in lines)
    assert "no errors" not in "\n".join(lines)


def test_a_name_with_control_characters_does_not_reach_the_terminal() -> None:
    where = LIVE._replace(name="can0\x1b[2J", problem="bad\x1b]0;x\x07 thing")
    assert "".join(texts(seen(1), (80, 24), where)).isprintable()


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("lost", "LINK: no telemetry"),
        ("silent", "no frames of kontronik_esc.dbc on can0"),
        ("none", "waiting for frames on can0"),
        ("replay", "REPLAY: "),
    ],
)
def test_what_is_not_live_is_said_to_be_so(kind: str, said: str) -> None:
    assert said in "\n".join(texts(seen(1, kind), (80, 24)))
    assert said not in "\n".join(texts(seen(1), (80, 24)))
