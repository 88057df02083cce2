"""A process that was held up sends no value older than its timeout, and loses no fresh one.

On the CAN side it obeys commands that waited, sends the answers, and computes measurements again.
"""

import errno
import random
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from itertools import pairwise
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest
from dbc_bench import compiled
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from packer_oracle import Msg, dbc_text
from wire_world import (
    CAN_FD,
    NOT_AVAILABLE,
    TIMES,
    World,
    layout_of,
    live,
    loop_in,
    run,
    speed_and_age,
)

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.esc.kontronik import codec
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import GatewayState, NmtState
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("hold-ups")

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.native_poller import NativePoller

NS_PER_BYTE = KONTRONIK.byte_ns


def shown(frame: CanFrame) -> tuple[int, int]:
    """Return the number of the ESC's frame and its age in ms."""
    return int.from_bytes(frame.data[:4], "little"), int.from_bytes(frame.data[4:6], "little")


def values(world: World, esc: int = 0) -> Iterator[tuple[int, int, int]]:
    """Yield time, number and age in ms of the frames that were sent with a value."""
    for at, frame in world.bus.sent:
        number, age = shown(frame)
        if frame.can_id == 0x100 + esc and number != NOT_AVAILABLE:
            yield at, number, age


def begin(patch: pytest.MonkeyPatch, world: World, *escs: EscSettings) -> Loop:
    loop = loop_in(world, patch, escs)
    loop.open()
    loop.begin()
    return loop


TWO = (EscSettings("esc1", timeout_ns=20 * MS), EscSettings("esc2"))
LAYOUTS = {count: layout_of(TWO[:count]) for count in (1, 2)}


