"""The listener on a fake port whose interface disappears. A real port is used in tests/vcan."""

import itertools

import pytest
from simulated_bus import Clock

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.receiver import bus_listener
from kontronik_can_gw.desk.receiver.bus_listener import BusListener
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import CanState

pytestmark = pytest.mark.promise("monitor")

FRAME = CanFrame(0x123, b"\x01\x02")


class FakePort:
    """A port whose interface can be removed. It has no method for sending."""

    opened: list["FakePort"]
    is_gone = False
    state = CanState.UNKNOWN
    overruns = 0

    def __init__(self, _config: CanConfig) -> None:
        self.inbox: list[CanFrame] = []
        FakePort.opened.append(self)

    def set_receive_ids(self, ids: frozenset[int]) -> None: ...

    def fileno(self) -> None: ...

    def receive(self, _limit: int) -> list[tuple[CanFrame, int | None]]:
        frames, self.inbox = self.inbox, []
        return [(frame, None) for frame in frames]

    def close(self) -> None: ...


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    FakePort.opened = []
    made = Clock()
    monkeypatch.setattr(bus_listener, "open_can", FakePort)
    monkeypatch.setattr(bus_listener, "fault_of", lambda _name: 0)
    monkeypatch.setattr(bus_listener, "time", made)
    return made


def test_missing_interface_is_tried_at_most_each_half_second(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = BusListener(CanConfig("pcan", "PCAN_USBBUS1"), frozenset({0x123}))
    looked: list[float] = []

    def refuse(_: CanConfig) -> FakePort:
        looked.append(clock.now)
        raise RunError("cannot be opened")

    FakePort.opened[0].is_gone = True
    monkeypatch.setattr(bus_listener, "open_can", refuse)
    for _ in range(100):
        assert listener.receive(0.05) == []
    assert listener.problem == "cannot be opened"
    assert 8 <= len(looked) <= 11
    assert all(later - earlier >= 0.5 for earlier, later in itertools.pairwise(looked))


def test_bus_off_is_reported_until_a_frame_is_received(clock: Clock) -> None:
    listener = BusListener(CanConfig(), frozenset({0x123}))
    (port,) = FakePort.opened
    port.state = CanState.BUS_OFF
    listener.receive(0.6)
    assert "is bus-off" in listener.problem
    port.inbox.append(FRAME)
    assert listener.receive(0.6) == [FRAME]
    assert listener.problem == ""
    assert listener.receive(0.6) == []
    assert listener.problem == ""
