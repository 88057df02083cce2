"""Rows of a CAN log are decoded column by column, and are what a listener on the bus has seen."""

import random
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from command_line import run
from log_files import opened
from recordings import candump_log

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.receiver.unpacker import SignalReader, Unpacker
from kontronik_can_gw.desk.receiver.view import View
from kontronik_can_gw.desk.recordings.can_logs.text import CandumpReader
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.desk.recordings.samples import RowsOfFrames
from kontronik_can_gw.desk.recordings.stream import HEAD
from kontronik_can_gw.frames import EXTENDED, CanFrame

pytestmark = pytest.mark.promise("tables")

MS = 1_000_000
Row = tuple[int, tuple[Any, ...]]
MULTIPLEXED = """VERSION ""
NS_ :
BS_:
BU_: Gateway
BO_ 256 Live: 4 Gateway
 SG_ BatteryVoltage : 0|16@1+ (0.01,0) [0|655] "V" Vector__XXX
 SG_ BatteryCurrent : 16|16@1+ (0.1,0) [0|6553] "A" Vector__XXX
BO_ 2147484161 Pages: 4 Gateway
 SG_ Page M : 0|8@1+ (1,0) [0|255] "" Vector__XXX
 SG_ MotorSpeed m1 : 8|16@1+ (0.1,0) [0|6553] "krpm" Vector__XXX
 SG_ PowerStageTemperature m2 : 8|8@1- (1,0) [-127|127] "degC" Vector__XXX
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 2147484161 100;
"""


def layouts(tmp_path: Path) -> Iterator[SignalReader]:
    """The shipped layout, and one with pages, a 29-bit id and a unit that is not the value's."""
    (path := tmp_path / "pages.dbc").write_text(MULTIPLEXED)
    for file in (shipped("dbc/kontronik_esc.dbc"), path):
        yield SignalReader(layout_of_dbc(Path(str(file))).layout)


def frames_of(reader: SignalReader, seed: int) -> list[TimedFrame]:
    """Random frames with pauses, so that some or all messages are lost, and in disorder.

    Some frames are too short, or not in the layout.
    """
    chance = random.Random(seed)
    keys = [*reader.keys]
    now, found = 5_000 * MS, []
    payloads = [bytes(8), b"\xff" * 8, b"\1" + chance.randbytes(7), b"\2" + chance.randbytes(7)]
    for number in range(900):
        now += chance.choice((0, 1, 1, 3, 6, 20, 20, 300 * (number % 50 == 0))) * MS
        now += 5_000 * MS * (number % 300 == 299)
        key = chance.choice(keys[: 1 + number // 100] if number % 7 else keys)
        data = chance.choice((*payloads, chance.randbytes(8)))
        frame = CanFrame(key & ~EXTENDED, data, key >= EXTENDED)
        if chance.random() < 0.05:
            frame = frame._replace(data=data[:3])
        if chance.random() < 0.05:
            frame = frame._replace(can_id=0x7F0, extended=False)
        time_ns = now - 50 * MS * (chance.random() < 0.05)
        found.append(TimedFrame(time_ns, frame))
    return found


def rows_in(
    reader: SignalReader, frames: Iterable[TimedFrame], chosen: Sequence[int], count: int
) -> Iterator[Row]:
    for times, columns in RowsOfFrames(reader, chosen).blocks(frames, count):
        assert len(times) <= count
        yield from zip(times, zip(*columns, strict=True), strict=True)


@pytest.mark.parametrize("seed", range(4))
def test_each_row_has_the_values_of_a_listener(tmp_path: Path, seed: int) -> None:
    for reader in layouts(tmp_path):
        view = View(reader)

        def heard(view: View, frames: list[TimedFrame]) -> Iterator[TimedFrame]:
            now = 0
            for item in frames:
                yield item  # a row that ends here does not have this frame
                now = max(now, item.time_ns)
                if item.frame.key in view.reader.keys:  # other frames end no row
                    view.expire(now)
                    view.take(item.frame.key, item.frame.data, now)

        whole = RowsOfFrames(reader, range(len(reader.columns)))
        whole._wanted = {  # in the units of the DBC, as the listener has them
            part: [one._replace(slope=1, shift=0) for one in wanted]
            for part, wanted in whole._wanted.items()
        }
        losses = rows = 0
        for (time_ns,), columns in whole.blocks(heard(view, frames_of(reader, seed)), 1):
            losses += view.expire(time_ns)
            rows += 1
            assert [value for (value,) in columns] == view.values
        assert rows > 200
        assert losses > 5


@pytest.mark.parametrize("seed", range(4))
def test_rows_do_not_depend_on_the_blocks(tmp_path: Path, seed: int) -> None:
    for reader in layouts(tmp_path):
        frames = frames_of(reader, seed)
        columns = range(len(reader.columns))
        single = list(rows_in(reader, frames, columns, 1))
        assert len({values for _, values in single}) > 50
        for count in (2, 7, 100, 512):
            assert list(rows_in(reader, frames, columns, count)) == single
        some = random.Random(seed).sample(columns, 4)
        expected = [(now, tuple(values[at] for at in some)) for now, values in single]
        assert list(rows_in(reader, frames, some, 100)) == expected


def test_no_frame_of_a_candump_log_is_decoded_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the line at the end of each buffer is read alone."""
    lines = candump_log(tmp_path / "one.log").read_bytes().splitlines(keepends=True)
    (path := tmp_path / "many.log").write_bytes(
        b"".join(lines * (4 * HEAD // (45 * len(lines)) + 1))
    )
    alone: list[bytes] = []
    frame_of_line = CandumpReader._frame

    def noted(reader: CandumpReader, line: bytes) -> Any:
        alone.append(line)
        return frame_of_line(reader, line)

    def refuse(*_: object) -> Any:
        raise AssertionError("a frame is decoded alone")

    monkeypatch.setattr(CandumpReader, "_frame", noted)
    monkeypatch.setattr(Unpacker, "values", refuse)
    with opened(path) as log:
        assert sum(len(block) for block in log.blocks()) > 500
    assert 2 <= len(alone) <= path.stat().st_size // HEAD + 1
    for words in (
        ["report", path, "-o", tmp_path / "a.html"],
        ["convert", path, tmp_path / "a.csv"],
    ):
        alone.clear()
        assert run(*words).code == 0
        assert 2 <= len(alone) <= path.stat().st_size // HEAD + 1


def test_rows_on_both_sides_of_a_clock_step_continue_the_time_of_day(tmp_path: Path) -> None:
    lines = candump_log(tmp_path / "even.log").read_text().splitlines()
    half = len(lines) // 2
    moved = [line.replace("(179", "(178", 1) for line in lines[half:]]
    assert moved[0] < lines[0]
    (path := tmp_path / "back.log").write_text("\n".join([*lines[:half], *moved]) + "\n")
    with opened(path) as log:
        blocks = list(log.blocks())
        assert len(log.clock_steps) == 1
        for block in blocks:
            assert {log.wall_offset_ns(time_ns) for time_ns in block.times} == {block.wall_ns}
    assert len({block.wall_ns for block in blocks}) == 1
    assert max(len(block) for block in blocks) > 10
