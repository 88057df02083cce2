"""Heartbeat: the producer's tick (1017h) and the watch over other nodes (1016h). CiA 301, 7.2.8.2.2 and 7.5.2.19/20."""

from collections.abc import Iterable

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.esc.telemetry import MS

COB_ID = 0x700
NEVER = 1 << 62
"""A deadline that does not come."""


class Producer:
    """When the next heartbeat is due. A period of 0 produces none."""

    def __init__(self) -> None:
        self.due = NEVER
        self._period = 0

    def configure(self, period_ms: int, now: int) -> None:
        """A changed period holds from now on: the first heartbeat comes one period later."""
        self._period = period_ms * MS
        self.due = now + self._period if self._period else NEVER

    def beat(self, now: int) -> None:
        """Let the next one come at once, if there are any."""
        if self._period:
            self.due = now

    def ticks(self, now: int) -> bool:
        """True when one is due. Missed ones are not made up for: one heartbeat says all."""
        if now < self.due:
            return False
        self.due += self._period
        if self.due <= now:
            self.due = now + self._period
        return True


class _Watched:
    def __init__(self, node_id: int, timeout: int) -> None:
        self.node_id = node_id
        self.timeout = timeout
        self.due = NEVER  # the watch begins with the first heartbeat
        self.lost = False


class Consumer:
    """The nodes that are watched. ``lost``: node-IDs whose heartbeat stayed away."""

    def __init__(self) -> None:
        self._watched: dict[int, _Watched] = {}

    def configure(self, values: Iterable[int]) -> None:
        """From the entries of 1016h: bits 23..16 node-ID, bits 15..0 time in ms; 0 in either leaves it unused.

        A watch that stays as it was goes on.
        """
        before, self._watched = self._watched, {}
        for value in values:
            node_id, timeout = value >> 16 & 0xFF, (value & 0xFFFF) * MS
            if 1 <= node_id <= 127 and timeout:
                old = before.get(node_id)
                kept = old if old is not None and old.timeout == timeout else None
                self._watched[node_id] = kept or _Watched(node_id, timeout)

    @property
    def node_ids(self) -> tuple[int, ...]:
        return tuple(self._watched)

    @property
    def lost(self) -> list[int]:
        return [w.node_id for w in self._watched.values() if w.lost]

    @property
    def due(self) -> int:
        return min((w.due for w in self._watched.values()), default=NEVER)

    def receive(self, node_id: int, at: int) -> bool:
        """A heartbeat (or boot-up message) came. True if the node had been lost."""
        watched = self._watched.get(node_id)
        if watched is None:
            return False
        watched.due = at + watched.timeout
        was_lost, watched.lost = watched.lost, False
        return was_lost

    def advance(self, now: int) -> list[int]:
        """Node-IDs whose time ran out by now."""
        found = [w for w in self._watched.values() if now >= w.due]
        for watched in found:
            watched.due, watched.lost = NEVER, True
        return [w.node_id for w in found]


def check_consumer(value: int, others: Iterable[int]) -> None:
    """A new entry of 1016h. SdoAbort 06040043h where another entry watches the node already (CiA 301, 7.5.2.19)."""
    node_id = value >> 16 & 0xFF
    if value >> 24:
        raise SdoAbort(Abort.VALUE)  # reserved bits
    if (
        value & 0xFFFF
        and 1 <= node_id <= 127
        and any(o & 0xFFFF and o >> 16 & 0xFF == node_id for o in others)
    ):
        raise SdoAbort(Abort.INCOMPATIBLE)
