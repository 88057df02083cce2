"""The gate's machine: all states that can be reached, at times around each limit.

The environment is a bus with every fault: from each state, each event is tried just before, at and
after each time limit. Two states are the same if no condition of the table can tell them apart.
"""

import copy
import os
import random
from collections import deque
from collections.abc import Callable, Iterator

import pytest

from kontronik_can_gw.gateway import gate as module
from kontronik_can_gw.gateway.gate import Gate
from kontronik_can_gw.gateway.gate_table import (
    ANSWER_NS,
    HELD,
    LASTING_NS,
    NO_FIRST_NS,
    NO_PORT,
    PASSING,
    SETTLING_NS,
    SOON_NS,
    TABLE,
    UNLIMITED,
    WORKED_NS,
    Act,
    Row,
    State,
)
from kontronik_can_gw.times import MS, NEVER, SECOND

pytestmark = pytest.mark.promise("gate")

TIMEOUT = 200 * MS
RESTART_AFTER = SECOND // 2
MOST_STATES = int(os.environ.get("KCG_GATE_STATES", "2500"))
"""States that one run of the test explores. A larger number takes longer and finds more."""
FRAMES = 2
"""Frames that are accepted at once."""

Step = Callable[[Gate, int], None]


def clone(gate: Gate) -> Gate:
    copied = copy.copy(gate)
    copied.acts = []
    for name in ("limit", "first", "restart", "under_way"):
        setattr(copied, name, copy.copy(getattr(gate, name)))
    copied.under_way._accepted = copy.copy(gate.under_way._accepted)
    return copied


