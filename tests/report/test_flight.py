"""Numbers of the summary are compared with pandas and numpy on simulated flights.

Events are compared with the options of the simulator.
"""

from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
import pytest
from report_flights import Row, column, flight_of, rows_of, simulated
from simulated_bus import layout_of

from kontronik_can_gw.desk.quantities import MINIMA
from kontronik_can_gw.desk.receiver.unpacker import Value
from kontronik_can_gw.desk.recordings.fields import ColumnType, TableColumn
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.report.esc import EscFlight
from kontronik_can_gw.desk.report.events import FlightEvent, FlightEvents
from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.desk.report.page import render
from kontronik_can_gw.esc.kontronik.simulator import Dropout, ErrorWindow, EscOptions, Faults, Swap
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
)
from kontronik_can_gw.times import SECOND as S

pytestmark = pytest.mark.promise("report")

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
    return layout_of(["left", "right"])


@pytest.fixture(scope="module")
def rows(bus: BusLayout) -> list[Row]:
    return list(simulated(bus, 110, OPTIONS))


@pytest.fixture(scope="module")
def flight(bus: BusLayout, rows: list[Row]) -> Flight:
    return flight_of(bus, rows)


def table(
    bus: BusLayout,
    rows: list[Row],
    esc: int,
    *sources: str,
) -> pd.DataFrame:
    """Return the rows as a table with a column for each source.

    The column ``held`` is the time for which a row is valid, 0 before a gap.
    """
    columns = {}
    for source in sources:
        at = column(bus, source, esc)
        columns[source] = [values[at] for _, values in rows]
    frame = pd.DataFrame(columns)
    times = np.array([time_ns for time_ns, _ in rows])
    held = np.append(np.diff(times), 0)
    return frame.assign(time_ns=times, held=np.where(held > GAP_NS, 0, held))


MEASURED = ("battery_voltage", "battery_current", "cell_count")


def with_computed(data: pd.DataFrame, source: str) -> pd.DataFrame:
    """Return a table with the values that a report of a CAN log computes.

    The report computes the values that are sent less often than their parts.
    """
    if source == "battery_power":
        power = (data.battery_voltage * data.battery_current).round(3)
        data = data.assign(battery_power=power)
    if source == "mean_cell_voltage":
        computed = (data.battery_voltage / data.cell_count).round(3)
        data = data.assign(mean_cell_voltage=computed.fillna(data.mean_cell_voltage))
    return data[[*dict.fromkeys((source, "time_ns"))]]


@pytest.mark.parametrize("esc", [0, 1])
def test_numbers_equal_those_computed_by_pandas(
    bus: BusLayout,
    rows: list[Row],
    flight: Flight,
    esc: int,
) -> None:
    sources = (
        "battery_power",
        "battery_voltage",
        "battery_current",
        "electrical_speed",
        "energy_used",
        "consumed_charge",
    )
    data = table(bus, rows, esc, *sources)
    found = flight.escs[esc]
    live = data[data.battery_voltage.notna()]
    turning = live[live.electrical_speed.fillna(0) > 0]
    assert found.telemetry_ns == live.held.sum()
    assert found.turning_ns == turning.held.sum()
    power = (live.battery_voltage * live.battery_current).fillna(0).to_numpy(float)
    energy = (power.clip(min=0) * live.held).sum() / 3.6e12
    assert found.energy_wh == pytest.approx(energy)
    # the gateway's counter, which is computed from finer values
    counter = data.energy_used.dropna().to_numpy(float)
    assert found.energy_wh == pytest.approx(counter[-1] - counter[0], abs=0.4)
    consumed = data.consumed_charge.dropna().to_numpy(float)
    steps = np.diff(consumed)
    charge = np.where(steps < 0, consumed[1:], steps).sum()
    assert found.counted["consumed_charge"] == pytest.approx(charge)
    assert charge > 100
    loaded = live[live.battery_current >= 5]
    assert found.load_voltage is not None
    assert found.load_voltage.value == loaded.battery_voltage.min()
    before_load = live.time_ns < loaded.time_ns.iloc[0]
    resting = live[before_load & (live.battery_current.abs() <= 1)]
    assert found.rest_voltage == resting.battery_voltage.iloc[-1]
    assert found.cells == 6
    assert {"battery_power", "motor_current", "battery_voltage"} <= found.extremes.keys()
    for source, extreme in found.extremes.items():
        data = with_computed(table(bus, rows, esc, source, *MEASURED), source).dropna()
        values = data[source].to_numpy(float)
        at = values.argmin() if source in MINIMA else values.argmax()
        assert extreme.value == values[at], source
        assert extreme.time_ns == data.time_ns.iloc[at], source


