"""Quiet mode in the loop: few wakes, no frame that waits, telemetry ends it."""

import logging

import pytest
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text
from wire_world import TIMES, World, loop_in, run, speed_and_age

from kontronik_can_gw.canopen.setup import shipped_canopen
from kontronik_can_gw.core.output_setup import OutputMaker
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.status import GatewayState
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("quiet-mode")

QUIET_AFTER_S = 3
LIVE_ID, STATE_ID = 0x100, 0x200
LAYOUT = compiled(
    dbc_text(
        [
            Msg("Live", LIVE_ID, 8, speed_and_age()),
            Msg("State", STATE_ID, 8, [Sig("GatewayState", 0, 8)]),
        ],
        TIMES,
    )
)


class Bench:
    """A loop whose ESC sends for a second and is then silent, until quiet mode has begun."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        *outputs: OutputMaker,
        restart_after_s: float = 0,
    ) -> None:
        self.world = World()
        self.loop: Loop = loop_in(
            self.world,
            monkeypatch,
            [EscSettings("esc1")],
            LAYOUT,
            outputs=outputs,
            quiet_after_s=QUIET_AFTER_S,
            restart_after_s=restart_after_s,
        )
        self.loop.open()
        self.loop.begin()
        self.live(1)
        self.silent_since = self.world.now

    def live(self, seconds: float) -> None:
        until = self.world.now + round(seconds * SECOND)
        self.world.wires[0].stream(self.world.now, until - 10 * MS, 10 * MS)
        self.run(seconds)

    def run(self, seconds: float) -> list[tuple[int, bytes]]:
        """Let time pass. Return the frames that were sent."""
        self.world.bus.take()
        run(self.loop, self.world, self.world.now + round(seconds * SECOND))
        return self.world.bus.take()

    @property
    def is_quiet(self) -> bool:
        return self.loop.gateway.status.is_quiet


def test_loop_wakes_about_once_a_second_in_quiet_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    frames = bench.run(QUIET_AFTER_S + 1)
    assert frames[-1] == (STATE_ID, bytes((GatewayState.QUIET,)) + bytes(7))
    bench.run(2)
    bench.world.looks.clear()
    assert bench.run(60) == []
    assert len(bench.world.looks) <= 130, "each wake looks at most twice"
    bench.loop.close()


def test_telemetry_ends_quiet_mode_at_its_second_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first frame may be a second old, because the loop sleeps."""
    bench = Bench(monkeypatch)
    bench.run(QUIET_AFTER_S + 10.3)
    begun = bench.world.now
    bench.world.wires[0].stream(begun, begun + SECOND, 10 * MS)
    bench.run(0.03)
    assert not bench.is_quiet
    frames = bench.run(1)
    ids = [can_id for can_id, _ in frames]
    assert ids.count(LIVE_ID) > 90
    assert ids.count(STATE_ID) > 40
    bench.loop.close()


def test_measurements_that_wait_for_the_bus_are_discarded_when_quiet_mode_begins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch)
    bench.run(QUIET_AFTER_S - 0.7)
    bench.world.bus.answer = Sent.FULL
    bench.run(0.5)
    assert not bench.is_quiet
    assert len(bench.loop.can.transmitter.queue) == 2
    bench.run(0.25)
    assert bench.is_quiet
    assert len(bench.loop.can.transmitter.queue) == 1
    bench.world.bus.answer = Sent.OK
    assert bench.run(5) == [(STATE_ID, bytes((GatewayState.QUIET,)) + bytes(7))]
    bench.loop.close()


def test_no_frame_waits_for_a_blocked_bus_in_quiet_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """When the bus works again, perhaps days later, nothing old is sent."""
    bench = Bench(monkeypatch)
    bench.run(QUIET_AFTER_S - 0.5)
    bench.world.bus.answer = Sent.FULL
    bench.run(5)
    assert bench.is_quiet
    assert len(bench.loop.can.transmitter.queue) == 0
    bench.world.looks.clear()
    bench.run(60)
    assert len(bench.world.looks) <= 130
    bench.world.bus.answer = Sent.OK
    assert bench.run(60) == []
    bench.live(1)
    assert not bench.is_quiet
    bench.loop.close()


