"""Detects other devices on the bus that transmit with this gateway's CAN ids."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from kontronik_can_gw.core.output import NO_IDS, Output, Owner
from kontronik_can_gw.frames import block_of, ids_in_words
from kontronik_can_gw.times import NEVER, SECOND

_OVER_NS = 10 * SECOND
"""A conflict ends if no further frame arrives for this long."""
_ECHO_NS = SECOND // 5
"""After the interface was opened, it may return own earlier frames for this long."""


@dataclass
class Conflict:
    """Another device that sends with an own id, or with an id of an own block."""

    key: int
    """The id or block. 29-bit ids contain ``EXTENDED``."""
    whose: str
    """Our use of the id, such as "message Voltages"."""
    node: int | None
    """The ESC whose node sends with the id. None if no node does."""
    output: Output | None
    """The output that uses the id. None if a message does."""
    last: int
    """The time of the last frame."""
    count: int = 0
    """Number of frames of the other device."""
    is_over: bool = False
    """True if the conflict has ended."""

    @property
    def ids(self) -> str:
        """The id, or the ids of the block, as text."""
        return ids_in_words(self.key)


class IdConflicts:
    """Watches the ids of the messages and of all outputs."""

    def __init__(self, message_ids: Mapping[int, Owner], outputs: Sequence[Output]) -> None:
        self._message_ids = message_ids
        self._outputs = outputs
        self._revision = -1
        self._own: dict[int, tuple[Owner, Output | None]] = {}
        self._own_blocks: tuple[int, ...] = ()
        self._receive_ids = NO_IDS
        self._present: dict[int, Conflict] = {}
        self._news: list[Conflict] = []
        self._echoes_until = 0
        self.due = NEVER
        """Time of the next call of ``advance``."""

    @property
    def receive_ids(self) -> frozenset[int]:
        """As ``Gateway.receive_ids``."""
        self._update_ids()
        return self._receive_ids

    def _update_ids(self) -> None:
        """Compute the ids again if an output has changed."""
        revision = sum([output.revision for output in self._outputs])
        if revision == self._revision:
            return
        self._revision = revision
        own: dict[int, tuple[Owner, Output | None]] = {}
        for key, owner in self._message_ids.items():
            own[key] = (owner, None)
        for output in self._outputs:
            for key, owner in output.own_ids().items():
                own[key] = (owner, output)
        self._own = own
        self._own_blocks = tuple(key for key in own if key >> 32)
        received = [output.receive_ids for output in self._outputs]
        ids = frozenset(own).union(*received)
        if ids != self._receive_ids:
            self._receive_ids = ids

    def first_own_id(self) -> int | None:
        """Return the lowest own id that belongs to no node, or None."""
        self._update_ids()
        without_node = []
        for key, (owner, _) in self._own.items():
            if owner.esc is None:
                without_node.append(key)
        return min(without_node, default=None)

    def own_blocks(self) -> tuple[int, ...]:
        """Return the own blocks of ids."""
        self._update_ids()
        return self._own_blocks

    def can_opened(self, now: int) -> None:
        """Ignore own frames that an interface may return after it was opened."""
        self._echoes_until = now + _ECHO_NS

    def receive(self, key: int, now: int) -> bool:
        """Take a data frame of another device. Return True if it has an own id."""
        self._update_ids()
        own = key if key in self._own else block_of(key, self._own_blocks)
        if own is None or now < self._echoes_until:
            return False
        conflict = self._present.get(own)
        if conflict is None:
            owner, output = self._own[own]
            conflict = Conflict(own, owner.what, owner.esc, output, now)
            self._present[own] = conflict
            self._news.append(conflict)
            self._report(conflict, True, now)
        conflict.count += 1
        conflict.last = now
        self.due = min(self.due, now + _OVER_NS + 1)
        return True

    def advance(self, now: int) -> None:
        """End the conflicts without a frame for ten seconds."""
        ended = [each for each in self._present.values() if now - each.last > _OVER_NS]
        for conflict in ended:
            conflict.is_over = True
            del self._present[conflict.key]
            self._news.append(conflict)
            node = (conflict.output, conflict.node)
            others = [(each.output, each.node) for each in self._present.values()]
            if node not in others:
                self._report(conflict, False, now)
        lasts = [each.last for each in self._present.values()]
        self.due = min(lasts, default=NEVER) + _OVER_NS + 1

    def take(self) -> list[Conflict]:
        """Return the conflicts that began or ended since the last call."""
        news = self._news
        self._news = []
        return news

    def _report(self, conflict: Conflict, present: bool, now: int) -> None:
        if conflict.output is not None and conflict.node is not None:
            conflict.output.collision(conflict.node, present, now)
