"""Simulated flights as inputs of the report: rows as ``open_input`` gives them, made by the real gateway without any file."""

import base64
import gzip
import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

from simulated_bus import flight

from kontronik_can_gw.capture.replay import TimedFrame
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.recording import Block
from kontronik_can_gw.desk.recordings.samples import RowsOfFrames, fields_of_log
from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.esc.kontronik.simulator import EscOptions
from kontronik_can_gw.signals.unpacker import SignalReader, Value
from kontronik_can_gw.times import SECOND

Row = tuple[int, list[Value]]


def simulated(bus: BusLayout, seconds: float, options: Sequence[EscOptions] = ()) -> Iterator[Row]:
    """Simulated ESCs through the real gateway, the bus and the DBC."""
    given = [*options, *[EscOptions()] * len(bus.escs)][: len(bus.escs)]
    reader = SignalReader(bus.layout)
    frames = (TimedFrame(5 * SECOND + now, frame) for now, frame in flight(bus, seconds, given))
    rows = RowsOfFrames(reader, range(len(reader.columns)))
    for times, columns in rows.blocks(frames, count=100):
        yield from zip(times, map(list, zip(*columns, strict=True)), strict=True)


def flight_of(bus: BusLayout, rows: Iterable[Row], points: int = 2000) -> Flight:
    """The flight of the rows of a bus."""
    made = Flight(bus.escs, fields_of_log(SignalReader(bus.layout), bus.escs), points)
    every = iter(rows)
    while some := list(islice(every, 100)):
        times, values = zip(*some, strict=True)
        made.take(Block(times, [*zip(*values, strict=True)], None))
    return made.finish()


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
    columns = [(column.source, column.esc) for column in SignalReader(bus.layout).columns]
    return columns.index((source, esc))
