"""Byte stream -> frames.

Contract: the frames emitted are exactly those a brute-force search finds in the whole stream (earliest start first, no overlap,
one of the four forms by header, length and CRC; the shorter where two match), however the stream is cut into chunks. A frame
comes out with its last byte unless an earlier, still undecided header forbids it. ``feed`` and ``flush`` never raise; garbage
is counted and dropped. At most 43 bytes are held; work is linear in the bytes fed.
"""

from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any
from zlib import crc32

from kontronik_can_gw.esc.decoder import Reading
from kontronik_can_gw.esc.kontronik.codec import (
    FORMS,
    FORMS_BY_HEADER,
    MAX_LENGTH,
    Form,
    Layout,
)
from kontronik_can_gw.esc.kontronik.fields import Data
from kontronik_can_gw.esc.kontronik.states import LARGEST_STATE

_new = tuple.__new__
_LEGACY_LIVE = next(form for form in FORMS if form.name == "live_legacy")
_PREFIX = b"KOD"
# A line that is read at a far higher rate than it is sent shows its bits as long runs: zeros, then ones.
_LONG_RUNS = bytes(0x100 - (1 << n) for n in range(8)) + b"\0"


class Frame(Reading):
    """A reading with the names of this protocol."""

    __slots__ = ()
    form: Form
    data: Data

    @property
    def layout(self) -> Layout:
        return self.form.layout

    @property
    def is_suspect(self) -> bool:
        """True where the bytes outside a legacy live frame's CRC are impossible (operating state above 26)."""
        data: Any = self.data
        return self.form is _LEGACY_LIVE and data.operating_state > LARGEST_STATE


@dataclass(slots=True)
class Counters:
    """What one stream held. Every byte fed is in a frame, dropped for one reason, or still pending."""

    bytes: int = 0
    live_v4: int = 0
    live_legacy: int = 0
    info_v4: int = 0
    info_legacy: int = 0
    headers: int = 0
    """KODL or KODI seen, good frames included."""
    crc_errors: int = 0
    """KODL or KODI followed by enough bytes, of which no CRC fits."""
    unknown_kinds: int = 0
    """KOD followed by a letter other than L and I."""
    dropped_noise: int = 0
    """Bytes that belong to no header."""
    dropped_crc: int = 0
    """Bytes after a header whose CRC failed, up to where its frame would have ended."""
    dropped_unknown_kind: int = 0
    """The KOD of frames of unknown kind."""
    dropped_incomplete: int = 0
    """Bytes after a header when the stream ended."""
    long_run_bytes: int = 0
    """Dropped bytes that look like a slower line read too fast (9600 baud of an old JIVE)."""
    longer_crcs: int = 0
    """Rejected live frames of 38 bytes whose CRC covers 34 bytes: no ESC is known to send them."""

    @property
    def live(self) -> int:
        return self.live_v4 + self.live_legacy

    @property
    def info(self) -> int:
        return self.info_v4 + self.info_legacy

    @property
    def dropped_bytes(self) -> int:
        return (
            self.dropped_noise
            + self.dropped_crc
            + self.dropped_unknown_kind
            + self.dropped_incomplete
        )

    @property
    def pending(self) -> int:
        """Bytes that are not decided yet; four or more begin with KODL or KODI."""
        in_frames: int = sum(form.length * getattr(self, form.name) for form in FORMS)
        return self.bytes - self.dropped_bytes - in_frames

    def as_dict(self) -> dict[str, int]:
        """All counters and totals by name."""
        sums = {"live": self.live, "info": self.info, "dropped_bytes": self.dropped_bytes}
        return sums | dict(zip(_NAMES, _all_of(self), strict=True))

    def copy(self) -> "Counters":
        return Counters(*_all_of(self))

    def diagnosis(self, since: "Counters | None" = None) -> str | None:
        """What is wrong with a line from which no frame comes, in words; None while frames come."""
        old = since or Counters()
        if self.live + self.info > old.live + old.info:
            return None
        received = self.bytes - old.bytes
        if not received:
            return "no bytes: ESC off, wire open, wrong port, or a KOSMIK that waits for one throttle pulse after power-up"
        if self.longer_crcs > old.longer_crcs:
            return (
                "live frames of 38 bytes whose CRC covers 34 bytes instead of 32: no recording of such an ESC is known, so they are "
                "not accepted. Please report device and firmware with a recording"
            )
        if self.crc_errors > old.crc_errors:
            return "headers but no valid CRC: noise on the line, bytes lost, or another revision of the protocol"
        if self.headers > old.headers or self.pending >= 4:
            return "a header but no whole frame yet"
        if self.unknown_kinds > old.unknown_kinds:
            return "KOD frames of unknown kind: a newer protocol?"
        noise = self.dropped_noise - old.dropped_noise
        if noise >= 64 and (self.long_run_bytes - old.long_run_bytes) * 10 >= noise * 9:
            return "bytes but never KOD, in long runs of equal bits: a slower line, as the 9600 baud of an old JIVE (not PRO)"
        return "bytes but never KOD: wrong parity (8E1 is needed), inverted signal, or the ESC is set to another protocol"


