"""Explores all states of the gate that can be reached, with every event of a faulty bus.

Many states differ only in times and numbers. They count as one if these are equal:

1. which limits of time have passed, and which is next, of those that the state's rows read;
2. the number of frames under way: 0, 1 or more; their limit: 1, 2, more or 31;
3. each flag that the state reads or hands to a later state.

So the number of states is finite. From each one, every event is tried at once, just before, at and
just after the next limit, and after a suspension in which all limits pass. Time passes for the gate
after each event, as in an iteration of the loop.
"""

import copy
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

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
    UNLIMITED,
    WORKED_NS,
    Act,
    Row,
    State,
)
from kontronik_can_gw.gateway.under_way import UNCOUNTED
from kontronik_can_gw.times import MS, NEVER, SECOND

TIMEOUT = 200 * MS
RESTART_AFTER = SECOND // 2
FRAMES = 2
"""Frames that are accepted at once."""
BEGIN = 100 * SECOND

UNORDERED = ("discard", "retry", "answer")
"""Limits whose order does not count: they change nothing that another condition reads."""
_SHUT = (State.CLOSED, State.OPENING, State.LOST)

Step = Callable[[Gate, int], None]
Key = tuple[object, ...]
Path = tuple[tuple[int, str], ...]
"""Times and names of events."""


class NotedGate(Gate):
    """A gate that notes the rows that it follows. Its copies share the list."""

    def __init__(self, timeout_ns: int, restart_after_ns: int) -> None:
        super().__init__(timeout_ns, restart_after_ns)
        self.rows: list[Row] = []

    def _follow(self, row: Row, now: int) -> None:
        self.rows.append(row)
        super()._follow(row, now)


def clone(gate: NotedGate) -> NotedGate:
    copied = object.__new__(NotedGate)
    copied.__dict__.update(gate.__dict__)
    copied.acts = []
    for name in ("limit", "first", "restart", "under_way"):
        part = getattr(gate, name)
        copied_part = object.__new__(type(part))
        copied_part.__dict__.update(part.__dict__)
        setattr(copied, name, copied_part)
    copied.under_way._accepted = copy.copy(gate.under_way._accepted)
    return copied


