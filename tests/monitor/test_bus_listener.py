"""The listener on python-can's in-process bus, and on a port that is none where an interface is to go away."""

import errno
import itertools
import os

import can
import pytest
from simulated_bus import Clock

from kontronik_can_gw.config import CanConfig
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.runtime import bus_listener, can_port
from kontronik_can_gw.runtime.bus_listener import BusListener
from kontronik_can_gw.sources import CanState

_numbers = itertools.count()
FRAME = CanFrame(0x123, b"\x01\x02")


@pytest.fixture
def config() -> CanConfig:
    return CanConfig("virtual", f"listener-{os.getpid()}-{next(_numbers)}")


def some(listener: BusListener, count: int, seconds: float = 60.0) -> list[CanFrame]:
    """So many frames, or what came in the time."""
    frames: list[CanFrame] = []
    for _ in range(round(seconds / 0.05)):
        frames += listener.receive(0.05)
        if len(frames) >= count:
            break
    return frames


def test_frames_come_in_order_and_only_those_that_were_asked_for(config: CanConfig) -> None:
    listener = BusListener(config, frozenset({0x100, 0x1ABCDE | EXTENDED}))
    try:
        with can.Bus(interface="virtual", channel=config.channel) as bus:
            for number in range(20):
                bus.send(can.Message(arbitration_id=0x100, data=[number], is_extended_id=False))
                bus.send(can.Message(arbitration_id=0x101, data=[number], is_extended_id=False))
                bus.send(can.Message(arbitration_id=0x100, data=[number], is_extended_id=True))
                bus.send(can.Message(arbitration_id=0x100, dlc=1, is_remote_frame=True, is_extended_id=False))
                bus.send(can.Message(arbitration_id=0x1ABCDE, data=[number], is_extended_id=True))
            frames = some(listener, 40)
            assert bus.recv(0) is None, "a listener sent something"
        expected = [CanFrame(each, bytes([n]), each != 0x100) for n in range(20) for each in (0x100, 0x1ABCDE)]
        assert frames == expected
        assert listener.problem == ""
    finally:
        listener.close()
        listener.close()


def test_an_interface_that_cannot_be_opened_is_one_line_with_the_remedy() -> None:
    with pytest.raises(UserError, match="Did you mean socketcan") as wrong:
        BusListener(CanConfig("socketcam", "can0"), frozenset())
    assert wrong.value.exit_code == 2
    with pytest.raises(RunError, match="CAN interface nosuchcan7: ") as missing:
        BusListener(CanConfig("socketcan", "nosuchcan7"), frozenset())
    assert len(missing.value.problems) == 1


class FakePort:
    """A port whose interface can be taken away; nothing may be sent with it: it has no way to."""

    opened: list["FakePort"]
    fault: int

    def __init__(self, config: CanConfig) -> None:
        if FakePort.fault:
            raise can_port.socketcan_error(config, FakePort.fault)
        self.inbox: list[CanFrame] = []
        self.gone = self.closed = False
        self.state = CanState.UNKNOWN
        self.overruns = 0
        FakePort.opened.append(self)

    def set_receive_ids(self, ids: frozenset[int]) -> None:
        self.ids = ids

    def fileno(self) -> None:
        return None

    def receive(self) -> list[tuple[CanFrame, int | None]]:
        frames, self.inbox = self.inbox, []
        return [(frame, None) for frame in frames]

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    FakePort.opened, FakePort.fault = [], 0
    made = Clock()
    monkeypatch.setattr(bus_listener, "CanPort", FakePort)
    monkeypatch.setattr(bus_listener, "fault_of", lambda _name: FakePort.fault)
    monkeypatch.setattr(bus_listener, "time", made)
    return made


def test_it_comes_back_after_the_interface_was_removed(clock: Clock) -> None:
    listener = BusListener(CanConfig(), frozenset({0x123}))
    (first,) = FakePort.opened
    first.inbox.append(FRAME)
    assert listener.receive(1) == [FRAME]
    first.gone, FakePort.fault = True, errno.ENODEV
    assert listener.receive(0.1) == []
    assert listener.problem.startswith("CAN interface can0: there is none.")
    assert first.closed
    assert listener.receive(60) == []
    assert FakePort.opened == [first], "it was not to be opened while it is not there"
    FakePort.fault = 0
    assert listener.receive(0.6) == []
    assert listener.problem == ""
    second = FakePort.opened[-1]
    assert second is not first and second.ids == frozenset({0x123})
    second.inbox.append(FRAME)
    assert listener.receive(1) == [FRAME]


def test_it_is_tried_at_most_each_half_second(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    listener = BusListener(CanConfig("pcan", "PCAN_USBBUS1"), frozenset({0x123}))
    looked: list[float] = []

    def refuse(config: CanConfig) -> FakePort:
        looked.append(clock.now)
        raise RunError("CAN pcan PCAN_USBBUS1: cannot be opened: no")

    FakePort.opened[0].gone = True
    monkeypatch.setattr(bus_listener, "CanPort", refuse)
    for _ in range(100):
        assert listener.receive(0.05) == []
    assert listener.problem == "CAN pcan PCAN_USBBUS1: cannot be opened: no"
    assert 8 <= len(looked) <= 11
    assert all(later - earlier >= 0.5 for earlier, later in itertools.pairwise(looked))


def test_bus_off_is_told_until_a_frame_comes(clock: Clock) -> None:
    listener = BusListener(CanConfig(), frozenset({0x123}))
    (port,) = FakePort.opened
    port.state = CanState.BUS_OFF
    listener.receive(0.6)
    assert "is bus-off" in listener.problem
    port.inbox.append(FRAME)
    assert listener.receive(0.6) == [FRAME]
    assert listener.problem == ""
    listener.receive(0.6)
    assert listener.problem == ""
