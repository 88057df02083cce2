"""A bus that takes nothing for long: what waits is dropped, said once, and told anew when frames go again."""

import logging
from collections.abc import Callable, Sequence

import pytest

from kontronik_can_gw.cli.common import assemble
from kontronik_can_gw.config import parse
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.mailboxes import Sent
from kontronik_can_gw.runtime.can_port import one_by_one
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import MS, SECOND


class Port:
    """A SocketCAN port whose bus can be stopped."""

    tells_busy_from_gone = True
    bus_off_count = 0
    state = CanState.ERROR_ACTIVE
    stopped = False

    def __init__(self) -> None:
        self.sent: list[CanFrame] = []

    def send(self, frame: CanFrame) -> Sent:
        if self.stopped:
            return Sent.BUSY
        self.sent.append(frame)
        return Sent.OK

    def send_all(self, frames: Sequence[CanFrame], clock: Callable[[], int], latest: int) -> tuple[int, Sent]:
        return one_by_one(self.send, frames, clock, latest)

    def fileno(self) -> None:
        return None

    def close(self) -> None:
        pass


def test_a_bus_that_stood_still_gets_what_is_true_now_and_no_backlog(caplog: pytest.LogCaptureFixture) -> None:
    tables = {"canopen": {"enabled": True, "store": "/nowhere"}, "esc": [{"port": "p"}]}
    loaded = assemble(parse(tables, "test"))
    gateway = Gateway(loaded.escs, loaded.layout, 0, canopen=loaded.canopen)
    loop = Loop(gateway, ["p"], loaded.config.can, clock=lambda: 0)
    port = loop.can.port = Port()  # type: ignore[assignment]
    assert isinstance(port, Port)
    live = bytes.fromhex("4B4F444C 00000000 8A09" + "0000" * 5 + "581F E903 00 00 1D 20 00000200 0C 00 39234C14")
    try:
        with caplog.at_level(logging.INFO, "kontronik_can_gw"):
            gateway.start(0)
            gateway.receive_bytes(0, live, MS, MS)
            loop.can.transmit(MS)
            assert CanFrame(0x701, b"\0", queued=True) in port.sent
            port.stopped = True
            for now in range(2 * MS, 60 * SECOND, 5 * MS):
                gateway.advance(now)
                loop.can.transmit(now)
            assert len(loop.can.mailboxes) < 50
            assert gateway.status.dropped_frames > 40
            port.stopped = False
            port.sent.clear()
            for now in range(60 * SECOND, 60 * SECOND + 50 * MS, 5 * MS):
                gateway.advance(now)
                loop.can.transmit(now)
    finally:
        loop.can.port = None
        loop.close()
    assert [frame.data for frame in port.sent if frame.can_id == 0x701] in ([], [b"\x7f"])
    emergencies = [frame.data[:2] for frame in port.sent if frame.can_id == 0x081]
    assert emergencies == [b"\x10\x75"]  # telemetry lost: told while nothing went, and told again
    said = [record.message for record in caplog.records if "no frame can be sent" in record.message]
    assert said == ["CAN can0: no frame can be sent: nobody acknowledges, or the bus is full. Trying again."]
    assert "CAN can0: frames are sent again, after 59.0 s" in caplog.messages
