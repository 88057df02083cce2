"""Others on the bus that send with ids that only this gateway may send with."""

from collections.abc import Mapping, Sequence

from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.frames import EXTENDED
from kontronik_can_gw.output import NO_IDS, Output, Owner

_OVER_NS = 10 * SECOND
"""A conflict is over when no further frame has come for so long."""
_ECHO_NS = SECOND // 5


class Conflict:
    """Another device sends with an id of ours. ``whose``: what it is here; ``over``: that has ceased."""

    def __init__(self, key: int, owner: Owner, now: int) -> None:
        self.key = key
        self.whose = owner.what
        self.node = owner.esc
        self.begun = self.last = now
        self.count = 0
        self.over = False

    @property
    def can_id(self) -> int:
        return self.key & ~EXTENDED

    @property
    def is_extended(self) -> bool:
        return bool(self.key & EXTENDED)


class IdConflicts:
    """Watches the ids of the gateway's messages, ``of_gateway``, and of all outputs."""

    def __init__(self, of_gateway: Mapping[int, Owner], outputs: Sequence[Output]) -> None:
        self._of_gateway = of_gateway
        self._outputs = outputs
        self._routed: list[frozenset[int]] | None = None
        self._own: Mapping[int, Owner] = {}
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
        if self._routed is not None:
            for output, known in zip(self._outputs, self._routed, strict=True):
                if output.receive_ids is not known:
                    break
            else:
                return
        self._routed = [output.receive_ids for output in self._outputs]
        own = dict(self._of_gateway)
        for output in self._outputs:
            own |= output.own_ids()
        self._own = own
        self._receive_ids = frozenset(own).union(*self._routed)

    def first_own_id(self) -> int | None:
        """The lowest id of ours that is of no ESC's node; None without any."""
        self._follow()
        return min((key for key, owner in self._own.items() if owner.esc is None), default=None)

    def can_opened(self, now: int) -> None:
        """The interface was opened (again): what we sent before may still come back, and is no conflict."""
        self._echoes_until = now + _ECHO_NS

    def receive(self, key: int, now: int) -> bool:
        """A data frame of another device; True where its id is ours."""
        self._follow()
        owner = self._own.get(key)
        if owner is None or now < self._echoes_until:
            return False
        conflict = self._present.get(key)
        if conflict is None:
            conflict = self._present[key] = Conflict(key, owner, now)
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
            if conflict.node not in {other.node for other in self._present.values()}:
                self._report(conflict, False, now)

    def take(self) -> list[Conflict]:
        """Conflicts that have begun, or are over, since the last call."""
        news, self._news = self._news, []
        return news

    def _report(self, conflict: Conflict, present: bool, now: int) -> None:
        if conflict.node is not None:
            for output in self._outputs:
                output.collision(conflict.node, present, now)
