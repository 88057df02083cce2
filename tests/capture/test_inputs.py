"""Rows and frames of every kind of recording.

Rows have the values of the bus and the times of the wire, and never contain old values.
"""

from itertools import pairwise
from pathlib import Path

import pytest
from capture_bench import START, Bench, capture, made, samples
from simulated_bus import write_log

from kontronik_can_gw.capture.format import (
    Entry,
    EntryKind,
    block,
    data_payload,
    json_payload,
    numbers_data,
)
from kontronik_can_gw.desk.recordings.inputs import (
    CanLogInput,
    CaptureInput,
    Input,
    open_input,
)
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.simulator import Dropout, EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("tables")


def plain_run(seconds: float, faults: Faults | None = None) -> Bench:
    """Run a gateway with an ESC whose frames are read every 5 ms."""
    bench = Bench(*made(1))
    gateway = bench.gateway
    now = START
    esc = SimulatedEsc(EscOptions(faults=faults or Faults()), seed=1, start_ns=START)
    gateway.port(0, True, now)
    gateway.start(now)
    for now in range(START, START + int(seconds * SECOND), 5 * MS):
        data = b"".join(sent.wire for sent in esc.frames_until(now))
        if data:
            gateway.receive_bytes(0, data, now, now)
        gateway.advance(now)
        bench.take(now)
    return bench


def columns(found: Input) -> dict[str, int]:
    return {field.name: index for index, field in enumerate(found.fields)}


def test_loss_is_a_row_without_values_until_the_next_frame(tmp_path: Path) -> None:
    bench = plain_run(15, Faults(dropout=Dropout(2 * SECOND, 6 * SECOND)))
    with open_input(capture(tmp_path / "a.kcap", bench.setup, bench.entries)) as found:
        at = columns(found)
        rows = list(samples(found))
        assert found.wall_ns(START + 5) == 1_700_000_000 * SECOND + 5
    gaps = [(a, b) for a, b in pairwise(rows) if b.time_ns - a.time_ns > SECOND]
    assert len(gaps) == 2
    for lost, back in gaps:
        assert lost.values[at["battery_voltage"]] is None
        assert lost.values[at["link_state"]] == "Lost"
        assert back.values[at["battery_voltage"]] is not None
        before = rows[rows.index(lost) - 1]
        assert 250 * MS <= lost.time_ns - before.time_ns < 300 * MS


def test_rows_of_a_can_log_have_values_while_they_are_fresh(tmp_path: Path) -> None:
    bench = plain_run(6)
    stop = START + 2 * SECOND
    resume = START + 5 * SECOND
    kept = [each for each in bench.sent if not stop < each.time_ns < resume]
    sent = [(each.time_ns - START, each.frame) for each in kept]
    log = write_log(tmp_path / "a.log", sent, start_s=1_700_000_000)
    with open_input(log) as found:
        assert isinstance(found, CanLogInput)
        at = columns(found)
        rows = list(samples(found))
        seconds = [(row.time_ns - rows[0].time_ns) / SECOND for row in rows]
        voltages = [row.values[at["battery_voltage"]] for row in rows]
        assert sum(v is not None for v in voltages) > 250
        assert any(2.0 < after < 4.9 for after in seconds), "the loss has a separate row"
        pairs = zip(voltages, seconds, strict=True)
        assert {value for value, after in pairs if 3.1 < after < 4.99} <= {None}
        assert found.wall_ns(rows[0].time_ns) == pytest.approx(1_700_000_000 * SECOND, abs=2 * MS)


