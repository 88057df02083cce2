"""Network management, slave side: states and commands (CiA 301, 7.2.8.2 and 7.3.2), objects 1029h and 1F80h; the heartbeat's tick (1017h)
and the watch over those of other nodes (1016h; 7.2.8.2.2 and 7.5.2.19/20).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, Value, Variable
from kontronik_can_gw.status import NmtState
from kontronik_can_gw.times import MS, NEVER, SECOND

_SELF_START_OFF = 4
_CATCHING_UP_NS = SECOND // 2
"""After a hold-up no heartbeat is missed for this long unless it was seen to be late: what came meanwhile is read piece by piece."""


class Command(IntEnum):
    """Command specifiers of the NMT message."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


RESETS = (Command.RESET_NODE, Command.RESET_COMMUNICATION)
ALL_NODES = 0
"""The node-ID in a command to every node on the bus."""
STATE_AFTER = {
    Command.START: NmtState.OPERATIONAL,
    Command.STOP: NmtState.STOPPED,
    Command.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


def command(data: bytes, node_id: int) -> Command | None:
    """The command that an NMT message holds for this node: byte 0 command, byte 1 node-ID or ALL_NODES.

    None for commands to other nodes, unknown, or not exactly two bytes long.
    """
    if (
        len(data) != 2
        or data[1] not in (ALL_NODES, node_id)
        or data[0] not in Command._value2member_map_
    ):
        return None
    return Command(data[0])


class Nmt:
    """The state machine of one node. ``entered`` is called with the time after each change of state by ``enter``."""

    def __init__(
        self, dictionary: Dictionary, self_start: bool, entered: Callable[[int], None]
    ) -> None:
        self.state = NmtState.INITIALISING
        self._dictionary = dictionary
        self._self_start = self_start
        self._entered = entered
        dictionary.bind(0x1F80, check=_check_startup)

    @property
    def starts_itself(self) -> bool:
        """Whether the node enters OPERATIONAL without a command: bit 2 of 1F80h is 0."""
        otherwise = 0 if self._self_start else None
        return not self._dictionary.number(0x1F80, otherwise=otherwise) & _SELF_START_OFF

    @property
    def communicates(self) -> bool:
        """Whether SDO, SYNC and EMCY work: PRE-OPERATIONAL or OPERATIONAL."""
        return self.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)

    @property
    def boots_after_outage(self) -> bool:
        """1029h:1 = 0."""
        return self._dictionary.number(0x1029, 1) == 0

    def enter(self, state: NmtState, now: int) -> None:
        if state is not self.state:
            self.state = state
            self._entered(now)

    def behave(self, error: int, now: int) -> None:
        """Follow 1029h: sub-index 1 communication error, 2 telemetry lost. 0 PRE-OPERATIONAL (if OPERATIONAL), 1 no change, 2 STOPPED."""
        behaviour = self._dictionary.number(0x1029, error)
        if behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self.enter(NmtState.PRE_OPERATIONAL, now)
        elif behaviour == 2 and self.communicates:
            self.enter(NmtState.STOPPED, now)


def _check_startup(value: int) -> None:
    """A new 1F80h of a slave: only the bits about starting by itself (2) and starting others (3, without meaning here)."""
    if value & ~0x0C:
        raise SdoAbort(Abort.VALUE)


class Producer:
    """Has heartbeats sent. A period of 0 produces none."""

    def __init__(self, dictionary: Dictionary, send: Callable[[], None]) -> None:
        self.due = NEVER
        self._dictionary = dictionary
        self._send = send
        self._period = 0
        dictionary.bind(0x1017, written=self.configure)

    def configure(self, now: int) -> None:
        """Take over 1017h. A changed period holds from now on: the first heartbeat comes one period later."""
        self._period = self._dictionary.number(0x1017) * MS
        self.due = now + self._period if self._period else NEVER

    def stop(self) -> None:
        """Produce none, whatever 1017h is: the node has no node-ID."""
        self._period, self.due = 0, NEVER

    def beat(self, now: int) -> None:
        """Let the next one come at once, if there are any."""
        if self._period:
            self.due = now

    def advance(self, now: int) -> None:
        """Send one if it is due. Missed ones are not made up for: one heartbeat says all."""
        if now < self.due:
            return
        self.due += self._period
        if self.due <= now:
            self.due = now + self._period
        self._send()


