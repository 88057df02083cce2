"""Asks an allocation server on the bus for the node-ID of one node at a time (specification, 6.6).

The unique id is sent in three anonymous requests. Each further one is sent after the allocation
server has repeated the parts before it. A client that receives the request of another client starts
again later. Random numbers are generated from a seed, so that a replay sends at the same times.
"""

from kontronik_can_gw.dronecan.wire import ALLOCATION, LOW, MAX_NODE_ID, anonymous_id
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.transfer import transfer
from kontronik_can_gw.times import MS, NEVER

# Delays before a request, in ms
_PERIOD_MS = 600
"""Shortest delay of a first request."""
_MORE_MS = 401
"""Limit of the random time that is added to it."""
_FOLLOW_UP_MS = 401
"""Limit of the random delay of a further request."""
_PART = 6
"""Number of bytes of the unique id that fit into an anonymous frame."""


class Allocation:
    """The client of dynamic node-ID allocation."""

    def __init__(self, seed: int) -> None:
        self.due = NEVER
        """Time of the next request. NEVER if all nodes have a node-ID."""
        self.requests = 0
        """Number of first requests sent."""
        self.refused = 0
        """Number of allocated node-IDs that were invalid or already in use here."""
        self._random_state = seed
        self._unique_id = b""
        self._confirmed = 0
        """Number of bytes of the unique id that the allocation server has repeated."""
        self._transfer_id = 0

    def ask(self, unique_id: bytes, now: int) -> None:
        """Ask for the node with this unique id. An empty id stops asking."""
        self._unique_id = unique_id
        self._restart(now)

    def advance(self, now: int) -> list[CanFrame]:
        """Return the frames of the due request."""
        is_first = not self._confirmed
        self.requests += is_first
        part = self._unique_id[self._confirmed : self._confirmed + _PART]
        self._transfer_id = self._transfer_id + 1 & 0x1F
        can_id = anonymous_id(ALLOCATION.number, self._random(1 << 14), LOW)
        self._restart(now)  # this remains valid if there is no answer
        payload = ALLOCATION.pack(is_first) + part
        return transfer(can_id, ALLOCATION.seed, payload, self._transfer_id)

    def receive(
        self,
        source: int,
        payload: bytes,
        taken: set[int],
        now: int,
    ) -> int | None:
        """Process an Allocation message while asking.

        Returns the node-ID that was allocated to us, or None.

        ``source`` is the allocation server's node-ID, or 0 if the message is the request of another
        client. A node-ID in ``taken`` is refused.
        """
        repeated = payload[1:]
        is_ours = source and repeated and self._unique_id.startswith(repeated)
        self._restart(now)
        if not is_ours:
            return None
        if len(repeated) < len(self._unique_id):
            self._confirmed = len(repeated)
            self.due = now + self._random(_FOLLOW_UP_MS) * MS
            return None
        node_id = payload[0] >> 1
        if not 1 <= node_id <= MAX_NODE_ID or node_id in taken:
            self.refused += 1
            return None
        return node_id

    def _restart(self, now: int) -> None:
        self._confirmed = 0
        self.due = NEVER
        if self._unique_id:
            self.due = now + (_PERIOD_MS + self._random(_MORE_MS)) * MS

    def _random(self, limit: int) -> int:
        """Return a random number from 0 to ``limit`` - 1 (Knuth's MMIX generator)."""
        state = self._random_state * 6364136223846793005 + 1442695040888963407
        self._random_state = state & (1 << 64) - 1
        return (self._random_state >> 33) % limit
