"""A loop that turns in C, with pseudo terminals and a local socket: what it records, replayed by the core in Python, gives what it sent."""

import logging
import os
import random
import socket
import struct
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import wire_world
from dialogue import shipped_eds
from equality import layout, settings, stream
from sanitized import run_sanitized

from kontronik_can_gw.canopen.cob_ids import EMERGENCY, HEARTBEAT
from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.nodes import CanopenSetup
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.capture.format import Entry, Kind
from kontronik_can_gw.capture.replay import Replay
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.config.output_keys import DronecanConfig
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings, Event
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.native import load
from kontronik_can_gw.output import NEVER, Given, Output
from kontronik_can_gw.outputs import setup_of
from kontronik_can_gw.runtime import can_link
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.runtime.native_poller import NativePoller
from kontronik_can_gw.runtime.recorded_gateway import RecordedGateway
from kontronik_can_gw.runtime.socketcan_port import SocketCanPort
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.transmit_queue import Sent

_HEAD = struct.Struct("=IBBBB")


class LocalBus(socket.socket):
    """One end of a local socket pair, which has no options of CAN."""

    def setsockopt(self, *_: object) -> None:
        pass


def _nodes(escs: Sequence[EscSettings], wanted: bool) -> CanopenSetup | None:
    """Self-starting ones with default PDOs."""
    if not wanted:
        return None
    count = len(escs)
    settings = tuple(NodeSettings(1 + n, self_start=True) for n in range(count))
    return CanopenSetup(shipped_eds(), settings, (Stored(),) * count, tuple(escs))


class World:
    """A loop with recorder, its ESCs' wires, and what comes out.

    ``is_slow``: the bus takes what is sent only now and then. ``has_nodes``: each ESC has a CANopen node, and all one of DroneCAN.
    """

    def __init__(
        self, seed: int, is_slow: bool, monkeypatch: pytest.MonkeyPatch, has_nodes: bool = False
    ) -> None:
        self.chance = chance = random.Random(seed)
        self.escs = [settings(chance, n) for n in range(chance.randint(1, 4))]
        self.layout = layout(chance, self.escs)
        self.is_slow = is_slow
        pairs = [os.openpty() for _ in self.escs]
        for _, terminal in pairs:
            tty.setraw(terminal)
        self.wires = [wire for wire, _ in pairs]
        self.entries: list[Entry] = []
        ours, self.bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 if is_slow else 1 << 20)
        port = LocalBus(fileno=ours.detach())
        monkeypatch.setattr(can_link, "open_can", lambda _: SocketCanPort(port, port.close))
        begun = time.monotonic_ns()
        arguments = (self.escs, self.layout, begun)
        self.more: dict[str, Any] = {"canopen": _nodes(self.escs, has_nodes), "further": ()}
        if has_nodes:
            given = Given(DronecanConfig(node_id=42, extended_hz=30), b"", (1, 2), 3)
            self.more["further"] = [setup_of("dronecan", given, self.escs).make]
        self.gateway = RecordedGateway(self.put, *arguments, **self.more)
        self.begun = self.gateway.status.started_ns
        self.poller = NativePoller(self.gateway)
        ports = [os.ttyname(terminal) for _, terminal in pairs]
        self.loop = Loop(self.gateway, ports, CanConfig(channel="lo", fd=True), poller=self.poller)
        if not is_slow:  # then nothing is dropped, however slow the machine is
            monkeypatch.setattr(self.loop.can.transmitter, "max_turn_ns", lambda: 3600 * SECOND)
        for _, terminal in pairs:
            os.close(terminal)
        self.received: list[tuple[int, bytes]] = []

    def put(
        self, now: int, kind: int, esc: int, data: bytes, flags: int, came: int | None = None
    ) -> None:
        self.entries.append(Entry(now, Kind(kind), esc, data, flags, came))

    def feed(self, turns: int) -> None:
        """Bytes of all ESCs in pieces of any size, at any time, until there were ``turns`` turns in C; then the wires are cut."""
        chance = self.chance
        data = dict.fromkeys(self.wires, b"")
        for _ in range(100_000):
            if self.poller.count >= turns:
                break
            for wire, rest in data.items():
                size = chance.choice((1, 10, 40, 40, 44, 80, 400))
                rest = rest or stream(chance)
                os.write(wire, rest[:size])
                data[wire] = rest[size:]
            time.sleep(chance.choice((0, 0, 0.0003, 0.002)))
        for wire in self.wires:
            os.close(wire)
        self.loop.stop()

    def receive(self) -> None:
        while data := self.bus.recv(72):
            can_id, length, *_ = _HEAD.unpack_from(data)
            assert len(data) in (16, 72)
            self.received.append((can_id, data[8 : 8 + length]))
            if self.is_slow and self.chance.random() < 0.02:
                time.sleep(0.01)

    def run(self, turns: int) -> None:
        threads = [
            threading.Thread(target=self.receive),
            threading.Thread(target=self.feed, args=(turns,)),
        ]
        self.loop.open()
        for thread in threads:
            thread.start()
        self.loop.run()
        for thread in threads:
            thread.join()
        self.bus.close()

    def replayed(self, monkeypatch: pytest.MonkeyPatch) -> list[CanFrame]:
        monkeypatch.setenv(load.PURE, "1")
        load.library.cache_clear()
        gateway = Gateway(self.escs, self.layout, self.begun, **self.more)
        assert gateway.core.language == "Python"
        replay = Replay(gateway)
        frames = [timed.frame for timed in replay.follow(self.entries)]
        assert replay.rejected == 0
        return frames


