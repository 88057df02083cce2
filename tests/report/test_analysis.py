"""The summary's numbers against pandas and numpy on simulated flights; events against the options of the simulator."""

from itertools import pairwise

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
import pytest
from report_flights import Row, analysed, analysis_of, column, rows_of, shipped_bus, simulated

from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.report import trackers
from kontronik_can_gw.desk.report.flight import EscFlight, Event, Flight
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.simulator import Dropout, ErrorWindow, EscOptions, Faults, Swap
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
)
from kontronik_can_gw.esc.telemetry import SECOND as S
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.signals.unpacker import SignalReader

GAP_NS = 500_000_000
FAULTS = Faults(
    dropout=Dropout(2 * S, 31 * S),
    flipped_bits=1e-5,
    errors=(
        ErrorWindow(OperatingError.POWER_STAGE_OVERTEMP_WARNING, 18 * S, 5 * S),
        ErrorWindow(OperatingError.UNDERVOLTAGE, 20 * S, S // 2),
        ErrorWindow(SelfTestError.TEST_EEPROM_SIZE, 40 * S),
    ),
    swaps=(Swap(70 * S, Device.KOLIBRI),),
)
OPTIONS = (EscOptions(faults=FAULTS), EscOptions(device=Device.JIVEPRO))


@pytest.fixture(scope="module")
def bus() -> BusLayout:
    return shipped_bus("left", "right")


@pytest.fixture(scope="module")
def rows(bus: BusLayout) -> list[Row]:
    return list(simulated(bus, 110, OPTIONS))


@pytest.fixture(scope="module")
def flight(bus: BusLayout, rows: list[Row]) -> Flight:
    return analysed(analysis_of(bus), rows)


def table(bus: BusLayout, rows: list[Row], esc: int, *sources: str) -> pd.DataFrame:
    """Rows by source, with the time that each holds (0 in front of a gap)."""
    places = {source: column(bus, source, esc) for source in sources}
    frame = pd.DataFrame(
        {source: [values[at] for _, values in rows] for source, at in places.items()}
    )
    times = np.array([time_ns for time_ns, _ in rows])
    held = np.append(np.diff(times), 0)
    return frame.assign(time_ns=times, held=np.where(held > GAP_NS, 0, held))


@pytest.mark.parametrize("esc", [0, 1])
def test_time_and_energy_are_those_of_pandas(
    bus: BusLayout, rows: list[Row], flight: Flight, esc: int
) -> None:
    sources = ("battery_power", "battery_voltage", "electrical_speed", "energy_used")
    data = table(bus, rows, esc, *sources)
    summary = flight.escs[esc]
    live = data[data.battery_voltage.notna()]
    assert summary.telemetry_ns == live.held.sum()
    turning = live[live.electrical_speed.fillna(0) > 0]
    assert summary.turning_ns == turning.held.sum()
    power = live.battery_power.fillna(0).to_numpy(float)
    assert summary.energy_drawn == pytest.approx((power.clip(min=0) * live.held).sum() / 3.6e12)
    assert summary.energy_returned == pytest.approx((-power.clip(max=0) * live.held).sum() / 3.6e12)
    assert summary.power_turning == pytest.approx(
        (turning.battery_power * turning.held).sum() / turning.held.sum()
    )
    counter = data.energy_used.dropna().to_numpy(float)
    assert summary.counted["energy_used"] == pytest.approx(counter[-1] - counter[0])
    assert summary.energy_drawn == pytest.approx(
        summary.counted["energy_used"], abs=0.4
    )  # the counter knows no rows, and no coarser power


@pytest.mark.parametrize("esc", [0, 1])
def test_charge_goes_on_over_resets(
    bus: BusLayout, rows: list[Row], flight: Flight, esc: int
) -> None:
    data = table(bus, rows, esc, "consumed_charge")
    counter = data.consumed_charge.dropna().to_numpy(float)
    steps = np.diff(counter)
    expected = steps[steps > 0].sum() + counter[1:][steps < 0].sum()
    assert flight.escs[esc].counted["consumed_charge"] == pytest.approx(expected)
    assert flight.escs[esc].charge_resets == (steps < 0).sum()
    assert expected > 100


@pytest.mark.parametrize("esc", [0, 1])
def test_extremes_are_those_of_pandas_with_their_time(
    bus: BusLayout, rows: list[Row], flight: Flight, esc: int
) -> None:
    found = flight.escs[esc]
    assert {"battery_power", "motor_current"} <= found.maxima.keys()
    assert {"battery_voltage", "bec_voltage"} <= found.minima.keys()
    for extremes, place in ((found.maxima, np.argmax), (found.minima, np.argmin)):
        for source, extreme in extremes.items():
            data = table(bus, rows, esc, source).dropna()
            values = data[source].to_numpy(float)
            at = place(values)
            assert (extreme.value, extreme.time_ns) == (values[at], data.time_ns.iloc[at]), source


def test_the_voltage_at_rest_and_under_load(
    bus: BusLayout, rows: list[Row], flight: Flight
) -> None:
    data = table(bus, rows, 1, "battery_voltage", "battery_current").dropna()
    summary = flight.escs[1]
    loaded = data[data.battery_current >= 5]
    assert summary.load_voltage is not None
    assert summary.load_voltage.value == loaded.battery_voltage.min()
    before = data[data.time_ns < loaded.time_ns.iloc[0]]
    rest = before[before.battery_current.abs() <= 1].battery_voltage
    assert rest.min() <= (summary.rest_voltage or 0) <= rest.max()
    assert summary.cells == 6


def test_errors_and_a_swapped_device_are_events_when_they_came(flight: Flight) -> None:
    def of(text: str, esc: int = 0) -> list[Event]:
        return [e for e in flight.events if e.kind == "error" and e.text == text and e.esc == esc]

    for text, severity, *times in (
        ("power stage hot", "warning", 18, 23),
        ("battery voltage too low", "error", 20, 20.5),
    ):
        (event,) = of(text)
        assert event.severity == severity
        found = [((at or 0) - flight.origin_ns) / S for at in (event.begin_ns, event.end_ns)]
        assert found == pytest.approx(times, abs=0.05)
    # set for ever: it comes again after each loss and with each info frame
    selftest = of("self-test: EEPROM size")
    assert len(selftest) >= 2
    assert selftest[0].note == "until telemetry was lost"
    assert not [e for e in flight.events if e.kind == "error" and e.esc == 1]
    devices = ["Kosmik 120, firmware 4.17", "Kolibri 120, firmware 4.17"]
    assert (flight.escs[0].devices, flight.escs[0].layout) == (devices, "V4")
    (change,) = [event for event in flight.events if event.kind == "device"]
    assert change.text == "Device changed from {} to {}".format(*devices)
    assert change.begin_ns == change.end_ns
    assert not [e for e in flight.events if "programming" in e.text]


def test_losses_are_gaps_in_lines_and_events(
    bus: BusLayout, rows: list[Row], flight: Flight
) -> None:
    lost = [e for e in flight.events if e.text == "No telemetry"]
    assert {e.esc for e in lost} == {0}
    assert [round((e.begin_ns - flight.origin_ns) / S, 1) for e in lost] == [29.2, 60.2, 91.2]
    summary = flight.escs[0]
    assert summary.gaps == 3
    assert summary.longest_gap_ns / S == pytest.approx(1.75, abs=0.05)
    assert summary.counted["losses"] == rows[-1][1][column(bus, "losses")] == 3
    assert summary.counted["crc_errors"] > 0
    points = list(zip(flight.times, flight.lines[0, "battery_power"], strict=True))
    for event in lost:
        inside = [v for t, v in points if event.begin_ns < t < (event.end_ns or 0)]
        assert None in inside
        assert all(v is None for v in inside[5:-5])


def test_counters_that_roll_go_on_and_those_that_begin_again_too() -> None:
    bus = shipped_bus()
    top = int(SignalReader(bus.layout).columns[column(bus, "losses")].high)

    def total(*counts: int) -> float:
        times = [number * 10_000_000 for number in range(len(counts))]
        flight = analysed(analysis_of(bus), rows_of(bus, times, losses=counts))
        return flight.escs[0].counted["losses"]

    assert total(3, 5, 9) == 6
    assert total(top - 1, top, 0, 2) == 4
    assert total(100, 104, 0, 2) == 6


def test_many_events_and_states_stay_bounded() -> None:
    bus = shipped_bus()
    rows = rows_of(
        bus,
        range(0, 300 * S, S // 100),
        battery_voltage=[24.0] * 30_000,
        undervoltage=[0, 1] * 15_000,
        operating_state_raw=[OperatingState.Forward, OperatingState.Brake] * 15_000,
    )
    flight = analysed(analysis_of(bus, 1000), rows)
    assert flight.left_out == 35_000
    assert len(flight.events) == 10_000
    assert len(flight.escs[0].segments) <= 4000
    assert len(flight.times) <= 1000


@pytest.mark.parametrize("points", [100, 20_000])
def test_rows_far_apart_are_not_joined_even_without_a_row_that_shows_the_loss(points: int) -> None:
    """As in a log that was stopped for a while: 2 s of rows, nothing for 1.1 s, and so on."""
    bus = shipped_bus()
    times = [part * 3_100_000_000 + at * 10_000_000 for part in range(40) for at in range(201)]
    voltages = [20 + number % 7 for number in range(len(times))]
    flight = analysed(analysis_of(bus, points), rows_of(bus, times, battery_voltage=voltages))
    line = flight.lines[0, "battery_voltage"]
    drawn = [
        (t0, t1)
        for (t0, t1), (a, b) in zip(pairwise(flight.times), pairwise(line), strict=True)
        if a is not None and b is not None
    ]
    assert len(drawn) >= 40
    assert max(t1 - t0 for t0, t1 in drawn) <= 2 * S
    assert all(t0 // 3_100_000_000 == t1 // 3_100_000_000 for t0, t1 in drawn)
    assert flight.escs[0].gaps == 39


def test_words_of_errors_and_the_state_of_the_link_become_events() -> None:
    events, times = trackers.Events(), [0, 10, 20, 30, 40]
    programming, unknown = 1 << OperatingError.PROGRAMMING_ALLOWED, 1 << 30
    errors = trackers.Errors(0, {"operating_errors": 0}, events, KONTRONIK)
    words = [programming, programming | unknown, 1, 1, None]
    errors.take(times, [1, 1, 1, 1, None], {"operating_errors": words})
    link = trackers.Link(0, EscFlight("esc1", KONTRONIK), events)
    states = ["OK", "DEGRADED", "OK", LinkState.PORT_ERROR, LinkState.PORT_ERROR]
    link.take(times, [1] * 5, {"link_state": states})
    assert [(e.begin_ns, e.end_ns, e.text, e.note) for e in events.in_order()] == [
        (10, 20, "bit 30, unknown to this program", ""),
        (10, 20, "Link degraded: many bytes are damaged", ""),
        (20, 40, "battery voltage too low", "until telemetry was lost"),
        (30, None, "The port of the ESC cannot be used", ""),
    ]
