"""The content of the page equals the decoded frames, also while they are missing."""

import json
from typing import Any

import pytest
from live_bench import FedBus
from simulated_bus import FLYING, flight, layout_of, with_errors

from kontronik_can_gw.desk.live.content import STEPS, Content
from kontronik_can_gw.desk.monitor.model import Monitor, Track
from kontronik_can_gw.esc.kontronik.simulator import EscOptions
from kontronik_can_gw.esc.kontronik.states import OperatingError
from kontronik_can_gw.times import SECOND as S

pytestmark = pytest.mark.promise("live-page")


def content_of(names: list[str], seconds: float, **options: Any) -> Content:
    content = Content(FedBus(names))
    for now, frame in flight(layout_of(names), seconds, **options):
        content.take(frame, now)
        content.steps(now)
    return content


def update_of(content: Content, now: int) -> dict[str, Any]:
    content.steps(now)
    found: dict[str, Any] = json.loads(content.update(now, 0))
    return found


def test_every_figure_equals_the_decoded_frames() -> None:
    names = ["left", "right"]
    content = content_of(names, 20)
    monitor = Monitor(layout_of(names))
    for now, frame in flight(layout_of(names), 20):
        monitor.take(frame, now)
    layout = json.loads(content.layout())
    update = update_of(content, now)
    for esc, shown in zip(monitor.escs, update["escs"], strict=True):
        for quantity, value in zip(layout["quantities"], shown["values"], strict=True):
            track = esc.tracks[quantity["source"]]
            digits = quantity["digits"]
            real = esc.number(quantity["source"])
            assert real is not None
            assert value[:2] == [round(real, digits), None], quantity
            assert value[2:4] == [round(track.low or 0, digits), round(track.high or 0, digits)]


def test_value_that_is_not_available_keeps_its_age() -> None:
    content = content_of(["esc1"], 10, until=7)
    (esc,) = update_of(content, 10 * S)["escs"]
    value, age_s, low, high, mark = esc["values"][1]
    assert 20 < low <= value <= high
    assert 2.5 <= age_s <= 3.1  # the last telemetry arrived at 7 s
    assert mark == ""
    assert not esc["isGood"]


def test_silent_gateway_is_reported_with_its_time() -> None:
    content = content_of(["esc1"], 5)
    assert update_of(content, 5 * S)["state"][0] == "ok"
    assert update_of(content, 17 * S)["state"] == ["error", "no gateway heard for 12 s"]
    assert all(value[1] is not None for value in update_of(content, 17 * S)["escs"][0]["values"])


def test_alarms_have_remedy_begin_and_end_and_the_newest_is_first() -> None:
    content = content_of(["esc1"], 10, options=[with_errors(OperatingError.UNDERVOLTAGE)], until=6)
    link, voltage = update_of(content, 10 * S)["alarms"]
    assert link["text"].startswith("no telemetry for")
    assert link["to"] is None
    assert voltage["text"] == "battery voltage too low"
    assert voltage["remedy"]
    assert voltage["note"] == "its end is not known"
    assert -4 < voltage["to"] < -2
    assert voltage["from"] < -9
    update_of(content, 14 * S)  # the gateway is silent
    link, _ = update_of(content, 15 * S)["alarms"]
    assert link["to"] == -1
    assert link["note"] == "its end is not known"


def test_large_figures_begin_with_speed_and_end_with_temperatures() -> None:
    quantities = json.loads(content_of(["esc1"], 1).layout())["quantities"]
    assert [each["source"] for each in quantities if each["isLarge"]] == [
        "motor_speed",
        "battery_voltage",
        "battery_current",
        "battery_power",
        "energy_used",
        "power_stage_temperature",
        "bec_temperature",
    ]
    assert [each["isLarge"] for each in quantities[:8]] == [True] * 7 + [False]


def test_recording_is_named_as_one() -> None:
    bus = FedBus(["esc1"])
    assert json.loads(Content(bus).layout())["origin"] == ""
    bus.is_file = True
    assert json.loads(Content(bus).layout())["origin"] == "recording"


def test_reset_restarts_the_extremes_and_keeps_the_plots() -> None:
    content = content_of(["esc1"], 20, options=[EscOptions(profile=FLYING)])
    high = update_of(content, 20 * S)["escs"][0]["values"][0][3]
    assert high > 1000
    content.monitor.restart_extremes()
    assert update_of(content, 20 * S)["escs"][0]["values"][0][2:4] == [None, None]


def test_step_has_the_extremes_of_its_second_in_their_order() -> None:
    track = Track()
    for value in (5.0, 9.0, 2.0):
        track.add(value, 0)
    assert track.take_step(2.0) == (9.0, 2.0)
    assert track.take_step(2.0) == (2.0, 2.0)
    for value in (3.0, 1.0, 7.0):
        track.add(value, 0)
    assert track.take_step(7.0) == (1.0, 7.0)
    assert track.take_step(None) == (None, None)


def test_seconds_without_a_call_become_gaps() -> None:
    content = content_of(["esc1"], 3)
    steps = [json.loads(step) for step in content.steps(6 * S)]
    assert len(steps) == 4
    assert all(value is None for step in steps[:-1] for value in step)
    assert len(content.steps(10_000 * S)) == STEPS


def test_recording_that_is_played_fast_has_no_gaps() -> None:
    content = Content(FedBus(["esc1"]))
    for now, frame in flight(layout_of(["esc1"]), 20):
        content.take(frame, now)
    steps = [json.loads(step) for step in content.steps(20 * S)]
    assert len(steps) == 20
    assert all(None not in step for step in steps[1:])


@pytest.mark.parametrize("count", [1, 8])
def test_plots_have_a_line_for_each_esc(count: int) -> None:
    content = content_of([f"esc{number}" for number in range(count)], 3)
    layout = json.loads(content.layout())
    assert [plot["key"] for plot in layout["plots"]] == [
        "battery_voltage",
        "current",
        "power",
        "speed",
        "temperature",
    ]
    lines = sum(len(plot["series"]) for plot in layout["plots"])
    assert lines == 6 * count
    assert len(json.loads(content.steps(4 * S)[0])) == 2 * lines
