"""Bytes of one ESC -> stretches of frames that stand end to end, checked in columns, and the bytes between them.

The frames of the stretches, with those that a Deframer finds in the bytes between, are exactly those that one Deframer finds in the whole.
A stretch begins where that Deframer has nothing pending, so it may be passed over (``pass_over``). Memory is bounded by the buffer.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from kontronik_can_gw.protocol.codec import FORMS, FORMS_BY_KIND_BYTE, Form, Kind, Layout
from kontronik_can_gw.protocol.deframer import LONGEST, Deframer
from kontronik_can_gw.protocol.fields import rows

Offsets = NDArray[np.int64]
Records = NDArray[np.void]
Words = NDArray[np.uint32]
_Bytes = NDArray[np.uint8]

BUFFER = 1 << 21
LEAST = 16
"""Frames of a stretch: of fewer, the streaming way is as quick."""
_BLOCK = 4096
"""Rows at a time, so that they stay in the processor's cache."""
_REGULAR = 4
"""Equidistant headers in a row that are worth a slice."""
_K, _O, _D = b"KOD"


def form_of(kind: Kind, layout: Layout) -> Form:
    """The form of a kind of frame in a layout."""
    return next(form for form in FORMS if form.kind is kind and form.layout is layout)


def record_type(form: Form) -> "np.dtype[np.void]":
    """A whole frame as a record of its wire fields."""
    names, formats, offsets, at = [], [], [], 4
    for name, row in rows(form.data_type).items():
        names.append(name)
        formats.append("<" + row.wire)
        offsets.append(at)
        at += struct.calcsize("<" + row.wire)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": form.length})


_RECORDS = {form: record_type(form) for form in FORMS}


@dataclass(frozen=True)
class Stretch:
    """Frames of one layout end to end. ``offset``: in the stream; ``data``: their bytes."""

    offset: int
    layout: Layout
    data: bytes
    infos: Offsets
    """Where in ``data`` an info frame begins."""

    @cached_property
    def live(self) -> Records:
        """The live frames."""
        data, length = memoryview(self.data), self._info.length
        parts, at = [], 0
        for begin in self.infos.tolist():
            parts.append(data[at:begin])
            at = begin + length
        parts.append(data[at:])
        return np.frombuffer(b"".join(parts), _RECORDS[self._live])

    @cached_property
    def info(self) -> Records:
        """The info frames."""
        data, length = memoryview(self.data), self._info.length
        return np.frombuffer(b"".join(data[at : at + length] for at in self.infos.tolist()), _RECORDS[self._info])

    @cached_property
    def live_before(self) -> Offsets:
        """How many live frames stand in front of each info frame."""
        numbers = np.arange(len(self.infos), dtype=np.int64)
        before: Offsets = (self.infos - numbers * self._info.length) // self._live.length
        return before

    @cached_property
    def live_offsets(self) -> Offsets:
        """Where in the stream each live frame begins."""
        infos = np.bincount(self.live_before, minlength=len(self.live) + 1).cumsum()[: len(self.live)]
        offsets: Offsets = np.arange(len(self.live), dtype=np.int64) * self._live.length + infos * self._info.length
        return offsets + self.offset

    @property
    def info_offsets(self) -> Offsets:
        """Where in the stream each info frame begins."""
        return self.infos + self.offset

    @property
    def live_count(self) -> int:
        return (len(self.data) - len(self.infos) * self._info.length) // self._live.length

    @property
    def _live(self) -> Form:
        return form_of(Kind.LIVE, self.layout)

    @property
    def _info(self) -> Form:
        return form_of(Kind.INFO, self.layout)


def pieces(read: Callable[[int], bytes], least: int = LEAST, buffer: int = BUFFER) -> Iterator[Stretch | bytes]:
    """The stream in order. ``read``: gives up to so many bytes, none at the end.

    ``least``: frames that make a stretch; ``buffer``: bytes that are read at once.
    """
    scanner = _Scanner(max(1, least))
    held = b""
    while True:
        data = read(buffer)
        held += data
        found, used = scanner.scan(held, final=not data)
        yield from found
        held = held[used:]
        if not data:
            return


def pass_over(deframer: Deframer, stretch: Stretch) -> None:
    """Let a Deframer that has nothing pending be behind a stretch, with its counters."""
    assert not deframer.pending
    counters = deframer.counters
    live, info = stretch.live_count, len(stretch.infos)
    counters.bytes += len(stretch.data)
    counters.headers += live + info
    if stretch.layout is Layout.V4:
        counters.live_v4 += live
        counters.info_v4 += info
    else:
        counters.live_legacy += live
        counters.info_legacy += info
    deframer._base = counters.bytes
    deframer._blame_until = 0