_NAMES = tuple(f.name for f in fields(Counters))
_all_of = attrgetter(*_NAMES)


def has_longer_crc(frame: bytes) -> bool:
    """Whether the CRC of a legacy live frame covers everything before it, as one other receiver takes it."""
    crc_at = _LEGACY_LIVE.crc_at
    return bool(crc32(frame[:crc_at]) == _LEGACY_LIVE.crc_of(frame)[0])


class Deframer:
    """Finds the frames in one byte stream. Holds no mode: the layout is found from the CRC of each frame."""

    __slots__ = ("_base", "_blame", "_blame_until", "_held", "_need", "counters")

    def __init__(self) -> None:
        self.counters = Counters()
        self._held = b""
        self._base = 0  # stream position of _held[0]
        self._need = 1  # how many more bytes before anything can be decided
        self._blame = "dropped_crc"  # why bytes before _blame_until are dropped
        self._blame_until = 0

    @property
    def pending(self) -> int:
        """How many bytes are held, undecided: 0..43."""
        return len(self._held)

    def feed(self, data: bytes, now: int = 0) -> list[Frame]:  # noqa: ARG002  frames have headers
        """Take the next bytes; return the frames that are now certain, in stream order."""
        size = len(data)
        self.counters.bytes += size
        if size < self._need:
            self._held += data
            self._need -= size
            return []
        return self._scan(self._held + data, False)

    def flush(self) -> list[Frame]:
        """The stream ended or was interrupted: search what is pending, drop the rest, be ready for a new start."""
        frames = self._scan(self._held, True)
        self._blame_until = self._base
        return frames

    def _scan(self, buffer: bytes, ended: bool) -> list[Frame]:
        frames: list[Frame] = []
        counters = self.counters
        size = len(buffer)
        at = missing = 0
        while at < size:
            frame = buffer[at : at + MAX_LENGTH]
            forms = FORMS_BY_HEADER.get(frame[:4])
            if forms is None:
                start = self._skip(buffer, at, ended)
                if start == at:
                    break
                at = start
                continue
            crc = 0
            for form in forms:
                end = at + form.length
                if end > size:
                    missing = end - size
                    break
                crc = crc32(frame[form.crc_goes_on_over], crc)
                if crc == form.crc_of(frame)[0]:
                    setattr(counters, form.name, getattr(counters, form.name) + 1)
                    data = _new(form.data_type, form.fields_of(frame))
                    frames.append(_new(Frame, (form, self._base + at, data)))
                    at, self._blame_until = end, 0
                    break
            else:
                counters.crc_errors += 1
                if forms[0] is _LEGACY_LIVE and has_longer_crc(frame):
                    counters.longer_crcs += 1
                self._reject(buffer, at, form.length, "dropped_crc")
                at += 4
            if missing:
                if not ended:
                    break
                missing = 0
                self._reject(buffer, at, size - at, "dropped_incomplete")
                at += 4
        counters.headers += len(frames)
        self._held = buffer[at:]
        self._need = missing or 1
        self._base += at
        return frames

    def _skip(self, buffer: bytes, at: int, ended: bool) -> int:
        """Drop what belongs to no header of a known kind; return where one may begin, ``at`` where that is not decided yet."""
        start, size = buffer.find(_PREFIX, at), len(buffer)
        if start < 0:
            tail = b"" if ended else buffer[max(at, size - 2) :]
            start = size - (2 if tail == b"KO" else 1 if tail.endswith(b"K") else 0)
        if start > at:
            self._drop(buffer, at, start)
        elif size - at >= 4:
            self.counters.unknown_kinds += 1
            start += 3
            self._drop(buffer, at, start, "dropped_unknown_kind")
        elif ended:
            start = size
            self._drop(buffer, at, start, "dropped_incomplete")
        return start

    def _reject(self, buffer: bytes, at: int, length: int, reason: str) -> None:
        """Drop a header (no frame can begin inside it) and blame ``reason`` for what is dropped up to ``length`` from its start."""
        self.counters.headers += 1
        self._blame, self._blame_until = reason, max(self._blame_until, self._base + at + length)
        self._drop(buffer, at, at + 4)

    def _drop(self, buffer: bytes, begin: int, end: int, reason: str = "dropped_noise") -> None:
        counters = self.counters
        dropped = buffer[begin:end]
        counters.long_run_bytes += len(dropped) - len(dropped.translate(None, _LONG_RUNS))
        blamed = min(max(self._blame_until - self._base - begin, 0), end - begin)
        if blamed:
            setattr(counters, self._blame, getattr(counters, self._blame) + blamed)
        setattr(counters, reason, getattr(counters, reason) + end - begin - blamed)
