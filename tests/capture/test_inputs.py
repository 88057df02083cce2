"""Recordings of every kind as rows and frames: rows are what the bus said, times are those of the wire, nothing old is ever shown."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from capture_bench import START, Bench, capture, made
from simulated_bus import write_log

from kontronik_can_gw.desk.recordings.inputs import (
    CanLogInput,
    CaptureInput,
    Input,
    open_input,
)
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.kontronik import Device
from kontronik_can_gw.esc.kontronik.simulator import Dropout, EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.esc.telemetry import MS, SECOND


def plain_run(
    seconds: float, escs: int = 1, faults: Faults | None = None
) -> tuple[Bench, list[list[Any]]]:
    """A gateway that reads each frame when its last byte has come; what the ESCs meant, by ESC, (time of the last byte, data)."""
    bench = Bench(*made(escs))
    gateway = bench.gateway
    simulated = [
        SimulatedEsc(
            EscOptions(device=Device.KOSMIK, faults=faults or Faults()),
            seed=n,
            start_ns=START + n * 3 * MS,
        )
        for n in range(escs)
    ]
    due: list[tuple[int, int, Any]] = []
    meant: list[list[Any]] = [[] for _ in range(escs)]
    for index, esc in enumerate(simulated):
        for sent in esc.frames_until(START + int(seconds * SECOND)):
            end = sent.time_ns + len(sent.wire) * 11 * SECOND // 115_200
            due.append((end, index, sent))
            if sent.intact:
                meant[index].append((end, sent.data))
        gateway.port(index, True, START)
    gateway.start(START)
    bench.take(START)
    for now, index, sent in sorted(due, key=lambda item: item[:2]):
        while (deadline := gateway.next_deadline()) < now:
            gateway.advance(deadline)
            bench.take(deadline)
        if sent.wire:
            gateway.receive_bytes(index, sent.wire, now, now)
        gateway.advance(now)
        bench.take(now)
    return bench, meant


def columns(found: Input) -> dict[str, int]:
    return {field.name: index for index, field in enumerate(found.fields)}


def test_rows_of_a_capture_are_the_esc_s_frames_at_their_times(tmp_path: Path) -> None:
    bench, meant = plain_run(12)
    lives = [(end, data) for end, data in meant[0] if hasattr(data, "battery_voltage")]
    with open_input(capture(tmp_path / "a.kcap", bench.setup, bench.entries)) as found:
        at = columns(found)
        rows = list(found.samples())
        assert len(rows) == len(lives) > 1000
        for row, (end, data) in zip(rows, lives, strict=True):
            assert abs(row.time_ns - end) <= 1
            assert row.values[at["battery_voltage"]] == pytest.approx(data.battery_voltage / 100)
            assert row.values[at["battery_current"]] == pytest.approx(data.battery_current / 10)
            assert row.values[at["electrical_speed"]] == data.electrical_speed
            assert row.values[at["throttle"]] == data.throttle
            assert row.values[at["undervoltage"]] == (data.operating_errors & 1)
        assert rows[-1].values[at["device"]] == "KOSMIK"
        assert rows[0].values[at["device"]] is None
        assert found.wall_ns(START + 5) == 1_700_000_000 * SECOND + 5
        assert found.damage == []


def test_a_loss_is_a_row_without_values_until_the_next_frame(
    tmp_path: Path,
) -> None:
    bench, _ = plain_run(12, faults=Faults(dropout=Dropout(2 * SECOND, 6 * SECOND)))
    with open_input(capture(tmp_path / "a.kcap", bench.setup, bench.entries)) as found:
        at = columns(found)
        rows = list(found.samples())
        gaps = [(a, b) for a, b in pairwise(rows) if b.time_ns - a.time_ns > SECOND]
        assert len(gaps) == 2
        for lost, back in gaps:
            assert lost.values[at["battery_voltage"]] is None
            assert lost.values[at["link_state"]] == "Lost"
            assert back.values[at["battery_voltage"]] is not None
            before = rows[rows.index(lost) - 1]
            assert 250 * MS <= lost.time_ns - before.time_ns < 300 * MS


def test_rows_of_a_can_log_hold_values_while_they_are_fresh(tmp_path: Path) -> None:
    bench, _ = plain_run(6)
    stop, resume = START + 2 * SECOND, START + 5 * SECOND
    sent = [(f.time_ns - START, f.frame) for f in bench.sent if not stop < f.time_ns < resume]
    log = write_log(tmp_path / "a.log", sent, start_s=1_700_000_000)
    with open_input(log) as found:
        assert isinstance(found, CanLogInput)
        at = columns(found)
        rows = list(found.samples())
        start = rows[0].time_ns
        for row in rows:
            inside = 2.0 + 1.1 < (row.time_ns - start) / SECOND < 4.99
            if inside:
                assert row.values[at["battery_voltage"]] is None
        voltages = [row.values[at["battery_voltage"]] for row in rows]
        assert sum(v is not None for v in voltages) > 250
        assert any(2.0 < (row.time_ns - start) / SECOND < 4.9 for row in rows), (
            "the loss has a row of its own"
        )
        assert found.wall_ns(rows[0].time_ns) == pytest.approx(1_700_000_000 * SECOND, abs=2 * MS)


def test_folders_and_beginnings_of_names(tmp_path: Path) -> None:
    bench, _ = plain_run(1)
    with pytest.raises(UserError, match="has no captures"):
        open_input(tmp_path)
    with pytest.raises(RunError, match="no such file"):
        open_input(tmp_path / "nothing")
    capture(tmp_path / "20260101T000000Z-aaaaaa-0000.kcap", bench.setup, bench.entries)
    capture(tmp_path / "20260102T000000Z-bbbbbb-0000.kcap", bench.setup, bench.entries, run="b")
    with pytest.raises(UserError, match="2 runs"):
        open_input(tmp_path)
    with open_input(tmp_path / "20260102") as found:
        assert isinstance(found, CaptureInput)
        assert found.header["run"] == "b"
    capture(
        tmp_path / "20260102T000000Z-bbbbbb-0001.kcap", bench.setup, bench.entries, run="c", part=1
    )
    with open_input(tmp_path / "20260102") as found, pytest.raises(UserError, match="another run"):
        list(found.samples())


def test_a_part_without_a_header_is_reported_and_the_others_are_read(tmp_path: Path) -> None:
    bench, _ = plain_run(1)
    (tmp_path / "20260101T000000Z-aaaaaa-00000.kcap").write_bytes(b"")
    capture(tmp_path / "20260101T000000Z-aaaaaa-00001.kcap", bench.setup, bench.entries, part=1)
    with open_input(tmp_path) as found:
        assert len(list(found.samples())) > 50
        assert (
            "20260101T000000Z-aaaaaa-00000.kcap: has no header that could be read" in found.damage
        )