def limits(gate: Gate) -> dict[str, int]:
    """Return the times at which a condition of the table changes."""
    found = {
        "late": gate.under_way.oldest + TIMEOUT // 4 + 1,
        "blocked": gate.still_since + TIMEOUT * 7 // 8,
        "stands": gate.still_since + LASTING_NS,
        "quarter": gate.limit.quarter_due,
        "outage": gate.outage_since + LASTING_NS,
        "no first": gate.outage_since + NO_FIRST_NS,
        "ask": gate.restart_due,
        "answer": gate.restart.asked + ANSWER_NS,
        "discard": gate.discarded + LASTING_NS,
        "worked": gate.restart.works_since + WORKED_NS,
        "settled": gate.runs_since + SETTLING_NS + 1,
        "retry": gate.retry_due,
        "look": gate.look_due,
    }
    if gate.refused_since is not None:
        found["refused"] = gate.refused_since + LASTING_NS
    if gate.first.at is not None:
        found["repeat"] = gate.first.at + LASTING_NS
        found["soon"] = gate.first.at + SOON_NS
    if gate.first.moves_since is not None:
        found["moved"] = gate.first.moves_since + SOON_NS
        found["slowly"] = gate.first.moves_since + TIMEOUT // 4 + 1
    return {name: at for name, at in found.items() if abs(at) < NEVER // 2}


def key_of(gate: Gate, now: int) -> tuple[object, ...]:
    """Return all that conditions can tell apart. Times count by the limits that have passed."""
    passed = frozenset(name for name, at in limits(gate).items() if now >= at)
    limit = gate.limit.frames
    return (
        *(gate.state, gate.is_held, gate.is_quiet, gate.is_off, gate.stays_off, gate.is_stalled),
        *(gate.is_slow, gate.is_socket, gate.under_way.count > 0, bool(gate.queued)),
        min(gate.under_way.frames, 3),
        *(gate.limit.takes_long, limit if limit in (1, 2, UNLIMITED - 1, UNLIMITED) else 3),
        *(gate.first.is_missing, gate.first.at is None, gate.first.moves_since is None),
        gate.first.count <= gate.under_way.count,
        *(gate.restart.is_awaited, gate.restart.asked > 0, min(gate.restart.count, 1)),
        passed,
    )


def _move(frames: int, queued: int) -> Step:
    def look(gate: Gate, now: int) -> None:
        gate.look(gate.under_way.count + frames, queued, now)

    return look


EVENTS: dict[str, Step] = {
    "opening": lambda gate, now: gate.opening(now),
    "opened": lambda gate, now: gate.opened(7, now),
    "opened, uncounted": lambda gate, now: gate.opened(0, now),
    "opened, no socket": lambda gate, now: gate.opened(7, now, is_socket=False),
    "lost": lambda gate, now: gate.lost(False, now),
    "down": lambda gate, now: gate.lost(True, now),
    "bus-off": lambda gate, now: gate.bus_off(False, now),
    "bus-off, stays": lambda gate, now: gate.bus_off(True, now),
    "controller stands": lambda gate, now: _use(gate.left_bus_off(False, True, now)),
    "controller runs": lambda gate, now: _use(gate.left_bus_off(True, True, now)),
    "controller ready": lambda gate, now: _use(gate.left_bus_off(True, False, now)),
    "all left": lambda gate, now: gate.look(
        gate.under_way.count + max(1, gate.under_way.frames), 0, now
    ),
    "one left": _move(1, 0),
    "one left, one waits": _move(1, 1),
    "count of others": _move(5, 1),
    "stood still": _move(0, 0),
    "reset": lambda gate, now: gate.look(1, 0, now),
    "request": lambda gate, now: gate.request(now),
    "quiet": lambda gate, now: gate.quiet(True, now),
    "telemetry": lambda gate, now: gate.quiet(False, now),
    "suspended": lambda gate, now: gate.suspended(now),
    "stop": lambda gate, now: gate.stop(now),
    "time": lambda gate, now: gate.advance(now),
}


def _use(_result: bool) -> None:
    """Ignore a result. The gate's state shows it."""


def handed_over(gate: Gate, now: int) -> Iterator[tuple[str, Step]]:
    """Yield the events that follow from a frame that may be handed over now."""
    if gate.wants_first_frame(now):
        yield "first frame", lambda gate, now: gate.accepted_first(now)
        yield "no first frame", lambda gate, now: gate.no_first_frame(now)
    if gate.wants_first_frame(now) or gate.room(now):
        yield "busy", lambda gate, now: gate.refused(False, now)
        yield "full", lambda gate, now: gate.refused(True, now)
    if gate.room(now):
        frames = min(gate.room(now), FRAMES)
        yield "accepted", lambda gate, now: gate.accepted(frames, now)


def events_of(gate: Gate, now: int) -> Iterator[tuple[str, Step]]:
    """Yield the events that are possible in a state."""
    is_shut = gate.state in (State.CLOSED, State.OPENING, State.LOST)
    of_open = {"lost", "down", "bus-off", "bus-off, stays", "all left", "one left", "reset"}
    of_open |= {"one left, one waits", "count of others", "stood still", "request"}
    of_off = {"controller stands", "controller runs", "controller ready"}
    for name, step in EVENTS.items():
        if name in of_off and not gate.is_off:
            continue
        if name in of_open - {"lost", "down"} and gate.is_off:
            continue
        if name in of_open and is_shut and name != "lost":
            continue
        if name.startswith("open") and not is_shut:
            continue
        yield name, step
    yield from handed_over(gate, now)


def check(before: Gate, gate: Gate, now: int) -> None:
    """Check the invariants after an event."""
    room = gate.room(now)
    assert not room or gate.state in PASSING, "nothing is handed over while held"
    if gate.state is State.SLOW:
        assert room <= gate.limit.frames
        assert room or gate.under_way.frames, "one frame is always allowed"
    assert not (gate.wants_first_frame(now) and gate.is_quiet), "no first frame in quiet mode"
    assert gate.is_held >= (gate.state in HELD and gate.state not in NO_PORT)
    assert not (gate.is_held and gate.state in PASSING)
    if Act.ASK in gate.acts:
        assert now - before.outage_since >= RESTART_AFTER, "no restart while frames leave"
        assert not gate.is_quiet or before.under_way.frames, "nothing else is restarted then"
    if gate.state in HELD and gate.state not in NO_PORT and gate.state is not State.QUIET_BLOCKED:
        assert gate.due <= now + LASTING_NS, "every wait has a deadline"
    if gate.state is State.SLOW:
        assert gate.due <= max(now, gate.limit.quarter_due)


def recover(gate: Gate, now: int) -> int:
    """Let everything work. Return how long it takes until frames pass, in ns."""
    begin = now
    if gate.state in (State.CLOSED, State.OPENING, State.LOST):
        gate.opened(7, now)
    if gate.is_off:
        gate.left_bus_off(True, False, now)
    gate.quiet(False, now)
    while gate.state not in PASSING:
        assert now - begin < 3 * SECOND, gate.state
        gate.advance(now)
        if gate.must_look(now):
            gate.look(gate.under_way.count + gate.under_way.frames, 0, now)
        if gate.wants_first_frame(now):
            gate.accepted_first(now)
        now += MS
    return now - begin


@pytest.mark.promise("unstoppable")
def test_all_states_that_can_be_reached_keep_the_invariants(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows: set[Row] = set()
    pairs: set[tuple[Row, Row]] = set()
    follow = Gate._follow
    last: dict[int, Row] = {}

    def note(gate: Gate, row: Row, now: int) -> None:
        rows.add(row)
        before = last.get(id(gate))
        if before is not None:
            pairs.add((before, row))
        last[id(gate)] = row
        follow(gate, row, now)

    monkeypatch.setattr(Gate, "_follow", note)
    seen, transitions, slowest = _explore(last)
    print(
        f"{len(seen)} states, {transitions} transitions, {len(rows)} of {len(TABLE)} rows, "
        f"{len(pairs)} pairs of rows; frames pass again within {slowest / SECOND:.2f} s"
    )
    assert len(rows) >= 50
    if len(seen) < MOST_STATES:
        assert rows == set(TABLE), [row for row in TABLE if row not in rows]


def _explore(last: dict[int, Row]) -> tuple[set[tuple[object, ...]], int, int]:
    """Return the states, the number of transitions, and the slowest recovery.

    Half of the states are taken in the order in which they were found, the others are the newest.
    """
    first = Gate(TIMEOUT, RESTART_AFTER)
    now = 100 * SECOND
    seen = {key_of(first, now)}
    queue: deque[tuple[Gate, int, Row | None]] = deque([(first, now, None)])
    transitions = 0
    slowest = 0
    chance = random.Random(0)
    while queue and len(seen) < MOST_STATES:
        gate, now, row = queue.popleft() if chance.random() < 0.5 else queue.pop()
        times = {now}
        for limit in limits(gate).values():
            times |= {each for each in (limit - 1, limit, limit + 1) if each > now}
        for later in sorted(times):
            for _, step in events_of(gate, later):
                after = clone(gate)
                if row is not None:
                    last[id(after)] = row
                step(after, later)
                check(gate, after, later)
                transitions += 1
                followed = last.pop(id(after), None)
                key = key_of(after, later)
                after.acts.clear()
                if key not in seen:
                    seen.add(key)
                    slowest = max(slowest, recover(clone(after), later))
                    queue.append((after, later, followed))
    return seen, transitions, slowest


def test_a_count_of_0_blocks_nothing() -> None:
    """There are drivers that do not count."""
    gate = Gate(TIMEOUT)
    gate.opened(0, 0)
    gate.accepted(1, 0)
    gate.look(0, 0, SECOND)
    assert gate.state is State.OPEN


def test_the_limit_of_a_slow_bus_halves_and_grows() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(8, 0)
    gate.look(8, 0, 51 * MS)
    assert gate.state is State.SLOW
    assert gate.limit.frames == 3
    assert gate.room(51 * MS) == 0, "a frame is late"
    gate.look(15, 0, 60 * MS)
    assert gate.room(60 * MS) == 3
    gate.advance(101 * MS)
    assert gate.limit.frames == 4
    gate.accepted(4, 101 * MS)
    gate.look(16, 0, 152 * MS)
    gate.advance(152 * MS)
    assert gate.limit.frames == 2
    gate.look(19, 0, 160 * MS)
    now = 160 * MS
    while gate.state is State.SLOW:
        now += 50 * MS
        gate.advance(now)
    assert gate.room(now) == UNLIMITED
    assert now < 2 * SECOND


def test_frames_of_another_program_do_not_count_as_own_departures() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(2, 0)
    gate.look(50, 2, 51 * MS)
    assert gate.state is State.SLOW
    assert module.POLL_NS <= 2 * MS
