"""The receiver's view of the bus: the newest value of each signal while it is fresh.

Pure: time is an argument. A value is None before its first frame, and while the gateway sends it as
not available. It also becomes None if its message is missing for this time:

* a cyclic message for three cycles,
* a message that is sent with telemetry for a second,
* a message that is sent on change if no frame of the gateway was received for three of the shortest
  cycles, and at least 3 s. It never expires if no message has a cycle.
"""

from collections.abc import Sequence

from kontronik_can_gw.desk.receiver.unpacker import Chunk, Part, SignalReader, Value
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.signals.plan import SendType
from kontronik_can_gw.times import MS, SECOND

_MIN_NS = 250 * MS
_CYCLES = 3
_MIN_SILENCE_NS = 3 * SECOND


class Freshness:
    """The times at which the values of a layout's parts expire. ``now`` must not decrease."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.last_ns: int | None = None
        """Time of the newest frame."""
        self.next_expiry: int | None = None
        """``expire`` has no effect before this time. None: it has no effect at any time."""
        self._life = [_life(part) for part in parts]
        self._seen: list[int | None] = [None] * len(parts)
        """Time of each part's newest frame. None after its values have expired."""
        self._silence_ns: int | None = None
        """Time without a frame of the gateway after which all values expire. None: never."""
        plans = [part.plan for part in parts if part.plan.cycle_ns]
        if plans:
            shortest_ns = min(plan.cycle_ns * len(plan.pages) for plan in plans)
            self._silence_ns = max(_MIN_SILENCE_NS, _CYCLES * shortest_ns)

    def note(self, parts: Sequence[int], now: int) -> None:
        """Record the arrival of a frame with these parts."""
        self.last_ns = now
        for part in parts:
            is_new = self._seen[part] is None
            self._seen[part] = now
            if is_new:  # otherwise ``next_expiry`` is already early enough for this part
                due = self._due(part)
                if due is not None and (self.next_expiry is None or due < self.next_expiry):
                    self.next_expiry = due

    def expire(self, now: int) -> list[int]:
        """Return the parts whose values have expired. Their next frame counts as the first one."""
        if self.next_expiry is None or now <= self.next_expiry:
            return []
        expired = []
        next_expiry = None
        for index in range(len(self._life)):
            due = self._due(index)
            if due is None:
                continue
            if now > due:
                expired.append(index)
            elif next_expiry is None or due < next_expiry:
                next_expiry = due
        for index in expired:
            self._seen[index] = None
        self.next_expiry = next_expiry
        return expired

    def _due(self, index: int) -> int | None:
        """Return the time at which a part's values expire. None if unknown or without values."""
        seen = self._seen[index]
        life = self._life[index]
        if seen is None:
            return None
        if life is not None:
            return seen + life
        if self._silence_ns is None or self.last_ns is None:
            return None
        return self.last_ns + self._silence_ns


class View:
    """The values of a layout's columns, in the order of ``reader.columns``.

    ``now`` is in ns on the clock of the frames, and must not decrease.
    """

    def __init__(self, reader: SignalReader) -> None:
        self.reader = reader
        self.values: list[Value] = [None] * len(reader.columns)
        self.frames = 0
        """Number of frames of the layout received."""
        self._freshness = Freshness(reader.parts)
        self._part_of = {part.first: index for index, part in enumerate(reader.parts)}
        """Index of the part that begins at a column."""

    @property
    def last_ns(self) -> int | None:
        """Time of the newest frame."""
        return self._freshness.last_ns

    def take(self, key: int, data: bytes, now: int) -> list[Chunk] | None:
        """Evaluate a frame. Return its values, or None if it is not in the layout.

        ``key``: its id, with EXTENDED for 29 bits.
        """
        chunks = self.reader.read(key, data)
        if chunks is None:
            return None
        self.frames += 1
        for first, new in chunks:
            self.values[first : first + len(new)] = new
        parts = [self._part_of[first] for first, _ in chunks]
        self._freshness.note(parts, now)
        return chunks

    def expire(self, now: int) -> bool:
        """Set the values of missing messages to None. Return True if a message is missing."""
        expired = self._freshness.expire(now)
        for index in expired:
            part = self.reader.parts[index]
            end = part.first + part.count
            self.values[part.first : end] = [None] * part.count
        return bool(expired)


def _life(part: Part) -> int | None:
    """Return the time in ns after which a part's values expire without a new frame.

    None if they are valid while any frame of the gateway is received.
    """
    plan = part.plan
    if plan.cycle_ns:
        return max(_MIN_NS, _CYCLES * plan.cycle_ns * len(plan.pages))
    if SendType.EVENT in plan.send_type and Group.LIVE in plan.paces:
        return SECOND
    return None