@pytest.fixture(autouse=True)
def _core_in_c(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv(load.PURE, raising=False)
    library = load.library
    library.cache_clear()
    if library()[0] is None:
        pytest.skip(f"the core in C: {library()[1]}")
    yield
    library.cache_clear()


def on_the_wire(frames: Sequence[CanFrame]) -> list[tuple[int, bytes]]:
    return [(f.can_id | (EXTENDED if f.extended else 0), f.data) for f in frames]


@pytest.mark.parametrize("seed", range(6))
def test_what_is_sent_is_what_a_replay_in_python_sends(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(seed, False, monkeypatch)
    world.run(200)
    assert world.poller.count >= 200
    assert world.received == on_the_wire(world.replayed(monkeypatch))
    assert len(world.received) == world.gateway.status.sent_frames > 0


@pytest.mark.parametrize("seed", range(6))
def test_with_nodes_too_what_is_sent_is_what_a_replay_in_python_sends(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nearly each live frame has other error bits. Order within an id: queue and slots take turns in Python's transmit queue."""
    world = World(seed, False, monkeypatch, has_nodes=True)
    world.run(300)
    replayed = on_the_wire(world.replayed(monkeypatch))
    for can_id in {number for number, _ in replayed}:
        received = [data for number, data in world.received if number == can_id]
        assert received == [data for number, data in replayed if number == can_id]
    assert len(world.received) == len(replayed) == world.gateway.status.sent_frames
    assert sum(EMERGENCY < number < EMERGENCY + 5 for number, _ in replayed) > 500
    assert sum(number == 0x98040A2A for number, _ in replayed) > 20


@pytest.mark.parametrize("has_nodes", [True, False])
def test_other_error_bits_are_followed_between_turns_in_c_and_only_where_somebody_wants_it(
    has_nodes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop comes round for housekeeping, and heartbeats; an emergency goes in front of what the core sends in its turn."""
    monkeypatch.setenv(load.PURE, "0")
    world = wire_world.World()
    escs = (EscSettings("esc1"),)
    loop = wire_world.loop_in(world, monkeypatch, escs, canopen=_nodes(escs, has_nodes))
    events: list[int] = []
    turns: list[int] = []
    _count(monkeypatch, loop._poller, "_follow", lambda: events.append(_found(loop)))
    _count(monkeypatch, loop, "_serve", lambda: turns.append(world.now))
    loop.open()
    loop.begin()
    wire, begun = world.wires[0], world.now
    for n in range(400):
        frame = encode(LiveData(operating_errors=n // 2 % 2 << 20), WireLayout.V4)
        wire.put(frame, [begun + n * 10 * MS] * len(frame))
    wire_world.run(loop, world, begun + 4 * SECOND)
    assert len(turns) < 4 * 4
    states = [found for found in events if found & Event.STATE]
    emergencies = [(at, f) for at, f in world.bus.sent if f.can_id == EMERGENCY + 1]
    assert len(emergencies) == (199 if has_nodes else 0)
    assert (len(states) > 150) if has_nodes else not states
    for at, _ in emergencies:
        together = [frame.can_id for when, frame in world.bus.sent if when == at]
        assert together[0] in (EMERGENCY + 1, HEARTBEAT + 1)
        assert len(together) > 1
    loop.close()


def _found(loop: Loop) -> int:
    found: int = loop._poller._turns.state.found  # type: ignore[attr-defined]
    return found & 0xFF


def _count(patch: pytest.MonkeyPatch, of: object, name: str, note: Callable[[], None]) -> None:
    """``note`` is called before each call of a method."""
    method = getattr(of, name)

    def noted(*arguments: Any) -> Any:
        note()
        return method(*arguments)

    patch.setattr(of, name, noted)


class Beacon(Output):
    """A measurement of its own each 20 ms: the newest wins, unless it is ``queued``."""

    events = Event.NONE

    def __init__(self, queued: bool) -> None:
        super().__init__()
        self.due = 0
        self.count = 0
        self._queued = queued

    def next_deadline(self) -> int:
        return self.due

    def advance(self, now: int) -> None:
        if now >= self.due:
            self.due = now + 20 * MS
            self.count += 1
            self.frames.append(CanFrame(0x700, struct.pack("<I", self.count), queued=self._queued))


@pytest.mark.parametrize("queued", [True, False])
def test_an_output_whose_time_has_come_speaks_between_turns_in_c(
    queued: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With telemetry and without; on a full bus what is queued waits, of what is not the newest alone."""
    monkeypatch.setenv(load.PURE, "0")
    world = wire_world.World()
    escs = (EscSettings("esc1"),)
    beacon = Beacon(queued)
    loop = wire_world.loop_in(world, monkeypatch, escs, further=[lambda *_: beacon])
    turns: list[int] = []
    _count(monkeypatch, loop, "_serve", lambda: turns.append(world.now))
    loop.open()
    loop.begin()
    wire, begun = world.wires[0], world.now
    for n in range(300):
        frame = encode(LiveData(consumed_charge=n), WireLayout.V4)
        wire.put(frame, [begun + n * 10 * MS] * len(frame))
    wire_world.run(loop, world, begun + 5 * SECOND)
    sent = [(at, f) for at, f in world.bus.sent if f.can_id == 0x700]
    assert [f.data for _, f in sent] == [struct.pack("<I", 1 + n) for n in range(len(sent))]
    assert 200 < len(sent) == beacon.count <= 251
    assert len(turns) < 5 * 4
    world.bus.frame_ns = 300 * MS
    while world.bus.send(CanFrame(0x100, b"")) is Sent.OK:
        pass
    wire_world.run(loop, world, begun + 5500 * MS)
    waiting = [f for f in loop.can.transmitter.queue.in_order() if f.can_id == 0x700]
    assert waiting[-1].data == struct.pack("<I", beacon.count)
    assert (len(waiting) > 10) == queued
    assert len(waiting) == 1 or queued
    loop.close()


def test_a_foreign_frame_with_our_id_is_over_after_ten_seconds_between_turns_in_c(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """No output has a deadline of its own; the next one is a new one, which is said."""
    caplog.set_level(logging.INFO)
    monkeypatch.setenv(load.PURE, "0")
    world = wire_world.World()
    loop = wire_world.loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    wire, begun = world.wires[0], world.now
    wire.stream(begun, begun + 40 * SECOND, 10 * MS)
    conflicts = loop.gateway.conflicts
    for came in (1, 25):
        world.bus.came(0x100, bytes(8), begun + came * SECOND)
        wire_world.run(loop, world, begun + (came + 9) * SECOND)
        assert conflicts.next_deadline() < NEVER
        wire_world.run(loop, world, begun + (came + 11) * SECOND)
        assert conflicts.next_deadline() == NEVER
    wire_world.run(loop, world, begun + 39 * SECOND)
    said = [
        r.getMessage().split(": ")[2].split()[0]
        for r in caplog.records
        if "else sends" in r.getMessage()
    ]
    assert said == ["somebody", "nobody", "somebody", "nobody"]
    loop.close()


def test_the_kernel_is_asked_for_the_interface_each_second_between_turns_in_c(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(load.PURE, "0")
    world = wire_world.World()
    loop = wire_world.loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    asked: list[int] = []

    def ask(now: int) -> None:
        asked.append(now)
        loop.can.controller.due = now + SECOND

    monkeypatch.setattr(loop.can, "ask", ask)
    loop.can.controller.due = world.now
    begun = world.now
    world.wires[0].stream(begun, begun + 10 * SECOND, 10 * MS)
    wire_world.run(loop, world, begun + 10 * SECOND)
    gaps = [later - at for at, later in pairwise([begun, *asked, world.now])]
    assert max(gaps) <= 1600 * MS
    assert len(asked) < 12
    loop.close()


def test_an_emergency_that_meets_a_full_bus_long_after_the_last_frame_waits_and_is_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That the bus took nothing counts from then on: it is no stall, and nothing is lost."""
    monkeypatch.setenv(load.PURE, "0")
    world = wire_world.World()
    escs = (EscSettings("esc1"),)
    nothing = Layout("", "", ())
    loop = wire_world.loop_in(world, monkeypatch, escs, nothing, canopen=_nodes(escs, True))
    loop.open()
    loop.begin()
    wire, begun = world.wires[0], world.now
    for n in range(600):
        frame = encode(LiveData(operating_errors=(n >= 530) << 20), WireLayout.V4)
        wire.put(frame, [begun + n * 10 * MS] * len(frame))
    wire_world.run(loop, world, begun + SECOND)
    assert 0x181 in dict(world.bus.take())
    world.bus.came(0, b"\x80\x01")  # pre-operational: heartbeats and emergencies remain
    wire_world.run(loop, world, begun + 5295 * MS)  # between two heartbeats
    world.bus.frame_ns = 30 * MS
    while world.bus.send(CanFrame(0x700, b"")) is Sent.OK:
        pass
    wire_world.run(loop, world, begun + 6 * SECOND)
    status, transmitter = loop.can._gateway.status, loop.can.transmitter
    assert (transmitter.is_stalled, status.dropped_frames) == (False, 0)
    (at,) = [
        at for at, f in world.bus.sent if f.can_id == EMERGENCY + 1 and at > begun + 4 * SECOND
    ]
    assert at < begun + 5600 * MS
    loop.close()


@pytest.mark.parametrize("seed", range(2))
def test_where_the_bus_does_not_take_all_the_newest_values_are_sent(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was replaced is missing; nothing else comes, and nothing twice or in another order of its id."""
    world = World(seed, True, monkeypatch)
    world.run(200)
    status = world.gateway.status
    assert len(world.received) == status.sent_frames
    replayed = on_the_wire(world.replayed(monkeypatch))
    for can_id in {number for number, _ in replayed}:
        all_of_it = iter([data for number, data in replayed if number == can_id])
        got = [data for number, data in world.received if number == can_id]
        assert all(any(data == other for other in all_of_it) for data in got)
    waiting = len(world.loop.can.transmitter.queue)
    assert status.sent_frames + status.replaced_frames + waiting == len(replayed)


@pytest.mark.extended
def test_turns_and_hold_ups_touch_nothing_outside_their_memory_and_nothing_is_undefined(
    tmp_path: Path,
) -> None:
    found = run_sanitized(tmp_path, "-c", _UNDER_SANITIZERS)
    assert all(int(count) > 50 for count in found.split()), found


_UNDER_SANITIZERS = """
import os, pathlib, sys
del os.environ["LD_PRELOAD"]  # the compiler needs none
os.environ["KONTRONIK_PURE"] = "0"
import pytest, native_world, sanitized, test_hold_ups, test_turns_in_c
from kontronik_can_gw.native import binding, load

patch = pytest.MonkeyPatch()
plain = binding.load(pathlib.Path(sys.argv[1]))
patch.setattr(load, "library", lambda: (plain, ""))
for seed, is_slow, has_nodes in ((0, False, True), (1, True, False), (5, False, True)):
    with pytest.MonkeyPatch.context() as each:
        world = test_turns_in_c.World(seed, is_slow, each, has_nodes)
        world.run(80)
        print(len(world.received))
faked = native_world.library(sanitized.SANITIZED)
patch.setattr(native_world, "library", lambda: faked)
hold_ups = test_hold_ups.test_whatever_holds_the_process_up_values_end_in_time_and_ages_are_true
for seed in range(3):
    hold_ups.hypothesis.inner_test(seed, 60, 10, 0.05, seed % 2, seed % 3)
"""
