"""A loop that runs in C, with a simulated kernel.

A replay of its recording by the Python core gives the frames that it sent.
"""

import ctypes as c
import random
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import native_world
import pytest
import wire_world
from built import run_sanitized
from dbc_bench import compiled
from dialogue import shipped_eds
from equality import layout, settings, stream
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.canopen.cob_ids import EMERGENCY, HEARTBEAT
from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.setup import CanopenSetup
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.capture.format import Entry, EntryKind
from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
from kontronik_can_gw.config.output_keys import DronecanConfig
from kontronik_can_gw.core.output import Output
from kontronik_can_gw.core.output_setup import OutputSetup, ReadyOutput
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.replay import Replay
from kontronik_can_gw.dronecan.nodes import Given
from kontronik_can_gw.dronecan.setup import DronecanSetup
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings, Event
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway.gate_table import PASSING
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.native import load
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS, SECOND


def _nodes(escs: Sequence[EscSettings]) -> CanopenSetup:
    """Return a self-starting node with default PDOs for each ESC."""
    count = len(escs)
    settings = tuple(NodeSettings(1 + n, self_start=True) for n in range(count))
    return CanopenSetup(shipped_eds(), settings, (Stored(),) * count, tuple(escs))


ESCS = (EscSettings("esc1"),)
EVENT = 'BA_DEF_DEF_ "GenMsgSendType" "Event";\n'
pytestmark = [
    pytest.mark.promise("both-cores"),
    pytest.mark.parametrize("core_language", ["C"], indirect=True),
]


class InC:
    """A loop that runs in C, in a World. ``turns`` has the times of iterations in Python."""

    def __init__(
        self,
        patch: pytest.MonkeyPatch,
        layout: MessageLayout | None = None,
        escs: Sequence[EscSettings] = ESCS,
        **more: Any,
    ) -> None:
        self.world = world = wire_world.World(len(escs))
        self.loop = wire_world.loop_in(world, patch, escs, layout, **more)
        self.bus = world.bus
        self.begun = world.now
        self.turns: list[int] = []
        _count(patch, self.loop, "_serve", lambda: self.turns.append(world.now))
        self.loop.open()
        self.loop.begin()

    def feed(self, frames: Iterable[LiveData]) -> None:
        """Send one frame every 10 ms, beginning at the start."""
        for n, data in enumerate(frames):
            wire = encode(data, WireLayout.V4)
            self.world.wires[0].put(wire, [self.begun + n * 10 * MS] * len(wire))

    def run(self, seconds: float) -> None:
        """Run until this time after the start."""
        wire_world.run(self.loop, self.world, self.begun + round(seconds * SECOND))

    def fill_bus(self, frame_ns: int) -> None:
        self.bus.frame_ns = frame_ns
        while self.bus.send(CanFrame(0x100, b"")) is Sent.OK:
            pass


def _count(
    patch: pytest.MonkeyPatch,
    of: object,
    name: str,
    note: Callable[[], None],
) -> None:
    """Call ``note`` before each call of a method."""
    method = getattr(of, name)

    def noted(*arguments: Any) -> Any:
        note()
        return method(*arguments)

    patch.setattr(of, name, noted)


class Recorded(InC):
    """A recorded loop with random ESCs, layout and bytes.

    With ``has_nodes`` each ESC has a CANopen node, and all ESCs share a DroneCAN node.
    """

    def __init__(
        self,
        seed: int,
        patch: pytest.MonkeyPatch,
        has_nodes: bool = False,
    ) -> None:
        chance = random.Random(seed)
        self.entries: list[Entry] = []
        self.escs = [settings(chance, n) for n in range(chance.randint(1, 4))]
        self.layout = layout(chance, self.escs)
        given = Given(DronecanConfig(node_id=42, extended_hz=30), b"", (1, 2), 3)
        self.outputs: list[OutputSetup] = []
        if has_nodes:
            self.outputs = [_nodes(self.escs), DronecanSetup(given, tuple(self.escs))]
        patch.setattr(wire_world, "Gateway", partial(RecordedGateway, self._put))
        super().__init__(patch, self.layout, self.escs, outputs=self.outputs)
        self.status = self.loop.gateway.status
        for wire in self.world.wires:
            at = self.begun
            while at < self.begun + 2 * SECOND:
                data = stream(chance)
                # The bytes arrive at once, or as on the wire.
                step = chance.choice((0, wire_world.NS_PER_BYTE))
                wire.put(data, [at + n * step for n in range(1, len(data) + 1)])
                at += len(data) * wire_world.NS_PER_BYTE
                at += chance.choice((0, MS, 6 * MS, 6 * MS, 6 * MS, 300 * MS))

    def _put(
        self,
        now: int,
        kind: int,
        esc: int,
        data: bytes,
        flags: int,
        came: int | None = None,
    ) -> None:
        self.entries.append(Entry(now, EntryKind(kind), esc, data, flags, came))

    def sent(self) -> list[tuple[int, bytes]]:
        """Run to the end. Return the frames that were sent."""
        self.run(2.5)
        self.loop.end()
        assert len(self.bus.sent) == self.status.sent_frames
        return on_the_wire(frame for _, frame in self.bus.sent)

    def replayed(self, patch: pytest.MonkeyPatch) -> list[tuple[int, bytes]]:
        patch.setattr(load, "library", lambda: (None, ""))
        gateway = Gateway(CoreSettings(self.escs, self.layout), self.begun, outputs=self.outputs)
        assert gateway.core.language == "Python"
        replay = Replay(gateway)
        frames = [timed.frame for timed in replay.follow(self.entries)]
        assert replay.rejected == 0
        return on_the_wire(frames)