def test_errors_and_a_swapped_device_are_events_at_their_times(flight: Flight) -> None:
    errors = [event for event in flight.events if event.kind == "error"]

    def of(text: str) -> list[FlightEvent]:
        return [error for error in errors if error.text == text and error.esc == 0]

    for text, severity, *times in (
        ("power stage hot", "warning", 18, 23),
        ("battery voltage too low", "error", 20, 20.5),
    ):
        (event,) = of(text)
        assert event.severity == severity
        assert event.end_ns is not None
        found = [event.begin_ns - flight.origin_ns, event.end_ns - flight.origin_ns]
        assert [ns / S for ns in found] == pytest.approx(times, abs=0.05)
    # this bit is always set, so the event begins again after each loss and with each info frame
    selftest = of("self-test: EEPROM size")
    assert len(selftest) >= 2
    assert selftest[0].note == "until telemetry was lost"
    assert not [error for error in errors if error.esc == 1]
    devices = ["Kosmik 120, firmware 4.17", "Kolibri 120, firmware 4.17"]
    assert flight.escs[0].devices == devices
    (change,) = [event for event in flight.events if event.kind == "device"]
    assert change.text == "Device changed from {} to {}".format(*devices)
    assert change.begin_ns == change.end_ns
    assert not [e for e in flight.events if "programming" in e.text]


def test_losses_are_gaps_in_lines_and_events(
    bus: BusLayout,
    rows: list[Row],
    flight: Flight,
) -> None:
    lost = [e for e in flight.events if e.text == "No telemetry"]
    assert {e.esc for e in lost} == {0}
    begins = [event.begin_ns - flight.origin_ns for event in lost]
    assert [round(ns / S, 1) for ns in begins] == [29.2, 60.2, 91.2]
    summary = flight.escs[0]
    assert summary.gaps == 3
    _, last_values = rows[-1]
    assert last_values[column(bus, "losses")] == 3
    assert summary.counted["losses"] == 3
    assert summary.counted["crc_errors"] > 0
    points = list(zip(flight.points.times, flight.lines[0, "battery_power"], strict=True))
    for event in lost:
        end_ns = event.end_ns or 0
        inside = [value for time_ns, value in points if event.begin_ns < time_ns < end_ns]
        assert None in inside
        assert all(v is None for v in inside[5:-5])


