"""Each row of the gate's table, and each pair of rows, in a gateway with both cores and a replay.

The exploration of the gate gives the shortest path to a row or pair. It is driven with a real
gateway, transmitter and a port that follows the path. The frames that the port accepted are
equal with both cores, and in the same order in the replay of the recording.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

import pytest
from dialogue import shipped_eds
from gate_exploration import BEGIN, RESTART_AFTER, TIMEOUT, NotedGate, Path, events_of, explore
from test_outages import with_status
from wire_world import live

from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.setup import CanopenSetup
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.capture.format import Entry, EntryKind
from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.replay import Replay
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gate_table import TABLE, Row
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.native import load
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.transmitter import Transmitter
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, NEVER

pytestmark = pytest.mark.promise("gate", "replay")

READ_DEVICE_TYPE = bytes.fromhex("4000100000000000")
"""An SDO request. Its response is a frame that waits."""
ESCS = (EscSettings("esc1", timeout_ns=TIMEOUT),)
SETTINGS = CoreSettings(ESCS, with_status())
NODE = NodeSettings(1, self_start=True)
OUTPUTS = (CanopenSetup(shipped_eds(), (NODE,), (Stored(),), ESCS),)


HANDED_OVER: dict[str, tuple[int, Sent]] = {
    "accepted": (2, Sent.LATE),
    "first frame": (1, Sent.LATE),
    "first frame waits": (1, Sent.LATE),
    "busy": (0, Sent.BUSY),
    "full": (0, Sent.FULL),
}
"""Number of accepted frames and last answer of the port for each event."""


class ScriptedPort(CanPort):
    """A port that accepts ``room`` frames and then gives ``answer``."""

    is_socket = True

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        self.queued = 0
        self.room = 0
        self.answer = Sent.LATE
        self.accepted: list[CanFrame] = []

    def frames_left(self) -> int:
        return self.count

    def frames_queued(self) -> int:
        return self.queued

    def _send_each(
        self, frames: Sequence[CanFrame], clock: Callable[[], int], latest: int
    ) -> tuple[int, Sent]:
        taken = frames[: self.room]
        self.accepted += taken
        self.room -= len(taken)
        return len(taken), Sent.OK if len(taken) == len(frames) else self.answer

    def fileno(self) -> int | None:
        return None

    def close(self) -> None: ...

    def _filter(self) -> None: ...

    def _drops(self) -> int:
        return 0

    def receive(self, limit: int = 0) -> list[tuple[CanFrame, int | None]]:
        return []


class Drive:
    """A recorded gateway that follows a path of the exploration."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self.gateway = RecordedGateway(self._put, SETTINGS, BEGIN, outputs=OUTPUTS)
        config = CanConfig(interface="socketcan", channel="can0", restart_after_s=0.5)
        self.transmitter = Transmitter(
            config, self.gateway, FaultLog(), lambda _now: None, lambda: self.now
        )
        self.now = BEGIN
        self.is_quiet = False
        """Quiet mode as the path has it. The core of the gateway hears an ESC."""
        self.gate = NotedGate(TIMEOUT, RESTART_AFTER)
        self.transmitter.gate = self.gate
        self.transmitter.reports._gate = self.gate
        self.transmitter.ask_restart = lambda _channel: None
        self.port = ScriptedPort()
        self.gateway.start(BEGIN)
        self.gateway.take_frames(BEGIN)  # as a replay does

    def _put(
        self, now: int, kind: int, esc: int, data: bytes, flags: int, came: int | None = None
    ) -> None:
        self.entries.append(Entry(now, EntryKind(kind), esc, data, flags, came))

    def follow(self, path: Path) -> None:
        """Follow the events of a path."""
        for now, event in path:
            self.now = now
            step = dict(events_of(self.gate, now))[event]
            if event in HANDED_OVER:
                self._hand_over(event)
            elif event in ("quiet", "telemetry"):
                self.is_quiet = event == "quiet"
                step(self.gate, now)
            else:
                if event == "request":
                    self._request()
                step(self.gate, now)
            self.gate.advance(now)
            self.transmitter.work(now)
            self.port.count = self.gate.under_way.count

    def _request(self) -> None:
        self.gateway.receive_frame(CanFrame(0x601, READ_DEVICE_TYPE), self.now, self.now)

    def _hand_over(self, event: str) -> None:
        """Hand over frames, and let the port give the answer of the event."""
        self._request()
        self._request()
        self.gateway.receive_bytes(0, live(1 + len(self.entries)), self.now, self.now)
        self.gateway.advance(self.now)
        self.port.room, self.port.answer = HANDED_OVER[event]
        self.port.queued = int(event == "first frame waits")
        self.gateway.status.is_quiet = self.is_quiet
        self.transmitter.transmit(self.port, self.now)
        self.gateway.status.is_quiet = False

    def replayed(self) -> list[CanFrame]:
        """Return the frames of a replay by the core in Python."""
        replay = Replay(Gateway(SETTINGS, BEGIN, outputs=OUTPUTS))
        frames = [each.frame for each in replay.follow(self.entries) if not each.received]
        assert replay.rejected == 0
        return frames


