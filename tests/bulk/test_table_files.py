"""Tables that are written by blocks are those that are written row by row: the same bytes as text, the same columns in Parquet and MF4."""

import io
import json
import math
import random
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.parquet  # type: ignore[import-untyped]
import pytest
from capture_bench import START, Bench, made
from flights import Wandering, random_layout
from hypothesis import given, settings
from hypothesis import strategies as st
from protocol.streams import damaged

from kontronik_can_gw import capture
from kontronik_can_gw.cli import main
from kontronik_can_gw.offline import inputs
from kontronik_can_gw.offline.layouts import BusLayout
from kontronik_can_gw.offline.tables import Block, BlockColumn, Choice, Field, Row, Rows, Table, open_table
from kontronik_can_gw.offline.tables.fields import Kind
from kontronik_can_gw.protocol.codec import Layout

OPTIONS: list[list[str]] = [
    [],
    ["--signals", "Battery*,OperatingState,Uptime,Dev*,LinkState"],
    ["--signals", "MotorSpeed"],
    ["--from", "2.005", "--until", "9.5"],
    ["--until", "0.3"],
    ["--from", "7"],
    ["--rate", "7"],
    ["--live-rate", "33.3", "--esc", "esc1"],
    ["--frames"],
]


@pytest.fixture(autouse=True)
def _blocks_of_small_files_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inputs, "LEAST_FOR_NUMPY", 1)


@pytest.fixture(scope="module")
def stream() -> bytes:
    source = random.Random(4)
    esc = Wandering(source)
    return esc.frames(700) + damaged(esc.frames(100), source, 2) + esc.frames(400, 20)


def written(path: Path, out: Path, options: Sequence[str]) -> int:
    return main(["convert", str(path), str(out), "--force", "-q", *options])


