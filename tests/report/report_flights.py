"""Simulated flights as inputs of the report: rows as ``open_input`` gives them, made by the real gateway without any file."""

import base64
import gzip
import heapq
import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from simulated_bus import layout_of

from kontronik_can_gw.dbc.view import View
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.samples import fields_of_log
from kontronik_can_gw.desk.report.analysis import Analysis
from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, SimulatedEsc
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.signals.unpacker import SignalReader, Value

Row = tuple[int, list[Value]]


def shipped_bus(*names: str) -> BusLayout:
    """The shipped DBC for these ESCs, by default one."""
    return layout_of(names or ["esc1"])


def simulated(bus: BusLayout, seconds: float, options: Sequence[EscOptions] = ()) -> Iterator[Row]:
    """Simulated ESCs through the real gateway and the DBC: a row at each frame of theirs."""
    start_ns = 5 * SECOND
    gateway = Gateway(bus.escs, bus.layout, start_ns)
    gateway.start(start_ns)
    view = View(SignalReader(bus.layout))
    escs = [
        SimulatedEsc(
            options[i] if i < len(options) else EscOptions(),
            seed=7 + i,
            start_ns=start_ns + i * 1_234_567,
        )
        for i in range(len(bus.escs))
    ]
    due = [(esc.next_ns, index) for index, esc in enumerate(escs)]
    heapq.heapify(due)
    end_ns = start_ns + round(seconds * SECOND)
    while due[0][0] < end_ns:
        now, index = due[0]
        while (deadline := gateway.next_deadline()) is not None and deadline < now:
            gateway.advance(deadline)
            for frame in gateway.take_frames(deadline):
                view.take(frame.key, frame.data, deadline)
        for sent in escs[index].frames_until(now):
            gateway.receive_bytes(index, sent.wire, now, now)
        gateway.advance(now)
        for frame in gateway.take_frames(now):
            view.take(frame.key, frame.data, now)
        view.expire(now)
        yield now, list(view.values)
        heapq.heapreplace(due, (escs[index].next_ns, index))


def analysis_of(
    bus: BusLayout, points: int = 2000, window: tuple[float | None, float | None] = (None, None)
) -> Analysis:
    """An analysis of the rows of a bus."""
    fields = fields_of_log(SignalReader(bus.layout), bus.escs)
    return Analysis(bus.escs, fields, points, window)


def analysed(analysis: Analysis, rows: Iterable[Row]) -> Flight:
    """The flight of these rows."""
    for time_ns, values in rows:
        if not analysis.take(time_ns, values):
            break
    return analysis.finish()


def rows_of(bus: BusLayout, times: Sequence[int], **columns: Sequence[Value]) -> Iterator[Row]:
    """Rows with values of the first ESC by source; the others are not available."""
    count = len(SignalReader(bus.layout).columns)
    places = [(column(bus, source), values) for source, values in columns.items()]
    for number, time_ns in enumerate(times):
        row: list[Value] = [None] * count
        for at, values in places:
            row[at] = values[number]
        yield time_ns, row


def data_of(html: str) -> dict[str, Any]:
    """The data that a page draws."""
    packed = html.partition(' id="data">')[2].partition("<")[0]
    found: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(packed)))
    return found


def column(bus: BusLayout, source: str, esc: int | None = 0) -> int:
    """Where a source is in a row."""
    found = SignalReader(bus.layout).column_of(source, esc)
    assert found is not None
    return found
