"""The state of the gate to the bus."""

from dataclasses import dataclass

from kontronik_can_gw.gateway.gate_table import (
    ANSWER_NS,
    LASTING_NS,
    NO_PORT,
    PASSING,
    UNLIMITED,
    WAITING,
    Act,
    State,
)
from kontronik_can_gw.gateway.under_way import UnderWay
from kontronik_can_gw.times import NEVER


@dataclass
class Limit:
    """The limit of frames under way on a slow bus."""

    frames: int = UNLIMITED
    changed: int = NEVER
    """Time of its last change."""
    since: int = 0
    """Time at which the bus became slow."""
    late: int = 0
    """The last time at which a frame was under way for more than a quarter."""
    is_long: bool = False
    """True if a frame has left late since the bus became slow, so it is not just blocked.

    Or the first frame has left late after another one.
    """


@dataclass
class FirstFrame:
    """The first frame after an outage."""

    at: int = NEVER
    """Time at which it was accepted."""
    count: int = 0
    """The interface's count as soon as it has left."""
    moves_since: int = NEVER
    """Time since which frames leave after it was accepted."""
    is_missing: bool = False
    """True if each possible frame has measurements."""


@dataclass
class Restarts:
    """Requests to restart a hung interface."""

    after_ns: int
    """Time after which the first restart is requested. 0: never."""
    pause_ns: int
    """Pause before the next request."""
    asked: int = -NEVER
    """Time of the last request."""
    is_awaited: bool = False
    """True if neither a restart nor ANSWER_NS has followed the last request."""
    frames: int = 0
    """Number of frames under way at the last request."""
    count: int = 0
    """Number of restarts since the interface last worked. The owner sets it to 0."""
    works_since: int = 0
    works_count: int = 0
    """The interface's count as soon as more frames have left than were under way."""


class GateState:
    """The data of the gate."""

    def __init__(self, timeout_ns: int, restart_after_ns: int = 0) -> None:
        self.state = State.CLOSED
        self.timeout_ns = timeout_ns
        """The shortest telemetry timeout. The owner updates it."""
        self.acts: list[Act] = []
        """Work for the owner, oldest first. The owner empties the list."""
        self.is_held = False
        """True if no frame may be handed over except answers and a first frame."""
        self.is_quiet = False
        self.is_socket = True
        self.is_off = False
        """True in bus-off, also while its end settles or a restart is awaited."""
        self.stays_off = False
        """True if the bus-off does not end by itself."""
        self.is_stalled = False
        """True if it was reported that no frame leaves."""
        self.is_slow = False
        """True if it was reported that the bus is slow."""
        self.under_way = UnderWay()
        self.queued = 0
        """Number of own frames in the kernel's queue."""
        self.still_since = NEVER
        """Time since which frames are under way and none has left. NEVER if none is."""
        self.outage_since = 0
        """Time since which no frame has left the interface, while frames are held."""
        self.discarded = -NEVER
        """Time at which waiting frames were discarded."""
        self.refused_since = NEVER
        """Time since which the port has accepted no frame. NEVER if it accepted the last one."""
        self.runs_since = 0
        """Time since which a controller runs although its driver reports bus-off."""
        self.retry_due = NEVER
        """Time of the next attempt after a refusal. NEVER if the last frame was accepted."""
        self.next_look = NEVER
        """Time of the next usual look at the interface's count (``look_due``)."""
        self.limit = Limit()
        self.first = FirstFrame()
        self.restart = Restarts(restart_after_ns, restart_after_ns)

    @property
    def quarter_ns(self) -> int:
        """A quarter of the shortest telemetry timeout."""
        return self.timeout_ns // 4

    @property
    def limit_due(self) -> int:
        """Time at which the limit of a slow bus changes.

        A frame that was accepted in the first quarter after a change is late in the second one, if
        the limit is too high.
        """
        return self.limit.changed + 2 * self.quarter_ns

    @property
    def may_ask(self) -> bool:
        """True if a restart is requested after the pause."""
        if not self.restart.after_ns:
            return False
        if self.state is State.BUS_OFF:
            return self.stays_off and not self.is_quiet
        if self.state is State.QUIET_BLOCKED:
            return bool(self.under_way.frames)
        return self.state is State.BLOCKED or self.state is State.FIRST

    @property
    def restart_due(self) -> int:
        """Time at which a restart is requested."""
        return max(self.outage_since, self.restart.asked) + self.restart.pause_ns

    @property
    def look_due(self) -> int:
        """Time of the next look at the interface's count. A restart is requested after a look."""
        if self.may_ask and self.under_way.looked < self.restart_due and not self.is_off:
            return min(self.next_look, self.restart_due)
        return self.next_look

    def is_late(self, now: int) -> bool:
        """Return True if a frame is under way for more than a quarter."""
        return now - self.under_way.oldest > self.quarter_ns

    # --- questions of the owner

    @property
    def period_ns(self) -> int:
        """Pause between two looks at full speed."""
        return self.timeout_ns // 8

    @property
    def may_run_in_c(self) -> bool:
        """True if no frame is held, limited or refused."""
        is_free = self.state is State.OPEN or self.state is State.QUIET
        return is_free and self.refused_since == NEVER

    def room(self, now: int) -> int:
        """Return how many frames may be handed over now."""
        if self.state not in PASSING:
            return 0
        if self.state is not State.SLOW:
            return UNLIMITED
        if self.is_late(now):
            return 0
        return max(0, self.limit.frames - self.under_way.frames)

    def may_try(self, now: int) -> bool:
        """Return True unless the next attempt after a refusal is due later."""
        return self.retry_due == NEVER or now >= self.retry_due

    def wants_first_frame(self, now: int) -> bool:
        """Return True if a frame without measurements must be handed over now."""
        return self.state is State.BLOCKED and self.may_try(now)

    @property
    def due(self) -> int:
        """Time at which ``look`` or ``advance`` must be called. Earlier calls do no harm.

        At full speed the owner looks at least once in a quarter anyway.
        """
        state = self.state
        if state is State.OPEN or state is State.UNPROVEN:
            return self.retry_due
        if state in NO_PORT and state is not State.BUS_OFF:
            return NEVER
        if state is State.SLOW:
            return min(self.look_due, self.limit_due)
        due = min(self.retry_due, self.look_due)
        if state in WAITING:
            due = min(due, self.discarded + LASTING_NS)
        if state is State.RESTARTING:
            due = min(due, self.restart.asked + ANSWER_NS)
        elif self.may_ask:
            due = min(due, self.restart_due)
        return due
