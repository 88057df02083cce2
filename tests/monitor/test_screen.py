"""The screen: fits any terminal, shows what matters at 60x20, 80x24 and 120x40 for one to eight ESCs, with and without colour and UTF-8."""

import re
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_bus import STEP_NS, Timed, flight, layout_of, with_errors

from kontronik_can_gw.cli.monitor_screen import (
    UNICODE,
    Choice,
    Glyphs,
    Where,
    number,
    plain_lines,
    screen,
)
from kontronik_can_gw.cli.status import Line
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.monitor import Monitor
from kontronik_can_gw.protocol.states import Device, OperatingError, SelfTestError
from kontronik_can_gw.simulator import SECOND_NS, EscOptions, Faults

SIZES = [(80, 24), (60, 20), (120, 40)]
LIVE = Where("can0", hints=("Is the gateway running?",))


@cache
def seen(count: int, kind: str = "good") -> Monitor:
    """A monitor of so many ESCs in flight; the first with errors, silent, or all as they should be."""
    names = [f"esc{index + 1}" for index in range(count)]
    first = {
        "errors": with_errors(OperatingError.UNDERVOLTAGE, OperatingError.BEC_OVERCURRENT),
        "all": with_errors(*OperatingError, *SelfTestError),
        "warning": with_errors(OperatingError.POWER_STAGE_OVERTEMP_WARNING),
        "degraded": EscOptions(faults=Faults(flipped_bits=0.0005)),
    }.get(kind, EscOptions(device=Device.JIVEPRO))
    bus = layout_of(names)
    monitor = Monitor(bus)
    monitor.advance(0)
    frames: Timed = []
    if kind == "unopened":
        gateway = Gateway(bus.escs, bus.layout, 0)
        gateway.start(0)
        gateway.port_lost(0, 0)
        for step in range(330):
            gateway.advance(step * STEP_NS)
            frames += [(step * STEP_NS, frame) for frame in gateway.take_frames()]
    elif kind != "none":
        sender = layout_of(["esc1", "esc2"]) if kind == "of two" else bus
        frames = flight(sender, 3.2, [first], replay=kind == "replay", until=1.5 if kind == "lost" else 9)
    for now, frame in frames:
        monitor.take(frame, now)
        monitor.advance(now)
    monitor.advance(round(({"silent": 10.4, "none": 1}.get(kind, 3.2)) * SECOND_NS))
    return monitor


def texts(
    monitor: Monitor, size: tuple[int, int], where: Where = LIVE, choice: Choice | None = None, glyphs: Glyphs = UNICODE
) -> list[str]:
    lines = screen(monitor, where, size, choice or Choice(), glyphs)
    return [text.rstrip() for text in as_texts(lines)]


def as_texts(lines: list[Line]) -> list[str]:
    """The words alone."""
    return ["".join(piece.text for piece in line) for line in lines]


KINDS = ["good", "errors", "all", "warning", "lost", "silent", "replay", "none"]


@given(
    st.tuples(st.integers(1, 150), st.integers(1, 60)), st.sampled_from([1, 2, 8]), st.sampled_from(KINDS),
    st.integers(-3, 9), st.none() | st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=100, deadline=None)
def test_any_size_page_and_choice_is_borne(
    size: tuple[int, int], count: int, kind: str, page: int, esc: int | None
) -> None:
    lines = as_texts(screen(seen(count, kind), LIVE, size, Choice(page, esc)))
    assert len(lines) <= max(4, size[1])
    assert max(map(len, lines)) <= max(20, size[0])


@pytest.mark.parametrize("count", [1, 2, 8])
@pytest.mark.parametrize("size", SIZES, ids=str)
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
            assert re.search(rf"(?<![\d.]){re.escape(number(esc.number(source), digits))}(?![\d.])", whole), source
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


@pytest.mark.parametrize(
    ("kind", "count", "said"),
    [
        ("lost", 1, "LINK: no telemetry"), ("lost", 8, "esc1 LINK: no telemetry"), ("degraded", 1, "LINK: degraded"),
        ("unopened", 1, "LINK: the gateway cannot open the port"), ("silent", 1, "no frames of kontronik_esc.dbc on can0"),
        ("none", 1, "waiting for frames on can0"), ("replay", 2, "REPLAY: "), ("errors", 8, "esc1 !! "),
        ("warning", 8, "esc1 ! "), ("warning", 1, "WARNING: power stage hot"), ("all", 1, "lines more of errors"),
        ("of two", 1, "the gateway has 2 ESCs"), ("good", 12, "page 1 of 2, 12 ESCs"),
    ],
)  # fmt: skip
def test_what_holds_stands_on_the_screen_and_nowhere_else(kind: str, count: int, said: str) -> None:
    assert said in "\n".join(texts(seen(count, kind), (80, 24)))
    if kind != "good":
        assert said not in "\n".join(texts(seen(count), (80, 24)))


def test_plain_lines_have_a_line_for_each_esc_with_its_values_and_errors() -> None:
    first, second = plain_lines(seen(2, "errors"))
    assert "ERROR battery voltage too low  ERROR BEC current too high" in first
    assert "ERROR" not in second
    assert re.search(r"battery_voltage \d+\.\d\d V", second)
    assert all(line.startswith("REPLAY") for line in plain_lines(seen(2, "replay")))


def test_a_name_with_control_characters_does_not_reach_the_terminal() -> None:
    where = LIVE._replace(name="can0\x1b[2J", problem="bad\x1b]0;x\x07 thing")
    lines = "".join(as_texts(screen(seen(1), where, (80, 24), Choice())))
    assert lines.isprintable()
