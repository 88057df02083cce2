"""Bytes without times -> each frame's bytes and its assumed time, piece by piece, so that whole stretches can be passed over between.

For the bytes that are given here this is ``DumpInput.chunks``: the same bytes at the same times.
"""

from collections.abc import Iterator

from kontronik_can_gw.offline.bulk.state import Stretched
from kontronik_can_gw.offline.inputs import _LONGEST_FRAME, _MOST_WAITING, CHUNK
from kontronik_can_gw.protocol.codec import Kind
from kontronik_can_gw.protocol.deframer import Deframer, Frame

Timed = tuple[int, bytes]


class Feed:
    """``size``: of the whole stream; it was read ``CHUNK`` bytes at once."""

    def __init__(self, size: int, period_ns: int) -> None:
        self.now = 0
        self.lives = 0
        """Live frames so far."""
        self._size = size
        self._period_ns = period_ns
        self._deframer = Deframer()
        self._waiting = bytearray()
        self._position = 0  # in the stream
        self._at = 0  # of the first byte that waits

    @property
    def is_between(self) -> bool:
        """True where no byte waits: the next one may be the first of a stretch that is passed over."""
        return not self._waiting

    def feed(self, data: bytes) -> Iterator[Timed]:
        """The next bytes of the stream."""
        view = memoryview(data)
        while view:
            room = CHUNK - self._position % CHUNK
            if room == CHUNK:  # no frame for long: what can belong to none any more goes
                read = min(CHUNK, self._size - self._position)
                gone = len(self._waiting) - _LONGEST_FRAME
                if gone > 0 and len(self._waiting) + read > _MOST_WAITING:
                    yield self.now, self._take(gone)
            part, view = bytes(view[:room]), view[room:]
            self._position += len(part)
            self._waiting += part
            yield from self._found(self._deframer.feed(part))

    def pass_over(self, stretched: Stretched, first: int, count: int) -> None:
        """So many frames of a stretch were dealt with; no byte waits."""
        length = stretched.offset(first + count) - stretched.offset(first)
        self._position += length
        self._at += length
        self._deframer.counters.bytes += length
        self._deframer._base += length
        self._deframer._blame_until = 0
        self.lives += int(stretched.live_rows[first + count] - stretched.live_rows[first])
        self.now = int(stretched.times[first + count - 1])

    def finish(self) -> Iterator[Timed]:
        """The stream has ended."""
        yield from self._found(self._deframer.flush())
        if self._waiting:
            yield self.now, self._take(len(self._waiting))

    @property
    def damage(self) -> list[str]:
        """What was not intact, a line each; complete behind ``finish``."""
        counters = self._deframer.counters
        found = []
        if counters.dropped_bytes:
            found.append(f"{counters.dropped_bytes} bytes belong to no frame, {counters.crc_errors} CRC errors")
        if not self.lives:
            found.append(counters.diagnosis() or "no live frame")
        return found

    def _found(self, frames: list[Frame]) -> Iterator[Timed]:
        for frame in frames:
            if frame.kind is Kind.LIVE:
                self.now = self.lives * self._period_ns
                self.lives += 1
            else:
                self.now = max(self.now, self.lives * self._period_ns - self._period_ns // 2)
            yield self.now, self._take(frame.offset + frame.form.length - self._at)

    def _take(self, count: int) -> bytes:
        taken = bytes(self._waiting[:count])
        del self._waiting[:count]
        self._at += count
        return taken
