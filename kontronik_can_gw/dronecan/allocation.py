"""The client of dynamic node-ID allocation (specification, 6.6): asks an allocator on the bus for a node-ID, for one node at a time.

The unique id goes out in three anonymous requests, each after the allocator has repeated what came before. A client
that hears another's request begins anew, later. Random numbers come from a seed, so that a replay asks at the same moments.
"""

from kontronik_can_gw.dronecan.wire import ALLOCATION, LOW, MAX_NODE_ID, anonymous_id
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.transfer import transfer
from kontronik_can_gw.times import MS, NEVER

_PERIOD_MS, _MORE_MS, _FOLLOW_UP_MS = 600, 401, 401
_PART = 6
"""Bytes of the unique id in a request: more do not fit an anonymous frame."""


class Allocation:
    """``due``: when ``advance`` has something to do. ``requests``: first parts sent; ``refused``: node-IDs that cannot be ours."""

    def __init__(self, seed: int) -> None:
        self.due = NEVER
        self.requests = self.refused = 0
        self._random_state = seed
        self._unique_id = b""
        self._confirmed = 0
        """Bytes of the unique id that the allocator has repeated."""
        self._transfer_id = 0

    def ask(self, unique_id: bytes, now: int) -> None:
        """Ask for the node with this id; empty: nothing is to be asked for."""
        self._unique_id = unique_id
        self._begin_anew(now)

    def advance(self, now: int) -> list[CanFrame]:
        """The request that is due."""
        first = not self._confirmed
        self.requests += first
        part = self._unique_id[self._confirmed : self._confirmed + _PART]
        self._transfer_id = self._transfer_id + 1 & 0x1F
        can_id = anonymous_id(ALLOCATION.number, self._random(1 << 14), LOW)
        self._begin_anew(now)  # without an answer
        payload = ALLOCATION.pack(first) + part
        return transfer(can_id, ALLOCATION.seed, payload, self._transfer_id)

    def receive(self, source: int, payload: bytes, taken: set[int], now: int) -> int | None:
        """Take an Allocation message of a node, 0: of another that asks. Returns the node-ID that was allocated to us.

        ``taken``: those that cannot be.
        """
        if self.due == NEVER:
            return None
        said = payload[1:]
        is_ours = source and said and self._unique_id.startswith(said)
        self._begin_anew(now)
        if not is_ours:
            return None
        if len(said) < len(self._unique_id):
            self._confirmed = len(said)
            self.due = now + self._random(_FOLLOW_UP_MS) * MS
            return None
        node_id = payload[0] >> 1
        if not 1 <= node_id <= MAX_NODE_ID or node_id in taken:
            self.refused += 1
            return None
        return node_id

    def _begin_anew(self, now: int) -> None:
        self._confirmed, self.due = 0, NEVER
        if self._unique_id:
            self.due = now + (_PERIOD_MS + self._random(_MORE_MS)) * MS

    def _random(self, below: int) -> int:
        """A number from 0 on (Knuth's MMIX generator)."""
        state = self._random_state * 6364136223846793005 + 1442695040888963407
        self._random_state = state & (1 << 64) - 1
        return (self._random_state >> 33) % below
