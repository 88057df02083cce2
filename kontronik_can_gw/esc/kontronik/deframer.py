"""Finds the frames in a stream of bytes.

1. The result is exactly the frames that a brute-force search finds in the whole stream, however the
   stream is cut into chunks. The search begins at the earliest position and finds no overlapping
   frames. Header, length and CRC must match one of the four forms. If two forms match, the shorter
   one is used.
2. A frame is returned as soon as its last byte is fed, unless an earlier header may still begin a
   frame that overlaps it.
3. ``feed`` and ``flush`` never raise. Bytes that are not part of a frame are counted and dropped.
4. At most 43 bytes are held. The work is linear in the number of bytes.
"""

from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any
from zlib import crc32

from kontronik_can_gw.esc.decoder import Reading
from kontronik_can_gw.esc.kontronik.codec import (
    CRC_LENGTH,
    FORMS,
    FORMS_BY_HEADER,
    MAX_LENGTH,
    PREFIX,
    Form,
    WireLayout,
)
from kontronik_can_gw.esc.kontronik.fields import Data
from kontronik_can_gw.esc.kontronik.states import LARGEST_STATE

_LEGACY_LIVE = next(form for form in FORMS if form.name == "live_legacy")
_HEADER_LENGTH = len(PREFIX) + 1
_LONG_RUNS = bytes(0x100 - (1 << n) for n in range(8)) + b"\0"
"""Bytes whose bits are sent as zeros followed by ones.

They are received if the line's baud rate is much lower than ours.
"""


class Frame(Reading):
    """A reading of this protocol."""

    __slots__ = ()
    form: Form
    data: Data

    @property
    def layout(self) -> WireLayout:
        return self.form.layout

    @property
    def is_suspect(self) -> bool:
        """True for a legacy live frame with an impossible operating state, above 26.

        The CRC of these frames does not cover the state.
        """
        data: Any = self.data
        return self.form is _LEGACY_LIVE and data.operating_state > LARGEST_STATE


@dataclass(slots=True)
class DeframerCounters:
    """Counts of one stream.

    Every byte fed is part of a frame, counted as dropped under one reason, or still pending.
    """

    bytes: int = 0
    live_v4: int = 0
    live_legacy: int = 0
    info_v4: int = 0
    info_legacy: int = 0
    headers: int = 0
    """Times that KODL or KODI was found, also at the start of a good frame."""
    crc_errors: int = 0
    """Headers that were followed by enough bytes, but by no matching CRC."""
    unknown_kinds: int = 0
    """Times that KOD was followed by a letter other than L and I."""
    dropped_noise: int = 0
    """Bytes dropped outside headers and rejected frames."""
    dropped_crc: int = 0
    """Bytes dropped from a header without a matching CRC to the end of its longer form."""
    dropped_unknown_kind: int = 0
    """Bytes of KOD that were followed by a letter other than L and I."""
    dropped_incomplete: int = 0
    """Bytes after a header that were too few for a frame when the stream ended."""
    long_run_bytes: int = 0
    """Dropped bytes that suggest a lower baud rate, for example the 9600 baud of an old JIVE."""
    longer_crcs: int = 0
    """Rejected live frames of 38 bytes whose CRC covers 34 bytes. No ESC is known to send them."""

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
        """Number of undecided bytes. If there are four or more, they begin with KODL or KODI."""
        in_frames: int = sum(form.length * getattr(self, form.name) for form in FORMS)
        return self.bytes - self.dropped_bytes - in_frames

    def as_dict(self) -> dict[str, int]:
        """Return all counters and totals by name."""
        totals = {"live": self.live, "info": self.info, "dropped_bytes": self.dropped_bytes}
        return totals | dict(zip(_NAMES, _get_all(self), strict=True))

    def copy(self) -> "DeframerCounters":
        return DeframerCounters(*_get_all(self))

    def diagnosis(self, since: "DeframerCounters | None" = None) -> str | None:
        """Explain in words why no frame was received since the earlier state ``since``.

        Without ``since``, since the start of the stream. None if a frame was received.
        """
        old = since or DeframerCounters()
        if self.live + self.info > old.live + old.info:
            return None
        received = self.bytes - old.bytes
        if not received:
            return (
                "no bytes: ESC off, wire open, wrong port, "
                "or a KOSMIK that waits for one throttle pulse after power-up"
            )
        if self.longer_crcs > old.longer_crcs:
            return (
                "live frames of 38 bytes whose CRC covers 34 bytes instead of 32: "
                "no recording of such an ESC is known, so they are not accepted. "
                "Please report device and firmware with a recording"
            )
        if self.crc_errors > old.crc_errors:
            return (
                "headers but no valid CRC: "
                "noise on the line, bytes lost, or another revision of the protocol"
            )
        if self.headers > old.headers or self.pending >= 4:
            return "a header but no whole frame yet"
        if self.unknown_kinds > old.unknown_kinds:
            return "KOD frames of unknown kind: a newer protocol?"
        noise = self.dropped_noise - old.dropped_noise
        in_long_runs = self.long_run_bytes - old.long_run_bytes
        if noise >= 64 and in_long_runs * 10 >= noise * 9:
            return (
                "bytes but never KOD, in long runs of equal bits: "
                "a slower line, such as the 9600 baud of an old JIVE (not PRO)"
            )
        return (
            "bytes but never KOD: wrong parity (8E1 is needed), inverted signal, "
            "or the ESC is set to another protocol"
        )


_NAMES = tuple(f.name for f in fields(DeframerCounters))
_get_all = attrgetter(*_NAMES)


