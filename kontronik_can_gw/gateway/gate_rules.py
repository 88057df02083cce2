"""The conditions and acts of the gate's table, as functions of its state."""

from collections.abc import Callable, Mapping

from kontronik_can_gw.gateway.gate_state import GateState
from kontronik_can_gw.gateway.gate_table import (
    ANSWER_NS,
    LASTING_NS,
    MAX_PAUSE_NS,
    NO_FIRST_NS,
    SETTLING_NS,
    SOON_NS,
    UNLIMITED,
    WORKED_NS,
    Act,
    If,
    State,
)
from kontronik_can_gw.gateway.under_way import UNCOUNTED
from kontronik_can_gw.times import NEVER

# --- acts that change the gate


def _hold(gate: GateState, now: int) -> None:
    if not gate.is_held and gate.state in (State.BLOCKED, State.QUIET_BLOCKED):
        gate.outage_since = min(now, gate.still_since, gate.refused_since)
    gate.is_held = True
    gate.discarded = now


def _forget(gate: GateState, _now: int) -> None:
    gate.under_way.forget()
    gate.still_since = NEVER


def _release(gate: GateState, now: int) -> None:
    gate.is_held = False
    gate.restart.works_since = now
    gate.restart.works_count = gate.under_way.count + gate.restart.frames + 1
    gate.first.at = NEVER
    gate.first.moves_since = NEVER
    gate.retry_due = NEVER
    if not gate.restart.count:
        gate.is_stalled = False


def _limit(gate: GateState, now: int) -> None:
    gate.limit.since = now
    gate.limit.frames = gate.under_way.frames
    _halve(gate, now)


