"""Others on the bus that send with ids that only this gateway may send with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from kontronik_can_gw.core.output import NO_IDS, Output, Owner
from kontronik_can_gw.frames import block_of, ids_in_words
from kontronik_can_gw.times import NEVER, SECOND

_OVER_NS = 10 * SECOND
"""A conflict is over when no further frame has come for so long."""
_ECHO_NS = SECOND // 5


@dataclass
class Conflict:
    """Another device sends with an id of ours. ``whose``: what it is here; ``output``: that has it, None: the gateway.

    ``over``: that has ceased.
    """

    key: int
    whose: str
    node: int | None
    output: Output | None
    last: int
    count: int = 0
    over: bool = False

    @property
    def ids(self) -> str:
        """The id, or the ids of a block, in words."""
        return ids_in_words(self.key)


class IdConflicts:
    """Watches the ids of the gateway's messages, ``of_gateway``, and of all outputs."""

    def __init__(self, of_gateway: Mapping[int, Owner], outputs: Sequence[Output]) -> None:
        self._of_gateway = of_gateway
        self._outputs = outputs
        self._revision = -1
        self._own: dict[int, tuple[Owner, Output | None]] = {}
        self._own_blocks: tuple[int, ...] = ()
        self._receive_ids = NO_IDS
        self._present: dict[int, Conflict] = {}
        self._news: list[Conflict] = []
        self._echoes_until = 0

    @property
    def receive_ids(self) -> frozenset[int]:
        """The ids (29-bit ones with EXTENDED) of all frames that concern us; the same object until they change."""
        self._follow()
        return self._receive_ids

    def _follow(self) -> None:
        revision = sum([output.revision for output in self._outputs])
        if revision == self._revision:
            return
        self._revision = revision
        own: dict[int, tuple[Owner, Output | None]]
        own = {key: (owner, None) for key, owner in self._of_gateway.items()}
        for output in self._outputs:
            own |= {key: (owner, output) for key, owner in output.own_ids().items()}
        self._own, self._own_blocks = own, tuple(key for key in own if key >> 32)
        ids = frozenset(own).union(*[output.receive_ids for output in self._outputs])
        if ids != self._receive_ids:
            self._receive_ids = ids

    def first_own_id(self) -> int | None:
        """The lowest id of ours that is of no ESC's node; None without any."""
        self._follow()
        return min(
            (key for key, (owner, _) in self._own.items() if owner.esc is None), default=None
        )

    def own_blocks(self) -> tuple[int, ...]:
        """The blocks of ids that only we send with."""
        self._follow()
        return self._own_blocks

    def can_opened(self, now: int) -> None:
        """The interface was opened (again): what we sent before may still come back, and is no conflict."""
        self._echoes_until = now + _ECHO_NS

    def receive(self, key: int, now: int) -> bool:
        """A data frame of another device; True where its id is ours."""
        self._follow()
        own = key if key in self._own else block_of(key, self._own_blocks)
        if own is None or now < self._echoes_until:
            return False
        conflict = self._present.get(own)
        if conflict is None:
            owner, output = self._own[own]
            conflict = self._present[own] = Conflict(own, owner.what, owner.esc, output, now)
            self._news.append(conflict)
            self._report(conflict, True, now)
        conflict.count += 1
        conflict.last = now
        return True

    def advance(self, now: int) -> None:
        """End the conflicts of which no frame has come for ten seconds."""
        if not self._present:
            return
        for conflict in [c for c in self._present.values() if now - c.last > _OVER_NS]:
            conflict.over = True
            del self._present[conflict.key]
            self._news.append(conflict)
            if not any(
                (each.output, each.node) == (conflict.output, conflict.node)
                for each in self._present.values()
            ):
                self._report(conflict, False, now)

    def next_deadline(self) -> int:
        """When ``advance`` has something to do at the earliest."""
        if not self._present:
            return NEVER
        return min(each.last + _OVER_NS + 1 for each in self._present.values())

    def take(self) -> list[Conflict]:
        """Conflicts that have begun, or are over, since the last call."""
        news, self._news = self._news, []
        return news

    def _report(self, conflict: Conflict, present: bool, now: int) -> None:
        if conflict.output is not None and conflict.node is not None:
            conflict.output.collision(conflict.node, present, now)
