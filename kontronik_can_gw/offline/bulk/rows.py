"""The rows of plain UART bytes: those of ``DumpInput.samples``, in blocks of columns where nothing but intact frames comes.

Everything else goes through the core, frame by frame: the beginning, damaged bytes and the frames behind them up to where the gateway is
steady again, another device. Memory does not grow with the recording.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kontronik_can_gw.dbc_output.unpacker import Part, SignalReader
from kontronik_can_gw.offline.bulk.feed import Feed
from kontronik_can_gw.offline.bulk.scan import Stretch, pieces
from kontronik_can_gw.offline.bulk.state import Quiet, Steady, Stretched, is_steady
from kontronik_can_gw.offline.bulk.values import ColumnReader, Steps, Unsuited
from kontronik_can_gw.offline.samples import GATEWAY_NS, SAME_ROW_NS, Sample, SampledGateway
from kontronik_can_gw.offline.tables.blocks import Block, BlockColumn
from kontronik_can_gw.protocol.codec import Kind, Layout
from kontronik_can_gw.protocol.fields import InfoData, LiveData
from kontronik_can_gw.protocol.states import LARGEST_STATE, Device
from kontronik_can_gw.sources import Group
from kontronik_can_gw.telemetry import MS

Numbers = NDArray[np.int64]

BLOCK = 8192
"""Frames at a time, so that columns stay in the processor's cache."""
LEAST = 64
"""Of fewer frames, the streaming way is as quick."""
MOST_PERIOD_NS = 500 * MS
_LATEST_NS = 1 << 61
_FIELD = {name: number for number, name in enumerate(LiveData._fields)}
_INFO_FIELD = {name: number for number, name in enumerate(InfoData._fields)}


def can_read(period_ns: int, size: int) -> bool:
    """True where ``read_rows`` can be quicker than the streaming way."""
    return 1 < period_ns <= MOST_PERIOD_NS and period_ns * size < _LATEST_NS


def read_rows(
    gateway: SampledGateway,
    reader: SignalReader,
    chosen: Sequence[int],
    read: Callable[[int], bytes],
    feed: Feed,
    period_ns: int,
    block: int = BLOCK,
    least: int = LEAST,
) -> Iterator[Sample | Block]:
    """The rows in order, single ones and blocks of the ``chosen`` columns; ``gateway`` is a new one.

    Single rows have all columns, of which the others may be stale.
    """
    columns = _Columns(gateway, reader, chosen)
    for piece in pieces(read, least):
        if isinstance(piece, Stretch):
            stretched = Stretched(piece, feed.lives, period_ns)
            for found in _stretch_rows(gateway, columns, feed, stretched, block, least):
                yield from gateway.take_rows()
                if isinstance(found, Block):
                    yield found
        else:
            for now, data in feed.feed(piece):
                gateway.play(now, data)
                yield from gateway.take_rows()
    for now, data in feed.finish():
        gateway.play(now, data)
    yield from gateway.finish()


def _stretch_rows(
    gateway: SampledGateway, columns: "_Columns", feed: Feed, stretched: Stretched, block: int, least: int
) -> Iterator[Block | None]:
    """Blocks, and None behind each frame that the gateway itself was given: its rows come first, in front of a block too."""
    at, end, data = 0, len(stretched), stretched.stretch.data
    wary = 0  # up to this frame, columns have no room for the values
    while at < end:
        behind = min(end, at + block)
        while behind > at and not stretched.is_live[behind - 1]:  # the last row stays open
            behind -= 1
        if (
            behind - at >= least
            and at >= wary
            and stretched.is_live[at]
            and feed.is_between
            and is_steady(gateway, stretched.layout)
        ):
            steady = Quiet(gateway, stretched, at, behind - at, feed.now)
            if steady.count and not steady.is_live[steady.count - 1]:
                count = int(np.flatnonzero(steady.is_live[: steady.count])[-1]) + 1
                steady = Quiet(gateway, stretched, at, count, feed.now)
            if steady.count:
                try:
                    found = columns.follow(steady, stretched)
                except Unsuited:
                    wary = at + steady.count
                    continue
                feed.pass_over(stretched, at, steady.count)
                at += steady.count
                if len(found):
                    yield found
                continue
        for now, part in feed.feed(data[stretched.offset(at) : stretched.offset(at + 1)]):
            gateway.play(now, part)
        at += 1
        yield None