def _halve(gate: GateState, now: int) -> None:
    gate.limit.frames = max(1, gate.limit.frames // 2)
    gate.limit.late = now
    gate.limit.changed = now


def _grow(gate: GateState, now: int) -> None:
    gate.limit.frames += 1
    gate.limit.changed = now


def _ask(gate: GateState, now: int) -> None:
    gate.restart.asked = now
    gate.restart.frames = gate.under_way.frames
    gate.restart.is_awaited = True


def _count_restart(gate: GateState, _now: int) -> None:
    gate.restart.is_awaited = False
    gate.restart.count += 1
    _double(gate, gate.restart.pause_ns)


def _note_unanswered(gate: GateState, _now: int) -> None:
    gate.restart.is_awaited = False
    _double(gate, max(gate.restart.pause_ns, ANSWER_NS))


def _double(gate: GateState, pause_ns: int) -> None:
    longest_ns = max(MAX_PAUSE_NS, gate.restart.after_ns)
    gate.restart.pause_ns = min(2 * pause_ns, longest_ns)


def _note_worked(gate: GateState, _now: int) -> None:
    gate.restart.asked = -NEVER
    gate.restart.is_awaited = False
    gate.restart.pause_ns = gate.restart.after_ns
    gate.is_stalled = False


def _note_stall(gate: GateState, _now: int) -> None:
    gate.is_stalled = True


def _note_slow(gate: GateState, _now: int) -> None:
    gate.is_slow = True


def _is_blocked(gate: GateState, now: int) -> bool:
    if gate.under_way.count == UNCOUNTED:
        return False
    limit = gate.timeout_ns * 7 // 8
    if gate.state is State.SLOW and gate.limit.is_long:
        limit = max(limit, LASTING_NS)
    return now - gate.still_since >= limit


def _is_opened_without_first(gate: GateState, now: int) -> bool:
    if not gate.under_way.frames:
        return True
    return not gate.queued and now - gate.outage_since >= NO_FIRST_NS


def _is_limit_old(gate: GateState, now: int) -> bool:
    return now >= gate.limit_due


def _is_limit_too_high(gate: GateState, now: int) -> bool:
    was_late = gate.is_late(now) or gate.limit.late > gate.limit.changed
    return was_late and _is_limit_old(gate, now)


def _is_refused_long(gate: GateState, now: int) -> bool:
    return now - gate.refused_since >= LASTING_NS


def _is_stall_noticed(gate: GateState, now: int) -> bool:
    if gate.is_stalled or gate.is_off or gate.is_quiet:
        return False
    return now - gate.outage_since >= LASTING_NS


def _has_first_left(gate: GateState, now: int) -> bool:
    """Return True if the first frame has left.

    Frames that were accepted before it leave first. If the driver has lost some of them, the
    count stays too low. Then the first frame has left SOON_NS after another one, unless it
    still waits in the kernel's queue.
    """
    if gate.first.at == NEVER or gate.queued:
        return False
    return gate.under_way.count >= gate.first.count or now - gate.first.moves_since >= SOON_NS


def _has_first_left_slowly(gate: GateState, now: int) -> bool:
    is_slow = gate.limit.is_long or now - gate.first.moves_since > gate.quarter_ns
    return is_slow and _has_first_left(gate, now)


def _is_first_lost(gate: GateState, now: int) -> bool:
    return not gate.queued and now - gate.first.at >= LASTING_NS


def _may_ask_now(gate: GateState, now: int) -> bool:
    if not gate.may_ask or now < gate.restart_due:
        return False
    return gate.is_off or gate.under_way.looked >= gate.restart_due


def _is_unanswered(gate: GateState, now: int) -> bool:
    return now - gate.restart.asked >= ANSWER_NS


def _is_settled(gate: GateState, now: int) -> bool:
    return now - gate.runs_since > SETTLING_NS


def _has_worked(gate: GateState, now: int) -> bool:
    if gate.restart.asked == -NEVER or now - gate.restart.works_since < WORKED_NS:
        return False
    count = gate.under_way.count
    return count == UNCOUNTED or count >= gate.restart.works_count


TESTS: Mapping[If, Callable[[GateState, int], bool]] = {
    If.ALWAYS: lambda _gate, _now: True,
    If.NEVER_HELD: lambda gate, _now: not gate.is_held,
    If.QUIET: lambda gate, _now: gate.is_quiet,
    If.QUIET_ON: lambda gate, _now: gate.is_quiet and not gate.is_off,
    If.RESTART: lambda gate, _now: gate.restart.is_awaited,
    If.FAILED: lambda gate, now: not gate.is_socket and _is_refused_long(gate, now),
    If.REFUSED_LONG: _is_refused_long,
    If.BLOCKED: _is_blocked,
    If.LATE: GateState.is_late,
    If.HALF_LATE: _is_limit_too_high,
    If.FULL_SPEED: lambda gate, now: (
        _is_limit_old(gate, now) and gate.limit.frames + 1 >= UNLIMITED
    ),
    If.HALF: _is_limit_old,
    If.LATE_LONG: lambda gate, _now: (
        not gate.is_slow and gate.limit.late - gate.limit.since >= LASTING_NS
    ),
    If.UNCOUNTED: lambda gate, _now: gate.under_way.count == UNCOUNTED,
    If.NO_FIRST_OPENS: _is_opened_without_first,
    If.NO_FIRST: lambda gate, _now: gate.first.is_missing,
    If.FIRST_LEFT: _has_first_left,
    If.FIRST_LEFT_SLOWLY: _has_first_left_slowly,
    If.BUS_IS_ON: lambda gate, _now: not gate.is_off,
    If.FIRST_SENT: lambda gate, _now: gate.first.at != NEVER,
    If.STANDS: lambda gate, now: now - gate.outage_since >= LASTING_NS,
    If.REPEAT: _is_first_lost,
    If.STALLED: _is_stall_noticed,
    If.DISCARD: lambda gate, now: now - gate.discarded >= LASTING_NS,
    If.HELD_FRAMES: lambda gate, now: now > gate.discarded,
    If.ASK: _may_ask_now,
    If.ASK_UNDER_WAY: _may_ask_now,
    If.ASK_OFF: _may_ask_now,
    If.UNANSWERED_OFF: lambda gate, now: gate.is_off and _is_unanswered(gate, now),
    If.UNANSWERED_QUIET: lambda gate, now: gate.is_quiet and _is_unanswered(gate, now),
    If.UNANSWERED: _is_unanswered,
    If.SETTLED: _is_settled,
    If.SETTLED_QUIET: lambda gate, now: gate.is_quiet and _is_settled(gate, now),
    If.WORKED: _has_worked,
}

CHANGES: Mapping[Act, Callable[[GateState, int], None]] = {
    Act.HOLD: _hold,
    Act.FORGET: _forget,
    Act.RELEASE: _release,
    Act.LIMIT: _limit,
    Act.HALVE: _halve,
    Act.GROW: _grow,
    Act.ASK: _ask,
    Act.COUNT: _count_restart,
    Act.NOT_RESTARTED: _note_unanswered,
    Act.WORKED: _note_worked,
    Act.STALLED: _note_stall,
    Act.SLOW: _note_slow,
}