def test_run_is_selected_by_its_folder_or_the_beginning_of_its_name(tmp_path: Path) -> None:
    bench = plain_run(1)
    with pytest.raises(UserError, match="has no captures"):
        open_input(tmp_path)
    with pytest.raises(UserError, match="does not exist"):
        open_input(tmp_path / "nothing")
    capture(tmp_path / "20260101T000000Z-aaaaaa-0000.kcap", bench.setup, bench.entries)
    capture(tmp_path / "20260102T000000Z-bbbbbb-0000.kcap", bench.setup, bench.entries, run="b")
    with pytest.raises(UserError, match="2 runs"):
        open_input(tmp_path)
    with open_input(tmp_path / "20260102") as found:
        assert isinstance(found, CaptureInput)
        assert found.header["run"] == "b"
    other = tmp_path / "20260102T000000Z-bbbbbb-0001.kcap"
    capture(
        other,
        bench.setup,
        bench.entries,
        run="c",
        part=1,
    )
    with open_input(tmp_path / "20260102") as found, pytest.raises(UserError, match="another run"):
        list(samples(found))


def test_part_without_a_header_is_reported_and_the_others_are_read(tmp_path: Path) -> None:
    bench = plain_run(1)
    (tmp_path / "20260101T000000Z-aaaaaa-00000.kcap").write_bytes(b"")
    capture(tmp_path / "20260101T000000Z-aaaaaa-00001.kcap", bench.setup, bench.entries, part=1)
    with open_input(tmp_path) as found:
        assert len(list(samples(found))) > 50
        expected = "20260101T000000Z-aaaaaa-00000.kcap: left out, because it has no readable header"
        assert expected in found.damage


def byte_entry(time_ns: int) -> Entry:
    return Entry(time_ns, EntryKind.BYTES, 0, b"x", 0, time_ns)


def clock_entry(time_ns: int, wall_ns: int) -> Entry:
    return Entry(
        time_ns,
        EntryKind.CLOCK,
        0,
        numbers_data(wall_ns),
        0,
        None,
    )


def test_changed_wall_clock_applies_to_later_entries(tmp_path: Path) -> None:
    """Each part of a run begins with the wall clock of its own header."""
    setup = made(1)[0]
    wall = 1_700_000_000 * SECOND
    first = [
        byte_entry(START),
        byte_entry(START + SECOND),
        clock_entry(START + SECOND, wall + 3600 * SECOND),
        byte_entry(START + 2 * SECOND),
    ]
    second = [byte_entry(START + 5 * SECOND)]
    capture(tmp_path / "20260101T000000Z-aaaaaa-00000.kcap", setup, first)
    capture(
        tmp_path / "20260101T000000Z-aaaaaa-00001.kcap",
        setup,
        second,
        part=1,
        monotonic_ns=START + 4 * SECOND,
        wall_ns=wall + 50 * SECOND,
    )
    with open_input(tmp_path) as found:
        assert isinstance(found, CaptureInput)
        times = [each.time_ns for each in found.entries() if each.kind == EntryKind.BYTES]
        walls = [found.wall_ns(time_ns) for time_ns in times]
        assert found.damage == []
    assert [time_ns - START for time_ns in times] == [0, SECOND, 2 * SECOND, 5 * SECOND]
    assert walls == [wall, wall + SECOND, wall + 3601 * SECOND, wall + 51 * SECOND]


@pytest.mark.promise("damaged-captures")
def test_missing_blocks_and_a_missing_end_of_a_capture_are_reported(tmp_path: Path) -> None:
    """Times of entries never decrease, even if the times in the file do."""
    header = made(1)[0].header() | {"run": "r", "part": 0, "created_ns": START}
    steps = (3, 2, 7)
    times_of_start = {"monotonic_ns": START, "wall_ns": START}
    blocks = [block(b"H", 0, json_payload(header | times_of_start))]
    for number, step in zip((1, 2, 5), steps, strict=True):
        payload = data_payload([byte_entry(START + step * SECOND)])
        blocks.append(block(b"D", number, payload))
    path = tmp_path / "a.kcap"
    path.write_bytes(b"".join(blocks))
    with open_input(path) as found:
        assert isinstance(found, CaptureInput)
        times = [each.time_ns - START for each in found.entries()]
        damage = list(found.damage)
    assert times == [3 * SECOND, 3 * SECOND, 7 * SECOND]
    place = sum(map(len, blocks[:3]))
    assert damage == [
        f"a.kcap: 2 blocks lost before byte {place}",
        "a.kcap: was not closed, so up to a second may be missing at its end",
    ]