@pytest.mark.parametrize("options", OPTIONS, ids=" ".join)
@pytest.mark.parametrize("form", ["csv", "jsonl", "parquet"])
def test_a_file_is_the_same(
    stream: bytes, tmp_path: Path, form: str, options: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(stream)
    further = ["--units-line"] if form == "jsonl" else []
    by_blocks, by_rows = tmp_path / f"blocks.{form}", tmp_path / f"rows.{form}"
    assert written(path, by_blocks, options + further) == 0
    monkeypatch.setattr(inputs.DumpInput, "blocks", lambda *_: None)
    assert written(path, by_rows, options + further) == 0
    if form == "parquet":
        one, other = (pyarrow.parquet.read_table(file) for file in (by_blocks, by_rows))
        assert one.schema.equals(other.schema, check_metadata=True)
        assert one.equals(other)
    else:
        assert by_blocks.read_bytes() == by_rows.read_bytes()


def test_mf4_is_the_same(stream: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from asammdf import MDF

    path = tmp_path / "a.bin"
    path.write_bytes(stream[:60_000])
    assert written(path, tmp_path / "blocks.mf4", []) == 0
    monkeypatch.setattr(inputs.DumpInput, "blocks", lambda *_: None)
    assert written(path, tmp_path / "rows.mf4", []) == 0
    with MDF(tmp_path / "blocks.mf4") as one, MDF(tmp_path / "rows.mf4") as other:
        for name in ("BatteryVoltage", "OperatingState", "CellCount", "Uptime"):
            first, second = one.get(name, raw=True), other.get(name, raw=True)
            np.testing.assert_array_equal(first.samples, second.samples)
            np.testing.assert_array_equal(first.timestamps, second.timestamps)


def test_without_numpy_it_goes_row_by_row(stream: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(stream[:20_000])
    assert written(path, tmp_path / "with.csv", []) == 0
    for name in [name for name in sys.modules if name.startswith("kontronik_can_gw.offline.bulk.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "numpy", None)
    assert inputs.DumpInput(path).blocks([0]) is None
    assert written(path, tmp_path / "without.csv", []) == 0
    assert (tmp_path / "with.csv").read_bytes() == (tmp_path / "without.csv").read_bytes()


@pytest.mark.parametrize("seed", range(5))
def test_any_layout_as_text(tmp_path: Path, seed: int) -> None:
    """Texts with commas, floats that are infinite, counters of many digits."""
    source = random.Random(seed)
    layout = random_layout(source, 6)
    esc = Wandering(source, source.choice(list(Layout)))
    path = tmp_path / "a.bin"
    path.write_bytes(esc.frames(300, source.choice([0, 7, 100])) + esc.frames(150, 25))
    for form in ("csv", "jsonl"):
        texts = [_text(path, layout, form, by_blocks) for by_blocks in (True, False)]
        assert texts[0] == texts[1]


class RowByRow(inputs.DumpInput):
    """Has no blocks."""

    def blocks(self, chosen: Sequence[int]) -> None:
        return None


def _text(path: Path, layout: BusLayout, form: str, by_blocks: bool) -> bytes:
    recording = (inputs.DumpInput if by_blocks else RowByRow)(path, layout)
    rows = Rows(recording, Choice(range(len(recording.reader.columns))))
    assert rows.table is not None
    file = io.BytesIO()
    blocks = 0
    with open_table(file, form, rows.table) as writer:
        for item in rows:
            if isinstance(item, Block):
                writer.write_block(item)
                blocks += 1
            else:
                writer.write(item)
    assert bool(blocks) == by_blocks
    return file.getvalue()


TEXTS = ((0, "plain"), (3, 'with, comma and "quotes"'), (5, "{brace}"), (9, "plain"))
FIELDS = [
    Field("Flag", "", Kind.FLAG, "M"),
    Field("Whole", "rpm", Kind.WHOLE, "M"),
    Field("Float", "V", Kind.FLOAT, "M"),
    Field("Real", "A", Kind.FLOAT, "M"),
    Field("Text", "", Kind.TEXT, "M", TEXTS),
    Field("Na{me", "", Kind.WHOLE, "M"),
]


@st.composite
def blocks(draw: st.DrawFn) -> Block:
    """Columns with and without values, that change often, seldom and never."""
    source = random.Random(draw(st.integers(0, 1 << 32)))
    rows = draw(st.sampled_from([1, 2, 30, 100]))
    columns = []
    for field in FIELDS:
        kind = source.choice(["same", "seldom", "often"])
        count = 1 if kind == "same" else rows
        picks = [source.randrange(1 if kind == "same" else 4)]
        while len(picks) < count:
            picks.append(picks[-1] if kind == "seldom" and source.random() < 0.97 else source.randrange(5))
        divisor = 1
        if field.kind is Kind.TEXT:
            numbers = np.array(picks) % 4
        elif field.kind is Kind.FLAG:
            numbers = np.array(picks) & 1
        elif field.name == "Real":
            values = [0.1, 1e300, source.uniform(-5, 5), math.inf, -math.inf]
            numbers = np.array([values[pick] for pick in picks])
        else:
            divisor = 3 if field.kind is Kind.FLOAT else 1  # of one column always the same
            values = [0, -7, source.randrange(1 << 40), 65_535, source.randrange(-300, 300)]
            numbers = np.array([values[pick] for pick in picks], np.int64)
        valid = np.array([source.random() < 0.6 for _ in numbers]) if source.random() < 0.5 else None
        columns.append(BlockColumn(numbers, valid, divisor))
    first = draw(st.sampled_from([0, 999_990_000, 3_600_000_000_123, -500]))
    times = first + np.arange(rows, dtype=np.int64) * draw(st.sampled_from([10_000_000, 1000, 333]))
    walls = times + 1_700_000_000_000_000_000 if draw(st.booleans()) else None
    return Block(times, walls, columns)


@given(st.lists(blocks(), min_size=1, max_size=3), st.booleans())
@settings(max_examples=25, deadline=None)
def test_any_block(tmp_path_factory: pytest.TempPathFactory, given_blocks: list[Block], has_utc: bool) -> None:
    table = Table(FIELDS, has_utc)
    texts = [[text for _, text in field.texts] for field in FIELDS]
    folder = tmp_path_factory.getbasetemp()
    found: list[dict[str, object]] = []
    for by_blocks in (True, False):
        results: dict[str, object] = {}
        for form in ("csv", "jsonl", "parquet"):
            target = folder / "any.parquet" if form == "parquet" else io.BytesIO()
            with open_table(target, form, table) as writer:
                for block in given_blocks:
                    if by_blocks:
                        writer.write_block(block)
                    else:
                        for row in block.rows(texts):
                            writer.write(Row(*row))
            if isinstance(target, Path):
                read = pyarrow.parquet.read_table(target)
                results[form] = [repr(column.to_pylist()) for column in read.columns]
            else:
                results[form] = target.getvalue()
        found.append(results)
    for form, expected in found[1].items():
        assert found[0][form] == expected
    for line in str(found[0]["jsonl"], "utf-8").splitlines():  # type: ignore[call-overload]
        json.loads(line)


def test_some_of_a_block() -> None:
    block = Block(np.arange(10, dtype=np.int64), None, [BlockColumn(np.arange(10)), BlockColumn(np.array([7]))])
    assert [row[0] for row in block.of(3, 6).rows([[], []])] == [3, 4, 5]
    assert [row[2] for row in block.of(3, 5).rows([[], []])] == [(3, 7), (4, 7)]
    assert len(block.of(0, 99)) == 10
    assert block.rows_before(4) == 4
    assert (block.time_ns, block.last_ns) == (0, 9)
    assert list(block.since(-5).times_ns) == list(range(5, 15))


@cache
def capture_bytes(escs: int, nodes: bool) -> bytes:
    """A capture in which everything happens."""
    bench = Bench(*made(escs, canopen=nodes)).live(escs, 5)
    header = bench.setup.header() | {"run": "r", "part": 0, "created_ns": START, "monotonic_ns": START, "wall_ns": 7}
    data = capture.block(b"D", 1, capture.data_payload(bench.entries))
    return b"".join([capture.block(b"H", 0, capture.json_payload(header)), data, capture.block(b"E", 2, b"")])


@pytest.mark.parametrize(("escs", "nodes"), [(1, False), (2, True)])
def test_a_capture_without_its_frames_has_the_same_values(tmp_path: Path, escs: int, nodes: bool) -> None:
    path = tmp_path / "a.kcap"
    path.write_bytes(capture_bytes(escs, nodes))
    with inputs.open_input(path) as recording:
        columns = recording.reader.columns
        chosen = [index for index, column in enumerate(columns) if column.source != "sent_frames"]
        assert len(chosen) < len(columns)
        found = recording.blocks(chosen)
        assert found is not None
        rows = [(row.time_ns, [row.values[i] for i in chosen]) for row in found if not isinstance(row, Block)]
        expected = [(row.time_ns, [row.values[i] for i in chosen]) for row in recording.samples()]
        assert len(rows) > 100
        assert rows == expected
        every = recording.blocks(range(len(columns)))
        assert every is not None
        assert list(every) == list(recording.samples())
