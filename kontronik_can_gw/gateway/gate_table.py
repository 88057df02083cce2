"""The table of the gate to the bus: its states, events, conditions and acts, and their words."""

from enum import Enum
from typing import NamedTuple

from kontronik_can_gw.times import MS, SECOND

LASTING_NS = SECOND
"""A fault of this duration lasts: it is reported, and answers that waited are too old."""
SOON_NS = 50 * MS
"""A first frame is expected to leave within this time. It is looked for more often until then."""
SETTLING_NS = 200 * MS
"""Time after which a restarted controller is used even if its driver still reports bus-off."""
ANSWER_NS = 2 * SECOND
"""A loss of the interface within this time after a request is its restart."""
WORKED_NS = 2 * SECOND
"""A restart has worked if frames leave for this time."""
MAX_PAUSE_NS = 10 * SECOND
"""Longest pause between two requests of a restart."""
NO_FIRST_NS = 10 * SECOND
"""Longest wait for a departure if no first frame exists. Then one frame is tried."""
UNLIMITED = 32
"""More frames than are under way as a rule: a limit that limits nothing."""


class State(Enum):
    """A state of the way to the bus."""

    __hash__ = object.__hash__  # an enumeration's own is slow, and the gate looks up rows by it

    CLOSED = "closed"
    OPENING = "opening"
    UNPROVEN = "unproven"
    OPEN = "open"
    SLOW = "slow"
    BLOCKED = "blocked"
    FIRST = "first frame"
    MOVING = "moving"
    LOST = "lost"
    QUIET = "quiet"
    QUIET_BLOCKED = "quiet-blocked"
    BUS_OFF = "bus-off"
    SETTLING = "settling"
    RESTARTING = "restart asked"


class Event(Enum):
    """Something that happens to the way to the bus."""

    __hash__ = object.__hash__  # as for ``State``

    OPENING = "a thread opens the interface"
    OPENED = "interface open"
    LOST = "interface lost"
    ACCEPTED = "frame accepted"
    REFUSED = "frame refused"
    FIRST_ACCEPTED = "first frame accepted"
    NO_FIRST = "no first frame exists"
    MOVED = "count moved"
    STILL = "count stood still"
    REQUEST = "request received"
    QUIET_BEGINS = "quiet mode begins"
    QUIET_ENDS = "telemetry begins"
    BUS_OFF = "bus-off"
    STOPPED = "controller stands"
    RUNS = "controller runs"
    READY = "controller ready"
    SUSPENDED = "process was suspended"
    STOP = "gateway ends"
    TIME = "time"


class If(Enum):
    """A condition of a row."""

    ALWAYS = ""
    NEVER_HELD = "frames were never held"
    QUIET = "quiet mode"
    QUIET_ON = "quiet mode, no bus-off"
    RESTART = "down within 2 s after a request"
    FAILED = "refused for 1 s, no socket"
    REFUSED_LONG = "refused for 1 s"
    BLOCKED = "none has left for too long"
    LATE = "a frame is late"
    HALF_LATE = "half over, a frame was late"
    FULL_SPEED = "half over, the limit is 31"
    HALF = "half over"
    LATE_LONG = "late frames for 1 s, not reported"
    UNCOUNTED = "the driver does not count"
    NO_FIRST_OPENS = "no frame is under way, or none has left for 10 s"
    NO_FIRST = "no first frame exists"
    FIRST_LEFT = "the first frame has left"
    FIRST_LEFT_SLOWLY = "the first frame has left late"
    BUS_IS_ON = "no bus-off"
    FIRST_SENT = "a first frame was accepted"
    STANDS = "none has left for 1 s"
    REPEAT = "the driver has had it for 1 s"
    STALLED = "none has left for 1 s, not reported, no quiet mode"
    DISCARD = "1 s since the last time"
    HELD_FRAMES = "at each iteration"
    ASK = "pause over"
    ASK_UNDER_WAY = "pause over, frames are under way"
    ASK_OFF = "pause over, no automatic restart, no quiet mode"
    UNANSWERED_OFF = "2 s, bus-off"
    UNANSWERED_QUIET = "2 s, quiet mode"
    UNANSWERED = "2 s"
    SETTLED = "for 200 ms"
    SETTLED_QUIET = "for 200 ms, quiet mode"
    WORKED = "2 s, more have left than were under way"


class Act(Enum):
    """Work for the owner of the gate."""

    HOLD = "hold"
    FORGET = "forget frames under way"
    RELEASE = "send again"
    PROVE = "end the fault"
    LIMIT = "limit"
    HALVE = "halve the limit"
    GROW = "limit + 1"
    UNLIMIT = "end the limit"
    DROP = "discard measurements"
    FAIL = "close the port"
    ASK = "request a restart"
    COUNT = "count the restart"
    NOT_RESTARTED = "report the missing unit"
    WORKED = "report that it works"
    STALLED = "report that no frame leaves"
    SLOW = "report the slow bus"


