"""Captures the time around events: keeps the input in memory, and writes it when an event occurs.

The recorder's thread moves the entries to a ring of about ``before_s`` seconds. With an event, the
ring becomes the beginning of a capture, which continues until ``after_s`` seconds after the last
event. Each capture is a run of its own. If events are close together, captures can have entries in
common.

The ring is cut into segments, each of which begins with a STATE entry, and only whole segments are
dropped. A replay has the exact state ``SETTLE_NS`` after its beginning, so the ring is longer than
``before_s`` by that time.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw.capture.format import (
    SETTLE_NS,
    EntryKind,
    Packed,
    data_payload,
    event_in_words,
    json_payload,
    packed,
    read_json,
    read_numbers,
)
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.runtime.files.recorder import (
    STATE_NS,
    CapturePart,
    Item,
    Recorder,
    RecorderFacts,
    remark_of_losses,
)
from kontronik_can_gw.runtime.status.facts import utc
from kontronik_can_gw.runtime.system.clock import ClockFacts
from kontronik_can_gw.times import SECOND

_MARGIN_NS = SETTLE_NS + STATE_NS
"""Time by which the ring is longer than ``before_s``."""
_BYTES_PER_S = 20_000
"""Size of an ESC's second in memory, at most. Usually a second at 100 Hz needs less than half."""
_MAX_LISTED = 100
"""Number of events that a capture lists. Later ones are only counted."""
_MAX_WAITING = 1000
"""Number of events that can wait for the recorder's thread. Later ones are only counted."""


def ring_bytes(config: RecordConfig, escs: int) -> int:
    """Return the greatest size of the ring in memory."""
    seconds = config.before_s + (_MARGIN_NS + STATE_NS) // SECOND
    return escs * seconds * _BYTES_PER_S


class RecordedEvent(NamedTuple):
    """An event that is recorded."""

    time_ns: int
    """Time on the monotonic clock."""
    wall: float
    """Unix time in seconds."""
    esc: str
    """Name of the ESC. Empty if the event does not belong to an ESC."""
    reason: str

    @property
    def in_words(self) -> str:
        return event_in_words(self.esc, self.reason)


@dataclass
class EventRecorderFacts(RecorderFacts):
    """The state of the recording on events, for the status document."""

    on_event: bool = True
    ring_bytes: int = 0
    """Size of the entries that are kept in memory."""
    events: int = 0
    """Number of events since the start."""
    event: dict[str, str] | None = None
    """The last event: its ``time`` in UTC, ``esc``, ``reason`` and ``file``.

    The file is empty until the event is recorded. None if it could not be recorded.
    """


class Segment(NamedTuple):
    """A part of the ring. It begins with a STATE entry, except at the start of the gateway."""

    begin_ns: int
    state: bytes
    """The data of the STATE entry. Empty at the start of the gateway."""
    offset: int
    """Time of the wall clock minus the monotonic clock at its beginning, in ns."""
    clock: ClockFacts


class Chunk(NamedTuple):
    """Some entries of a segment, packed."""

    number: int
    """Counts up from 1."""
    begin_ns: int
    segment: Segment
    payload: Packed
    entries: int
    """Number of entries, without remarks about losses and the clock."""
    missing: int
    """Sum of the losses that its remarks state."""


