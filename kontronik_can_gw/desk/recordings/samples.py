"""Rows of all values of a layout, from bytes of ESCs through the core, or from CAN frames.

A row holds each column's value as it is known at the row's time; None where it is not available. From bytes a row comes with each telemetry
frame, and with its loss; from CAN frames with each group of messages that belong together. What comes of another ESC, or in another
message, within 5 ms goes into the same row.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.dbc.output import DbcOutput
from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.esc.telemetry import MS, Event
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.signals.unpacker import Part, SignalReader, Value

SAME_ROW_NS = 5 * MS
GATEWAY_NS = 100 * MS
"""The gateway's own values are read so often."""


class Sample(NamedTuple):
    """A row. ``values``: in the order of the layout's columns; the list is the taker's own."""

    time_ns: int
    values: list[Value]


_Taken = tuple[int, int | None, slice, Callable[[int], list[Value]]]
"""A part: index of its message, page, columns, what gives their values."""


class _ValuesOnly(DbcOutput):
    """An output of which only ``bits`` is wanted: nothing is ever due."""

    def start(self, now: int) -> None:
        pass

    def on_event(self, esc: int, events: int, now: int) -> None:
        pass

    def on_gateway_change(self, now: int, at_once: bool = False, each_second: bool = False) -> None:
        pass

    def advance(self, now: int) -> None:
        pass

    def next_deadline(self) -> int | None:
        return None


class SampledGateway(Gateway):
    """A gateway that makes rows. They gather in ``rows``, which the owner empties; ``finish`` gives the last.

    ``frames_count``: the owner counts the frames that are sent; they are made where a row may hold how many there were. Otherwise nobody
    would take note of them.
    """

    def __init__(
        self,
        setup: CaptureSetup,
        layout: Layout,
        reader: SignalReader,
        now: int,
        frames_count: bool = True,
    ) -> None:
        self.rows: list[Sample] = []
        self._values: list[Value] = [None] * len(reader.columns)
        self._row_ns: int | None = None
        self._last_ns = 0
        self._in_row: set[int] = set()
        self._gateway_ns = now - GATEWAY_NS
        indices = {plan.name: index for index, plan in enumerate(layout.messages)}

        def taken(parts: Iterable[Part]) -> list[_Taken]:
            return [
                (
                    indices[p.plan.name],
                    p.page,
                    slice(p.first, p.first + p.count),
                    reader.unpack_of(p),
                )
                for p in parts
            ]

        by_esc = [[p for p in reader.parts if esc in p.plan.escs] for esc in range(len(setup.escs))]
        self._by_esc = [taken(parts) for parts in by_esc]
        self._with_live = [
            taken(p for p in parts if {Group.LIVE, Group.LINK} & p.plan.paces) for parts in by_esc
        ]
        self._of_gateway = taken(p for p in reader.parts if not p.plan.escs)
        super().__init__(setup.escs, layout, now, setup.silent_on_loss, setup.canopen)
        if not frames_count or not any(column.source == "sent_frames" for column in reader.columns):
            self._output = _ValuesOnly(layout, self.escs, self.status, now)
        self._started = False

    def play(self, now: int, data: bytes) -> None:
        """Bytes of the only ESC, with which it starts, and time goes by; it is never late."""
        if not self._started:
            self._started = True
            self.port_opened(0, now)
            self.start(now)
        while (due := self.next_deadline()) < now:
            self.advance(due)
        self.receive_bytes(0, data, now, now)
        self.advance(now)
        self.take_frames()
        self.take_link_changes()

    def take_rows(self) -> Sequence[Sample]:
        """The rows that are complete."""
        if not self.rows:
            return ()
        rows, self.rows = self.rows, []
        return rows

    def finish(self) -> list[Sample]:
        """The row that is not closed yet."""
        self._close_row()
        rows, self.rows = self.rows, []
        return rows

    def _follow(self, esc: int, events: int, now: int) -> None:
        super()._follow(esc, events, now)
        if not events & (Event.LIVE | Event.LINK | Event.INFO):
            return
        state = self.escs[esc]
        when = now
        if events & Event.LIVE and state.live is not None and state.live_ns is not None:
            when = min(now, state.live_ns)  # of its last byte on the wire
        when = max(when, self._last_ns)  # rows do not go back
        if self._row_ns is not None:
            when = max(when, self._row_ns)
            again = events & Event.LIVE and esc in self._in_row
            if again or when - self._row_ns > SAME_ROW_NS:
                self._close_row()
        if events & (Event.LINK | Event.INFO):
            self._read(self._by_esc[esc], when)
        else:
            self._read(self._with_live[esc], when)
        if when - self._gateway_ns >= GATEWAY_NS or events & Event.LINK:
            self._gateway_ns = when
            self._read(self._of_gateway, when)
        if events & Event.LIVE:
            self._in_row.add(esc)
            if self._row_ns is None:
                self._row_ns = when

    def _read(self, parts: list[_Taken], now: int) -> None:
        values, bits = self._values, self.message_bits
        for message, page, columns, unpack in parts:
            values[columns] = unpack(bits(message, now, page))

    def _close_row(self) -> None:
        if self._row_ns is not None:
            self.rows.append(Sample(self._row_ns, list(self._values)))
            self._last_ns = self._row_ns
            self._row_ns = None
            self._in_row.clear()


def samples_of_frames(frames: Iterable[TimedFrame], reader: SignalReader) -> Iterator[Sample]:
    """Rows of CAN frames, as a listener has them: values hold while they are fresh."""
    view = View(reader)
    row_ns: int | None = None
    in_row: set[int] = set()
    last = 0
    for frame_ns, frame, _ in frames:
        last = time_ns = max(frame_ns, last)  # a log of several interfaces may not be in order
        key = frame.key
        if key not in reader.keys:
            continue
        if row_ns is not None and (key in in_row or time_ns - row_ns > SAME_ROW_NS):
            yield Sample(row_ns, list(view.values))
            row_ns = None
            in_row.clear()
        while (due := view.next_expiry) is not None and due < time_ns:  # a loss is a row of its own
            if view.expire(due + 1):
                if row_ns is not None:
                    row_ns = None
                    in_row.clear()
                yield Sample(due + 1, list(view.values))
        if view.take(key, frame.data, time_ns) is None:
            continue
        in_row.add(key)
        if row_ns is None:
            row_ns = time_ns
    if row_ns is not None:
        yield Sample(row_ns, list(view.values))