class Row(NamedTuple):
    """A row of the table. The first row of a state and event whose condition is true is followed.

    Without a row, an event changes nothing.
    """

    states: tuple[State, ...]
    event: Event
    condition: If
    after: State | None
    """The next state. None if it stays the same."""
    acts: tuple[Act, ...] = ()


_S, _E = State, Event
NO_PORT = (_S.CLOSED, _S.OPENING, _S.LOST, _S.BUS_OFF, _S.SETTLING)
"""States in which nothing can be handed over."""
PASSING = (_S.UNPROVEN, _S.OPEN, _S.SLOW, _S.QUIET)
"""States in which frames pass."""
NOT_SLOW = (_S.OPEN, _S.LOST, _S.QUIET, _S.QUIET_BLOCKED)
"""States in which a limit and a report of a slow bus end."""
WAITING = (_S.BLOCKED, _S.FIRST, _S.MOVING, _S.RESTARTING)
"""States in which frames are held although there is a port, except in quiet mode."""
_SHUT = (_S.CLOSED, _S.OPENING, _S.LOST)
HELD = (*NO_PORT, *WAITING, _S.QUIET_BLOCKED)
"""States in which frames are held."""
_UP = (*PASSING, *WAITING, _S.QUIET_BLOCKED)
_OFF = (_S.BUS_OFF, _S.SETTLING, _S.RESTARTING)

