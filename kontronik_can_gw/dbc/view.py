"""The receiver's view of the bus: the newest value of each signal while it is fresh. Pure; time is an argument.

A value is None before its first frame, while the gateway sends it as not available, and when its message is missing: a cyclic one for
three cycles, one sent with telemetry for a second, one sent on change when nothing of the gateway has come for three of the shortest
cycles (at least 3 s; never if no message has a cycle).
"""

from collections.abc import Sequence

from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.signals.plan import SendType
from kontronik_can_gw.signals.unpacker import Chunk, Part, SignalReader, Value
from kontronik_can_gw.times import MS, SECOND

_MIN_NS = 250 * MS
_CYCLES = 3
_MIN_SILENCE_NS = 3 * SECOND


class Freshness:
    """How long the parts of a layout hold their values. ``now`` never goes back."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.last_ns: int | None = None
        """Time of the newest frame."""
        self.next_expiry: int | None = None
        """``expire`` has nothing to do before this time. None: it has nothing to do at any time."""
        self._life = [_life(part) for part in parts]
        self._seen: list[int | None] = [None] * len(parts)
        cycles = [part.plan.cycle_ns * len(part.plan.pages) for part in parts if part.plan.cycle_ns]
        self._silence_ns = max(_MIN_SILENCE_NS, _CYCLES * min(cycles)) if cycles else None

    def note(self, parts: Sequence[int], now: int) -> None:
        """Take note of a frame with these parts."""
        self.last_ns = now
        for part in parts:
            is_new = self._seen[part] is None
            self._seen[part] = now
            if is_new:  # otherwise its values held until a later time than ``next_expiry`` before
                due = self._due(part)
                if due is not None and (self.next_expiry is None or due < self.next_expiry):
                    self.next_expiry = due

    def expire(self, now: int) -> list[int]:
        """Return the parts that hold no longer. They are then as before their first frame."""
        if self.next_expiry is None or now <= self.next_expiry:
            return []
        dues = [self._due(index) for index in range(len(self._life))]
        expired = [index for index, due in enumerate(dues) if due is not None and now > due]
        for index in expired:
            self._seen[index] = None
        self.next_expiry = min(
            (due for due in dues if due is not None and due >= now), default=None
        )
        return expired

    def _due(self, index: int) -> int | None:
        """Until when a part's values hold; None: unknown, or there are none."""
        seen, life = self._seen[index], self._life[index]
        if seen is None:
            return None
        if life is not None:
            return seen + life
        if self._silence_ns is None or self.last_ns is None:
            return None
        return self.last_ns + self._silence_ns


class View:
    """The values of a layout's columns, in the order of ``reader.columns``.

    ``now``: nanoseconds on the clock of the frames, which never goes back.
    """

    def __init__(self, reader: SignalReader) -> None:
        self.reader = reader
        self.values: list[Value] = [None] * len(reader.columns)
        self.frames = 0
        """Number of frames of the layout received."""
        self._freshness = Freshness(reader.parts)
        self._part_of = {part.first: index for index, part in enumerate(reader.parts)}

    @property
    def last_ns(self) -> int | None:
        """Time of the newest frame."""
        return self._freshness.last_ns

    def take(self, key: int, data: bytes, now: int) -> list[Chunk] | None:
        """Take a frame and return its values. None if it is not of the layout.

        ``key``: its id, with EXTENDED for 29 bits.
        """
        chunks = self.reader.read(key, data)
        if chunks is None:
            return None
        self.frames += 1
        for first, new in chunks:
            self.values[first : first + len(new)] = new
        self._freshness.note([self._part_of[first] for first, _ in chunks], now)
        return chunks

    def expire(self, now: int) -> bool:
        """Drop the values of missing messages; True where something was dropped."""
        expired = self._freshness.expire(now)
        for index in expired:
            part = self.reader.parts[index]
            self.values[part.first : part.first + part.count] = [None] * part.count
        return bool(expired)


def _life(part: Part) -> int | None:
    """How long a part's values hold without a new frame; None: as long as any frame of the gateway comes."""
    plan = part.plan
    if plan.cycle_ns:
        return max(_MIN_NS, _CYCLES * plan.cycle_ns * len(plan.pages))
    if SendType.EVENT in plan.send_type and Group.LIVE in plan.paces:
        return SECOND
    return None
