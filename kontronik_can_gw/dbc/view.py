"""What a participant of the bus knows now: the newest value of each signal, as long as it is fresh. Pure; time is handed in.

A value is None before its first frame, when the gateway says that it is not available, and when its message stays away: a cyclic one for
three cycles, one that comes with telemetry for a second, one that comes on change only when nothing of the gateway's has come for three of
the shortest cycles (3 s at least; never where no message has a cycle, because then nobody knows).
"""

from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.signals.plan import SendType
from kontronik_can_gw.signals.unpacker import Chunk, Part, SignalReader, Value

_MIN_NS = 250 * MS
_CYCLES = 3
_MIN_SILENCE_NS = 3 * SECOND


class View:
    """The values of a layout's columns, in the order of ``reader.columns``. ``now``: nanoseconds of one clock, that of the frames."""

    def __init__(self, reader: SignalReader) -> None:
        self.reader = reader
        self.values: list[Value] = [None] * len(reader.columns)
        self.frames = 0
        """Frames of the layout that were taken."""
        self.last_ns: int | None = None
        """When the newest of them came."""
        self._part_of = {part.first: index for index, part in enumerate(reader.parts)}
        self._life = [_life(part) for part in reader.parts]
        self._seen: list[int | None] = [None] * len(reader.parts)
        self._next_expiry: int | None = None
        cycles = [
            part.plan.cycle_ns * len(part.plan.pages) for part in reader.parts if part.plan.cycle_ns
        ]
        self._silence_ns = max(_MIN_SILENCE_NS, _CYCLES * min(cycles)) if cycles else None

    @property
    def next_expiry(self) -> int | None:
        """``expire`` has nothing to do up to this time; None: for ever."""
        return self._next_expiry

    def take(self, key: int, data: bytes, now: int) -> list[Chunk] | None:
        """Take a frame (``key``: its id, with EXTENDED for 29 bits); what it brought, None where it is not of the layout."""
        chunks = self.reader.read(key, data)
        if chunks is None:
            return None
        self.frames += 1
        self.last_ns = now
        values, seen = self.values, self._seen
        for first, new in chunks:
            values[first : first + len(new)] = new
            part = self._part_of[first]
            seen[part] = now
            due = self._due(part)
            if due is not None and (self._next_expiry is None or due < self._next_expiry):
                self._next_expiry = due
        return chunks

    def expire(self, now: int) -> bool:
        """Forget what has stayed away for too long; True where something was forgotten."""
        if self._next_expiry is None or now <= self._next_expiry:
            return False
        dues = [self._due(index) for index in range(len(self._life))]
        forgotten = False
        for index, (part, due) in enumerate(zip(self.reader.parts, dues, strict=True)):
            if due is not None and now > due:
                self._seen[index] = None
                self.values[part.first : part.first + part.count] = [None] * part.count
                forgotten = True
        self._next_expiry = min(
            (due for due in dues if due is not None and due >= now), default=None
        )
        return forgotten

    def _due(self, index: int) -> int | None:
        """Until when a part's values hold; None: nobody knows, or there are none."""
        seen, life = self._seen[index], self._life[index]
        if seen is None:
            return None
        if life is not None:
            return seen + life
        return (
            None
            if self._silence_ns is None or self.last_ns is None
            else self.last_ns + self._silence_ns
        )

    def value(self, source: str, esc: int | None = None) -> Value:
        """The value of the signal that is bound to a source; None where the layout has none too."""
        index = self.reader.column_of(source, esc)
        return None if index is None else self.values[index]


def _life(part: Part) -> int | None:
    """How long a part's values hold without a new frame; None: as long as anything of the gateway's comes."""
    plan = part.plan
    if plan.cycle_ns:
        return max(_MIN_NS, _CYCLES * plan.cycle_ns * len(plan.pages))
    if SendType.EVENT in plan.send_type and Group.LIVE in plan.paces:
        return SECOND
    return None