TABLE = (
    # opening
    Row((_S.CLOSED, _S.LOST), _E.OPENING, If.ALWAYS, _S.OPENING),
    Row(_SHUT, _E.OPENED, If.QUIET, _S.QUIET_BLOCKED, (Act.HOLD, Act.PROVE)),
    Row(_SHUT, _E.OPENED, If.NEVER_HELD, _S.UNPROVEN),
    Row(_SHUT, _E.OPENED, If.ALWAYS, _S.BLOCKED),
    Row((_S.UNPROVEN,), _E.ACCEPTED, If.ALWAYS, _S.OPEN, (Act.PROVE,)),
    # loss
    Row((*_UP, _S.BUS_OFF, _S.SETTLING), _E.LOST, If.RESTART, _S.LOST, (Act.HOLD, Act.COUNT)),
    Row((*_UP, _S.BUS_OFF, _S.SETTLING), _E.LOST, If.ALWAYS, _S.LOST, (Act.HOLD,)),
    Row((_S.CLOSED, _S.OPENING), _E.LOST, If.ALWAYS, _S.LOST),
    Row(NO_PORT, _E.TIME, If.HELD_FRAMES, None, (Act.HOLD,)),
    # a busy port
    Row((*PASSING, _S.BLOCKED), _E.REFUSED, If.FAILED, None, (Act.FAIL,)),
    Row((_S.UNPROVEN, _S.OPEN, _S.SLOW), _E.REFUSED, If.REFUSED_LONG, _S.BLOCKED, (Act.HOLD,)),
    Row((_S.QUIET,), _E.REFUSED, If.REFUSED_LONG, _S.QUIET_BLOCKED, (Act.HOLD,)),
    # a slow bus
    Row((_S.OPEN,), _E.STILL, If.BLOCKED, _S.BLOCKED, (Act.HOLD,)),
    Row((_S.OPEN,), _E.STILL, If.LATE, _S.SLOW, (Act.LIMIT,)),
    Row((_S.OPEN,), _E.MOVED, If.LATE, _S.SLOW, (Act.LIMIT,)),
    Row((_S.SLOW,), _E.STILL, If.BLOCKED, _S.BLOCKED, (Act.HOLD,)),
    Row((_S.SLOW,), _E.TIME, If.HALF_LATE, None, (Act.HALVE,)),
    Row((_S.SLOW,), _E.TIME, If.FULL_SPEED, _S.OPEN, (Act.UNLIMIT,)),
    Row((_S.SLOW,), _E.TIME, If.HALF, None, (Act.GROW,)),
    Row((_S.SLOW,), _E.TIME, If.LATE_LONG, None, (Act.SLOW,)),
    # the first frame after an outage
    Row((_S.BLOCKED,), _E.FIRST_ACCEPTED, If.UNCOUNTED, _S.OPEN, (Act.RELEASE, Act.PROVE)),
    Row((_S.BLOCKED,), _E.FIRST_ACCEPTED, If.ALWAYS, _S.FIRST),
    Row(
        (_S.BLOCKED,),
        _E.NO_FIRST,
        If.NO_FIRST_OPENS,
        _S.SLOW,
        (Act.FORGET, Act.RELEASE, Act.PROVE, Act.LIMIT),
    ),
    Row((_S.BLOCKED,), _E.MOVED, If.NO_FIRST, _S.SLOW, (Act.RELEASE, Act.PROVE, Act.LIMIT)),
    Row(
        (_S.FIRST, _S.MOVING),
        _E.MOVED,
        If.FIRST_LEFT_SLOWLY,
        _S.SLOW,
        (Act.RELEASE, Act.PROVE, Act.LIMIT),
    ),
    Row((_S.FIRST, _S.MOVING), _E.MOVED, If.FIRST_LEFT, _S.OPEN, (Act.RELEASE, Act.PROVE)),
    Row((_S.FIRST,), _E.MOVED, If.ALWAYS, _S.MOVING),
    Row((_S.MOVING,), _E.STILL, If.FIRST_LEFT, _S.OPEN, (Act.RELEASE, Act.PROVE)),
    Row((_S.MOVING,), _E.STILL, If.STANDS, _S.BLOCKED),
    Row((_S.FIRST,), _E.TIME, If.REPEAT, _S.BLOCKED),
    Row(WAITING, _E.TIME, If.STALLED, None, (Act.STALLED,)),
    Row(WAITING, _E.TIME, If.DISCARD, None, (Act.HOLD,)),
    # bus-off
    Row(_UP, _E.BUS_OFF, If.ALWAYS, _S.BUS_OFF, (Act.HOLD,)),
    Row((_S.BUS_OFF, _S.RESTARTING), _E.RUNS, If.ALWAYS, _S.SETTLING),
    Row((_S.SETTLING,), _E.RUNS, If.SETTLED_QUIET, _S.QUIET_BLOCKED),
    Row((_S.SETTLING,), _E.RUNS, If.SETTLED, _S.BLOCKED),
    Row((_S.SETTLING,), _E.STOPPED, If.ALWAYS, _S.BUS_OFF),
    Row(_OFF, _E.READY, If.QUIET, _S.QUIET_BLOCKED),
    Row(_OFF, _E.READY, If.ALWAYS, _S.BLOCKED),
    # a restart of the interface
    Row((_S.BLOCKED, _S.FIRST), _E.TIME, If.ASK, _S.RESTARTING, (Act.ASK,)),
    Row((_S.QUIET_BLOCKED,), _E.TIME, If.ASK_UNDER_WAY, _S.RESTARTING, (Act.ASK,)),
    Row((_S.BUS_OFF,), _E.TIME, If.ASK_OFF, _S.RESTARTING, (Act.ASK,)),
    Row((_S.RESTARTING,), _E.TIME, If.UNANSWERED_OFF, _S.BUS_OFF, (Act.NOT_RESTARTED,)),
    Row((_S.RESTARTING,), _E.TIME, If.UNANSWERED_QUIET, _S.QUIET_BLOCKED, (Act.NOT_RESTARTED,)),
    Row((_S.RESTARTING,), _E.TIME, If.UNANSWERED, _S.BLOCKED, (Act.NOT_RESTARTED,)),
    Row((_S.RESTARTING,), _E.MOVED, If.QUIET, _S.QUIET, (Act.RELEASE, Act.PROVE)),
    Row((_S.RESTARTING,), _E.MOVED, If.FIRST_LEFT, _S.OPEN, (Act.RELEASE, Act.PROVE)),
    Row((_S.RESTARTING,), _E.MOVED, If.FIRST_SENT, _S.MOVING),
    Row((_S.RESTARTING,), _E.MOVED, If.ALWAYS, _S.BLOCKED),
    Row((_S.OPEN, _S.SLOW, _S.QUIET), _E.TIME, If.WORKED, None, (Act.WORKED,)),
    # quiet mode
    Row((_S.UNPROVEN, _S.OPEN), _E.QUIET_BEGINS, If.ALWAYS, _S.QUIET, (Act.DROP,)),
    Row((_S.SLOW,), _E.QUIET_BEGINS, If.ALWAYS, _S.QUIET, (Act.DROP, Act.UNLIMIT)),
    Row(WAITING[:3], _E.QUIET_BEGINS, If.ALWAYS, _S.QUIET_BLOCKED, (Act.HOLD,)),
    Row((_S.QUIET,), _E.STILL, If.BLOCKED, _S.QUIET_BLOCKED, (Act.HOLD,)),
    Row((_S.QUIET_BLOCKED,), _E.MOVED, If.ALWAYS, _S.QUIET, (Act.RELEASE, Act.PROVE)),
    Row((_S.QUIET_BLOCKED,), _E.REQUEST, If.ALWAYS, _S.QUIET, (Act.RELEASE, Act.PROVE)),
    Row((_S.RESTARTING,), _E.REQUEST, If.QUIET_ON, _S.QUIET, (Act.RELEASE, Act.PROVE)),
    Row((_S.RESTARTING,), _E.QUIET_ENDS, If.BUS_IS_ON, _S.BLOCKED, (Act.HOLD,)),
    Row((_S.QUIET, _S.QUIET_BLOCKED), _E.QUIET_ENDS, If.ALWAYS, _S.BLOCKED, (Act.HOLD,)),
    # the process
    Row(PASSING, _E.SUSPENDED, If.ALWAYS, None, (Act.DROP,)),
    Row(WAITING, _E.STOP, If.ALWAYS, None, (Act.HOLD,)),
)