class _Scanner:
    """What has to be known of the bytes before."""

    def __init__(self, least: int) -> None:
        self._least = least
        self._base = 0  # stream position of the buffer
        self._decided = 0  # stream position: before it, an earlier false header is still undecided
        self._tail = b""  # the last bytes before the buffer that belong to no frame

    def scan(self, buffer: bytes, final: bool) -> tuple[list[Stretch | bytes], int]:
        """What the buffer holds, and how many of its bytes that is; the others come again, with more behind them."""
        size = len(buffer)
        padded = np.frombuffer(buffer + bytes(LONGEST), np.uint8)
        starts = _headers(padded, size - 4 if final else size - LONGEST)
        is_info = padded[starts + 3] == FORMS[-1].header[3]
        lengths = _lengths(padded, starts, is_info, size)
        inside = _inside(starts, lengths)
        if inside is not None:
            starts, lengths, is_info = starts[~inside], lengths[~inside], is_info[~inside]
        false = lengths == 0
        decided = starts[false] + np.where(is_info[false], _LONGEST_OF[True], _LONGEST_OF[False])
        begins = starts
        if len(decided):
            begins, lengths, is_info = starts[~false], lengths[~false], is_info[~false]
        ends = begins + lengths
        used = size if final else max(int(ends[-1]) if len(ends) else 0, size - LONGEST + 1, 0)
        found: list[Stretch | bytes] = []
        out = 0
        for first, last in self._runs(begins, ends, lengths):
            begin = int(begins[first])
            before = int(ends[first - 1]) if first else 0
            guard = self._decided - self._base
            number = int(np.searchsorted(starts[false], begin))
            if number:
                guard = max(guard, int(decided[:number].max()))
            kept = first + int(np.searchsorted(begins[first:last], guard))
            noise = (
                buffer[max(before, begin - 3) : begin] if before else self._tail + buffer[max(0, begin - 3) : begin]
            )[-3:]
            if kept == first and noise.endswith((b"K", b"KO", b"KOD")):
                kept += 1
            if last - kept < self._least:
                continue
            begin, end = int(begins[kept]), int(ends[last - 1])
            if begin > out:
                found.append(buffer[out:begin])
            infos = begins[kept:last][is_info[kept:last]] - begin
            layout = _LAYOUT_OF[int(lengths[kept])]
            found.append(Stretch(self._base + begin, layout, buffer[begin:end], infos))
            out = end
        if used > out:
            found.append(buffer[out:used])
        last_end = int(ends[-1]) if len(ends) else 0
        self._tail = (buffer[last_end:used] if len(ends) else self._tail + buffer[:used])[-3:]
        if len(decided):
            self._decided = max(self._decided, self._base + int(decided.max()))
        self._base += used
        return found, used

    def _runs(self, begins: Offsets, ends: Offsets, lengths: Offsets) -> Iterator[tuple[int, int]]:
        """First and behind the last of frames that stand end to end in one layout, of long enough ones."""
        if not len(begins):
            return
        layouts = _IS_V4[lengths]
        breaks = np.flatnonzero((begins[1:] != ends[:-1]) | (layouts[1:] != layouts[:-1])) + 1
        edges = np.concatenate(([0], breaks, [len(begins)]))
        for number in np.flatnonzero(np.diff(edges) >= self._least).tolist():
            yield int(edges[number]), int(edges[number + 1])


_LONGEST_OF = {info: max(form.length for form in FORMS if (form.kind is Kind.INFO) == info) for info in (False, True)}
_LAYOUT_OF = {form.length: form.layout for form in FORMS}
_IS_V4 = np.array([_LAYOUT_OF.get(length) is Layout.V4 for length in range(LONGEST + 1)])


def _headers(padded: _Bytes, last: int) -> Offsets:
    """Where KODL or KODI stands, up to ``last``."""
    at = np.flatnonzero(padded[: max(0, last + 1)] == _K)
    at = at[padded[at + 1] == _O]
    at = at[padded[at + 2] == _D]
    kind = padded[at + 3]
    found: Offsets = at[np.isin(kind, list(FORMS_BY_KIND_BYTE))].astype(np.int64, copy=False)
    return found