class _Columns:
    """Computes the chosen columns, and leaves the gateway as if it had made the rows itself."""

    def __init__(self, gateway: SampledGateway, reader: SignalReader, chosen: Sequence[int]) -> None:
        self._gateway = gateway
        self._chosen = list(chosen)
        self._texts = [[text for _, text in reader.columns[index].texts] for index in chosen]
        self._readers: list[tuple[ColumnReader, str]] = []
        for index in chosen:
            part = next(p for p in reader.parts if p.first <= index < p.first + p.count)
            signals = [s for s in part.plan.signals if s.source is not None and s.page == part.page]
            plan = signals[index - part.first]
            assert plan.source is not None
            self._readers.append((ColumnReader(plan, signals), _read_with(part, plan.source.group)))

    def follow(self, steady: Steady, stretched: Stretched) -> Block:
        """The rows of a steady block, which begins and ends with live frames, but for the last one, which stays open."""
        gateway = self._gateway
        views = _Views(gateway, steady, stretched)
        found = [self._column(reader, views, which) for reader, which in self._readers]
        gateway._close_row()
        steady.leave()
        times = views.live_times
        count = len(times)
        for index, column, texts in zip(self._chosen, found, self._texts, strict=True):
            last = column.of(count - 1, count)
            gateway._values[index] = last.listed(1, texts)[0]
        gateway._in_row = {0}
        gateway._row_ns = int(times[-1])
        if count > 1:
            gateway._last_ns = int(times[-2])
        gateway._gateway_ns = views.last_gateway_read
        gateway._all_read_ns = int(views.info_reads[-1])
        return Block(times, None, found).of(0, count - 1)

    def _column(self, reader: ColumnReader, views: "_Views", which: str) -> BlockColumn:
        numbers, valid, divisor = reader.read(getattr(views, which))
        if which != "rows":
            numbers, valid = _spread(numbers, valid, getattr(views, which).index)
        rows = len(views.live_times)
        if valid is not None and valid.all():
            valid = None
        elif valid is not None and not valid.any():
            return BlockColumn(numbers[:1], valid[:1], divisor)
        if valid is not None and len(numbers) == 1 < rows:
            numbers = np.broadcast_to(numbers, rows)
        return BlockColumn(numbers, valid, divisor)


def _read_with(part: Part, group: Group) -> str:
    """What a signal is read with: each row, each info frame, or each turn of the gateway's own values."""
    if not part.plan.escs:
        return "gateway_turns"
    return "infos" if group is Group.INFO or not {Group.LIVE, Group.LINK} & part.plan.paces else "rows"