class Ring:
    """The last entries, packed. Bounded in time and in bytes.

    Entries stay in the ring after they were written, so that the next capture can begin with them.
    """

    def __init__(self, keep_ns: int, max_bytes: int) -> None:
        self.bytes = 0
        self.written = 0
        """Number of the last chunk that is in the capture."""
        self._keep_ns = keep_ns
        self._max_bytes = max_bytes
        self._segments: deque[Segment] = deque()
        self._chunks: deque[Chunk] = deque()
        self._number = 0
        self.is_cut = False
        """True if entries are ignored until the next segment begins."""
        self.missing = 0
        """Number of entries that are missing after the newest one in the ring."""
        self.newest_ns = 0
        """Time of the newest entry."""

    def add(
        self,
        items: Sequence[Item],
        offset: int,
        clock: ClockFacts,
        holds: bool = False,
    ) -> int:
        """Append entries. Return the number of dropped entries that were not written.

        The number of missing entries is remarked as soon as entries follow, at the end of the
        segment before them. So each capture with that place has the remark. ``holds``: old entries
        are kept, and new entries are dropped if the ring is full. A disk that fails should not cost
        the seconds before an event.
        """
        lost = 0
        for part in _cut(items):
            begin_ns, kind, _, state, _, _ = part[0]
            is_begin = kind == EntryKind.STATE
            is_held = holds and bool(self._segments)
            payload = packed(data_payload(part))
            is_ignored = self.is_cut and (is_held or not is_begin)
            if is_ignored or (holds and self.bytes + len(payload.stored) > self._max_bytes):
                entries, missing = _counts(part)
                lost += entries
                self.missing += entries + missing
                self.is_cut = True
                continue
            self.is_cut = False
            before = self._segments[-1] if self._segments else None
            if is_begin or before is None:
                self._segments.append(Segment(begin_ns, state if is_begin else b"", offset, clock))
            if self.missing:
                time_ns = begin_ns if before is None else self.newest_ns
                remark = [remark_of_losses(time_ns, self.missing)]
                self.missing = 0
                segment = before or self._segments[-1]
                self._append(segment, remark, packed(data_payload(remark)))
            self._append(self._segments[-1], part, payload)
            while self.bytes > self._max_bytes or (not holds and self._is_first_old()):
                dropped = self._drop_segment()
                lost += sum(chunk.entries for chunk in dropped)
                self.is_cut = not self._segments
                if self.is_cut:
                    self.missing += sum(chunk.entries + chunk.missing for chunk in dropped)
        return lost

    def _append(self, segment: Segment, items: Sequence[Item], payload: Packed) -> None:
        self._number += 1
        chunk = Chunk(self._number, items[0][0], segment, payload, *_counts(items))
        self._chunks.append(chunk)
        self.bytes += len(payload.stored)
        self.newest_ns = items[-1][0]

    def _is_first_old(self) -> bool:
        segments = self._segments
        return len(segments) > 1 and segments[1].begin_ns <= self.newest_ns - self._keep_ns

    def _drop_segment(self) -> list[Chunk]:
        """Drop the oldest segment. Return its chunks that were not written."""
        segment = self._segments.popleft()
        dropped = []
        while self._chunks and self._chunks[0].segment is segment:
            chunk = self._chunks.popleft()
            self.bytes -= len(chunk.payload.stored)
            if chunk.number > self.written:
                dropped.append(chunk)
        return dropped

    def unwritten(self, end_ns: int) -> list[Chunk]:
        """Return the chunks that were not written, of segments that begin before ``end_ns``."""
        return [
            chunk
            for chunk in self._chunks
            if chunk.number > self.written and chunk.segment.begin_ns < end_ns
        ]

    def is_complete(self, end_ns: int) -> bool:
        """Return True if no entry can be added to the segments that begin before ``end_ns``."""
        return bool(self._segments) and self._segments[-1].begin_ns >= end_ns


def _counts(items: Sequence[Item]) -> tuple[int, int]:
    """Return the number of entries without remarks, and the losses that the remarks state."""
    entries = sum(item[1] not in (EntryKind.LOST, EntryKind.CLOCK) for item in items)
    missing = [read_numbers(item[3])[0] for item in items if item[1] == EntryKind.LOST]
    return entries, sum(missing)


def _cut(items: Sequence[Item]) -> Iterator[Sequence[Item]]:
    """Cut entries before each STATE entry."""
    begin = 0
    for place, item in enumerate(items):
        if item[1] == EntryKind.STATE and place > begin:
            yield items[begin:place]
            begin = place
    if begin < len(items):
        yield items[begin:]


