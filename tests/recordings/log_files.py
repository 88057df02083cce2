"""Logs of random CAN frames for the tests, written by our own writer or by python-can."""

import random
from functools import cache
from pathlib import Path

import can

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.can_logs.writer import CanLogWriter
from kontronik_can_gw.desk.recordings.inputs import Input, open_input
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.frames import CanFrame

Item = tuple[int, CanFrame, bool]

WALL_NS = 1_700_000_000_123_456_000
SUFFIX = {"candump": ".log", "asc": ".asc", "blf": ".blf", "trc": ".trc", "mf4": ".mf4"}
READERS = {
    "candump": can.CanutilsLogReader,
    "asc": can.ASCReader,
    "blf": can.BLFReader,
    "trc": can.TRCReader,
    "mf4": can.MF4Reader,
}


def some_frames(count: int, seed: int = 1, fd: bool = False) -> list[Item]:
    """Return random frames with ids of both lengths.

    Their times rise in whole microseconds, with some long pauses.
    """
    chance = random.Random(seed)
    now = 0
    items = []
    for _ in range(count):
        pause = chance.randrange(1, 20_000) * 1000
        now += pause * chance.choice((1,) * 30 + (1000,))
        extended = chance.random() < 0.3
        is_fd = fd and chance.random() < 0.3
        if is_fd:
            size = chance.choice((0, 1, 2, 7, 8, 12, 16, 20, 24, 32, 48, 64))
        else:
            size = chance.randrange(9)
        can_id = chance.randrange(1 << 29 if extended else 1 << 11)
        frame = CanFrame(can_id, chance.randbytes(size), extended, is_fd)
        is_received = chance.random() < 0.5
        items.append((now, frame, is_received))
    return items


def write_log(
    path: Path,
    format_: str,
    items: list[Item],
    wall_start_ns: int | None = WALL_NS,
) -> None:
    """Write a log with our own writer."""
    with path.open("wb") as file:
        writer = CanLogWriter(file, format_, wall_start_ns)
        writer.write([TimedFrame(*item) for item in items])
        writer.close()


@cache
def _layout() -> BusLayout:
    return layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))


def opened(path: Path) -> Input:
    """Open a log with our own reader."""
    return open_input(path, _layout())


def read_log(path: Path) -> tuple[list[Item], list[str]]:
    """Return the frames with Unix times (if the log has them), and the damage."""
    items = []
    with opened(path) as log:
        for time_ns, frame, received in log.frames():
            start_ns = log.wall_ns(0) or 0
            items.append((start_ns + time_ns, frame, received))
        return items, log.damage


def message_of(item: Item) -> can.Message:
    """Return the frame as a message of python-can."""
    time_ns, frame, received = item
    return can.Message(
        time_ns / 1e9,
        frame.can_id,
        frame.extended,
        data=frame.data,
        is_fd=frame.fd,
        is_rx=received,
        channel=0,
    )


def read_by_library(path: Path, format_: str) -> list[Item]:
    """Read a log with python-can. Times are rounded to a microsecond."""
    options = {"relative_timestamp": False} if format_ == "asc" else {}
    found = []
    with READERS[format_](path, **options) as reader:
        for m in reader:
            frame = CanFrame(m.arbitration_id, bytes(m.data), m.is_extended_id, m.is_fd)
            found.append((round(m.timestamp * 1e6) * 1000, frame, m.is_rx))
    return found


def at_wall(items: list[Item], wall_start_ns: int = WALL_NS) -> list[Item]:
    """Return the same frames with Unix times."""
    return [(wall_start_ns + time_ns, frame, received) for time_ns, frame, received in items]