@dataclass
class _Watched:
    timeout: int
    due: int = NEVER  # the watch begins with the first heartbeat
    lost: bool = False


class Consumer:
    """The watch over other nodes (1016h).

    ``changed`` is called with a node-ID, whether its heartbeat is lost (or no longer), the time,
    and the time at which that happened.
    """

    def __init__(
        self, dictionary: Dictionary, changed: Callable[[int, bool, int, int], None]
    ) -> None:
        self._dictionary = dictionary
        self._changed = changed
        self._watched: dict[int, _Watched] = {}
        self._judged_from = -NEVER
        for variable in dictionary.subs(0x1016):
            variable.check = partial(self._check, variable)
            variable.written = self._written

    def reset(self) -> None:
        """All watches begin anew."""
        self._watched = {}
        self._configure()

    @property
    def node_ids(self) -> tuple[int, ...]:
        return tuple(self._watched)

    @property
    def due(self) -> int:
        if not self._watched:
            return NEVER
        return max(self._judged_from, min(watched.due for watched in self._watched.values()))

    def held_up(self, now: int) -> None:
        """The process was held up until ``now``: a heartbeat may still wait to be read."""
        self._judged_from = now + _CATCHING_UP_NS

    def receive(self, node_id: int, data: bytes, now: int, at: int) -> None:
        """A heartbeat (or boot-up message) that came ``at``."""
        watched = self._watched.get(node_id)
        if len(data) != 1 or watched is None:
            return
        self._judge(at, now)  # it may have come too late, and others not at all
        watched.due = at + watched.timeout
        if watched.lost:
            watched.lost = False
            self._changed(node_id, False, now, at)

    def advance(self, now: int) -> None:
        """Let time pass."""
        if now >= self._judged_from:
            self._judge(now, now)

    def _judge(self, until: int, now: int) -> None:
        late = {node_id: each for node_id, each in self._watched.items() if until >= each.due}
        times = {node_id: watched.due for node_id, watched in late.items()}
        for watched in late.values():
            watched.due = NEVER
            watched.lost = True
        for node_id, due in times.items():
            self._changed(node_id, True, now, due)

    def _configure(self) -> None:
        """Take over 1016h. A watch that stays as it was goes on."""
        before, self._watched = self._watched, {}
        for node_id, timeout in self._entries():
            old = before.get(node_id)
            kept = old if old is not None and old.timeout == timeout else None
            self._watched[node_id] = kept or _Watched(timeout)

    def _written(self, now: int) -> None:
        before = self._watched
        self._configure()
        for node_id, old in before.items():
            if old.lost and self._watched.get(node_id) is not old:
                self._changed(node_id, False, now, now)

    def _check(self, own: Variable, value: int) -> None:
        """A new entry. SdoAbort 06040043h where another entry watches the node already (CiA 301, 7.5.2.19)."""
        if value >> 24:
            raise SdoAbort(Abort.VALUE)  # reserved bits
        used = _used(value)
        if used is not None and used[0] in dict(self._entries(own)):
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _entries(self, but: Variable | None = None) -> Iterator[tuple[int, int]]:
        for variable in self._dictionary.subs(0x1016):
            if variable is not but and (used := _used(variable.value)) is not None:
                yield used


def _used(value: Value) -> tuple[int, int] | None:
    """An entry's node-ID (bits 23..16) and time (bits 15..0, ms) in ns; None where either is none."""
    if not isinstance(value, int):
        return None
    node_id, timeout = value >> 16 & 0xFF, (value & 0xFFFF) * MS
    return (node_id, timeout) if 1 <= node_id <= 127 and timeout else None
