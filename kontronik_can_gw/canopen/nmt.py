"""Network management (NMT) of one node: its states, its heartbeat and its watch over other nodes.

States and commands follow CiA 301, 7.2.8.2 and 7.3.2, with the objects 1029h and 1F80h. The
producer of heartbeats has the object 1017h, the consumer 1016h (7.2.8.2.2 and 7.5.2.19/20).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

from kontronik_can_gw.canopen.dictionary import (
    Abort,
    Dictionary,
    SdoAbort,
    Value,
    Variable,
    only,
)
from kontronik_can_gw.status import NmtState
from kontronik_can_gw.times import MS, NEVER, SECOND

_SELF_START_OFF = 4
_CATCHING_UP_NS = SECOND // 2
"""After a hold-up, a heartbeat counts as missing only after this time, or if it was seen late.

Frames that arrived during the hold-up are read in several iterations of the loop.
"""


class Command(IntEnum):
    """Command specifiers of the NMT message."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


RESETS = (Command.RESET_NODE, Command.RESET_COMMUNICATION)
ALL_NODES = 0
"""The node-ID of a command to all nodes on the bus."""
STATE_AFTER = {
    Command.START: NmtState.OPERATIONAL,
    Command.STOP: NmtState.STOPPED,
    Command.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


def command(data: bytes, node_id: int) -> Command | None:
    """Return the command of an NMT message: byte 0 command, byte 1 node-ID or ALL_NODES.

    None for commands to other nodes, unknown commands, and data that is not two bytes long.
    """
    if len(data) != 2 or data[1] not in (ALL_NODES, node_id):
        return None
    if data[0] not in Command._value2member_map_:
        return None
    return Command(data[0])


class Nmt:
    """The NMT state machine of one node.

    ``entered`` is called with the time after each change of state by ``enter``.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        self_start: bool,
        entered: Callable[[int], None],
    ) -> None:
        self.state = NmtState.INITIALISING
        self._dictionary = dictionary
        self._self_start = self_start
        self._entered = entered
        # Bit 2 is about starting by itself, bit 3 about starting others, which a slave ignores.
        dictionary.bind(0x1F80, check=only((0, 4, 8, 12)))

    @property
    def starts_itself(self) -> bool:
        """True if the node enters OPERATIONAL without a command: bit 2 of 1F80h is 0."""
        otherwise = 0 if self._self_start else None
        return not self._dictionary.number(0x1F80, otherwise=otherwise) & _SELF_START_OFF

    @property
    def communicates(self) -> bool:
        """True if SDO, SYNC and EMCY work: PRE-OPERATIONAL or OPERATIONAL."""
        return self.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)

    @property
    def boots_after_outage(self) -> bool:
        """True if the node boots after bus-off or an outage of the interface: 1029h:1 is 0."""
        return self._dictionary.number(0x1029, 1) == 0

    def enter(self, state: NmtState, now: int) -> None:
        if state is not self.state:
            self.state = state
            self._entered(now)

    def behave(self, error: int, now: int) -> None:
        """Change the state after an error as 1029h requires.

        ``error`` is the sub-index: 1 for a communication error, 2 for lost telemetry. The value 0
        means PRE-OPERATIONAL if the node is OPERATIONAL, 1 no change, 2 STOPPED.
        """
        behaviour = self._dictionary.number(0x1029, error)
        if behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self.enter(NmtState.PRE_OPERATIONAL, now)
        elif behaviour == 2 and self.communicates:
            self.enter(NmtState.STOPPED, now)


class Producer:
    """Sends heartbeats at the period of 1017h. With a period of 0 it sends no heartbeats."""

    def __init__(self, dictionary: Dictionary, send: Callable[[], None]) -> None:
        self.due = NEVER
        self._dictionary = dictionary
        self._send = send
        self._period = 0
        self.is_quiet = False
        """True if no heartbeats are sent: in quiet mode, or because no frame may leave."""
        dictionary.bind(0x1017, written=self.configure)

    @property
    def is_on(self) -> bool:
        """True if 1017h is not 0."""
        return bool(self._period)

    def configure(self, now: int) -> None:
        """Take over 1017h. The next heartbeat is sent one new period from now."""
        self._period = self._dictionary.number(0x1017) * MS
        self._set_due(now + self._period)

    def stop(self) -> None:
        """Send no heartbeats, whatever 1017h is, because the node has no node-ID."""
        self._period = 0
        self.due = NEVER

    def beat(self, now: int) -> None:
        """Make the next heartbeat due now, unless 1017h is 0."""
        self._set_due(now)

    def set_quiet(self, is_quiet: bool, now: int) -> None:
        """Send no heartbeats while ``is_quiet``. Afterwards, begin after one period."""
        self.is_quiet = is_quiet
        self._set_due(now + self._period)

    def _set_due(self, due: int) -> None:
        self.due = due if self._period and not self.is_quiet else NEVER

    def advance(self, now: int) -> None:
        """Send a heartbeat if it is due. Missed heartbeats are not sent later."""
        if now < self.due:
            return
        self.due += self._period
        if self.due <= now:
            self.due = now + self._period
        self._send()


@dataclass
class _Watched:
    """The watch over one node. It begins with the first heartbeat."""

    consumer_ns: int
    due: int = NEVER
    is_lost: bool = False


class Consumer:
    """The watch over heartbeats of other nodes (1016h).

    ``changed`` is called with a node-ID, True if its heartbeat is lost (False if it is back), the
    time, and the time at which the change happened.
    """

    def __init__(
        self, dictionary: Dictionary, changed: Callable[[int, bool, int, int], None]
    ) -> None:
        self._dictionary = dictionary
        self._changed = changed
        self._watched: dict[int, _Watched] = {}
        self._judged_from = -NEVER
        self._is_quiet = False
        for variable in dictionary.subs(0x1016):
            variable.check = partial(self._check, variable)
            variable.written = self._written

    def reset(self) -> None:
        """Start all watches from the beginning."""
        self._watched = {}
        self._configure()

    @property
    def node_ids(self) -> tuple[int, ...]:
        return tuple(self._watched)

    @property
    def due(self) -> int:
        """Earliest time at which ``advance`` acts."""
        if not self._watched or self._is_quiet:
            return NEVER
        first_due = min(watched.due for watched in self._watched.values())
        return max(self._judged_from, first_due)

    def set_quiet(self, is_quiet: bool) -> None:
        """Report no missing heartbeats while ``is_quiet``.

        Afterwards, the watch over each node begins again with its next heartbeat.
        """
        self._is_quiet = is_quiet
        for watched in self._watched.values():
            watched.due = NEVER

    def held_up(self, now: int) -> None:
        """Note that the process was held up until ``now``, so heartbeats may still be unread."""
        self._judged_from = now + _CATCHING_UP_NS

    def receive(
        self,
        node_id: int,
        data: bytes,
        now: int,
        at: int,
    ) -> None:
        """Note a heartbeat or boot-up message that arrived ``at``."""
        watched = self._watched.get(node_id)
        if len(data) != 1 or watched is None:
            return
        self._report_late(at, now)  # also this heartbeat may be late
        watched.due = at + watched.consumer_ns
        if watched.is_lost:
            watched.is_lost = False
            self._changed(node_id, False, now, at)

    def advance(self, now: int) -> None:
        """Report heartbeats that are missing now."""
        if now >= self._judged_from:
            self._report_late(now, now)

    def _report_late(self, until: int, now: int) -> None:
        """Report the heartbeats that were due before ``until``."""
        if self._is_quiet:
            return
        times: dict[int, int] = {}
        for node_id, watched in self._watched.items():
            if until >= watched.due:
                times[node_id] = watched.due
                watched.due = NEVER
                watched.is_lost = True
        for node_id, due in times.items():
            self._changed(node_id, True, now, due)

    def _configure(self) -> None:
        """Take over 1016h. Unchanged watches continue."""
        before = self._watched
        self._watched = {}
        for node_id, consumer_ns in self._entries():
            watched = before.get(node_id)
            if watched is None or watched.consumer_ns != consumer_ns:
                watched = _Watched(consumer_ns)
            self._watched[node_id] = watched

    def _written(self, now: int) -> None:
        before = self._watched
        self._configure()
        for node_id, old in before.items():
            if old.is_lost and self._watched.get(node_id) is not old:
                self._changed(node_id, False, now, now)

    def _check(self, own: Variable, value: int) -> None:
        """Check a new entry (CiA 301, 7.5.2.19).

        SdoAbort 06090030h for reserved bits, 06040043h if another entry watches the node already.
        """
        if value >> 24:
            raise SdoAbort(Abort.VALUE)  # reserved bits
        watch = _watch_of(value)
        if watch is None:
            return
        node_id, _ = watch
        if node_id in dict(self._entries(own)):
            raise SdoAbort(Abort.INCOMPATIBLE)

    def _entries(self, skipped: Variable | None = None) -> Iterator[tuple[int, int]]:
        """Yield node-ID and time in ns of each used entry, except a skipped one."""
        for variable in self._dictionary.subs(0x1016):
            if variable is skipped:
                continue
            watch = _watch_of(variable.value)
            if watch is not None:
                yield watch


def _watch_of(value: Value) -> tuple[int, int] | None:
    """Return an entry's node-ID (bits 23..16) and its time (bits 15..0, ms) in ns.

    None for an unused entry: the time is 0, or the node-ID is not 1..127.
    """
    if not isinstance(value, int):
        return None
    node_id = value >> 16 & 0xFF
    consumer_ns = (value & 0xFFFF) * MS
    if not 1 <= node_id <= 127 or not consumer_ns:
        return None
    return node_id, consumer_ns