@pytest.mark.parametrize("request_comes", [False, True])
def test_nothing_is_handed_over_behind_frames_that_do_not_leave(
    monkeypatch: pytest.MonkeyPatch, request_comes: bool
) -> None:
    """The other devices sleep already, so no one acknowledges the last frames."""
    bench = Bench(monkeypatch, shipped_canopen([1]), restart_after_s=0.5)
    bus = bench.world.bus
    bus.frame_ns = MS // 4
    bench.run(QUIET_AFTER_S - 0.1)
    bus.block()
    asked: list[str] = []
    bench.loop.can.transmitter.ask_restart = asked.append
    bench.run(3)
    assert bench.is_quiet
    assert bench.loop.gateway.is_held
    assert asked, "the frames stay in the controller"
    bench.world.looks.clear()
    assert bench.run(60) == []
    assert len(bench.world.looks) <= 150
    bus.discard_waiting()  # as the restart of the interface does
    bus.free()
    bus.arrived.clear()
    bench.run(30)
    if request_comes:
        bus.came(0x601, bytes.fromhex("4000100000000000"))
        bench.run(1)
    assert [frame.can_id for _, frame in bus.arrived] == [0x581] * request_comes
    bus.arrived.clear()
    bench.live(1)
    first, *others = [frame for _, frame in bus.arrived]
    assert (first.can_id, first.data[0]) == (STATE_ID, GatewayState.RUNNING)
    assert {0x701, LIVE_ID} <= {frame.can_id for frame in others}
    bench.loop.close()


def test_frames_that_leave_late_end_the_outage_but_not_quiet_mode(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch)
    bus = bench.world.bus
    bus.frame_ns = MS // 4
    bench.run(QUIET_AFTER_S - 1)
    bus.block()
    bench.run(2)
    assert bench.is_quiet
    bus.free()
    bus.arrived.clear()
    bench.run(3)
    assert not bench.loop.gateway.is_held
    assert bench.is_quiet
    last = bus.arrived[-1][1]
    assert (last.can_id, last.data[0]) == (STATE_ID, GatewayState.QUIET)
    bus.arrived.clear()
    bench.run(60)
    assert bus.arrived == []
    bench.loop.close()


def test_requests_are_answered_in_quiet_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, shipped_canopen([1]))
    bench.run(QUIET_AFTER_S + 20)
    bench.world.bus.came(0x601, bytes.fromhex("4000100000000000"))
    assert [can_id for can_id, _ in bench.run(10)] == [0x581]
    bench.loop.close()


def test_interface_that_returns_in_quiet_mode_gets_no_frame(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """systemd may set it down for a suspend of the machine."""
    caplog.set_level(logging.INFO)
    bench = Bench(monkeypatch, shipped_canopen([1]))
    bench.run(QUIET_AFTER_S + 20)
    bench.world.bus.is_gone = True
    bench.world.bus.came(0x601, bytes.fromhex("4000100000000000"))
    bench.world.there = False
    bench.run(3)
    assert bench.loop.can.port is None
    bench.world.bus.is_gone = False
    bench.world.there = True
    assert bench.run(60) == []
    assert bench.loop.can.is_open
    assert not bench.loop.conditions.is_on(bench.loop.can.condition)
    bench.live(3)
    ids = {can_id for can_id, _ in bench.run(1)}
    assert ids >= {STATE_ID, 0x701}
    lines = [record.message for record in caplog.records if "quiet" in record.message]
    assert lines[0] == "CAN world: quiet: no ESC was heard for 3 s, so only requests are answered"
    assert lines[1].startswith("CAN world: quiet mode ends: an ESC is heard, after ")
    bench.loop.close()


def test_begin_and_the_end_of_quiet_mode_are_logged_at_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """In C, too, whose iterations could otherwise go on for long without a line in the log."""
    caplog.set_level(logging.INFO)
    bench = Bench(monkeypatch)
    world = bench.world
    lines: list[tuple[int, str]] = []

    def note_time(record: logging.LogRecord) -> bool:
        lines.append((world.now, record.getMessage()))
        return True

    last_heard = world.now
    caplog.handler.addFilter(note_time)
    bench.run(60)
    heard = world.now
    world.wires[0].stream(heard, heard + 20 * SECOND, 10 * MS)
    bench.run(20)
    bench.loop.close()
    [(begun, begin)] = [line for line in lines if "quiet: no ESC was heard" in line[1]]
    assert begin == "CAN world: quiet: no ESC was heard for 3 s, so only requests are answered"
    assert begun <= last_heard + QUIET_AFTER_S * SECOND
    [(ended, _)] = [line for line in lines if "quiet mode ends" in line[1]]
    assert ended <= heard + SECOND + 20 * MS, "the loop sleeps for up to a second"