@pytest.mark.promise("true")
@settings(max_examples=25, deadline=None, phases=[Phase.generate])  # a seed cannot be shrunk
@given(
    st.integers(0, 2**32),
    st.sampled_from([20, 60, 100, 250, 1000]),
    st.sampled_from([8, 10, 20, 50]),
    st.sampled_from([0, 0.002, 0.05]),
    st.booleans(),
    st.booleans(),
)
def test_after_any_hold_up_values_end_in_time_and_ages_are_true(
    seed: int,
    timeout_ms: int,
    period_ms: int,
    stops: float,
    neighbour: bool,
    bundled: bool,
) -> None:
    rng = random.Random(seed)
    world = World(1 + neighbour)
    wire = world.wires[0]
    start = world.now
    timeout = timeout_ms * MS
    period = period_ms * MS
    escs = (EscSettings("esc1", timeout_ns=timeout), TWO[1])[: 1 + neighbour]
    at = start + rng.randrange(period)
    while at < start + 4 * SECOND:
        wire.send(at, bundled)
        has_gap = rng.random() < 0.01
        jitter = rng.randrange(2 * timeout) if has_gap else rng.randrange(-MS, MS)
        at += max(4 * MS, period + jitter)
    if neighbour:
        world.wires[1].stream(start, start + 4 * SECOND, 17 * MS)

    def hold_up() -> int:
        is_stopped = rng.random() < stops
        return rng.randrange(400 * MS if is_stopped else MS // 10)

    world.hold_up = hold_up
    with pytest.MonkeyPatch.context() as patch:
        loop = loop_in(world, patch, escs, LAYOUTS[len(escs)])
        loop.open()
        loop.begin()
        lost: list[tuple[int, int]] = []
        while world.now < start + 5 * SECOND:
            losses = loop.gateway.escs[0].losses
            loop.turn()
            new_losses = loop.gateway.escs[0].losses - losses
            lost += [(world.now, world.looks[-2])] * new_losses
        loop.close()
    for sent, number, age in values(world):
        truth = sent - wire.frames[number - 1]
        if bundled:  # bytes that the adapter held back arrive faster than the wire allows
            truth -= 40 * NS_PER_BYTE
        assert truth <= timeout
        # ages are shown in whole ms, the period has jitter
        assert (age + 1) * MS >= truth - period - 2 * MS
    for when, looked in lost:
        # The frame arrived between two checks of the port. The loss may be found earlier than
        # the timeout by the time between these two checks.
        newest = max(whole for whole in wire.frames if whole <= looked)
        look = bisect_left(world.looks, newest)
        between = world.looks[look] - world.looks[look - 1]
        assert when - newest >= timeout - between
        assert stops or between <= timeout // 4


@pytest.mark.parametrize("sends", [True, False])
def test_loop_checks_its_ports_four_times_per_shortest_time_out(
    monkeypatch: pytest.MonkeyPatch,
    sends: bool,
) -> None:
    """A master may change the timeout. No message wakes the loop, and it does not check more."""
    world = World(2)
    escs = (EscSettings("esc1", timeout_ns=SECOND), EscSettings("esc2"))
    loop = loop_in(world, monkeypatch, escs, MessageLayout("", "", ()))
    loop.open()
    loop.begin()
    for timeout in (SECOND, 60 * MS, 20 * MS, 400 * MS):
        loop.gateway.core.apply(0, EscSettings("esc1", timeout_ns=timeout))
        shortest = min(timeout, 250 * MS)
        end = world.now + 2 * SECOND
        if sends:
            world.wires[0].stream(world.now, end, shortest * 6 // 10)
            run(loop, world, world.now + 10 * MS)
        world.looks.clear()
        run(loop, world, end)
        assert loop.gateway.status.escs_ok == sends
        longest = max(b - a for a, b in zip(world.looks, world.looks[1:], strict=False))
        assert shortest // 6 < longest <= shortest // 4
    loop.close()


@pytest.mark.parametrize("interrupted", ["no poll", "polls of ports that were read", "all polls"])
def test_bytes_beyond_one_read_are_dated_by_their_position(
    monkeypatch: pytest.MonkeyPatch,
    interrupted: str,
) -> None:
    """If a signal interrupts a poll in C, the poll does not show that a port is empty."""
    world = World()
    (wire,) = world.wires
    start = world.now
    if interrupted != "no poll":

        def poll_fault(is_all: bool) -> int:
            is_interrupted = interrupted == "all polls" or not is_all
            return errno.EINTR if is_interrupted else 0

        world.poll_fault = poll_fault
    loop = begin(monkeypatch, world, EscSettings("esc1", timeout_ns=20 * SECOND))
    wire.stream(start, start + 8 * SECOND, 40 * NS_PER_BYTE)  # without a pause: 83 kB
    world.now += 9 * SECOND
    esc = loop.gateway.escs[0]
    for _ in range(24):
        loop.turn()
        newest = bisect_right(wire.frames, esc.live_bound_ns + NS_PER_BYTE)
        assert esc.counters.live in (0, newest)
    loop.close()
    assert wire.waiting == 0
    assert abs(wire.frames[-1] - esc.live_bound_ns) <= NS_PER_BYTE


@pytest.mark.promise("ports-fair")
def test_port_that_always_has_bytes_does_not_delay_other_ports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each frame of the other port is sent at most two reads later.

    A megabyte waits at the first port, and the process needs a millisecond for 4 KiB.
    """
    world = World(2)
    flooded, usual = world.wires
    start = world.now
    read = flooded.read

    def slow_read(most: int = 4096) -> bytes:
        data = read(most)
        world.now += len(data) * MS // 4096
        return data

    monkeypatch.setattr(flooded, "read", slow_read)
    loop = begin(monkeypatch, world, *TWO)
    flooded.put(bytes(1 << 20), [start] * (1 << 20))
    usual.stream(start, start + 200 * MS, 10 * MS)
    run(loop, world, start + 220 * MS)
    loop.close()
    assert flooded.waiting > 1 << 16
    first = {number: at for at, number, _ in reversed(list(values(world, 1)))}
    assert list(range(1, 21)) == sorted(first)
    for number, whole in enumerate(usual.frames, 1):
        assert first[number] - whole <= 2 * MS


@pytest.mark.parametrize("is_reopened", [False, True])
def test_frame_that_waits_in_a_newly_opened_port_is_never_sent(
    monkeypatch: pytest.MonkeyPatch,
    is_reopened: bool,
) -> None:
    """The age of such a frame is unknown."""
    world = World()
    (wire,) = world.wires
    if not is_reopened:
        wire.send(world.now - 5 * SECOND)
    loop = begin(monkeypatch, world, EscSettings("esc1", timeout_ns=60 * SECOND))
    if is_reopened:
        wire.fails_at = world.now
        run(loop, world, world.now + 10 * MS)
        assert loop.escs[0].port is None
        wire.send(world.now + MS)
        run(loop, world, world.now + 10 * MS)
        assert wire.waits_to_be_read
    run(loop, world, world.now + 2 * SECOND)
    assert loop.escs[0].port is not None
    assert list(values(world)) == []
    wire.send(world.now)
    run(loop, world, world.now + SECOND)
    loop.close()
    assert {number for _, number, _ in values(world)} == {2}


MANY = [Msg(f"M{n}", 0x100 + n, 8, speed_and_age()) for n in range(100)]
"""More messages than one system call of the C core hands over, which is 64."""


def shown_of_all(world: World) -> Iterator[tuple[int, int, int, int]]:
    """Yield id, time, number and age in ms of every frame that was sent with a value."""
    for at, frame in world.bus.sent:
        number, age = shown(frame)
        if number != NOT_AVAILABLE:
            yield frame.can_id, at, number, age


def test_bytes_faster_than_the_wire_allows_are_not_dated_in_the_future(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """More than two reads arrive at once, as from another device. A frame is at the end."""
    world = World()
    (wire,) = world.wires
    timeout = 100 * MS
    loop = begin(monkeypatch, world, EscSettings("esc1", timeout_ns=timeout))
    wire.stream(world.now, world.now + 400 * MS, 20 * MS)
    run(loop, world, world.now + SECOND)
    came = world.now + MS
    number = len(wire.frames) + 1
    flood = bytes(10_000) + live(number)
    wire.put(flood, [came] * len(flood))
    wire.frames.append(came)
    run(loop, world, came + SECOND)
    esc = loop.gateway.escs[0]
    loop.close()
    assert came - 40 * MS < esc.live_bound_ns <= came
    sent = [at for at, shown_number, _ in values(world) if shown_number == number]
    assert came <= sent[0] < sent[-1] <= came + timeout


def test_bytes_left_in_a_lost_port_do_not_age_the_bytes_after_reopening(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World()
    (wire,) = world.wires
    loop = begin(monkeypatch, world, EscSettings("esc1", timeout_ns=60 * SECOND))
    wire.send(world.now)
    run(loop, world, world.now + 100 * MS)
    wire.put(bytes(5000), [world.now] * 5000)
    lost = world.now
    read = wire.read

    def read_once(most: int = 4096) -> bytes:
        data = read(most)
        assert wire.waits_to_be_read
        wire.fails_at = world.now
        monkeypatch.setattr(wire, "read", read)
        return data

    monkeypatch.setattr(wire, "read", read_once)
    run(loop, world, lost + SECOND)
    assert loop.escs[0].reopened == 1
    at = world.now
    wire.send(at, bundled=True)
    run(loop, world, at + 100 * MS)
    esc = loop.gateway.escs[0]
    loop.close()
    assert at - 300 * MS < esc.live_bound_ns <= wire.frames[-1]


def test_hold_up_is_logged_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Delays that are shorter than the shortest timeout are not logged."""
    world = World()
    start = world.now
    loop = begin(monkeypatch, world, EscSettings("esc1", timeout_ns=100 * MS))
    world.wires[0].stream(start, start + 3 * SECOND, 10 * MS)
    left = {1100 * MS: 90 * MS, 2100 * MS: 400 * MS}

    def hold_up() -> int:
        due = [since for since in left if world.now >= start + since]
        return left.pop(due[0]) if due else 0

    world.hold_up = hold_up
    run(loop, world, start + 3 * SECOND)
    loop.close()
    assert not left
    (line,) = [each for each in caplog.messages if "suspended" in each]
    assert line.startswith("the process was suspended for 0.4 s")


@pytest.mark.parametrize("frames_before", [0, 64])
def test_frames_that_become_old_while_being_sent_are_computed_again(
    monkeypatch: pytest.MonkeyPatch,
    frames_before: int,
) -> None:
    """The process is held up after the read, or when the kernel has taken 64 of 100 frames."""
    world = World()
    (wire,) = world.wires
    start = world.now
    hold_up = 300 * MS
    read = wire.read
    escs = (EscSettings("esc1", timeout_ns=SECOND),)
    loop = loop_in(world, monkeypatch, escs, compiled(dbc_text(MANY, TIMES)))
    loop.open()
    loop.begin()
    wire.stream(start, start + SECOND, 100 * MS)
    run(loop, world, start + SECOND)
    held = len(wire.frames) + 1
    sent = 0

    def slow_read(most: int = 4096) -> bytes:
        data = read(most)
        if data:
            monkeypatch.setattr(wire, "read", read)
            world.now += hold_up
        return data

    def count(frame: CanFrame) -> None:
        nonlocal sent
        sent += shown(frame)[0] == held
        if sent == frames_before:
            world.bus.on_send = lambda _frame: None
            world.now += hold_up

    world.bus.sent.clear()
    if frames_before:
        world.bus.on_send = count
    else:
        monkeypatch.setattr(wire, "read", slow_read)
    wire.send(world.now, bundled=True)
    whole = wire.frames[-1]
    run(loop, world, world.now + 900 * MS)
    loop.close()
    found = [each for each in shown_of_all(world) if each[2] == held]
    early = [each for each in found if each[1] < whole + hold_up]
    assert len(early) == frames_before
    assert {can_id for can_id, *_ in found} == {message.can_id for message in MANY}
    for _, at, _, age in found:
        assert 0 <= at - whole - age * MS < 2 * MS


def test_bus_that_takes_only_some_frames_gets_the_others_later(
    monkeypatch: pytest.MonkeyPatch,
    core_language: str,
) -> None:
    """The kernel takes six of 25 frames at once. The others are sent before the next values."""
    world = World()
    (wire,) = world.wires
    start = world.now
    period = 50 * MS
    messages = MANY[:25]
    world.bus.frame_ns = 200_000
    layout = compiled(dbc_text(messages, TIMES.replace("20", "1000")))
    loop = loop_in(world, monkeypatch, [EscSettings("esc1")], layout)
    loop.open()
    loop.begin()
    wire.stream(start + 5 * MS, start + SECOND, period)
    run(loop, world, start + SECOND)
    status = loop.gateway.status
    loop.close()
    assert len(world.bus.sent) == status.sent_frames
    assert status.send_failures >= 19 * 3
    assert status.dropped_frames == 0
    found = list(shown_of_all(world))
    for number, whole in enumerate(wire.frames, 1):
        in_time = set()
        for can_id, at, shown_number, _ in found:
            if shown_number == number and at < whole + period // 2:
                in_time.add(can_id)
        assert in_time == {message.can_id for message in messages}
    if core_language == "C":
        assert cast("NativePoller", loop._poller).count > 500


@pytest.mark.promise("watchdog")
@pytest.mark.parametrize(
    "blind",
    [
        set(),
        {1000},
        {CAN_FD},
        {1000, CAN_FD},
    ],
)
def test_watchdog_is_fed_only_while_everything_is_served(
    monkeypatch: pytest.MonkeyPatch,
    blind: set[int],
) -> None:
    world = World()
    fed: list[int] = []
    signs = SimpleNamespace(is_present=True, watchdog_ns=500 * MS, ready=lambda _: None)
    signs.status = signs.ready
    signs.watchdog = lambda: fed.append(world.now)
    escs = (EscSettings("esc1", timeout_ns=60 * SECOND),)
    loop = loop_in(world, monkeypatch, escs, notifier=signs)  # type: ignore[arg-type]
    loop.open()
    loop.begin()
    begin = world.now
    run(loop, world, begin + 5 * SECOND)  # the line is silent, so the loop need not wake for it
    middle = world.now
    end = world.now + 10 * SECOND
    world.wires[0].stream(middle, end, 20 * MS)
    for at in range(middle, end, 50 * MS):
        world.bus.came(0x100, b"", at)
    run(loop, world, middle + 3 * SECOND)
    assert all(late - early <= 600 * MS for early, late in pairwise([begin, *fed, world.now]))
    world.blind = blind
    run(loop, world, end)
    loop.close()
    last = [at for at in fed if at > middle + 4200 * MS]
    if blind:
        assert len(last) == 0
    else:
        assert len(last) > 8


def test_bytes_received_while_the_interface_was_opened_are_old(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World()
    (wire,) = world.wires
    start = world.now
    world.there = False
    world.opening_ns = 400 * MS
    loop = begin(monkeypatch, world, EscSettings("esc1"))
    wire.stream(start + 410 * MS, start + 2 * SECOND, 100 * MS)
    run(loop, world, start + 2 * SECOND)
    world.there = True
    world.opening_ns = 100 * MS
    run(loop, world, start + 4 * SECOND)
    wire.send(world.now)
    run(loop, world, world.now + 50 * MS)
    loop.close()
    assert {number for _, number, _ in values(world)} == {len(wire.frames)}


def test_slow_bus_gets_the_newest_values_in_order(
    monkeypatch: pytest.MonkeyPatch,
    core_language: str,
) -> None:
    """The frames of four ESCs arrive together, and the kernel takes six frames in advance.

    The C core sends them in the background: hardly an iteration of the loop is needed for it.
    """
    world = World(4)
    start = world.now
    end = world.now + 3 * SECOND
    world.bus.frame_ns = 1_900_000
    for number, wire in enumerate(world.wires):
        wire.stream(start + number * 100_000, end, 10 * MS)
    loop = begin(monkeypatch, world, *[EscSettings(f"esc{n + 1}") for n in range(4)])
    turns = 0
    while world.now < end + 100 * MS:
        loop.turn()
        turns += 1
    status = loop.gateway.status
    assert len(world.bus.sent) == status.sent_frames
    assert status.send_failures > 100
    for esc in range(4):
        numbers = [shown(frame)[0] for _, frame in world.bus.sent if frame.can_id == 0x100 + esc]
        numbers = [number for number in numbers if number != NOT_AVAILABLE]
        assert numbers == sorted(numbers)
        assert numbers[-1] == len(world.wires[esc].frames)
        assert len(set(numbers)) > 0.7 * len(world.wires[esc].frames)
    if core_language == "C":
        assert turns < 0.1 * cast("NativePoller", loop._poller).count
    loop.close()


@pytest.mark.parametrize("clock_error_s", [-3600, 3600])
def test_frame_received_in_a_hold_up_has_its_true_age(
    monkeypatch: pytest.MonkeyPatch,
    clock_error_s: int,
) -> None:
    """The wall clock may be set meanwhile. The frame arrived between two checks of the bus."""
    world = World()
    shown_at = list[int]()
    loop = begin(monkeypatch, world, EscSettings("esc1"))

    def note_time(_frame: CanFrame, _now: int, at: int) -> None:
        shown_at.append(at)

    monkeypatch.setattr(loop.gateway, "receive_frame", note_time)
    world.bus.clock_error = clock_error_s * SECOND
    world.wires[0].stream(world.now, world.now + 2 * SECOND, 10 * MS)
    for _ in range(5):
        run(loop, world, world.now + 100 * MS)
        came = world.now + MS
        world.bus.came(0x80, b"", came)
        world.now += 200 * MS
        run(loop, world, world.now + 20 * MS)
        if clock_error_s < 0:
            assert came - 50 * MS < shown_at.pop() <= came
        else:
            assert came <= shown_at.pop() <= came + 220 * MS
    loop.close()


# --- the CAN side


HELD_UP_NS = 400 * MS
REQUEST = 0x601
ANSWER = 0x581
EMCY = 0x081
HEARTBEAT = 0x701
TPDO = 0x181
SPEED = 0x688
ZEROS = "00 00 00 00"
WATCH = ("23 16 10 01 2c 01 05 00", "2f 29 10 01 01 00 00 00", "2b 00 21 04 60 ea 00 00")
"""SDO requests: watch node 5 for 300 ms, keep the state at its loss, timeout of the ESC 60 s."""


class Bench:
    """A gateway with a running CANopen node 1, and telemetry of 100 Hz."""

    def __init__(self, patch: pytest.MonkeyPatch, opening_ns: int = 0) -> None:
        self.world = World()
        self.world.opening_ns = opening_ns
        canopen = {"enabled": True, "self_start": True, "store": "/nowhere"}
        loaded = assemble(parse({"canopen": canopen, "esc": [{"port": "p"}]}, "test"))
        self.layout = loaded.layout
        self.loop: Loop = loop_in(
            self.world, patch, loaded.escs, loaded.layout, outputs=loaded.outputs
        )
        self.wire = self.world.wires[0]
        self.loop.open()
        self.loop.begin()
        self.speed_until(SECOND)

    def speed_until(self, ns: int) -> None:
        self.wire.stream(self.world.now, self.world.now + ns, 10 * MS)
        self.run(ns)

    def run(self, ns: int) -> None:
        run(self.loop, self.world, self.world.now + ns)

    def ask(self, request: str) -> str:
        """Send an SDO request. Return the answer in hex."""
        self.take()
        self.world.bus.came(REQUEST, bytes.fromhex(request))
        self.run(20 * MS)
        (answer,) = [data for can_id, data in self.take() if can_id == ANSWER]
        return answer.hex(" ")

    def write(self, *requests: str) -> None:
        for request in requests:
            assert self.ask(request).startswith("60"), request

    def hold_up(self, ns: int = HELD_UP_NS) -> None:
        self.take()
        self.world.now += ns
        self.run(20 * MS)

    def take(self) -> list[tuple[int, bytes]]:
        return self.world.bus.take()

    @property
    def state(self) -> NmtState:
        state: NmtState = self.loop.gateway.node_states()[0][1]
        return state


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    made = Bench(monkeypatch)
    assert made.loop.gateway.status.state is GatewayState.RUNNING
    yield made
    made.loop.close()


def of(frames: list[tuple[int, bytes]], *ids: int) -> list[tuple[int, str]]:
    return [(can_id, data.hex(" ")) for can_id, data in frames if can_id in ids]


@pytest.mark.promise("late-frames")
@pytest.mark.parametrize(
    ("can_id", "request_hex", "answer_id", "answer", "state"),
    [
        (0x000, "02 01", 0, "", NmtState.STOPPED),
        (0x000, "80 00", 0, "", NmtState.PRE_OPERATIONAL),
        (0x000, "81 01", HEARTBEAT, "00", NmtState.OPERATIONAL),
        (0x000, "82 01", HEARTBEAT, "00", NmtState.OPERATIONAL),
        (REQUEST, f"40 00 10 00 {ZEROS}", ANSWER, f"43 00 10 00 {ZEROS}", NmtState.OPERATIONAL),
        (REQUEST, f"40 99 99 00 {ZEROS}", ANSWER, "80 99 99 00 00 00 02 06", NmtState.OPERATIONAL),
        (0x7E5, f"04 01 00 00 {ZEROS}", 0x7E4, f"5e 01 00 00 {ZEROS}", NmtState.OPERATIONAL),
    ],
)
def test_waiting_command_is_obeyed_and_answered_once(
    bench: Bench,
    can_id: int,
    request_hex: str,
    answer_id: int,
    answer: str,
    state: NmtState,
) -> None:
    bus = bench.world.bus
    now = bench.world.now
    bus.came(can_id, bytes.fromhex(request_hex), now + MS)
    if can_id == 0x7E5:
        bus.came(can_id, bytes.fromhex(f"5e 00 00 00 {ZEROS}"), now + 2 * MS)
    bench.hold_up()
    expected = [(answer_id, answer)] if answer else []
    assert of(bench.take(), HEARTBEAT, ANSWER, 0x7E4) == expected
    assert bench.state is state


def test_interface_that_opens_slowly_is_not_a_hold_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = Bench(monkeypatch, opening_ns=HELD_UP_NS)
    world = made.world
    assert of(made.take(), HEARTBEAT)[0] == (HEARTBEAT, "00")
    made.loop.can._lost(Sent.GONE, world.now)
    made.run(2 * SECOND)
    assert of(made.take(), HEARTBEAT)[0] == (HEARTBEAT, "00"), "the node boots again"
    assert "suspended" not in "".join(made.loop.conditions.recent)
    made.loop.close()


def test_waiting_syncs_are_counted_and_not_answered(bench: Bench) -> None:
    bench.write(
        "23 00 18 01 81 01 00 c0",  # 1800h:1: invalid
        "2f 00 18 02 02 00 00 00",  # at each second SYNC
        "23 00 18 01 81 01 00 40",
    )
    sync = 0x80
    for n in range(3):
        bench.world.bus.came(sync, b"", bench.world.now + (10 + 100 * n) * MS)
    bench.wire.stream(bench.world.now, bench.world.now + SECOND, 10 * MS)
    bench.hold_up()
    assert of(bench.take(), TPDO) == []
    bench.world.bus.came(sync)
    bench.run(10 * MS)
    assert len(of(bench.take(), TPDO)) == 1, "the fourth SYNC is even: waiting ones were counted"
    for expected in (0, 1):
        bench.world.bus.came(sync)
        bench.run(10 * MS)
        assert len(of(bench.take(), TPDO)) == expected


@pytest.mark.promise("heartbeats")
@pytest.mark.parametrize(
    ("came_ms", "codes"),
    [
        (range(50, 2000, 50), []),  # all the time, by the times of the kernel
        ([100, *range(700, 2000, 50)], ["3081", "0000"]),  # missing for 600 ms
        ([100, 200, 300], ["3081"]),
        ([], ["3081"]),
    ],
)
def test_heartbeats_are_judged_by_the_time_of_their_arrival(
    bench: Bench,
    came_ms: Iterable[int],
    codes: list[str],
) -> None:
    """The process is held up for the first second. More frames wait than one call reads."""
    bench.write(*WATCH)
    bench.world.bus.came(0x705, b"\x05")
    bench.run(10 * MS)
    abort = bytes((0x80, 0, 0, 0, 0, 0, 0, 0))
    frames = [(ms, REQUEST, abort) for ms in range(900)]
    frames += [(ms, 0x705, b"\x05") for ms in came_ms]
    start = bench.world.now
    for ms, can_id, data in sorted(frames):
        bench.world.bus.came(can_id, data, start + ms * MS)
    bench.hold_up(SECOND)
    bench.run(900 * MS)
    emergencies = [data for can_id, data in bench.take() if can_id == EMCY]
    assert [data[:2].hex() for data in emergencies] == codes


@pytest.mark.promise("late-frames")
def test_waiting_answers_are_kept_and_measurements_are_computed_again(bench: Bench) -> None:
    bus = bench.world.bus
    bench.write(*WATCH)  # no loss of telemetry causes a frame
    bus.answer = Sent.BUSY
    for n in range(5):
        bus.came(REQUEST, bytes((0x40, n, 0x99, 0, 0, 0, 0, 0)))
    bench.speed_until(50 * MS)
    old = len(bench.wire.frames)
    assert len(bench.loop.can.transmitter.queue) > 5
    bench.loop.can.transmitter.queue.put_all([CanFrame(0x123, b"old")])
    bus.take()
    bus.answer = Sent.OK
    bench.world.now += HELD_UP_NS
    bench.wire.send(bench.world.now - 10 * MS)
    bench.loop.turn()
    sent = bench.take()
    assert [data[1] for can_id, data in sent if can_id == ANSWER] == list(range(5))
    speeds = {int.from_bytes(data[:3], "little") for can_id, data in sent if can_id == SPEED}
    assert speeds == {old + 1}
    dbc = {message.can_id for message in bench.layout.messages if message.cycle_ns <= HELD_UP_NS}
    sent_ids = {can_id for can_id, _ in sent}
    assert dbc <= sent_ids, "dropped messages are computed again immediately"
    assert 0x123 not in sent_ids, "a frame without a replacement is dropped too"


def test_hold_up_within_a_turn_discards_values_but_no_answers(
    bench: Bench,
) -> None:
    world = bench.world
    seen: list[object] = []

    def stop_once(frame: object) -> None:
        if not seen:
            world.now += 10 * SECOND
        seen.append(frame)

    for n in range(5):
        world.bus.came(REQUEST, bytes((0x40, n, 0x99, 0, 0, 0, 0, 0)))
    bench.wire.send(world.now - 5 * MS)
    number = len(bench.wire.frames)
    bench.take()
    world.bus.on_send = stop_once
    bench.run(20 * MS)
    bench.run(20 * MS)
    sent = [(at, frame.can_id, frame.data) for at, frame in world.bus.sent]
    late = [(can_id, data) for at, can_id, data in sent if at > world.now - SECOND]
    assert [data[1] for _, can_id, data in sent if can_id == ANSWER] == list(range(5))
    late_speeds = [int.from_bytes(data[:3], "little") for can_id, data in late if can_id == SPEED]
    assert number not in late_speeds
    assert late_speeds, "a frame that marks the value as not available is sent"


LOST = "1075"
UNDERVOLTAGE = "2032"
SYNC_LENGTH = "4082"
HEARTBEAT_LOST = "3081"


def emergencies(bench: Bench) -> list[str]:
    """Return the codes of the emergencies that were sent, in the byte order of the bus."""
    return [data[:2].hex() for can_id, data in bench.take() if can_id == EMCY]


@pytest.mark.parametrize(
    ("came_ms", "codes"),
    [(100, [SYNC_LENGTH, LOST]), (380, [LOST, SYNC_LENGTH])],
)
def test_emergencies_of_a_hold_up_are_sent_in_order_of_time(
    bench: Bench,
    came_ms: int,
    codes: list[str],
) -> None:
    """Telemetry ends when the hold-up begins, and is lost 250 ms later."""
    bench.world.bus.came(0x80, b"\x01", bench.world.now + came_ms * MS)
    bench.hold_up()
    assert emergencies(bench) == codes
    history = [bench.ask(f"40 03 10 0{sub} {ZEROS}")[12:17] for sub in (1, 2)]
    assert [each.replace(" ", "") for each in history] == codes[::-1]


def test_error_of_the_esc_in_a_hold_up_precedes_the_loss(bench: Bench) -> None:
    """The frames that waited are younger than the timeout. The frame before them is older."""
    start = bench.world.now
    wire = bench.wire
    for at in range(10, 300, 10):
        data = codec.encode(LiveData(operating_errors=1 << 0), codec.WireLayout.V4)
        first = start + at * MS
        wire.put(data, [first + n * NS_PER_BYTE for n in range(1, len(data) + 1)])
    bench.hold_up(300 * MS)
    sent = emergencies(bench)
    assert sent[:2] == [UNDERVOLTAGE, LOST]


def test_heartbeat_that_arrived_late_precedes_the_loss(bench: Bench) -> None:
    bench.write(WATCH[1], "23 16 10 01 64 00 05 00")  # node 5: 100 ms
    bench.world.bus.came(0x705, b"\x05")
    bench.speed_until(20 * MS)
    bench.world.bus.came(0x705, b"\x05", bench.world.now + 350 * MS)
    bench.hold_up()
    assert emergencies(bench)[:2] == [HEARTBEAT_LOST, LOST]


def test_loss_is_reported_before_the_node_stops_because_of_it(bench: Bench) -> None:
    bench.write("2f 29 10 02 02 00 00 00")  # 1029h:2: STOPPED
    bench.run(SECOND)
    assert emergencies(bench) == [LOST]
    assert bench.state is NmtState.STOPPED


def test_loss_that_a_hold_up_hides_is_logged_between_the_two_good_states(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Loss and return are found in one iteration, so the link's state is the same after it."""
    world = World()
    start = world.now
    world.wires[0].stream(start, start + 3 * SECOND, 10 * MS)
    loop = loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    run(loop, world, start + SECOND)
    held_up = iter([300 * MS])
    world.hold_up = lambda: next(held_up, 0)
    run(loop, world, start + 3 * SECOND)
    loop.close()
    assert loop.gateway.escs[0].losses == 1
    lines = [line.partition(" esc1: telemetry ")[2] for line in loop.conditions.recent]
    assert [line.partition(" (")[0] for line in lines if line] == [
        "ok",
        "was lost for a moment; its values were marked as not available",
        "ok",
    ]


def test_end_of_a_loop_is_logged_with_reason_and_totals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World()
    start = world.now
    world.wires[0].stream(start, start + SECOND, 10 * MS)
    loop = loop_in(world, monkeypatch)
    loop.open()
    loop.begin()
    run(loop, world, start + 2 * SECOND)
    loop.stop("stopped by SIGTERM")
    loop.end()
    sent = len(world.bus.sent)
    assert sent > 100
    expected = (
        "stopped by SIGTERM after 2.0 s: 100 live frames received, 0 CRC errors, "
        f"telemetry lost 1 time; {sent} CAN frames sent, 0 dropped, bus-off 0 times"
    )
    assert loop.conditions.recent[-1].endswith(expected)


def test_fault_of_the_program_is_logged_in_the_last_line(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()
    loop = loop_in(world, monkeypatch)
    loop.open()

    def fail() -> None:
        raise ZeroDivisionError("x")

    monkeypatch.setattr(loop, "turn", fail)
    with pytest.raises(ZeroDivisionError):
        loop.run()
    expected = "ended by an internal error (ZeroDivisionError('x')) after"
    assert expected in loop.conditions.recent[-1]
