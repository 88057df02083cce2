"""Quiet mode: without telemetry for can.quiet_after_s, the gateway only answers requests."""

from pathlib import Path
from typing import Any

import pytest

from kontronik_can_gw.assembly.assemble import Loaded, assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.dronecan import wire
from kontronik_can_gw.esc.kontronik import codec
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import MS, NEVER, SECOND

pytestmark = pytest.mark.promise("quiet-mode")

QUIET_AFTER = 5 * SECOND
LIVE = codec.encode(LiveData(battery_voltage=2400, operating_state=12), codec.WireLayout.V4)
GATEWAY_STATUS = 1752
OFFLINE = 7


OF_0_5_0 = Path(__file__).parents[1] / "golden" / "inputs" / "kontronik_esc_0.5.0.dbc"


def loaded(
    dbc: bool = True,
    canopen: bool = False,
    dronecan: bool = False,
    quiet_after_s: int = QUIET_AFTER // SECOND,
    file: str = "shipped",
) -> Loaded:
    tables: dict[str, Any] = {
        "can": {"interface": "virtual", "quiet_after_s": quiet_after_s},
        "dbc": {"enabled": dbc, "file": file},
        "canopen": {"enabled": canopen, "self_start": True, "store": "/nonexistent/store"},
        "dronecan": {"enabled": dronecan, "node_id": 42},
        "esc": [{"port": f"/dev/ttyUSB{n}", "name": f"e{n}"} for n in range(2)],
    }
    return assemble(parse(tables, "bench.toml"))


class Bench:
    """A gateway with two ESCs whose clock the test sets."""

    def __init__(self, given: Loaded) -> None:
        self.now = SECOND
        self.gateway = Gateway(
            given.core_settings,
            self.now,
            outputs=given.outputs,
        )
        self.sent: list[tuple[int, CanFrame]] = []
        self.wakes = 0
        """Number of deadlines that were reached."""
        for esc in range(2):
            self.gateway.port(esc, True, self.now)
        self.gateway.start(self.now)
        self._take()

    def _take(self) -> None:
        gateway = self.gateway
        self.sent += [(self.now, frame) for frame in gateway.take_frames(self.now)]
        if gateway.is_held:
            first = gateway.first_frame(self.now)
            assert first is not None
            self.sent.append((self.now, first))
            gateway.release(self.now)
            gateway.advance(self.now)
            self._take()

    def run(self, seconds: float, *live: int) -> list[CanFrame]:
        """Let time pass. The ESCs ``live`` send every 10 ms. Returns the frames that were sent."""
        end = self.now + round(seconds * SECOND)
        before = len(self.sent)
        while self.now < end:
            until = self.now + 10 * MS if live else end
            while (due := self.gateway.next_deadline()) <= until:
                assert due > 0
                self.now = max(self.now, due)
                self.wakes += 1
                self.gateway.advance(self.now)
                self._take()
            self.now = until
            for esc in live:
                self.gateway.receive_bytes(esc, LIVE, self.now, self.now)
            if live:
                self.gateway.advance(self.now)
                self._take()
        return [frame for _, frame in self.sent[before:]]

    def receive(self, can_id: int, data: bytes, extended: bool = False) -> list[CanFrame]:
        """Receive a frame, and return the frames that are sent at once."""
        before = len(self.sent)
        self.gateway.receive_frame(CanFrame(can_id, data, extended), self.now, self.now)
        self.gateway.advance(self.now)
        self._take()
        return [frame for _, frame in self.sent[before:]]

    def until_quiet(self) -> list[CanFrame]:
        """Let the ESCs send for a second and then be silent. Returns the last second's frames."""
        self.run(1, 0, 1)
        self.run(4.5)
        assert not self.gateway.status.is_quiet
        frames = self.run(1)
        assert self.gateway.status.is_quiet
        return frames


def test_last_frame_reports_quiet_at_the_configured_time() -> None:
    bench = Bench(loaded())
    bench.until_quiet()
    when, frame = bench.sent[-1]
    assert when == 2 * SECOND + QUIET_AFTER
    assert frame.can_id == GATEWAY_STATUS
    assert frame.data[0] & 15 == GatewayState.QUIET
    assert bench.gateway.status.state is GatewayState.QUIET


def test_gateway_that_never_hears_an_esc_becomes_quiet_after_its_start() -> None:
    bench = Bench(loaded())
    bench.run(10)
    assert bench.sent[-1][0] == SECOND + QUIET_AFTER