def has_longer_crc(frame: bytes) -> bool:
    """Return True if the CRC of a legacy live frame covers all bytes before it.

    One receiver in the field accepts such frames. No recording of one is public.
    """
    (found,) = _LEGACY_LIVE.unpack_crc(frame)
    return bool(crc32(frame[: _LEGACY_LIVE.length - CRC_LENGTH]) == found)


class Deframer:
    """Finds the frames in one byte stream. The CRC of each frame decides its layout."""

    __slots__ = ("_base", "_held", "_needed", "_rejected_for", "_rejected_until", "counters")

    def __init__(self) -> None:
        self.counters = DeframerCounters()
        self._held = b""
        """The undecided bytes."""
        self._base = 0
        """Stream position of the first held byte."""
        self._needed = 1
        """Number of further bytes that are needed before anything can be decided."""
        self._rejected_for = "dropped_crc"
        """The counter for bytes dropped before ``_rejected_until``."""
        self._rejected_until = 0
        """Stream position at which the last rejected frame would have ended."""

    @property
    def pending(self) -> int:
        """Number of undecided bytes, 0 to 43."""
        return len(self._held)

    def feed(self, data: bytes, now: int = 0) -> list[Frame]:  # noqa: ARG002  frames have headers
        """Take the next bytes and return the frames that are now certain, in stream order."""
        size = len(data)
        self.counters.bytes += size
        if size < self._needed:
            self._held += data
            self._needed -= size
            return []
        return self._scan(self._held + data, False)

    def flush(self) -> list[Frame]:
        """End the stream: return the frames in the pending bytes and drop the rest.

        The next call of ``feed`` starts a new stream. The counters continue.
        """
        frames = self._scan(self._held, True)
        self._rejected_until = self._base
        return frames

    def adopt_counters(self, counters: DeframerCounters) -> None:
        """Replace the counters. They must agree with the bytes that are held."""
        shift = counters.bytes - self.counters.bytes
        self._base += shift
        self._rejected_until += shift
        self.counters = counters

    def _scan(self, buffer: bytes, has_ended: bool) -> list[Frame]:
        """Return the frames in ``buffer`` and hold its undecided end.

        If the stream has ended, nothing is held.
        """
        frames: list[Frame] = []
        counters = self.counters
        size = len(buffer)
        at = 0
        missing = 0
        while at < size:
            frame = buffer[at : at + MAX_LENGTH]
            forms = FORMS_BY_HEADER.get(frame[:_HEADER_LENGTH])
            if forms is None:
                start = self._skip(buffer, at, has_ended)
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
                crc = crc32(frame[form.crc_part], crc)
                if crc == form.unpack_crc(frame)[0]:
                    setattr(counters, form.name, getattr(counters, form.name) + 1)
                    data = form.data_type(*form.unpack_fields(frame))
                    frames.append(Frame(form, self._base + at, data))
                    at = end
                    self._rejected_until = 0
                    break
            else:
                counters.crc_errors += 1
                if forms[0] is _LEGACY_LIVE and has_longer_crc(frame):
                    counters.longer_crcs += 1
                self._reject(buffer, at, form.length, "dropped_crc")
                at += _HEADER_LENGTH
            if missing:
                if not has_ended:
                    break
                missing = 0
                self._reject(buffer, at, size - at, "dropped_incomplete")
                at += _HEADER_LENGTH
        counters.headers += len(frames)
        self._held = buffer[at:]
        self._needed = missing or 1
        self._base += at
        return frames

    def _skip(self, buffer: bytes, at: int, has_ended: bool) -> int:
        """Drop bytes that are not part of a known header and return the next position to try.

        Returns ``at`` if the bytes there may be the beginning of a header.
        """
        size = len(buffer)
        start = buffer.find(PREFIX, at)
        if start < 0:
            start = size
            if not has_ended:
                start -= _length_of_partial_prefix(buffer[max(at, size - len(PREFIX) + 1) :])
        if start > at:
            self._drop(buffer, at, start)
        elif size - at >= _HEADER_LENGTH:
            self.counters.unknown_kinds += 1
            start += len(PREFIX)
            self._drop(buffer, at, start, "dropped_unknown_kind")
        elif has_ended:
            start = size
            self._drop(buffer, at, start, "dropped_incomplete")
        return start

    def _reject(
        self,
        buffer: bytes,
        at: int,
        length: int,
        reason: str,
    ) -> None:
        """Drop a header, in which no other frame can begin.

        ``length`` bytes from its start are counted under ``reason`` if they are dropped, too.
        """
        self.counters.headers += 1
        self._rejected_for = reason
        self._rejected_until = max(self._rejected_until, self._base + at + length)
        self._drop(buffer, at, at + _HEADER_LENGTH)

    def _drop(
        self,
        buffer: bytes,
        begin: int,
        end: int,
        reason: str = "dropped_noise",
    ) -> None:
        """Count dropped bytes: the part of a rejected frame under its reason, the rest as given."""
        counters = self.counters
        dropped = buffer[begin:end]
        size = end - begin
        counters.long_run_bytes += size - len(dropped.translate(None, _LONG_RUNS))
        rejected = min(max(self._rejected_until - self._base - begin, 0), size)
        if rejected:
            setattr(counters, self._rejected_for, getattr(counters, self._rejected_for) + rejected)
        setattr(counters, reason, getattr(counters, reason) + size - rejected)


def _length_of_partial_prefix(tail: bytes) -> int:
    """Return how many of the last bytes may be the beginning of a header."""
    for length in range(len(PREFIX) - 1, 0, -1):
        if tail.endswith(PREFIX[:length]):
            return length
    return 0