def _lengths(padded: _Bytes, starts: Offsets, is_info: NDArray[np.bool_], size: int) -> Offsets:
    """The length of the frame that begins at each header; 0: there is none."""
    found = np.zeros(len(starts), np.int64)
    gaps = np.diff(starts, append=size)
    gaps[is_info] = 0
    rest = np.ones(len(starts), np.bool_)
    view = padded.data
    live = FORMS_BY_KIND_BYTE[FORMS[0].header[3]]
    for form in live:
        # live frames that follow each other are slices of the buffer
        regular = gaps == form.length
        edges = np.flatnonzero(np.diff(regular, prepend=False, append=False))
        firsts, behinds = edges[::2], edges[1::2]
        long = behinds - firsts >= _REGULAR
        firsts, behinds = firsts[long], behinds[long]
        if not len(firsts):
            continue
        begins = starts[firsts]
        ends = begins + (behinds - firsts) * form.length
        slices = [view[begin:end] for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)]
        right = _checked(np.frombuffer(b"".join(slices), np.uint8).reshape(-1, form.length), live)
        chosen = np.zeros(len(starts), np.bool_)
        for first, behind in zip(firsts.tolist(), behinds.tolist(), strict=True):
            chosen[first:behind] = True
        found[chosen] = right
        if form is not live[-1] and not right.all():
            # the shorter form fits the distance but not the CRC: the longer one has not been tried
            chosen[chosen] = right > 0
        rest[chosen] = False
    windows = sliding_window_view(padded, LONGEST)
    for byte, forms in FORMS_BY_KIND_BYTE.items():
        others = np.flatnonzero(rest & (is_info == (byte == FORMS[-1].header[3])))
        for at in range(0, len(others), _BLOCK):
            block = others[at : at + _BLOCK]
            found[block] = _checked(windows[starts[block]], forms)
    beyond = starts + found > size  # zeros behind the end are no bytes of the stream
    if beyond.any():
        found[beyond] = 0
    return found


def _checked(frames: _Bytes, forms: tuple[Form, ...]) -> Offsets:
    """The length of the form of each row, 0 where none fits. Longer forms than the rows are not tried."""
    found = np.empty(len(frames), np.int64)
    for at in range(0, len(frames), _BLOCK):
        block = frames[at : at + _BLOCK]
        found[at : at + _BLOCK] = _checked_block(block, forms)
    return found


def _checked_block(frames: _Bytes, forms: tuple[Form, ...]) -> Offsets:
    halves = frames.view(np.dtype("<u2"))
    covered = forms[0].covered
    state = np.full(len(frames), _state(forms[0].header + bytes(covered - 4)), np.uint32)
    for at in range(4, covered, 2):
        state ^= _FOLD[(covered - at) // 2 - 1].take(halves[:, at // 2], mode="clip")
    found = np.zeros(len(frames), np.int64)
    for form in forms:
        if form.length > frames.shape[1]:
            break
        while covered < form.covered:
            state ^= _word(frames, covered)
            state = _FOLD[1].take(state & 0xFFFF, mode="clip") ^ _FOLD[0].take(state >> 16, mode="clip")
            covered += 4
        found[(found == 0) & (~state == _word(frames, form.crc_at))] = form.length
        if found.all():
            break
    return found


def _word(frames: _Bytes, at: int) -> Words:
    """Four bytes of each row as a number."""
    if at % 2 == 0:
        halves = frames.view(np.dtype("<u2"))
        word: Words = halves[:, at // 2] | halves[:, at // 2 + 1].astype(np.uint32) << np.uint32(16)
        return word
    single: Words = np.ascontiguousarray(frames[:, at : at + 4]).view(np.dtype("<u4"))[:, 0]
    return single


def _state(data: bytes) -> int:
    """The register of the CRC behind some bytes."""
    return zlib.crc32(data) ^ 0xFFFFFFFF


def _fold_tables(count: int) -> list[Words]:
    """Of each pair of bytes its part in the register, with so many further pairs behind it."""
    bytewise = np.array([_state(bytes((byte ^ 0xFF,))) ^ 0xFFFFFF for byte in range(256)], np.uint32)
    pairs = np.arange(1 << 16, dtype=np.uint32)
    first = pairs >> 8 ^ bytewise[pairs & 0xFF]
    tables = [first >> 8 ^ bytewise[first & 0xFF]]
    for _ in range(count - 1):
        tables.append(tables[-1] >> 16 ^ tables[0][tables[-1] & 0xFFFF])
    return tables


_FOLD = _fold_tables(max(form.covered for form in FORMS) // 2)


def _inside(starts: Offsets, lengths: Offsets) -> NDArray[np.bool_] | None:
    """Headers that stand inside a frame that began before; None where there is none."""
    ends = starts + lengths
    overlaps = np.flatnonzero(starts[1:] < ends[:-1]).tolist()
    if not overlaps:
        return None
    inside = np.zeros(len(starts), np.bool_)
    for index in overlaps:
        if not inside[index]:
            inside[index + 1 : int(np.searchsorted(starts, ends[index]))] = True
    return inside