def test_dbc_whose_value_table_has_no_quiet_causes_a_warning() -> None:
    given = loaded(file=str(OF_0_5_0))
    (warning,) = [each for each in given.warnings if "Quiet" in each]
    assert "GatewayStatus.GatewayState: its value table has no Quiet" in warning
    bench = Bench(given)
    bench.until_quiet()
    assert bench.sent[-1][1].data[0] & 15 == 14, "not Error"
    assert not [each for each in loaded().warnings if "Quiet" in each]
    without_key = loaded(file=str(OF_0_5_0), quiet_after_s=0)
    assert not [each for each in without_key.warnings if "Quiet" in each]


def test_without_the_key_the_gateway_never_becomes_quiet() -> None:
    bench = Bench(loaded(quiet_after_s=0))
    bench.run(1, 0)
    bench.run(30)
    assert not bench.gateway.status.is_quiet
    assert bench.run(1)


def test_one_heard_esc_prevents_quiet_mode() -> None:
    bench = Bench(loaded())
    bench.run(20, 1)
    assert not bench.gateway.status.is_quiet


def test_lost_port_leads_to_quiet_mode_as_silence_does() -> None:
    bench = Bench(loaded())
    bench.run(1, 0)
    bench.gateway.port(0, False, bench.now)
    bench.run(6)
    assert bench.gateway.status.is_quiet


def test_quiet_mode_waits_until_all_values_have_expired() -> None:
    """A master can set a telemetry timeout that is longer than can.quiet_after_s."""
    given = loaded(quiet_after_s=1)
    bench = Bench(given)
    for esc, settings in enumerate(given.escs):
        settings = type(settings)(name=settings.name, timeout_ns=3 * SECOND)
        bench.gateway.core.apply(esc, settings)
    bench.run(1, 0)
    bench.run(2.9)
    assert not bench.gateway.status.is_quiet
    bench.run(0.2)
    assert bench.gateway.status.is_quiet


def test_quiet_mode_sends_nothing_and_has_no_deadline() -> None:
    bench = Bench(loaded(canopen=True, dronecan=True))
    bench.until_quiet()
    bench.run(20)  # info data and emergencies have their own timeouts
    bench.wakes = 0
    assert bench.run(24 * 3600) == []
    assert bench.wakes == 0
    assert bench.gateway.next_deadline() == NEVER


def test_dronecan_nodes_report_offline_when_quiet_mode_begins() -> None:
    bench = Bench(loaded(dronecan=True))
    bench.until_quiet()
    frames = [frame for _, frame in bench.sent if frame.extended]
    status = [frame for frame in frames if frame.can_id >> 8 & 0xFFFF == wire.NODE_STATUS.number]
    assert status[-1].data[4] >> 3 & 7 == OFFLINE
    assert status[-2].data[4] >> 3 & 7 == wire.OPERATIONAL


def test_requests_are_answered_in_quiet_mode() -> None:
    bench = Bench(loaded(canopen=True, dronecan=True))
    bench.until_quiet()
    (answer,) = bench.receive(0x601, bytes.fromhex("40 00 10 00 00 00 00 00"))
    assert answer.can_id == 0x581
    assert [f.can_id for f in bench.receive(0, b"\x81\x01")] == [0x701], "no boot-up message"
    assert bench.receive(0, b"\x01\x01") == []
    assert bench.receive(0x7E5, b"\x04\x01" + bytes(6)) == []
    answers = bench.receive(0x7E5, b"\x5e" + bytes(7))
    assert [(frame.can_id, frame.data[1]) for frame in answers] == [(0x7E4, 1), (0x7E4, 2)]
    get_info = wire.SERVICE | wire.REQUEST | 1 << 16 | 42 << 8 | 100 | 24 << 24
    assert bench.receive(get_info, b"\xc0", extended=True)
    assert bench.run(60) == []


def test_dronecan_requests_are_answered_for_longer_than_a_second_of_answers() -> None:
    bench = Bench(loaded(dronecan=True))
    bench.until_quiet()
    get_info = wire.SERVICE | wire.REQUEST | 1 << 16 | 42 << 8 | 100 | 24 << 24
    for number in range(200):
        bench.run(0.1)
        assert bench.receive(get_info, bytes((0xC0 | number % 32,)), extended=True), number


