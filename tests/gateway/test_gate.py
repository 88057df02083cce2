"""The gate's machine: all states that can be reached keep the invariants, and single rules."""

import pytest
from gate_exploration import RESTART_AFTER, TIMEOUT, Exploration, explore

from kontronik_can_gw.gateway.gate import POLL_NS, Gate
from kontronik_can_gw.gateway.gate_table import (
    HELD,
    LASTING_NS,
    NO_PORT,
    PASSING,
    TABLE,
    UNLIMITED,
    Act,
    State,
)
from kontronik_can_gw.gateway.under_way import UNCOUNTED
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("gate")

OFF = (State.BUS_OFF, State.SETTLING, State.RESTARTING)


def check(gate: Gate, now: int) -> None:
    """Check the invariants after an event."""
    room = gate.room(now)
    assert not room or gate.state in PASSING, "nothing is handed over while held"
    if gate.state is State.SLOW:
        assert room <= gate.limit.frames
        assert room or gate.under_way.frames, "one frame is always allowed"
    assert not (gate.wants_first_frame(now) and gate.is_quiet), "no first frame in quiet mode"
    assert gate.is_held >= (gate.state in HELD and gate.state not in NO_PORT)
    assert not (gate.is_held and gate.state in PASSING)
    assert gate.is_off <= (gate.state in OFF), "a bus-off can end"
    assert gate.is_slow <= (gate.state is State.SLOW or gate.state in HELD), "its report ends"
    if gate.state in (State.QUIET, State.QUIET_BLOCKED):
        assert not gate.is_stalled, "a parked vehicle has no fault"
        assert not gate.is_slow
    if Act.ASK in gate.acts:
        assert now - gate.outage_since >= RESTART_AFTER, "no restart while frames leave"
        assert not gate.is_quiet or gate.under_way.frames, "nothing else is restarted then"
    if gate.state in HELD and gate.state not in NO_PORT and gate.state is not State.QUIET_BLOCKED:
        assert gate.due <= now + LASTING_NS, "every wait has a deadline"
    if gate.state is State.SLOW:
        assert gate.due <= max(now, gate.limit_due)


def recover(gate: Gate, now: int) -> int:
    """Let everything work. Return how long it takes until frames pass, in ns."""
    begin = now
    if gate.state in (State.CLOSED, State.OPENING, State.LOST):
        gate.opened(7, now)
    if gate.is_off:
        gate.left_bus_off(gate.under_way.count, True, False, now)
    gate.quiet(False, now)
    while gate.state not in PASSING:
        assert now - begin < 3 * SECOND, gate.state
        gate.advance(now)
        if now >= gate.look_due:
            gate.look(gate.under_way.count + gate.under_way.frames, 0, now)
        if gate.wants_first_frame(now):
            gate.accepted_first(now)
        now += MS
    return now - begin


def explore_and_report(most: int) -> Exploration:
    slowest = 0

    def note_recovery(gate: Gate, now: int) -> None:
        nonlocal slowest
        slowest = max(slowest, recover(gate, now))

    found = explore(check, note_recovery, most)
    print(
        f"{len(found.states)} states, {found.transitions} transitions, {len(found.pairs)} pairs "
        f"of rows; frames pass again within {slowest / SECOND:.2f} s"
    )
    return found


@pytest.mark.promise("unstoppable")
def test_states_within_few_events_keep_the_invariants() -> None:
    assert explore_and_report(3000).rows.keys() == set(TABLE)


@pytest.mark.promise("unstoppable")
@pytest.mark.extended
def test_all_states_that_can_be_reached_keep_the_invariants() -> None:
    found = explore_and_report(1_000_000)
    assert found.is_complete
    assert found.rows.keys() == set(TABLE), [row for row in TABLE if row not in found.rows]


def test_interface_without_a_count_is_never_blocked() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(UNCOUNTED, 0)
    gate.accepted(1, 0)
    gate.look(UNCOUNTED, 0, SECOND)
    assert gate.state is State.OPEN


def test_interface_that_has_sent_nothing_yet_is_blocked() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(0, 0)
    gate.accepted(1, 0)
    gate.look(0, 0, TIMEOUT)
    assert gate.state is State.BLOCKED
    gate.accepted_first(TIMEOUT)
    gate.look(0, 0, TIMEOUT + SECOND)
    assert not gate.room(TIMEOUT + SECOND)


def test_bus_that_is_unplugged_from_the_start_stays_blocked_however_many_frames_fit() -> None:
    """The driver takes each first frame, and holds more frames than the kernel."""
    gate = Gate(TIMEOUT)
    gate.opened(0, 0)
    gate.accepted(6, 0)
    for now in range(0, 100 * SECOND, 20 * MS):
        gate.look(0, 0, now)
        gate.advance(now)
        if gate.wants_first_frame(now):
            gate.accepted_first(now)
        if now >= SECOND:
            assert gate.is_stalled
            assert not gate.room(now)
    assert gate.under_way.frames > UNLIMITED + 1