def on_the_wire(frames: Iterable[CanFrame]) -> list[tuple[int, bytes]]:
    return [(f.can_id | (EXTENDED if f.extended else 0), f.data) for f in frames]


@pytest.mark.parametrize("has_nodes", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_sent_frames_equal_those_of_a_replay_in_python(
    seed: int,
    has_nodes: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The order is the same: frames of outputs, then slots, then messages.

    With nodes the error bits change in nearly each frame.
    """
    it = Recorded(seed, monkeypatch, has_nodes)
    sent = it.sent()
    replayed = it.replayed(monkeypatch)
    assert it.loop._poller.count > 100 > len(it.turns)  # type: ignore[attr-defined]
    assert len(sent) == len(replayed) > 0
    assert sent == replayed
    ids = [number for number, _ in replayed]
    emergencies = sum(EMERGENCY < number < EMERGENCY + 5 for number in ids)
    assert (emergencies > 100) == has_nodes
    assert (ids.count(0x98040A2A) > 20) == has_nodes


def test_recorded_calls_reach_the_recorder_within_a_third_of_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a power loss the calls that C still holds are lost. Before 0.25 s it keeps them."""
    it = Recorded(1, monkeypatch)
    delays = []

    def put(now: int, *_: object) -> None:
        delays.append(it.world.now - now)

    monkeypatch.setattr(it.loop.gateway, "_put", put)
    it.run(1.9)  # the ESCs send for two seconds
    assert len(delays) > 100
    assert 200 * MS < max(delays) < 333 * MS


def test_syncs_read_at_once_are_all_answered_live_and_in_a_replay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    it = Recorded(1, monkeypatch, has_nodes=True)
    for at, can_id, data in (
        (100, 0x601, "23 00 18 01 81 01 00 c0"),  # 1800h:1: invalid
        (110, 0x601, "2f 00 18 02 02 00 00 00"),  # every second SYNC
        (120, 0x601, "2f 00 1a 00 00 00 00 00"),
        (130, 0x601, "23 00 1a 01 08 02 20 20"),  # the live counter
        (140, 0x601, "2f 00 1a 00 01 00 00 00"),
        (150, 0x601, "23 00 18 01 81 01 00 40"),
        *[(1000, 0x80, "")] * 8,
        *[(1500, 0x80, "")] * 3,
        (1800, 0x80, ""),
    ):
        it.bus.came(can_id, bytes.fromhex(data), it.begun + at * MS)

    def one_byte_pdos(frames: list[tuple[int, bytes]]) -> list[bytes]:
        return [data for number, data in frames if number == 0x181 and len(data) == 1]

    pdos = one_byte_pdos(it.sent())
    assert len(pdos) == 6
    assert pdos == one_byte_pdos(it.replayed(monkeypatch))


@pytest.mark.parametrize("has_nodes", [True, False])
def test_changed_error_bits_interrupt_turns_in_c_only_if_needed(
    has_nodes: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The iterations of the loop in Python only for housekeeping and heartbeats.

    An emergency is sent before the core's frames of the same iteration.
    """
    it = InC(monkeypatch, outputs=[_nodes(ESCS)] if has_nodes else [])
    poller: Any = it.loop._poller
    events: list[int] = []
    _count(monkeypatch, poller, "_follow_event", lambda: events.append(poller._turns.result.event))
    it.feed(LiveData(operating_errors=n // 2 % 2 << 20) for n in range(400))
    it.run(4)
    assert len(it.turns) < 4 * 4
    states = [found for found in events if found & Event.STATE]
    emergencies = [(at, f) for at, f in it.bus.sent if f.can_id == EMERGENCY + 1]
    assert len(emergencies) == (199 if has_nodes else 0)
    if has_nodes:
        assert len(states) > 150
    else:
        assert not states
    for at, _ in emergencies:
        together = [frame.can_id for when, frame in it.bus.sent if when == at]
        assert together[0] in (EMERGENCY + 1, HEARTBEAT + 1)
        assert len(together) > 1
    it.loop.close()


class Beacon(Output):
    """An output that sends a measurement every 20 ms.

    A newer one replaces a waiting one, unless it is ``queued``.
    """

    events = Event.NONE

    def __init__(self, queued: bool) -> None:
        super().__init__()
        self.due = self.count = 0
        self._queued = queued

    def next_deadline(self) -> int:
        return self.due

    def advance(self, now: int) -> None:
        if now >= self.due:
            self.due = now + 20 * MS
            self.count += 1
            data = struct.pack("<I", self.count)
            self.frames.append(CanFrame(0x700, data, queued=self._queued))


@pytest.mark.parametrize("queued", [True, False])
def test_output_that_is_due_sends_between_turns_in_c(
    queued: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It does so with and without telemetry.

    On a full bus all queued frames wait, but only the newest one that is not queued.
    """
    beacon = Beacon(queued)
    it = InC(monkeypatch, outputs=[ReadyOutput(beacon)])
    it.feed(LiveData(consumed_charge=n) for n in range(300))
    it.run(5)
    sent = [f.data for _, f in it.bus.sent if f.can_id == 0x700]
    assert sent == [struct.pack("<I", 1 + n) for n in range(len(sent))]
    assert 200 < len(sent) == beacon.count <= 251
    assert len(it.turns) < 5 * 4
    it.fill_bus(150 * MS)
    it.run(5.5)
    waiting = [f for f in it.loop.can.transmitter.queue.in_order() if f.can_id == 0x700]
    assert waiting[-1].data == struct.pack("<I", beacon.count)
    if queued:
        assert len(waiting) > 10
    else:
        assert len(waiting) == 1
    it.loop.close()


def test_emergency_on_a_full_bus_after_a_long_pause_is_sent_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The time without a sent frame counts only from then. It is not a stall and not a loss."""
    it = InC(monkeypatch, MessageLayout("", "", ()), outputs=[_nodes(ESCS)])
    it.feed(LiveData(operating_errors=(n >= 530) << 20) for n in range(600))
    it.run(1)
    assert 0x181 in dict(it.bus.take())
    it.bus.came(0, b"\x80\x01")  # pre-operational: only heartbeats and emergencies are sent
    it.run(5.295)  # between two heartbeats
    it.fill_bus(30 * MS)
    it.run(6)
    status = it.loop.gateway.status
    assert not it.loop.can.gate.is_stalled
    assert status.dropped_frames == 0
    sent = [at - it.begun for at, f in it.bus.sent if f.can_id == EMERGENCY + 1]
    (at,) = [at for at in sent if at > 4 * SECOND]
    assert at < 5600 * MS
    it.loop.close()


@pytest.mark.parametrize("answer", [Sent.DOWN, Sent.GONE])
def test_failed_interface_is_noticed_at_the_next_frame(
    answer: Sent,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Neither error is a full bus, for which iterations in C would wait."""
    it = InC(monkeypatch)
    it.feed(LiveData(consumed_charge=n) for n in range(300))
    it.run(1)
    it.bus.answer = answer
    it.bus.sent.clear()
    it.run(1.02)
    assert it.loop.gateway.status.can_state is CanState.DOWN
    it.bus.answer = Sent.OK
    it.run(2)
    assert len(it.bus.sent) > 50
    it.loop.close()


def test_sending_to_a_busy_driver_is_retried_every_two_milliseconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its socket stays writable, so waiting for that would use the whole processor."""
    it = InC(monkeypatch)
    it.feed(LiveData(consumed_charge=n) for n in range(300))
    it.run(1)
    it.bus.answer = Sent.BUSY
    it.run(1.2)
    assert 50 < len(it.bus.refused) <= 110
    assert it.loop.can.gate.state in PASSING, "a busy driver is no outage"
    # These are the first attempt with a new frame, and an attempt every 2 ms.
    it.bus.answer = Sent.OK
    it.bus.sent.clear()
    it.run(1.3)
    assert len(it.bus.sent) > 5
    it.loop.close()


def test_slow_bus_gets_the_newest_pages_of_a_multiplexed_message(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A waiting group is replaced only by its newer version, and groups keep their order."""
    signals = [Sig("Page", 0, 8, mux="M")]
    source = "electrical_speed"
    for page in range(8):
        name = f"Speed{page}"
        signals.append(Sig(name, 8, 32, unit="1/min", mux=f"m{page}", source=source))
    text = dbc_text([Msg("Pages", 0x100, 8, signals)], EVENT)
    bind: dict[str, str | float] = {f"Pages.{signal.name}": source for signal in signals[1:]}
    layout = compiled(text, bind=bind)
    it = InC(monkeypatch, layout, (EscSettings("esc1", timeout_ns=SECOND),))
    it.bus.frame_ns = 15 * MS
    made: list[int] = []
    for at in range(it.begun, it.begun + 4 * SECOND, 10 * MS):
        # Each frame causes one group, at first faster than the bus takes them. Then it catches up.
        if (at - it.begun) % SECOND < 400 * MS:
            made.append(at)
            wire = encode(LiveData(electrical_speed=len(made)), WireLayout.V4)
            it.world.wires[0].put(wire, [at] * len(wire))
    it.run(4)
    status = it.loop.gateway.status
    it.loop.close()
    pages: dict[int, list[int]] = {}
    order: list[int] = []
    after: Counter[int] = Counter()
    for at, frame in it.bus.sent:
        if at > it.begun + SECOND:
            speed = int.from_bytes(frame.data[1:5], "little")
            pages.setdefault(frame.data[0], []).append(speed)
            order.append(speed)
            period, place = divmod(at - it.begun, SECOND)
            if place < 400 * MS:
                assert at - made[speed - 1] <= 90 * MS, "the eight groups come round in 80 ms"
            else:
                after[period] += 1
    assert max(after.values()) <= 8, "one of each group was left"
    assert sorted(pages) == list(range(8))
    for speeds in pages.values():
        assert speeds == sorted(set(speeds))
    assert order == sorted(order), "an alive counter of the message would run backward"
    assert status.replaced_frames > 15
    assert not it.loop.can.gate.is_stalled
    assert status.dropped_frames == 0
    assert it.loop._poller.count > 150, "most turns are in C"  # type: ignore[attr-defined]


def test_each_change_of_the_ports_leaves_one_epoll_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a flapping port would use up the process's descriptors."""
    opened = c.c_int.in_dll(native_world.library(), "fake_epolls")
    before = opened.value
    it = InC(monkeypatch)
    it.feed(LiveData(consumed_charge=n) for n in range(900))
    for second in range(1, 8):
        it.run(second)
        assert opened.value == before + 1
        it.world.wires[0].fails_at = it.world.now
    it.loop.close()
    assert it.loop.escs[0].reopened >= 6
    assert opened.value == before


@pytest.mark.promise("no-undefined-behaviour")
@pytest.mark.extended
def test_turns_and_hold_ups_have_no_memory_error_or_undefined_behaviour(
    tmp_path: Path,
) -> None:
    found = run_sanitized(tmp_path, "-c", _UNDER_SANITIZERS)
    assert all(int(count) > 50 for count in found.split()), found


_UNDER_SANITIZERS = """
import os, pathlib, sys
del os.environ["LD_PRELOAD"]  # the compiler needs none
os.environ["KONTRONIK_PURE"] = "0"
import pytest, native_world, built, test_hold_ups, test_turns_in_c
patch = pytest.MonkeyPatch()
faked = native_world.library(built.SANITIZED)
patch.setattr(native_world, "library", lambda: faked)
for seed, frame_ns, has_nodes in ((0, 0, True), (2, 20_000_000, False), (5, 0, True)):
    with pytest.MonkeyPatch.context() as each:
        it = test_turns_in_c.Recorded(seed, each, has_nodes)
        it.bus.frame_ns = frame_ns
        print(len(it.sent()))
hold_ups = test_hold_ups.test_after_any_hold_up_values_end_in_time_and_ages_are_true
for seed in range(3):
    hold_ups.hypothesis.inner_test(seed, 60, 10, 0.05, seed % 2, seed % 3)
"""


@pytest.mark.promise("bus-off")
def test_turns_in_c_send_no_frame_in_bus_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    turns = InC(monkeypatch)
    turns.feed(LiveData(electrical_speed=speed) for speed in range(300))
    turns.run(1)
    turns.bus.state = CanState.BUS_OFF
    turns.loop.can.controller.follow(turns.bus, turns.world.now)
    sent_before = len(turns.bus.sent)
    assert sent_before > 0
    turns.run(1.9)
    assert len(turns.bus.sent) == sent_before
    turns.run(2.5)
    assert len(turns.bus.sent) > sent_before, "the bus-off was not confirmed within a second"
