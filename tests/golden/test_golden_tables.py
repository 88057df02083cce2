"""Tables of the golden flights and captures have the values of the frames found by brute force."""

import csv
from collections.abc import Iterator
from pathlib import Path

import commands
import drive
import judge
import judged_esc
import pytest
import record
import specification
from esc import reference

pytestmark = pytest.mark.promise("tables")

FLIGHTS = ("v4", "legacy", "damage", "wreckage", "swap", "extremes", "errors")
"""Flights of one ESC. Plain bytes have no times, so nothing in them becomes too old."""
NOT_COMPARED = "bec_current"
"""It also depends on the device. The judge of the frames checks it."""
CAPTURES = sorted(record.HERE.glob("captures/*.kcap"))
Cells = dict[str, str]


def expected_rows(stream: bytes) -> list[Cells]:
    """Return the cells that a table must have for each measurement in the stream."""
    rows = []
    for frame in reference.frames_of(stream):
        if frame.kind == "live":
            rows.append(expected_cells(judged_esc.fields_of("live", frame.raw)))
    return rows


def expected_cells(values: judged_esc.Values) -> Cells:
    cells = {}
    for field in specification.LIVE_FIELDS:
        if field.name == NOT_COMPARED:
            continue
        unit = f" [{field.unit}]" if field.unit else ""
        cells[f"{field.name}{unit}"] = spelled(values[field.name], field.steps)
    state = values["operating_state"]
    cells["operating_state"] = specification.OPERATING_STATES.get(state, "")
    cells["operating_state_raw"] = str(state)
    for name, (word, bit) in judge.flags().items():
        if word in judged_esc.LIVE:
            cells[judged_esc.snake(name)] = str(values[word] >> bit & 1)
    return cells


def spelled(number: int, steps: int) -> str:
    return str(number) if steps == 1 else repr(number / steps)


def rows_in(table: Path, prefix: str, names: Cells) -> Iterator[Cells]:
    """Yield these cells of each row with new measurements of the ESC."""
    seen = ""
    with table.open(newline="", encoding="utf-8") as lines:
        for row in csv.DictReader(lines):
            count = row[f"{prefix}live_frames"]
            if count != seen and row[f"{prefix}electrical_speed [1/min]"]:
                yield {name: row[prefix + name] for name in names}
            seen = count


@pytest.mark.parametrize("flight", FLIGHTS)
def test_table_of_uart_bytes_has_exactly_the_frames(tmp_path: Path, flight: str) -> None:
    stream = commands.flight_bytes(record.HERE / f"flights/{flight}.txt", 1)
    expected = expected_rows(stream)
    source = tmp_path / "in.bin"
    source.write_bytes(stream)
    table = tmp_path / "out.csv"
    assert drive.command(["convert", "-q", str(source), str(table)]) == 0
    assert len(expected) > 20
    assert list(rows_in(table, "", expected[0])) == expected


@pytest.mark.parametrize("capture", CAPTURES, ids=lambda path: path.stem)
def test_table_of_a_capture_has_frames_in_their_order(tmp_path: Path, capture: Path) -> None:
    """Frames that the gateway discarded, because they arrived too slowly, are not in it."""
    table = tmp_path / "out.csv"
    assert drive.command(["convert", "-q", str(capture), str(table)]) == 0
    for prefix in prefixes_of(table):
        expected = expected_rows(bytes_of(capture, prefix, tmp_path))
        rows = list(rows_in(table, prefix, expected[0]))
        assert len(rows) > 20
        left = iter(expected)
        for row in rows:
            assert row in left  # consumes the frames up to this one


def prefixes_of(table: Path) -> list[str]:
    """Return the prefixes of the ESCs' columns: "" if there is only one ESC."""
    head = table.read_text(encoding="utf-8").partition("\n")[0].split(",")
    marker = "live_frames"
    return [name.removesuffix(marker) for name in head if name.endswith(marker)]


def bytes_of(capture: Path, prefix: str, folder: Path) -> bytes:
    target = folder / f"{prefix}bytes.bin"
    words = ["--esc", prefix.removesuffix(".")] if prefix else []
    assert drive.command(["convert", "-q", str(capture), str(target), *words]) == 0
    return target.read_bytes()