def limits(gate: Gate) -> dict[str, int]:
    """Return the times at which a condition of the state's rows changes, or of a later state's."""
    state = gate.state
    found: dict[str, int] = {}
    first = gate.first
    restart = gate.restart
    if restart.is_awaited:
        found["answer"] = restart.asked + ANSWER_NS
    if state in PASSING:
        if gate.refused_since != NEVER:
            found["refused"] = gate.refused_since + LASTING_NS
        if state is not State.QUIET:
            found["late"] = gate.under_way.oldest + TIMEOUT // 4 + 1
        if gate.under_way.count != UNCOUNTED:
            found["blocked"] = gate.still_since + TIMEOUT * 7 // 8
        if restart.asked != -NEVER:
            found["worked"] = restart.works_since + WORKED_NS
    if state is State.SLOW:
        found["half"] = gate.limit_due
        if gate.limit.is_long:
            found["blocked"] = gate.still_since + LASTING_NS
    if state is State.BLOCKED:
        found["retry"] = gate.retry_due
        if not gate.is_socket and gate.refused_since != NEVER:
            found["refused"] = gate.refused_since + LASTING_NS
        if gate.under_way.frames:
            found["no first"] = gate.outage_since + NO_FIRST_NS
    if state in (State.FIRST, State.MOVING, State.RESTARTING):
        if first.at != NEVER:
            found["repeat"] = first.at + LASTING_NS
        if first.moves_since != NEVER:
            found["moved"] = first.moves_since + SOON_NS
            found["slowly"] = first.moves_since + TIMEOUT // 4 + 1
    if state in HELD and state not in NO_PORT:
        if not gate.is_stalled or state is State.MOVING:
            found["outage"] = gate.outage_since + LASTING_NS
        if state is not State.QUIET_BLOCKED:
            found["discard"] = gate.discarded + LASTING_NS
    if state in HELD and state is not State.RESTARTING and state not in _SHUT:
        found["ask"] = gate.restart_due
    if state is State.SETTLING:
        found["settled"] = gate.runs_since + SETTLING_NS + 1
    return {name: at for name, at in found.items() if abs(at) < NEVER // 2}


def key_of(gate: Gate, now: int) -> Key:
    """Return the data that conditions can tell apart later."""
    state = gate.state
    times = limits(gate)
    restart = gate.restart
    passed = frozenset(name for name, at in times.items() if now >= at and name != "answer")
    ahead = [(at, name) for name, at in times.items() if now < at and name not in UNORDERED]
    order = min(ahead)[1] if ahead else ""
    is_awaited = restart.is_awaited and now <= restart.asked + ANSWER_NS
    key: list[object] = [state, gate.is_held, gate.is_quiet, gate.is_stalled]
    key += [is_awaited, restart.asked != -NEVER, min(restart.count, 1)]
    key += [passed, order]
    if state in _SHUT:
        return tuple(key)
    has_count = gate.under_way.count != UNCOUNTED
    key += [gate.is_socket, gate.is_off, gate.is_off and gate.stays_off, has_count]
    key += [gate.is_slow, gate.limit.is_long]
    key.append(gate.may_ask and gate.under_way.looked >= gate.restart_due)
    if state not in (State.BUS_OFF, State.SETTLING):
        key.append(min(gate.under_way.frames, 2))
    if state is State.SLOW:
        limit = gate.limit
        key.append(limit.frames if limit.frames in (1, 2, UNLIMITED - 1, UNLIMITED) else 3)
        key += [limit.late - limit.since >= LASTING_NS, limit.late > limit.changed]
    if state in (State.FIRST, State.MOVING, State.RESTARTING, State.BLOCKED):
        key += [bool(gate.queued), gate.first.is_missing, gate.first.at == NEVER]
        key.append(gate.first.moves_since == NEVER)
        key.append(gate.first.at != NEVER and gate.first.count <= gate.under_way.count)
    if state in PASSING and restart.asked != -NEVER and has_count:
        key.append(gate.under_way.count >= restart.works_count)
    return tuple(key)


def _move(frames: int, queued: int) -> Step:
    def look(gate: Gate, now: int) -> None:
        gate.look(gate.under_way.count + frames, queued, now)

    return look


def _let_grow(gate: Gate, now: int) -> None:
    """Let all frames leave, and time pass until the limit is the highest."""
    gate.look(gate.under_way.count + max(1, gate.under_way.frames), 0, now)
    while gate.limit.frames < UNLIMITED - 1:
        gate.limit.late = gate.limit.changed = now - TIMEOUT // 2
        gate.advance(now)


def _leave_bus_off(is_running: bool, is_reported: bool) -> Step:
    def leave(gate: Gate, now: int) -> None:
        gate.left_bus_off(gate.under_way.count, is_running, is_reported, now)

    return leave


_OPENINGS: dict[str, Step] = {
    "opening": lambda gate, now: gate.opening(now),
    "opened": lambda gate, now: gate.opened(7, now),
    "opened, uncounted": lambda gate, now: gate.opened(UNCOUNTED, now),
    "opened, no socket": lambda gate, now: gate.opened(UNCOUNTED, now, is_socket=False),
    "lost": lambda gate, now: gate.lost(False, now),
}
_OF_ALL: dict[str, Step] = {
    "quiet": lambda gate, now: gate.quiet(True, now),
    "telemetry": lambda gate, now: gate.quiet(False, now),
    "request": lambda gate, now: gate.request(now),
    "suspended": lambda gate, now: gate.suspended(now),
    "stop": lambda gate, now: gate.stop(now),
    "time": lambda gate, now: gate.advance(now),
}
_OF_SLOW: dict[str, Step] = {"all left, time passes": lambda gate, now: _let_grow(gate, now)}
_OF_OPEN: dict[str, Step] = {
    "lost": lambda gate, now: gate.lost(False, now),
    "down": lambda gate, now: gate.lost(True, now),
    "bus-off": lambda gate, now: gate.bus_off(False, now),
    "bus-off, stays": lambda gate, now: gate.bus_off(True, now),
}
_OF_OFF: dict[str, Step] = {
    "controller stands": _leave_bus_off(False, True),
    "controller runs": _leave_bus_off(True, True),
    "controller ready": _leave_bus_off(True, False),
}
_OF_COUNT: dict[str, Step] = {
    "all left": lambda gate, now: gate.look(
        gate.under_way.count + max(1, gate.under_way.frames), 0, now
    ),
    "one left": _move(1, 0),
    "one left, one waits": _move(1, 1),
    "count of others": _move(5, 1),
    "stood still": _move(0, 0),
    "stood still, one waits": _move(0, 1),
    "reset": lambda gate, now: gate.look(1, 0, now),
}
_OF_NO_COUNT: dict[str, Step] = {
    "looked": _move(0, 0),
    "looked, one waits": _move(0, 1),
}


def events_of(gate: NotedGate, now: int) -> Iterator[tuple[str, Step]]:
    """Yield the events that are possible in a state."""
    yield from _OF_ALL.items()
    if gate.state in _SHUT:
        yield from _OPENINGS.items()
        return
    yield from _OF_OPEN.items()
    if gate.is_off:
        yield from _OF_OFF.items()
        return
    yield from (_OF_NO_COUNT if gate.under_way.count == UNCOUNTED else _OF_COUNT).items()
    if gate.state is State.SLOW:
        yield from _OF_SLOW.items()
    yield from _handed_over(gate, now)


def _handed_over(gate: NotedGate, now: int) -> Iterator[tuple[str, Step]]:
    """Yield the events of frames that may be handed over. The owner lets time pass first."""
    ready = clone(gate)
    ready.rows = []
    ready.advance(now)
    has_room = ready.room(now) and ready.may_try(now)
    if ready.wants_first_frame(now):
        yield "first frame", _after_time(lambda gate, now: _accept_first(gate, 0, now))
        yield "first frame waits", _after_time(lambda gate, now: _accept_first(gate, 1, now))
        yield "no first frame", _after_time(lambda gate, now: gate.no_first_frame(now))
    if ready.wants_first_frame(now) or has_room:
        yield "busy", _after_time(lambda gate, now: gate.refused(False, now))
        yield "full", _after_time(lambda gate, now: gate.refused(True, now))
    if has_room:
        frames = min(ready.room(now), FRAMES)
        yield "accepted", _after_time(lambda gate, now: gate.accepted(frames, now))


def _accept_first(gate: Gate, queued: int, now: int) -> None:
    """Accept the first frame, and look, as the owner does."""
    gate.accepted_first(now)
    gate.look(gate.under_way.count, queued, now)


def _after_time(step: Step) -> Step:
    def advance_and_step(gate: Gate, now: int) -> None:
        gate.advance(now)
        step(gate, now)

    return advance_and_step


@dataclass
class Found:
    """A state that was found."""

    gate: NotedGate
    now: int
    row: Row | None = None
    """The last row that was followed."""
    before: "Found | None" = None
    event: str = ""
    """The event that led to the state."""

    @property
    def path(self) -> Path:
        """The events from the beginning to this state."""
        return () if self.before is None else (*self.before.path, (self.now, self.event))


@dataclass
class Exploration:
    """All states that can be reached, and the rows that were followed."""

    states: set[Key] = field(default_factory=set)
    transitions: int = 0
    rows: dict[Row, Path] = field(default_factory=dict)
    """The rows that were followed, with a shortest path to each."""
    pairs: dict[tuple[Row, Row], Path] = field(default_factory=dict)
    """The pairs of rows that were followed in a row, with a shortest path to each."""
    is_complete: bool = False


def explore(
    check: Callable[[Gate, int], None], recover: Callable[[Gate, int], None], most: int
) -> Exploration:
    """Explore until no state is new, or ``most`` states are found.

    ``check`` is called with the gate after each event, and ``recover`` with a copy of each state.
    """
    result = Exploration()
    gate = NotedGate(TIMEOUT, RESTART_AFTER)
    rows = gate.rows
    queue = deque([Found(gate, BEGIN)])
    while queue and len(result.states) < most:
        found = queue.popleft()
        gate, now = found.gate, found.now
        ahead = [at for at in limits(gate).values() if at > now]
        after = min(ahead, default=now + 1)
        suspended = max(ahead, default=now) + 1
        for at in sorted({now, after - 1, after, after + 1, suspended}):
            for event, step in events_of(gate, at):
                next_gate = clone(gate)
                rows.clear()
                step(next_gate, at)
                next_gate.advance(at)
                check(next_gate, at)
                if Act.WORKED in next_gate.acts:
                    next_gate.restart.count = 0  # as the owner does
                result.transitions += 1
                followed = [found.row, *rows] if found.row else rows.copy()
                last = followed[-1] if followed else None
                each = Found(next_gate, at, last, found, event)
                for row in rows:
                    if row not in result.rows:
                        result.rows[row] = each.path
                for pair in pairwise(followed):
                    if pair not in result.pairs:
                        result.pairs[pair] = each.path
                key = key_of(next_gate, at)
                if key not in result.states:
                    next_gate.acts.clear()
                    result.states.add(key)
                    queue.append(each)
                    recover(clone(next_gate), at)
    result.is_complete = not queue
    return result
