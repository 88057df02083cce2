"""The gate to the bus: decides whether a frame may leave. Pure: times and counts are passed in.

Each method for an event takes it over and appends to ``acts`` the work for the owner, which it
must do in this order. Between two events these questions are answered:

1. ``room``: how many frames may be handed over?
2. ``wants_first_frame``: must a frame without measurements be handed over now?
3. ``look_due``: when must the interface's count be passed to ``look``?
4. ``due``: when must ``advance`` be called? Earlier calls do no harm. A later call acts late.

The states and events are the table ``TABLE`` of gate_table.py. docs/design.md shows it.
"""

from typing import Any

from kontronik_can_gw.gateway.gate_rules import CHANGES, TESTS
from kontronik_can_gw.gateway.gate_state import FirstFrame, GateState, Limit
from kontronik_can_gw.gateway.gate_table import (
    ANSWER_NS,
    HELD,
    LASTING_NS,
    NO_PORT,
    NOT_SLOW,
    SOON_NS,
    TABLE,
    WAITING,
    Event,
    Row,
    State,
)
from kontronik_can_gw.times import MS, NEVER

POLL_NS = 2 * MS
"""Time between two looks while frames are limited, and between two attempts on a busy port."""
_NO_ROWS: tuple[Row, ...] = ()
_CLOSELY = (State.SLOW, State.MOVING, State.FIRST)
"""States in which the interface's count is looked at every POLL_NS, in FIRST only at its begin."""


def _rows() -> dict[tuple[State, Event], tuple[Row, ...]]:
    found: dict[tuple[State, Event], tuple[Row, ...]] = {}
    for row in TABLE:
        for state in row.states:
            key = (state, row.event)
            found[key] = (*found.get(key, ()), row)
    return found


_ROWS = _rows()


