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


class View:
    """The values of a layout's columns, in the order of ``reader.columns``. ``now``: nanoseconds on the clock of the frames."""

    def __init__(self, reader: SignalReader) -> None:
        self.reader = reader
        self.values: list[Value] = [None] * len(reader.columns)
        self.of_parts: list[Sequence[Value]] = [[None] * part.count for part in reader.parts]
        """The same values for each of ``reader.parts``. A list is replaced, never changed."""
        self.frames = 0
        """Number of frames of the layout received."""
        self.last_ns: int | None = None
        """Time of the newest frame."""
        self._part_of = {part.first: index for index, part in enumerate(reader.parts)}
        self._life = [_life(part) for part in reader.parts]
        self._seen: list[int | None] = [None] * len(reader.parts)
        self.next_expiry: int | None = None
        """``expire`` has nothing to do before this time; None: for ever."""
        cycles = [
            part.plan.cycle_ns * len(part.plan.pages) for part in reader.parts if part.plan.cycle_ns
        ]
        self._silence_ns = max(_MIN_SILENCE_NS, _CYCLES * min(cycles)) if cycles else None

    def take(self, key: int, data: bytes, now: int) -> list[Chunk] | None:
        """Take a frame (``key``: its id, with EXTENDED for 29 bits); return its values, None where it is not of the layout."""
        chunks = self.reader.read(key, data)
        if chunks is None:
            return None
        self.frames += 1
        self.last_ns = now
        values, seen = self.values, self._seen
        for first, new in chunks:
            values[first : first + len(new)] = new
            part = self._part_of[first]
            self.of_parts[part] = new
            seen[part] = now
            life = self._life[part]
            due = self._due(part) if life is None else now + life
            if due is not None and (self.next_expiry is None or due < self.next_expiry):
                self.next_expiry = due
        return chunks

    def expire(self, now: int) -> bool:
        """Drop the values of missing messages; True where something was dropped."""
        if self.next_expiry is None or now <= self.next_expiry:
            return False
        dues = [self._due(index) for index in range(len(self._life))]
        forgotten = False
        for index, (part, due) in enumerate(zip(self.reader.parts, dues, strict=True)):
            if due is not None and now > due:
                self._seen[index] = None
                self.of_parts[index] = [None] * part.count
                self.values[part.first : part.first + part.count] = self.of_parts[index]
                forgotten = True
        self.next_expiry = min(
            (due for due in dues if due is not None and due >= now), default=None
        )
        return forgotten

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


def _life(part: Part) -> int | None:
    """How long a part's values hold without a new frame; None: as long as any frame of the gateway comes."""
    plan = part.plan
    if plan.cycle_ns:
        return max(_MIN_NS, _CYCLES * plan.cycle_ns * len(plan.pages))
    if SendType.EVENT in plan.send_type and Group.LIVE in plan.paces:
        return SECOND
    return None