def _spread(
    numbers: NDArray[Any], valid: NDArray[np.bool_] | None, index: Numbers
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """From info frames, or the gateway's turns, to rows."""
    if len(numbers) > 1:
        numbers = numbers[:1] if (numbers == numbers[0]).all() else numbers[index]
    if valid is not None and len(valid) > 1:
        valid = valid[:1] if (valid == valid[0]).all() else valid[index]
    return numbers, valid


class _Views:
    """A steady block as the expressions see it: by rows, by info frames, by turns of the gateway's own values."""

    def __init__(self, gateway: SampledGateway, steady: Steady, stretched: Stretched) -> None:
        self.gateway = gateway
        self.steady = steady
        self.esc = steady.esc
        self.period_ns = stretched.period_ns
        frames = steady.times[1:]
        infos = np.flatnonzero(~steady.is_live)
        self.live_times = frames[steady.is_live]
        self.live_before = steady.live_rows[infos]
        """Live frames of the block in front of each info frame."""
        self.info_times = frames[infos]
        behind_ns = int(self.info_times[0] - self.live_times[self.live_before[0] - 1]) if len(infos) else 0
        self.same_row = behind_ns <= SAME_ROW_NS
        """An info frame still goes into the row of the live frame in front of it."""
        self.seen_from = self.live_before - 1 if self.same_row else self.live_before
        self.turns = np.flatnonzero(steady.is_live) + 1
        self.now = self.live_times
        if self.same_row and len(infos):
            self.now = self.now.copy()
            self.now[self.seen_from] = self.info_times
            self.turns[self.seen_from] = infos + 1
        self.info_reads = np.concatenate(([gateway._all_read_ns], self.info_times))

    def index_of(self, seen_from: Numbers) -> Numbers:
        """How many of something each row has seen."""
        rows = len(self.live_times)
        edges = np.concatenate(([0], np.minimum(seen_from, rows), [rows]))
        return np.repeat(np.arange(len(edges) - 1, dtype=np.int64), np.diff(edges))

    @cached_property
    def info_index(self) -> Numbers:
        return self.index_of(self.seen_from)

    @cached_property
    def _turns(self) -> list[tuple[int, int, int, int]]:
        """When the gateway's own values are read: the row that sees it first, the time, how many rows it is to the next, how many times."""
        last, start, period = self.gateway._gateway_ns, int(self.live_times[0]), self.period_ns
        step = -(-GATEWAY_NS // period)
        found = []
        begin = 0
        infos = zip(self.live_before.tolist(), self.info_times.tolist(), self.seen_from.tolist(), strict=True)
        for behind, info_ns, row in [*infos, (len(self.live_times), None, 0)]:
            first = max(begin, -((start - last - GATEWAY_NS) // period))
            if first < behind:
                count = (behind - 1 - first) // step + 1
                found.append((first, start + first * period, step, count))
                last = start + (first + (count - 1) * step) * period
            begin = behind
            if info_ns is not None and info_ns - last >= GATEWAY_NS:
                last = info_ns
                found.append((row, last, 0, 1))
        return found

    @property
    def last_gateway_read(self) -> int:
        """When the gateway's own values were read last."""
        if not self._turns:
            return self.gateway._gateway_ns
        _, time_ns, step, count = self._turns[-1]
        return time_ns + (count - 1) * step * self.period_ns

    @cached_property
    def gateway_reads(self) -> tuple[Numbers, Numbers]:
        """The row that sees each reading first, and the times; in front of them the last time before the block."""
        counts = [count for *_, count in self._turns]
        number = np.arange(sum(counts)) - np.repeat(np.cumsum([0, *counts[:-1]]), counts) if counts else np.arange(0)
        first, times, step = (np.repeat([turn[at] for turn in self._turns], counts).astype(np.int64) for at in range(3))
        times = times + number * step * self.period_ns
        return first + number * step, np.concatenate(([self.gateway._gateway_ns], times))

    @cached_property
    def info_fields(self) -> "_InfoFields | None":
        return None if self.esc.info is None else _InfoFields(self.steady)

    @cached_property
    def rows(self) -> "_Rows":
        return _Rows(self)

    @cached_property
    def infos(self) -> "_Infos":
        return _Infos(self)

    @cached_property
    def gateway_turns(self) -> "_GatewayTurns":
        return _GatewayTurns(self)


class _Rows:
    """What is known in each row, with its last frame. Values of info frames are read with ``_Infos``."""

    def __init__(self, views: _Views) -> None:
        self._views = views
        self.gateway = views.gateway.status
        self.now = views.now
        self.live = _LiveFields(views.steady)
        self.info = None
        self.esc = _RowEsc(views, self.live)


class _Infos:
    """What is known with each info frame, behind what was known before the block."""

    def __init__(self, views: _Views) -> None:
        self._views = views
        self.gateway = views.gateway.status
        self.now = views.info_reads
        self.live = None
        self.info = views.info_fields
        self.esc = _Device(views)

    @property
    def index(self) -> Numbers:
        return self._views.info_index


class _GatewayTurns:
    """The gateway's own values, each time they are read."""

    def __init__(self, views: _Views) -> None:
        self.gateway = views.gateway.status
        self.live = self.info = self.esc = None
        rows, self.now = views.gateway_reads
        self.index = views.index_of(rows)


class _LiveFields:
    """Fields of each live frame by their index; of length 1 where they never change."""

    def __init__(self, steady: Steady) -> None:
        self._steady = steady
        self._columns: dict[int, Numbers] = {}

    def __getitem__(self, field: int) -> Numbers:
        found = self._columns.get(field)
        if found is None:
            column = self._steady.live_column(field)[1:]
            found = self._columns[field] = _short(column)
        return found


class _InfoFields:
    def __init__(self, steady: Steady) -> None:
        self._steady = steady

    def __getitem__(self, field: int) -> Numbers:
        return _short(self._steady.info_column(field))

    @property
    def device(self) -> Numbers:
        return self[_INFO_FIELD["device_and_variant"]] >> 10

    @property
    def variant(self) -> Numbers:
        return self[_INFO_FIELD["device_and_variant"]] & 0x3FF


class _Device:
    """What is asked of an EscTelemetry about its device, which is the same in the whole block."""

    def __init__(self, views: _Views) -> None:
        self._views = views

    def bec_current_supplied(self, raw: Numbers) -> Any:
        esc = self._views.esc
        if esc.info is not None:
            return esc.info.device != Device.JIVEPRO
        return raw != 0 if esc.last_info is None or esc.last_info.device != Device.JIVEPRO else False


class _RowEsc(_Device):
    """As an EscTelemetry."""

    def __init__(self, views: _Views, live: _LiveFields) -> None:
        super().__init__(views)
        self._live = live
        self.link = views.esc.link
        self.layout = views.esc.layout
        self.losses = views.esc.losses
        self.live_ns = views.live_times
        self.counters = _RowCounters(views)

    @cached_property
    def cells(self) -> Any:
        esc, fields = self._views.esc, self._views.info_fields
        if esc.settings.cell_count or fields is None:
            return esc.cells
        cells = fields[_INFO_FIELD["cell_count"]]
        return cells if len(cells) == 1 else cells[self._views.info_index]

    @cached_property
    def energy(self) -> Steps:
        views, esc = self._views, self._views.esc
        power = self._live[_FIELD["battery_voltage"]] * self._live[_FIELD["battery_current"]]
        before = int(views.live_times[0]) - (esc.live_ns or 0)
        start = esc.energy + max(0, esc._last_power) * before
        return Steps(start, views.period_ns, _behind(np.maximum(power, 0), len(views.live_times)))

    @cached_property
    def run_time(self) -> Steps:
        views, esc = self._views, self._views.esc
        turning = (self._live[_FIELD["electrical_speed"]] != 0).astype(np.int64)
        before = int(views.live_times[0]) - (esc.live_ns or 0)
        start = esc.run_time + (before if esc.live is not None and esc.live.electrical_speed else 0)
        return Steps(start, views.period_ns, _behind(turning, len(views.live_times)))

    @cached_property
    def suspect_frames(self) -> Any:
        views = self._views
        before = views.esc.suspect_frames
        if views.steady.layout is not Layout.LEGACY:
            return before
        suspect = self._live[_FIELD["operating_state"]] > LARGEST_STATE
        if not suspect.any():
            return before
        return np.broadcast_to(suspect, len(views.live_times)).cumsum() + before

    @cached_property
    def frame_rate(self) -> Numbers:
        views, rates = self._views, self._views.steady.rates
        if (rates == rates[0]).all():
            return rates[:1]
        return views.steady.rate_at(views.turns, views.now, True)

    def age_ms(self, now: Numbers) -> Numbers:
        if now is self.live_ns:
            return np.zeros(1, np.int64)
        found: Numbers = (now - self.live_ns) // MS
        return found


class _RowCounters:
    """As a Deframer's counters; what is not here does not change while frames are intact."""

    def __init__(self, views: _Views) -> None:
        self._views = views
        counters = views.esc.counters
        self.crc_errors = counters.crc_errors
        self.dropped_bytes = counters.dropped_bytes

    @cached_property
    def live(self) -> Numbers:
        first = self._views.esc.counters.live + 1
        return np.arange(first, first + len(self._views.live_times), dtype=np.int64)

    @cached_property
    def info(self) -> Numbers:
        return _short(self._views.info_index + self._views.esc.counters.info)

    @cached_property
    def bytes(self) -> Numbers:
        views = self._views
        before = views.esc.counters
        lengths = views.steady.lengths
        live, info = self.live - before.live, views.info_index
        found: Numbers = live * lengths[Kind.LIVE] + info * lengths[Kind.INFO] + before.bytes
        return found


def _short(column: Numbers) -> Numbers:
    """Of length 1 where it never changes."""
    found: Numbers = column[:1] if (column == column[0]).all() else column
    return found


def _behind(column: NDArray[Any], rows: int) -> Numbers:
    """The sum of what came before each row."""
    if len(column) == 1:
        same: Numbers = np.arange(rows, dtype=np.int64) * column[0]
        return same
    found = np.empty(rows, np.int64)
    found[0] = 0
    np.cumsum(column[:-1], out=found[1:])
    return found