class Gate(GateState):
    """The way to the bus.

    ``restart_after_ns`` is the time after which a restart of a hung interface is requested, or 0.
    """

    # --- events of the interface

    def opening(self, now: int) -> None:
        """Follow a thread that has begun to open the interface."""
        self._step(Event.OPENING, now)

    def opened(self, count: int, now: int, is_socket: bool = True) -> None:
        """Follow an interface that was opened. ``count``: its sent frames, or UNCOUNTED."""
        self.is_socket = is_socket
        self.is_off = False
        self._forget()
        self.under_way.count = count
        self.outage_since = now
        self._step(Event.OPENED, now)

    def lost(self, is_down: bool, now: int) -> None:
        """Follow an interface that was set down, was removed or cannot be opened."""
        self.is_off = False
        self._forget()
        if not is_down or now - self.restart.asked > ANSWER_NS:
            self.restart.is_awaited = False
        self._step(Event.LOST, now)

    def bus_off(self, stays: bool, now: int) -> None:
        """Follow the begin of a bus-off. ``stays``: it does not end by itself."""
        self.stays_off = stays
        if not self.is_off:
            self.is_off = True
            self._forget()
            self.outage_since = now
            self._step(Event.BUS_OFF, now)

    def left_bus_off(self, count: int, is_running: bool, is_reported: bool, now: int) -> bool:
        """Follow a controller that reports the end of a bus-off. Returns True if it can be used.

        ``count``: its sent frames, or UNCOUNTED. ``is_running``: its queue runs. ``is_reported``:
        its driver still reports bus-off.
        """
        if not self.is_off:
            return True
        self.under_way.count = count
        if not is_running:
            self._step(Event.STOPPED, now)
        elif is_reported:
            self._step(Event.RUNS, now)
        else:
            self._step(Event.READY, now)
        if not self.is_off:
            self.outage_since = now
        return not self.is_off

    # --- events of frames

    def accepted(self, frames: int, now: int) -> None:
        """Note frames that the interface has accepted."""
        self.refused_since = NEVER
        self.retry_due = NEVER
        under_way = self.under_way
        if not under_way.frames:
            self.still_since = now
            self.next_look = min(self.next_look, now + self.period_ns)
        under_way.add(frames, now)
        if self.state is not State.OPEN:
            self._step(Event.ACCEPTED, now)

    def refused(self, is_full: bool, now: int) -> None:
        """Note that the interface is busy. ``is_full``: it reports when there is room."""
        self.refused_since = min(self.refused_since, now)
        if self.state is State.BLOCKED:
            self.retry_due = now + self.quarter_ns
        elif is_full:
            self.retry_due = max(now, self.refused_since + LASTING_NS)
        else:
            self.retry_due = now + POLL_NS
        self._step(Event.REFUSED, now)

    def made_room(self) -> None:
        """Note that the port takes frames again."""
        self.retry_due = NEVER

    def accepted_first(self, now: int) -> None:
        """Note that the interface has accepted the first frame."""
        under_way = self.under_way
        if not under_way.frames:
            self.still_since = now
        under_way.add(1, now)
        self.refused_since = NEVER
        count = under_way.count + under_way.frames
        self.first = FirstFrame(at=now, count=count)
        self._step(Event.FIRST_ACCEPTED, now)

    def no_first_frame(self, now: int) -> None:
        """Note that each possible frame has measurements."""
        self.first.is_missing = True
        self.retry_due = now + self.quarter_ns
        self._step(Event.NO_FIRST, now)

    def look(self, count: int, queued: int, now: int) -> None:
        """Take the count of sent frames, or UNCOUNTED, and own frames in the kernel's queue."""
        under_way = self.under_way
        was_late = self.is_late(now)
        if was_late:
            self.limit.late = now
        has_moved = under_way.look(count, queued, now)
        self.queued = queued
        if has_moved:
            self.still_since = now if under_way.frames else NEVER
            if self.state is State.BLOCKED:
                self.retry_due = NEVER
            elif was_late and self.state is State.SLOW:
                self.limit.is_long = True
            elif self.first.moves_since != NEVER:
                self.limit.is_long |= now - self.first.moves_since > self.quarter_ns
            if self.first.at != NEVER:
                self.first.moves_since = min(self.first.moves_since, now)
            if self.state in HELD:
                self.outage_since = now
        self._step(Event.MOVED if has_moved else Event.STILL, now)
        self.next_look = self._next_look(now)

    def adopt(self, departures: Any, now: int) -> None:
        """Take over the frames of iterations in C (``kcg_departures`` of native/linux.h)."""
        self.under_way.adopt(departures, now)
        self.still_since = departures.still_since
        self.next_look = departures.check_due

    def request(self, now: int) -> None:
        """Note that outputs have made answers while frames are held."""
        self._step(Event.REQUEST, now)

    # --- other events

    def quiet(self, is_quiet: bool, now: int) -> None:
        """Follow the begin or the end of quiet mode."""
        if is_quiet is not self.is_quiet:
            self.is_quiet = is_quiet
            if not is_quiet:
                self.outage_since = now
            self._step(Event.QUIET_BEGINS if is_quiet else Event.QUIET_ENDS, now)

    def suspended(self, now: int) -> None:
        """Follow a suspension of the process that has ended."""
        self._step(Event.SUSPENDED, now)

    def stop(self, now: int) -> None:
        """Follow the end of the gateway."""
        self._step(Event.STOP, now)

    def advance(self, now: int) -> None:
        """Let time pass."""
        while self._step(Event.TIME, now):
            pass

    # --- the table

    def _step(self, event: Event, now: int) -> bool:
        """Follow the first row of the state and event whose condition is true."""
        for row in _ROWS.get((self.state, event), _NO_ROWS):
            if TESTS[row.condition](self, now):
                self._follow(row, now)
                return True
        return False

    def _follow(self, row: Row, now: int) -> None:
        before = self.state
        after = before if row.after is None else row.after
        if after is not before:
            self.state = after
            self._enter(after, now)
        for act in row.acts:
            change = CHANGES.get(act)
            if change is not None:
                change(self, now)
            self.acts.append(act)

    def _enter(self, state: State, now: int) -> None:
        """Prepare for a state that was just entered."""
        if state in HELD:
            self.retry_due = NEVER
        if state in NOT_SLOW:
            self.limit = Limit()
            self.is_slow = False
        if self.is_quiet:
            self.is_stalled = False  # nobody listens on the bus of a parked vehicle
        if state is State.BLOCKED:
            self.first = FirstFrame()
        elif state is State.SETTLING:
            self.runs_since = now
        if state is State.BLOCKED or state is State.QUIET_BLOCKED:
            self.is_off = False
        self.next_look = self._next_look(now)

    def _next_look(self, now: int) -> int:
        """Return the time of the next look."""
        state = self.state
        has_frames = bool(self.under_way.frames)
        if state in NO_PORT or self.is_off:
            return NEVER
        if state is State.FIRST and now - self.first.at >= SOON_NS:
            return now + self.quarter_ns
        if state in _CLOSELY:
            return now + POLL_NS
        if state in WAITING and not self.is_quiet:
            return now + self.quarter_ns
        pause = LASTING_NS if state in HELD else self.period_ns
        return now + pause if has_frames else NEVER

    def _forget(self) -> None:
        """Forget accepted and refused frames, because the interface or the bus was lost."""
        self.under_way.forget()
        self.refused_since = NEVER
        self.retry_due = NEVER
        self.still_since = NEVER
        self.first.at = NEVER
        self.first.moves_since = NEVER
