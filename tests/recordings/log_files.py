"""Logs of random CAN frames for the tests, written by our writer or by python-can's."""

import random
from functools import cache
from pathlib import Path
from typing import Any

import can

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.can_logs.writer import CanLogWriter
from kontronik_can_gw.desk.recordings.inputs import Input, open_input
from kontronik_can_gw.desk.recordings.layouts import BusLayout, layout_of_dbc
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
    """Frames of both id lengths, times in whole microseconds, rising; here and there a long pause."""
    chance = random.Random(seed)
    now = 0
    items = []
    for _ in range(count):
        now += chance.randrange(1, 20_000) * 1000 * chance.choice((1,) * 30 + (1000,))
        extended = chance.random() < 0.3
        is_fd = fd and chance.random() < 0.3
        size = (
            chance.choice((0, 1, 2, 7, 8, 12, 16, 20, 24, 32, 48, 64))
            if is_fd
            else chance.randrange(9)
        )
        can_id = chance.randrange(1 << 29) if extended else chance.randrange(1 << 11)
        items.append(
            (now, CanFrame(can_id, chance.randbytes(size), extended, is_fd), chance.random() < 0.5)
        )
    return items


def write_log(
    path: Path, format_: str, items: list[Item], wall_start_ns: int | None = WALL_NS
) -> None:
    """By our writer."""
    with path.open("wb") as file:
        writer = CanLogWriter(file, format_, wall_start_ns)
        writer.write([TimedFrame(*item) for item in items])
        writer.close()


@cache
def _layout() -> BusLayout:
    return layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))


def opened(path: Path) -> Input:
    """By our reader."""
    return open_input(path, _layout())


def read_log(path: Path) -> tuple[list[Item], list[str]]:
    """Frames with Unix times (if the log has them), and the damage."""
    with opened(path) as log:
        items = [
            ((log.wall_ns(0) or 0) + time_ns, frame, received)
            for time_ns, frame, received in log.frames()
        ]
        return items, log.damage


def message_of(item: Item) -> can.Message:
    """The frame as python-can has it."""
    time_ns, frame, received = item
    more: dict[str, Any] = {"data": frame.data, "is_fd": frame.fd, "is_rx": received, "channel": 0}
    return can.Message(time_ns / 1e9, frame.can_id, frame.extended, **more)


def read_by_library(path: Path, format_: str) -> list[Item]:
    """By python-can; times to a microsecond."""
    options = {"relative_timestamp": False} if format_ == "asc" else {}
    found = []
    with READERS[format_](path, **options) as reader:
        for m in reader:
            frame = CanFrame(m.arbitration_id, bytes(m.data), m.is_extended_id, m.is_fd)
            found.append((round(m.timestamp * 1e6) * 1000, frame, m.is_rx))
    return found


def at_wall(items: list[Item], wall_start_ns: int = WALL_NS) -> list[Item]:
    """The same with Unix times."""
    return [(wall_start_ns + time_ns, frame, received) for time_ns, frame, received in items]
