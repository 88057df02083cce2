"""Recorded UART bytes -> records: one flat mapping per accepted frame, in file order, ready for JSON lines or CSV.

A record's keys stand in wire order under the names of the field table, values in physical units. Floats are the nearest to
the exact step, so that they print as 24.42 and read back to the raw value.
"""

import csv
import json
import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from io import StringIO

from kontronik_can_gw.esc.decoder import (
    Counters,
    Data,
    ErrorBit,
    EscProtocol,
    Field,
    Reading,
    bit_texts,
)
from kontronik_can_gw.esc.protocols import PROTOCOLS

Value = int | float | str | bool | list[str] | None
Record = dict[str, Value]

CHUNK = 1 << 16


@lru_cache(maxsize=1024)
def _names(word: int, bits: Sequence[ErrorBit]) -> list[str]:
    return bit_texts(word, bits)


def physical_fields(
    protocol: EscProtocol, is_info: bool, data: Data, device: int | None = None
) -> Record:
    """The fields of a reading in wire order, in physical units; None where the known ``device`` does not supply one.

    Error words also as names, states and devices as names with the number beside, firmware as "1.14"; of information also
    whose peak current the device reports (motor, battery, None where unknown).
    """
    record: Record = {}
    fields = (field for field in protocol.fields if field.is_info is is_info)
    for field in sorted(fields, key=lambda field: field.word):
        name, raw = field.name, field.of(data)
        if name == "firmware_main":
            record["firmware"] = protocol.firmware_text(data)
        elif name != "firmware_sub":
            record[name] = _physical(field, raw, device)
        if (bits := protocol.errors.get(name)) is not None:
            record[f"{name}_names"] = list(_names(raw, tuple(bits)))
        if name == "variant":
            record["peak_current_of"] = protocol.peak_current_text(data)
    return record


def _physical(field: Field, raw: int, device: int | None) -> Value:
    if field.names:
        return field.names.get(raw)
    if device in field.not_on:
        return None
    return raw if field.per_unit == 1 else raw / field.per_unit


def columns_of(protocol: EscProtocol) -> tuple[str, ...]:
    """The CSV header: fields of live data and of information."""
    words = max(field.word for field in protocol.fields) + 1
    nothing = (0,) * words
    live, info = (physical_fields(protocol, is_info, nothing) for is_info in (False, True))
    return ("kind", "layout", "offset", *live, "suspect", *info)


COLUMNS = columns_of(PROTOCOLS[0])


class Decoder:
    """One stream. ``feed`` and ``flush`` give the records that became certain. ``counters``: of the whole stream."""

    def __init__(self, protocol: EscProtocol = PROTOCOLS[0]) -> None:
        self._protocol = protocol
        self._decoder = protocol.make()
        self._device: int | None = None
        self._layout = 0

    @property
    def counters(self) -> Counters:
        found: Counters = self._decoder.counters
        return found

    def feed(self, data: bytes) -> list[Record]:
        """Take the next bytes."""
        return [self._record(reading) for reading in self._decoder.feed(data)]

    def flush(self) -> list[Record]:
        """The stream ended."""
        return [self._record(reading) for reading in self._decoder.flush()]

    def _record(self, reading: Reading) -> Record:
        protocol, form, data = self._protocol, reading.form, reading.data
        if form.layout_number != self._layout:
            # another device was plugged in: its information will show which
            self._layout = form.layout_number
            self._device = None
        if form.is_info:
            self._device = protocol.value("device_raw", data)
        record: Record = {
            "kind": "info" if form.is_info else "live",
            "layout": protocol.layouts[form.layout_number - 1].lower(),
            "offset": reading.offset,
        }
        record |= physical_fields(protocol, form.is_info, data, self._device)
        return record if form.is_info else record | {"suspect": reading.suspect}


def json_lines(records: list[Record]) -> str:
    """One JSON object a line."""
    return "".join(json.dumps(record) + "\n" for record in records)


def csv_lines(records: list[Record]) -> str:
    """One row of COLUMNS a line, without header: absent values empty, names joined by ``|``, booleans as in JSON."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([_cell(record.get(column)) for column in COLUMNS] for record in records)
    return text.getvalue()


def csv_header() -> str:
    """COLUMNS as a line."""
    return ",".join(COLUMNS) + "\n"


def _cell(value: Value) -> int | float | str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return "|".join(value) if isinstance(value, list) else value


def decode_stream(
    decoder: Decoder,
    fd: int,
    write: Callable[[str], object],
    *,
    lines: Callable[[list[Record]], str] = json_lines,
    advance: Callable[[int], object] = lambda _: None,
) -> None:
    """Read ``fd`` to its end, hand each chunk's lines to ``write`` and its size to ``advance``. Holds one chunk at a time.

    What is pending is flushed also when reading fails (OSError) or is interrupted (KeyboardInterrupt); both are passed on.
    """

    def put(records: list[Record]) -> None:
        if records:
            write(lines(records))

    try:
        while data := os.read(fd, CHUNK):
            put(decoder.feed(data))
            advance(len(data))
    except BrokenPipeError:  # from write: nobody wants the rest
        raise
    except (OSError, KeyboardInterrupt):
        put(decoder.flush())
        raise
    put(decoder.flush())


def summary(counters: Counters) -> str:
    """The counters in words: one line, and a second with the diagnosis where bytes but no frame came."""
    frames = counters.live + counters.info
    held = counters.as_dict()
    layouts = {
        name.lower(): held.get(f"live_{name.lower()}", 0) + held.get(f"info_{name.lower()}", 0)
        for name in PROTOCOLS[0].layouts
    }
    which = ", ".join(f"{number} {name}" for name, number in layouts.items() if number)
    line = (
        f"{counters.bytes} bytes: {counters.live} live and {counters.info} info frames"
        f"{f' ({which})' if frames else ''}, {counters.dropped_bytes} bytes dropped, {counters.crc_errors} CRC errors"
    )
    if not counters.bytes:
        return "0 bytes: the input is empty"
    diagnosis = counters.diagnosis()
    return f"{line}\nno frame found: {diagnosis}" if diagnosis else line
