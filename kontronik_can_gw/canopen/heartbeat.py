"""Heartbeat: the producer's tick (1017h) and the watch over other nodes (1016h). CiA 301, 7.2.8.2.2 and 7.5.2.19/20."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.dictionary import Dictionary, Value, Variable
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.output import NEVER

_CATCHING_UP_NS = SECOND // 2
"""After a hold-up no heartbeat is missed for this long unless it was seen to be late: what came meanwhile is read piece by piece."""


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

    ``changed`` is called with a node-ID, whether its heartbeat is lost (or no longer), and the time.
    """

    def __init__(self, dictionary: Dictionary, changed: Callable[[int, bool, int], None]) -> None:
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
            self._changed(node_id, False, now)

    def advance(self, now: int) -> None:
        """Let time pass."""
        if now >= self._judged_from:
            self._judge(now, now)

    def _judge(self, until: int, now: int) -> None:
        late = {node_id: each for node_id, each in self._watched.items() if until >= each.due}
        for watched in late.values():
            watched.due, watched.lost = NEVER, True
        for node_id in late:
            self._changed(node_id, True, now)

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
                self._changed(node_id, False, now)

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
