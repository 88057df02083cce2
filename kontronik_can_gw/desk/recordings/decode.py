"""Recorded UART bytes -> records: one flat mapping per accepted frame, in file order, ready for JSON lines or CSV.

A record's keys stand in wire order under the names of the field table, values in physical units. Floats are the nearest to
the exact step, so that they print as 24.42 and read back to the raw value.
"""

import csv
import json
import os
from collections.abc import Callable
from functools import lru_cache
from io import StringIO

from kontronik_can_gw.esc.kontronik.codec import Kind, Layout
from kontronik_can_gw.esc.kontronik.deframer import Counters, Deframer, Frame
from kontronik_can_gw.esc.kontronik.fields import Data, InfoData, LiveData, rows
from kontronik_can_gw.esc.kontronik.states import (
    ErrorBit,
    OperatingError,
    SelfTestError,
    bit_texts,
    device_text,
    peak_current_of,
    state_text,
)

Value = int | float | str | bool | list[str] | None
Record = dict[str, Value]

CHUNK = 1 << 16


@lru_cache(maxsize=1024)
def _names(word: int, kind: type[ErrorBit]) -> list[str]:
    return bit_texts(word, kind)


def physical_fields(data: Data, device: int | None = None) -> Record:
    """The fields of a frame in wire order, in physical units; None where the known ``device`` does not supply one.

    Error words also as names, states and devices as names with the number beside, firmware as "1.14"; of an info frame also
    whose peak current the device reports (motor, battery, None where unknown).
    """
    record: Record = {}
    for (name, row), raw in zip(rows(type(data)).items(), data, strict=True):
        match name:
            case "operating_errors" | "selftest_errors":
                record[name] = raw
                names = OperatingError if name == "operating_errors" else SelfTestError
                record[f"{name}_names"] = list(_names(raw, names))
            case "operating_state":
                record[name] = state_text(raw)
                record["operating_state_raw"] = raw
            case "device_and_variant" if isinstance(data, InfoData):
                record["device"] = device_text(data.device)
                record["device_raw"] = data.device
                record["variant"] = data.variant
                record["peak_current_of"] = peak_current_of(data.device)
            case "firmware_word" if isinstance(data, InfoData):
                record["firmware"] = data.firmware
            case _:
                record[name] = None if device in row.not_on else row.physical(raw)
    return record


COLUMNS = (
    "kind",
    "layout",
    "offset",
    *physical_fields(LiveData()),
    "suspect",
    *physical_fields(InfoData()),
)
"""The CSV header: live and info fields."""


class Decoder:
    """One stream. ``feed`` and ``flush`` give the records that became certain, as Deframer does the frames."""

    __slots__ = ("_deframer", "_device", "_layout")

    def __init__(self) -> None:
        self._deframer = Deframer()
        self._device: int | None = None
        self._layout: Layout | None = None

    @property
    def counters(self) -> Counters:
        return self._deframer.counters

    def feed(self, data: bytes) -> list[Record]:
        """Take the next bytes."""
        return [self._record(frame) for frame in self._deframer.feed(data)]

    def flush(self) -> list[Record]:
        """The stream ended."""
        return [self._record(frame) for frame in self._deframer.flush()]

    def _record(self, frame: Frame) -> Record:
        if frame.layout is not self._layout:
            # another device was plugged in: its info frame will show which
            self._layout = frame.layout
            self._device = None
        data = frame.data
        if isinstance(data, InfoData):
            self._device = data.device
        record: Record = {
            "kind": frame.kind.value,
            "layout": frame.layout.value,
            "offset": frame.offset,
        }
        record |= physical_fields(data, self._device)
        if frame.kind is Kind.LIVE:
            record["suspect"] = frame.suspect
        return record


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
    try:
        while data := os.read(fd, CHUNK):
            if records := decoder.feed(data):
                write(lines(records))
            advance(len(data))
    except BrokenPipeError:  # from write: nobody wants the rest
        raise
    except (OSError, KeyboardInterrupt):
        if records := decoder.flush():
            write(lines(records))
        raise
    if records := decoder.flush():
        write(lines(records))


def summary(counters: Counters) -> str:
    """The counters in words: one line, and a second with the diagnosis where bytes but no frame came."""
    frames = counters.live + counters.info
    layouts = {
        "v4": counters.live_v4 + counters.info_v4,
        "legacy": counters.live_legacy + counters.info_legacy,
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