class EventRecorder(Recorder):
    """Writes captures of the time around events. ``trigger`` reports an event."""

    facts: EventRecorderFacts
    _keeps_items = True

    def __init__(
        self,
        folder: Path,
        config: RecordConfig,
        escs: int,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(folder, config, clock)
        self.facts = EventRecorderFacts()
        self._ring = Ring(config.before_s * SECOND + _MARGIN_NS, ring_bytes(config, escs))
        self._after_ns = config.after_s * SECOND
        self._triggers: deque[RecordedEvent] = deque()
        self._dropped_events = 0
        """Number of events that could not wait. Only the loop's thread counts them."""
        self._newest_ns = 0
        """Time of the last event."""
        self._taken = 0
        self._until_ns: int | None = None
        """Time at which the capture may end. None while nothing is recorded."""
        self._listed: list[RecordedEvent] = []
        """The first events of the capture."""
        self._is_list_written = True
        self._has_next_part = False
        """True if the next part continues a capture."""
        self._new: list[RecordedEvent] = []
        """Events that were not logged yet."""
        self._lines: deque[tuple[str, str]] = deque()

    # --- in the loop's thread

    def mark(self) -> None:
        self.trigger(self._clock(), time.time(), "", "signal USR1")

    def trigger(self, time_ns: int, wall: float, esc: str, reason: str) -> None:
        """Report an event. Never waits."""
        self._newest_ns = max(self._newest_ns, time_ns)
        if len(self._triggers) < _MAX_WAITING:
            self._triggers.append(RecordedEvent(time_ns, wall, esc, reason))
        else:
            self._dropped_events += 1

    def take_events(self) -> list[tuple[str, str]]:
        return [self._lines.popleft() for _ in range(len(self._lines))]

    # --- in the recorder's thread

    def _write(self, items: list[Item], now: int) -> None:
        self._take_triggers()
        if items:
            self._add(items, now)
        self.facts.ring_bytes = self._ring.bytes
        if now >= self._check_ns:
            self._check(now)
        if self._is_usable and self._until_ns is not None:
            self._write_ring(self._until_ns, now)
        elif self._is_usable and self.facts.problem:
            self._note_problem("", f"{self._folder}: can be used again")
        self._make_lines()

    def _add(self, items: list[Item], now: int) -> None:
        """Add entries to the ring. Count those that a capture will not have."""
        is_active = self._until_ns is not None
        holds = is_active and self._file is None
        self._append_remarks(items, now)
        dropped = self._ring.add(items, self._offset, self._recorded_clock, holds)
        if self._ring.is_cut:  # the remark about the clock was dropped, too
            self._offset = 0
            self._clock_ns = 0
        if is_active:
            self._unwritten += dropped
            self._recorded_losses += dropped  # the ring remarks them
        is_full = holds and dropped > 0
        text = "captures: there is room in memory again"
        if is_full:
            text = "captures: the memory is full, so input is lost until the folder can be used"
        self._worker.faults.note("captures: memory", is_full, text)

    def _fail(self, error: Exception, now: int) -> None:
        super()._fail(error, now)
        self._has_next_part = False
        self._make_lines()

    def _take_triggers(self) -> None:
        """Begin or extend the capture for the events that have occurred."""
        for _ in range(len(self._triggers)):
            event = self._triggers.popleft()
            self._until_ns = self._newest_ns + self._after_ns
            self._new.append(event)
            if len(self._listed) < _MAX_LISTED:
                self._listed.append(event)
                self._is_list_written = False
            self._taken += 1
            self.facts.events = self._taken + self._dropped_events
            self.facts.event = {
                "time": utc(event.wall),
                "esc": event.esc,
                "reason": event.reason,
                "file": self.facts.file,
            }

    def _make_lines(self) -> None:
        """Make a line for the log about each new event."""
        place = f"recording to {self.facts.file or self._folder}"
        if self.facts.problem:
            place = f"cannot be recorded yet: {self.facts.problem}"
        for event in self._new:
            name = f"event: {event.in_words}"
            if len(self._lines) < _MAX_WAITING:
                self._lines.append((name, f"{name}: {place}"))
        self._new = []

    def _write_ring(self, until_ns: int, now: int) -> None:
        """Write the entries of the ring. End the capture if no entry can follow."""
        if not self._has_next_part and self._file is None:
            self._ring.written = 0  # the capture begins with the whole ring
        chunks = self._ring.unwritten(until_ns)
        if self._file is None and chunks:
            self._file = self._begin_file(chunks[0])
        file = self._file
        if file is not None:
            for chunk in chunks:
                file.append(chunk.payload)
                self._ring.written = chunk.number
            if not self._is_list_written or self._devices != self._recorded_devices:
                self._recorded_devices = self._devices
                file.write(b"I", json_payload({"devices": self._devices, "events": self._list}))
                self._is_list_written = True
            self._complete_block(file, now)
            self._has_next_part = self._file is None
            if self.facts.event is not None:
                self.facts.event = self.facts.event | {"file": str(file.path)}
        if self._ring.is_complete(until_ns):
            if file is None and not self._has_next_part:
                self._report_lost_capture()
            self._end_capture()

    def _report_lost_capture(self) -> None:
        """Log that a capture has no entry, because none of its segments fit into the ring."""
        name = f"event: {self._listed[0].in_words}"
        text = f"{name}: could not be recorded, because the memory is too small for the input"
        self._lines.append((name, text))
        self.facts.event = None

    @property
    def _list(self) -> list[dict[str, Any]]:
        """The events as JSON."""
        return [event._asdict() for event in self._listed]

    def _begin_file(self, first: Chunk) -> CapturePart:
        """Create the first part of a capture, or the next one. ``first`` is its first chunk."""
        if not self._has_next_part:
            self._run = os.urandom(8).hex()
            self._stamp = ""
            self._part = 0
        segment = first.segment
        known = dict(self.header) | {"events": self._list}
        if segment.state:
            known["state"] = read_json(segment.state)
        self._is_list_written = True
        file = self._open_part(first.begin_ns, segment.offset, segment.clock, known)
        if not self._has_next_part:
            self._spared = file.path  # it has the event
        return file

    def _end(self) -> None:
        file = self._file
        if file is not None and self._ring.missing:
            remark = remark_of_losses(self._ring.newest_ns, self._ring.missing)
            file.append(packed(data_payload([remark])))
        super()._end()

    def _end_capture(self) -> None:
        self._end_part()
        self._spared = None
        self._until_ns = None
        self._has_next_part = False
        self._listed = []
