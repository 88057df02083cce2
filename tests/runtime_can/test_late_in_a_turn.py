"""A process that is stopped while it hands frames over: what has become late in the middle of a turn is not sent."""

import errno
import itertools
from types import SimpleNamespace

import pytest

from kontronik_can_gw.config import CanConfig
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.mailboxes import Sent
from kontronik_can_gw.runtime import can_port
from kontronik_can_gw.runtime.can_port import CanPort


class Socket:
    """Takes what it is given, but for the frame of the number ``full``."""

    def __init__(self) -> None:
        self.taken: list[bytes] = []
        self.full: int | None = None

    def setsockopt(self, *_arguments: object) -> None:
        """All options are fine."""

    def setblocking(self, _blocking: bool) -> None:
        """It never blocks."""

    def send(self, data: bytes) -> None:
        if len(self.taken) == self.full:
            raise OSError(errno.ENOBUFS, "No buffer space available")
        self.taken.append(data)


FRAMES = [CanFrame(0x100 + n, bytes((n,))) for n in range(6)]


@pytest.fixture(params=["proven", "not proven"])
def port_and_socket(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> tuple[CanPort, Socket]:
    mine = Socket()
    monkeypatch.setattr(can_port, "_open", lambda _: SimpleNamespace(socket=mine))
    port = CanPort(CanConfig())
    if request.param == "proven":
        assert port.send(CanFrame(0x7FF, b"")) is Sent.OK
        mine.taken.clear()
    return port, mine


@pytest.mark.parametrize("stopped_before", range(7))
def test_what_is_late_stays(port_and_socket: tuple[CanPort, Socket], stopped_before: int) -> None:
    """The clock leaps in front of one of the frames: those before have gone, and nothing after."""
    port, mine = port_and_socket
    steps = itertools.count()
    answer = port.send_all(FRAMES, lambda: 1000 if next(steps) < stopped_before else 1001, 1000)
    assert answer == ((6, Sent.OK) if stopped_before == 6 else (stopped_before, Sent.LATE))
    assert [data[8] for data in mine.taken] == list(range(stopped_before))[:6]


@pytest.mark.parametrize("full", range(6))
def test_a_queue_that_is_full_is_told_from_lateness(port_and_socket: tuple[CanPort, Socket], full: int) -> None:
    port, mine = port_and_socket
    mine.full = full
    assert port.send_all(FRAMES, lambda: 0, 1000) == (full, Sent.BUSY)
    assert len(mine.taken) == full