def by_id(frames: Iterable[CanFrame]) -> dict[int, list[bytes]]:
    found: dict[int, list[bytes]] = {}
    for frame in frames:
        found.setdefault(frame.can_id, []).append(frame.data)
    return found


def check_path(path: Path, rows: tuple[Row, ...], patch: pytest.MonkeyPatch) -> None:
    """Check that a path follows ``rows`` with both cores, with equal frames, and in a replay."""
    drives = []
    for is_python in (False, True):
        with patch.context() as inner:
            if is_python:
                inner.setattr(load, "library", lambda: (None, ""))
            drives.append(Drive())
            drives[-1].follow(path)
    in_c, in_python = drives
    assert type(in_c.gateway.core) is not type(in_python.gateway.core)
    assert rows in (*zip(in_c.gate.rows), *pairwise(in_c.gate.rows)), path
    assert in_c.gate.rows == in_python.gate.rows
    assert in_c.port.accepted == in_python.port.accepted
    patch.setattr(load, "library", lambda: (None, ""))
    replayed = by_id(in_c.replayed())
    for can_id, sent in by_id(in_c.port.accepted).items():
        rest = iter(replayed[can_id])
        assert all(data in rest for data in sent), (path, hex(can_id))
    patch.undo()


def check_all(most: int, patch: pytest.MonkeyPatch) -> int:
    """Check all rows and the pairs that the first ``most`` states follow. Returns their number."""
    found = explore(ignore, ignore, most)
    assert found.rows.keys() == set(TABLE)
    for row, path in found.rows.items():
        check_path(path, (row,), patch)
    for pair, path in found.pairs.items():
        check_path(path, pair, patch)
    return len(found.pairs)


def test_rows_and_most_pairs_send_the_same_in_both_cores_and_a_replay(
    c_compiler: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert check_all(3000, monkeypatch) > 400


@pytest.mark.extended
def test_all_rows_and_pairs_send_the_same_in_both_cores_and_a_replay(
    c_compiler: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert check_all(1_000_000, monkeypatch) > 500


def ignore(_gate: object, _now: int) -> None:
    """Check nothing. tests/gateway/test_gate.py checks the states."""


def test_quiet_mode_after_a_busy_port_leaves_no_deadline_in_the_past() -> None:
    drive = Drive()
    gate = drive.gate
    transmitter = drive.transmitter
    gate.opened(0, BEGIN)
    transmitter.work(BEGIN)
    drive.port.room, drive.port.answer = 0, Sent.BUSY
    drive.now = BEGIN + 20 * MS
    drive.gateway.receive_bytes(0, live(1), drive.now, drive.now)
    drive.gateway.advance(drive.now)
    transmitter.transmit(drive.port, drive.now)
    assert gate.refused_since != NEVER
    drive.gateway.status.is_quiet = True
    drive.port.room, drive.port.answer = 99, Sent.OK
    for _ in range(3):
        drive.now += 10 * MS
        transmitter.transmit(drive.port, drive.now)
    assert gate.due > drive.now