def test_wait_on_a_slow_bus_ends_in_the_future_although_a_refused_frame_may_be_tried() -> None:
    """The loop would use all CPU time otherwise."""
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(30, 0)
    gate.refused(is_full=True, now=0)
    for now in range(60 * MS, 2 * SECOND, 20 * MS):
        gate.look(7 + now // (150 * MS), 6, now)
        gate.advance(now)
        assert gate.state is State.SLOW
        assert gate.due > now


def test_limit_of_a_slow_bus_halves_and_grows() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(8, 0)
    gate.look(8, 0, 51 * MS)
    assert gate.state is State.SLOW
    assert gate.limit.frames == 3
    assert gate.room(51 * MS) == 0, "a frame is late"
    gate.look(15, 0, 60 * MS)
    assert gate.room(60 * MS) == 3
    gate.advance(150 * MS)
    assert gate.limit.frames == 3
    gate.advance(151 * MS)
    assert gate.limit.frames == 1, "a frame was late at 60 ms, although it has left since"
    gate.advance(251 * MS)
    assert gate.limit.frames == 2, "no frame was late for half of the timeout"
    now = 251 * MS
    while gate.state is State.SLOW:
        now += 50 * MS
        gate.advance(now)
    assert gate.room(now) == UNLIMITED
    assert now < 4 * SECOND


def test_frames_of_another_program_do_not_count_as_own_departures() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(2, 0)
    gate.look(50, 2, 51 * MS)
    assert gate.state is State.SLOW
    assert POLL_NS <= 2 * MS


def test_slow_bus_that_was_blocked_and_is_free_again_is_no_longer_reported() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(8, 0)
    count = 7
    now = 0
    while not gate.is_slow:
        now += 60 * MS
        count += 1
        gate.look(count, 0, now)
        gate.advance(now)
        if gate.room(now):
            gate.accepted(gate.room(now), now)
    while gate.state is State.SLOW:
        now += 10 * MS
        gate.look(count, 0, now)
        gate.advance(now)
    gate.accepted_first(now)
    gate.look(count + 1, 0, now + MS)
    gate.look(count + 1, 0, now + 60 * MS)
    assert gate.room(now) == UNLIMITED
    assert not gate.is_slow


def test_request_in_a_bus_off_of_a_parked_vehicle_leaves_the_bus_off_as_it_is() -> None:
    gate = Gate(TIMEOUT, RESTART_AFTER)
    gate.opened(7, 0)
    gate.bus_off(stays=True, now=0)
    gate.advance(RESTART_AFTER)
    gate.quiet(True, 600 * MS)
    gate.request(700 * MS)
    assert gate.left_bus_off(7, is_running=True, is_reported=False, now=800 * MS)


def test_frame_that_the_driver_lost_does_not_block_a_gateway_without_a_first_frame() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(2, 0)
    gate.look(8, 0, MS)
    now = MS
    while not (gate.state is State.SLOW and gate.room(now)):
        now += 2 * MS
        assert now < 11 * SECOND
        gate.look(8, 0, now)
        gate.advance(now)
        if gate.wants_first_frame(now):
            gate.no_first_frame(now)


def test_blocked_bus_is_no_fault_of_a_parked_vehicle() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(7, 0)
    gate.accepted(1, 0)
    for now in (200 * MS, 1300 * MS):
        gate.look(7, 0, now)
        gate.advance(now)
    assert gate.is_stalled
    gate.quiet(True, 2 * SECOND)
    assert not gate.is_stalled


def test_frames_that_left_before_a_bus_off_do_not_prove_the_first_frame() -> None:
    gate = Gate(TIMEOUT)
    gate.opened(0, 0)
    gate.accepted(3, 0)
    gate.bus_off(stays=False, now=10 * MS)
    gate.left_bus_off(3, is_running=True, is_reported=False, now=SECOND)
    gate.accepted_first(SECOND)
    gate.look(3, 0, SECOND)
    assert gate.room(SECOND) == 0


def test_end_of_a_long_bus_off_asks_for_no_restart() -> None:
    gate = Gate(TIMEOUT, RESTART_AFTER)
    gate.opened(0, 0)
    gate.bus_off(stays=False, now=0)
    now = 2 * RESTART_AFTER
    gate.left_bus_off(0, is_running=True, is_reported=False, now=now)
    gate.advance(now)
    assert Act.ASK not in gate.acts
    assert not gate.is_stalled


@pytest.mark.parametrize("is_quiet", [False, True])
def test_restart_is_asked_for_only_after_a_look(is_quiet: bool) -> None:
    gate = Gate(TIMEOUT, RESTART_AFTER)
    gate.opened(0, 0)
    gate.quiet(is_quiet, 0)
    gate.accepted(3, 0)
    now = 0
    while Act.ASK not in gate.acts and now < 3 * SECOND:
        if now >= gate.look_due:
            gate.look(0, 0, now)
        gate.advance(now)
        now = max(now + 1, min(gate.due, gate.look_due))
    assert gate.under_way.looked == gate.restart.asked
