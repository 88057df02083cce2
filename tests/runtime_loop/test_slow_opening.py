"""A machine on which an interface takes long to open: that is no suspension of the process."""

from collections.abc import Callable, Sequence

import pytest

from kontronik_can_gw.cli.common import assemble
from kontronik_can_gw.config import parse
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.mailboxes import Sent
from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.protocol.codec import Layout, encode
from kontronik_can_gw.protocol.fields import LiveData
from kontronik_can_gw.runtime import can_side
from kontronik_can_gw.runtime.can_port import one_by_one
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import MS, SECOND


def test_the_boot_up_is_sent_and_what_came_meanwhile_is_thrown_away(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0]
    sent: list[CanFrame] = []

    class SlowPort:
        tells_busy_from_gone = True
        gone = False
        bus_off_count = overruns = 0
        state = CanState.ERROR_ACTIVE

        def __init__(self, _config: object) -> None:
            clock[0] += 400 * MS
            esc.write(encode(LiveData(electrical_speed=77_777), Layout.V4))  # of the time of opening: nobody knows when
            if clock[0] < 2 * SECOND:
                raise RunError("is down")

        def fileno(self) -> None:
            return None

        def set_receive_ids(self, _ids: object) -> None:
            pass

        def discard(self) -> None:
            pass

        def send(self, frame: CanFrame) -> Sent:
            sent.append(frame)
            if len(sent) > 40:
                loop.stop()
            return Sent.OK

        def send_all(self, frames: Sequence[CanFrame], clock: Callable[[], int], latest: int) -> tuple[int, Sent]:
            return one_by_one(self.send, frames, clock, latest)

        def close(self) -> None:
            pass

    def now() -> int:
        clock[0] += MS
        return clock[0]

    monkeypatch.setattr(can_side, "CanPort", SlowPort)
    with PtyEsc() as esc:
        tables = {
            "can": {"interface": "virtual", "channel": "slow"},
            "canopen": {"enabled": True, "store": "/nowhere"},
            "esc": [{"port": esc.path}],
        }
        loaded = assemble(parse(tables, "test"))
        gateway = Gateway(loaded.escs, loaded.layout, 0, canopen=loaded.canopen)
        loop = Loop(gateway, [esc.path], loaded.config.can, wait_for_devices=True, clock=now)
        loop.open()
        loop.run()
    assert [frame.data for frame in sent if frame.can_id == 0x701][:1] == [b"\0"]
    speeds = {int.from_bytes(frame.data[:3], "little") for frame in sent if frame.can_id == 0x688}
    assert 77_777 not in speeds