def test_heartbeats_stay_off_when_a_master_sets_their_period() -> None:
    bench = Bench(loaded(canopen=True))
    bench.until_quiet()
    (answer,) = bench.receive(0x601, bytes.fromhex("2b 17 10 00 64 00 00 00"))
    assert answer.data[0] == 0x60
    assert bench.run(10) == []
    beats = [frame for frame in bench.run(1, 0) if frame.can_id == 0x701]
    assert beats


def test_foreign_frames_neither_prevent_nor_end_quiet_mode() -> None:
    bench = Bench(loaded(canopen=True))
    bench.run(1, 0)
    for _ in range(100):
        bench.run(0.1)
        bench.receive(0x80, b"")
        bench.receive(GATEWAY_STATUS, bytes(8))
    assert bench.gateway.status.is_quiet
    assert bench.receive(0x80, b"") == []


def test_changes_of_the_interface_cause_no_frames_in_quiet_mode() -> None:
    bench = Bench(loaded(canopen=True, dronecan=True))
    bench.until_quiet()
    gateway = bench.gateway
    for state in (CanState.BUS_OFF, CanState.ERROR_ACTIVE, CanState.DOWN, CanState.ERROR_PASSIVE):
        gateway.set_can_state(state, bench.now)
        assert bench.run(1) == []
    gateway.can_opened(bench.now)
    gateway.can_returned(bench.now)
    gateway.receive_overrun(bench.now)
    gateway.held_up(bench.now, True)
    assert bench.run(60) == []


def test_end_of_the_program_causes_no_frame_in_quiet_mode() -> None:
    bench = Bench(loaded(canopen=True, dronecan=True))
    bench.until_quiet()
    bench.gateway.stop(bench.now)
    assert bench.gateway.take_frames(bench.now) == []


def test_telemetry_ends_quiet_mode_and_everything_is_sent_again() -> None:
    bench = Bench(loaded(canopen=True, dronecan=True))
    usual = {frame.can_id for frame in bench.run(3, 0, 1)}
    bench.until_quiet()
    bench.run(100)
    frames = bench.run(3, 0, 1)
    assert (frames[0].can_id, frames[0].data[0] & 15) == (GATEWAY_STATUS, GatewayState.RUNNING)
    assert bench.gateway.status.state is GatewayState.RUNNING
    assert {frame.can_id for frame in frames} >= usual
    boots = [frame.can_id for frame in frames if frame.can_id >> 7 == 14 and frame.data == b"\0"]
    assert boots == [0x701, 0x702], "the nodes do not boot as after an outage"


def test_error_that_begins_in_quiet_mode_is_reported_at_its_end() -> None:
    bench = Bench(loaded(canopen=True))
    bench.until_quiet()
    bench.gateway.parameters_damaged(0, bench.now)
    assert bench.run(5) == []
    emergencies = [frame for frame in bench.run(1, 0) if frame.can_id == 0x81]
    assert any(frame.data[1] == 0x63 for frame in emergencies), emergencies


def test_nodes_that_watch_each_other_miss_no_heartbeat_because_of_quiet_mode() -> None:
    bench = Bench(loaded(canopen=True))
    # 1016h:1 of node 1: node 2, 3 s. 1029h:1: no boot-up after an outage.
    assert bench.receive(0x601, bytes.fromhex("23 16 10 01 b8 0b 02 00"))
    assert bench.receive(0x601, bytes.fromhex("2f 29 10 01 01 00 00 00"))
    bench.run(3, 0, 1)
    bench.until_quiet()
    bench.run(60)
    frames = bench.run(5, 0, 1)
    assert not [f for f in frames if f.can_id == 0x81 and f.data[:2] == b"\x30\x81"]


def test_quiet_mode_begins_again_after_each_silence() -> None:
    bench = Bench(loaded())
    for _ in range(3):
        bench.until_quiet()
        assert bench.sent[-1][1].data[0] & 15 == GatewayState.QUIET
        assert bench.run(60) == []


def test_after_the_end_of_quiet_mode_no_deadline_is_due_at_once() -> None:
    """Seconds of the statistics passed in quiet mode. They end in the same iteration."""
    bench = Bench(loaded())
    bench.run(20)
    gateway = bench.gateway
    assert gateway.status.is_quiet
    gateway.receive_bytes(0, LIVE, bench.now, bench.now)
    gateway.advance(bench.now)
    assert not gateway.status.is_quiet
    assert gateway.core.next_deadline() > bench.now
