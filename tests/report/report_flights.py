"""Simulated flights as inputs of the report.

Their rows are as from ``open_input``, but they are made by the real gateway without a file.
"""

import base64
import gzip
import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

from simulated_bus import flight

from kontronik_can_gw.desk.receiver.unpacker import SignalReader, Value
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.recordings.recording import RowBlock
from kontronik_can_gw.desk.recordings.replay import TimedFrame
from kontronik_can_gw.desk.recordings.samples import RowsOfFrames, fields_of_log
from kontronik_can_gw.desk.report.flight import Flight
from kontronik_can_gw.esc.kontronik.simulator import EscOptions
from kontronik_can_gw.times import SECOND

Row = tuple[int, list[Value]]


def simulated(bus: BusLayout, seconds: float, options: Sequence[EscOptions] = ()) -> Iterator[Row]:
    """Yield the rows of simulated ESCs, whose values pass the real gateway, the bus and the DBC.

    Further options than ESCs are not used.
    """
    given = list(options)[: len(bus.escs)]
    while len(given) < len(bus.escs):
        given.append(EscOptions())
    reader = SignalReader(bus.layout)
    frames = []
    for now, frame in flight(bus, seconds, given):
        frames.append(TimedFrame(5 * SECOND + now, frame))
    rows = RowsOfFrames(reader, range(len(reader.columns)))
    for times, columns in rows.blocks(frames, count=100):
        values = zip(*columns, strict=True)
        yield from zip(times, map(list, values), strict=True)


def flight_of(bus: BusLayout, rows: Iterable[Row], points: int = 2000) -> Flight:
    """Return the flight of the rows of a bus, which are given in blocks of 100."""
    fields = fields_of_log(SignalReader(bus.layout), bus.escs)
    made = Flight(bus.escs, fields, points)
    every = iter(rows)
    while some := list(islice(every, 100)):
        times, values = zip(*some, strict=True)
        columns = list(zip(*values, strict=True))
        made.evaluate(RowBlock(times, columns, None))
    return made.finish()


def rows_of(bus: BusLayout, times: Sequence[int], **columns: Sequence[Value]) -> Iterator[Row]:
    """Yield rows with these values of the first ESC. All other values are not available."""
    count = len(SignalReader(bus.layout).columns)
    places = [(column(bus, source), values) for source, values in columns.items()]
    for number, time_ns in enumerate(times):
        row: list[Value] = [None] * count
        for at, values in places:
            row[at] = values[number]
        yield time_ns, row


def data_of(html: str) -> dict[str, Any]:
    """Return the data that a page draws."""
    _, _, rest = html.partition(' id="data">')
    packed, _, _ = rest.partition("<")
    data = gzip.decompress(base64.b64decode(packed))
    found: dict[str, Any] = json.loads(data)
    return found


def column(bus: BusLayout, source: str, esc: int | None = 0) -> int:
    """Return the position of a source in a row."""
    columns = SignalReader(bus.layout).columns
    sources = [(column.source, column.esc) for column in columns]
    return sources.index((source, esc))
