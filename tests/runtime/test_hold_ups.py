"""What a process that was held up shows: no value is older than its time-out, and none that is fresh is lost."""

import random
from bisect import bisect_left
from collections.abc import Iterator
from itertools import pairwise
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from wire_world import CAN_FD, NOT_AVAILABLE, World, layout_of, loop_in, run

from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.native_poller import NativePoller

NS_PER_BYTE = KONTRONIK.byte_ns


def shown(frame: CanFrame) -> tuple[int, int]:
    """(number of the ESC's frame, age in ms)."""
    return int.from_bytes(frame.data[:4], "little"), int.from_bytes(frame.data[4:6], "little")


def values(world: World, esc: int = 0) -> Iterator[tuple[int, int, int]]:
    """(time, number, age in ms) of what was sent while there was a value."""
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


@settings(max_examples=25, deadline=None, phases=[Phase.generate])  # a seed cannot be made simpler
@given(
    st.integers(0, 2**32),
    st.sampled_from([20, 60, 100, 250, 1000]),
    st.sampled_from([8, 10, 20, 50]),
    st.sampled_from([0, 0.002, 0.05]),
    st.booleans(),
    st.booleans(),
)
def test_whatever_holds_the_process_up_values_end_in_time_and_ages_are_true(
    seed: int, timeout_ms: int, period_ms: int, stops: float, neighbour: bool, bundled: bool
) -> None:
    rng = random.Random(seed)
    world = World(1 + neighbour)
    wire, start = world.wires[0], world.now
    timeout, period = timeout_ms * MS, period_ms * MS
    escs = (EscSettings("esc1", timeout_ns=timeout), TWO[1])[: 1 + neighbour]
    at = start + rng.randrange(period)
    while at < start + 4 * SECOND:
        wire.send(at, bundled)
        gap = rng.random() < 0.01
        at += max(4 * MS, period + (rng.randrange(2 * timeout) if gap else rng.randrange(-MS, MS)))
    if neighbour:
        world.wires[1].stream(start, start + 4 * SECOND, 17 * MS)
    world.hold_up = lambda: (
        rng.randrange(400 * MS) if rng.random() < stops else rng.randrange(MS // 10)
    )
    with pytest.MonkeyPatch.context() as patch:
        loop = loop_in(world, patch, escs, LAYOUTS[len(escs)])
        loop.open()
        loop.begin()
        lost: list[tuple[int, int]] = []
        while world.now < start + 5 * SECOND:
            losses = loop.gateway.escs[0].losses
            loop.turn()
            lost += [(world.now, world.looks[-2])] * (loop.gateway.escs[0].losses - losses)
        loop.close()
    for sent, number, age in values(world):
        truth = sent - wire.frames[number - 1]
        if bundled:  # what the adapter held back came sooner than the wire allows
            truth -= 40 * NS_PER_BYTE
        assert truth <= timeout
        # ages are shown in whole ms, the period has jitter
        assert (age + 1) * MS >= truth - period - 2 * MS
    for when, looked in lost:
        # none is given up earlier than by the time between the two looks between which it came
        newest = max(whole for whole in wire.frames if whole <= looked)
        look = bisect_left(world.looks, newest)
        between = world.looks[look] - world.looks[look - 1]
        assert when - newest >= timeout - between
        assert stops or between <= timeout // 4


@pytest.mark.parametrize("sends", [True, False])
def test_the_loop_looks_at_its_ports_four_times_within_the_shortest_time_out_whatever_a_master_makes_of_it(
    monkeypatch: pytest.MonkeyPatch, sends: bool
) -> None:
    """No message wakes it besides, and no more often than that."""
    world = World(2)
    escs = (EscSettings("esc1", timeout_ns=SECOND), EscSettings("esc2"))
    loop = loop_in(world, monkeypatch, escs, Layout("", "", ()))
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


def test_what_waited_beyond_one_read_is_dated_by_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World()
    (wire,) = world.wires
    start = world.now
    loop = begin(monkeypatch, world, EscSettings("esc1", timeout_ns=20 * SECOND))
    wire.stream(start, start + 8 * SECOND, 40 * NS_PER_BYTE)  # without a pause: 83 kB
    world.now += 9 * SECOND
    for _ in range(24):
        loop.turn()
    esc = loop.gateway.escs[0]
    loop.close()
    assert wire.waiting == 0
    assert abs(wire.frames[-1] - esc.live_bound_ns) <= NS_PER_BYTE


def test_a_port_that_always_has_bytes_keeps_no_other_one_waiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A megabyte waits at one, of which 4 KiB take the process a millisecond; each frame of the other is shown two reads later at most."""
    world = World(2)
    flooded, usual = world.wires
    start, read = world.now, flooded.read

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
    assert all(first[n + 1] - whole <= 2 * MS for n, whole in enumerate(usual.frames))


@pytest.mark.parametrize("blind", [set(), {1000}, {CAN_FD}, {1000, CAN_FD}])
def test_the_watchdog_is_fed_while_all_is_served_and_no_longer(
    monkeypatch: pytest.MonkeyPatch, blind: set[int]
) -> None:
    world = World()
    fed: list[int] = []
    signs = SimpleNamespace(present=True, watchdog_ns=500 * MS, ready=lambda _: None)
    signs.status, signs.watchdog = signs.ready, lambda: fed.append(world.now)
    escs = (EscSettings("esc1", timeout_ns=60 * SECOND),)
    loop = loop_in(world, monkeypatch, escs, notifier=signs)  # type: ignore[arg-type]
    loop.open()
    loop.begin()
    begin = world.now
    run(loop, world, begin + 5 * SECOND)  # on a silent line, for which the loop need not wake
    middle, end = world.now, world.now + 10 * SECOND
    world.wires[0].stream(middle, end, 20 * MS)
    for at in range(middle, end, 50 * MS):
        world.bus.came(0x100, b"", at)
    run(loop, world, middle + 3 * SECOND)
    assert all(late - early <= 600 * MS for early, late in pairwise([begin, *fed, world.now]))
    world.blind = blind
    run(loop, world, end)
    loop.close()
    last = [at for at in fed if at > middle + 4200 * MS]
    assert len(last) == 0 if blind else len(last) > 8


def test_bytes_that_came_while_the_interface_was_tried_are_old(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = World()
    (wire,) = world.wires
    start = world.now
    world.there, world.opening_ns = False, 400 * MS
    loop = begin(monkeypatch, world, EscSettings("esc1"))
    wire.stream(start + 410 * MS, start + 2 * SECOND, 100 * MS)
    run(loop, world, start + 2 * SECOND)
    world.there, world.opening_ns = True, 100 * MS
    run(loop, world, start + 4 * SECOND)
    wire.send(world.now)
    run(loop, world, world.now + 50 * MS)
    loop.close()
    assert {number for _, number, _ in values(world)} == {len(wire.frames)}


def test_a_bus_that_is_slower_than_what_comes_has_the_newest_values_in_order(
    monkeypatch: pytest.MonkeyPatch, core_language: str
) -> None:
    """Four ESCs whose frames come together; the kernel takes six frames in advance. In C hardly a turn comes back for it."""
    world = World(4)
    start, end = world.now, world.now + 3 * SECOND
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


def test_a_frame_that_came_in_a_hold_up_is_as_old_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However the wall clock was set meanwhile: it came between the two looks at the bus."""
    world, shown_at = World(), list[int]()
    loop = begin(monkeypatch, world, EscSettings("esc1"))
    monkeypatch.setattr(loop.gateway, "receive_frame", lambda _frame, _now, at: shown_at.append(at))
    world.bus.clock_error = -3600 * SECOND
    world.wires[0].stream(world.now, world.now + 2 * SECOND, 10 * MS)
    for _ in range(5):
        run(loop, world, world.now + 100 * MS)
        came = world.now + MS
        world.bus.came(0x80, b"", came)
        world.now += 200 * MS
        run(loop, world, world.now + 20 * MS)
        assert came - 50 * MS < shown_at.pop() <= came
    loop.close()