def test_peak_power_of_a_log_is_computed_from_voltage_and_current(tmp_path: Path) -> None:
    """The shipped DBC sends power every 100 ms, voltage and current with each telemetry frame."""
    bus = layout_of(["esc1"])
    times = range(0, S, S // 100)
    currents = [10.0] * 100
    currents[55] = 230.0
    columns: dict[str, list[Value]] = {
        "battery_voltage": [23.0] * 100,
        "battery_current": [*currents],
        "battery_power": [230.0] * 100,
    }
    flight = flight_of(bus, rows_of(bus, times, **columns))
    assert flight.escs[0].extremes["battery_power"] == (5290, 55 * S // 100)
    assert flight.escs[0].energy_wh == pytest.approx((98 * 230 + 5290) / 360_000)
    assert max(v or 0 for v in flight.lines[0, "battery_power"]) == 5290
    assert "Battery power is computed from voltage and current" in render(flight, source="y")
    text = bus_file_with_power_in_each_frame(tmp_path)
    fast = layout_of_dbc(text)
    flight = flight_of(fast, rows_of(fast, times, **columns))
    assert flight.escs[0].extremes["battery_power"].value == 230
    assert "is computed from voltage and current" not in render(flight, source="y")


def bus_file_with_power_in_each_frame(tmp_path: Path) -> Path:
    """Write a DBC that sends voltage, current and power together."""
    file = tmp_path / "fast.dbc"
    file.write_text(
        'VERSION ""\n'
        "NS_ :\n"
        "BS_:\n"
        "BU_: Gw\n"
        "BO_ 257 Main: 8 Gw\n"
        ' SG_ BatteryVoltage : 0|16@1- (0.01,0) [0|0] "V" Gw\n'
        ' SG_ BatteryCurrent : 16|16@1- (0.1,0) [0|0] "A" Gw\n'
        ' SG_ BatteryPower : 32|16@1- (1,0) [0|0] "W" Gw\n'
    )
    return file


def test_many_events_and_states_need_bounded_memory() -> None:
    bus = layout_of(["esc1"])
    rows = rows_of(
        bus,
        range(0, 300 * S, S // 100),
        battery_voltage=[24.0] * 30_000,
        undervoltage=[0, 1] * 15_000,
        operating_state_raw=[OperatingState.Forward, OperatingState.Brake] * 15_000,
    )
    flight = flight_of(bus, rows, 1000)
    assert flight.seen.left_out == 35_000
    assert len(flight.events) == 10_000
    assert len(flight.points.times) <= 1000


@pytest.mark.parametrize("points", [100, 20_000])
def test_distant_rows_are_not_joined_even_without_a_row_for_the_loss(points: int) -> None:
    """The log has 2 s of rows, then no rows for 1.1 s, and so on, as if it had been stopped."""
    bus = layout_of(["esc1"])
    part_ns = 3_100_000_000
    times: list[int] = []
    for begin in range(0, 40 * part_ns, part_ns):
        times += range(begin, begin + 2 * S + 1, S // 100)
    voltages = [20 + number % 7 for number in range(len(times))]
    flight = flight_of(bus, rows_of(bus, times, battery_voltage=voltages), points)
    line = flight.lines[0, "battery_voltage"]
    points_drawn = list(zip(flight.points.times, line, strict=True))
    drawn = []
    for (begin, before), (end, after) in pairwise(points_drawn):
        if before is not None and after is not None:
            drawn.append((begin, end))
    assert len(drawn) >= 40
    assert max(end - begin for begin, end in drawn) <= 2 * S
    assert all(begin // part_ns == end // part_ns for begin, end in drawn)
    assert flight.escs[0].gaps == 39


def test_words_of_errors_and_states_become_events() -> None:
    """The ESC has a word of errors instead of a flag for each bit, as in captures."""
    events = FlightEvents()
    kinds = {
        "operating_errors": ColumnType.WHOLE,
        "operating_state": ColumnType.TEXT,
        "battery_voltage": ColumnType.FLOAT,
        "bec_voltage": ColumnType.FLOAT,
    }
    fields = []
    for source, kind in kinds.items():
        fields.append(TableColumn(source, "", kind, source=source, esc=0, signal=source))
    esc = EscFlight(0, layout_of(["esc1"]).escs[0], fields, events)
    programming = 1 << OperatingError.PROGRAMMING_ALLOWED
    unknown = 1 << 30
    words = [programming, programming | unknown, 1, 1, None]
    states = ["Forward", "Forward", 99, "odd", None]
    rows: list[list[Any]] = [
        words,
        states,
        [24.0, 24.0, 24.0, 24.0, None],
        [7.5, inf, 7.5, None, 7.5],
    ]
    *_, bec = esc.evaluate([0, 10, 20, 30, 40], rows)
    assert list(bec) == [7.5, None, 7.5, None, 7.5], "a float signal may be infinite"
    assert [(e.begin_ns, e.end_ns, e.text, e.note) for e in events.in_order()] == [
        (0, 20, "Forward", ""),
        (10, 20, "unknown bit 30", ""),
        (20, 40, "battery voltage too low", "until telemetry was lost"),
        (20, 30, "state 99", ""),
        (30, 40, "state odd", ""),
        (40, None, "No telemetry", ""),
    ]
