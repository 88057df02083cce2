"""Tables in all formats have the values of a recording's rows, as cantools reads them, exactly."""

import csv
import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import asammdf
import cantools.database
import pandas as pd  # type: ignore[import-untyped]
import pyarrow as pa  # type: ignore[import-untyped]
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet
from recordings import (
    WALL_NS,
    capture_bytes,
    convert,
)

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.esc_stream import EscStream
from kontronik_can_gw.desk.recordings import tables
from kontronik_can_gw.desk.recordings.convert import _table_writer
from kontronik_can_gw.desk.recordings.fields import (
    Choice,
    ColumnType,
    Table,
    TableColumn,
    distinct,
    fields_of_values,
)
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.recording import RowBlock
from kontronik_can_gw.desk.recordings.samples import RowMaker
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("tables")

Cells = list[dict[str, Any]]
"""The values of each row by signal name. None: not available.

Time is in seconds, Utc is a text with microseconds.
"""


def utc_text(wall_ns: int) -> str:
    """Cut at the microsecond."""
    moment = datetime.fromtimestamp(wall_ns // 10**9, UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{wall_ns % 10**9 // 1000:06d}Z"


def _number(text: str) -> float | str | None:
    try:
        return float(text)
    except ValueError:
        return text or None


def read_csv(path: Path) -> Cells:
    with path.open(encoding="utf-8") as file:
        heads, *lines = csv.reader(file)
    names = [head.partition(" [")[0] for head in heads]
    return [dict(zip(names, map(_number, line), strict=True)) for line in lines]


def read_jsonl(path: Path) -> Cells:
    return [json.loads(line) for line in path.read_text().splitlines()]


def read_parquet(path: Path) -> Cells:
    table = parquet.read_table(path)
    rows: Cells = table.rename_columns(
        [n.partition(" [")[0] for n in table.schema.names]
    ).to_pylist()
    for row in rows:
        if "Utc" in row:
            row["Utc"] = utc_text(pd.Timestamp(row["Utc"]).value)
    return rows


READ = {"csv": read_csv, "jsonl": read_jsonl, "parquet": read_parquet}


def test_units_stand_in_headers_and_metadata(tmp_path: Path) -> None:
    source = tmp_path / "two.kcap"
    source.write_bytes(capture_bytes())
    for form in READ:
        assert convert(source, tmp_path / f"out.{form}") == 0
    with (tmp_path / "out.csv").open() as file:
        heads = next(csv.reader(file))
    schema = parquet.read_schema(tmp_path / "out.parquet")
    with open_input(source) as opened:
        fields = opened.fields
        provenance = opened.provenance
    expected = ["Time [s]", "Utc"] + [f"{c.name} [{c.unit}]" if c.unit else c.name for c in fields]
    assert heads == schema.names == expected
    assert {"e0.battery_voltage [V]", "e1.bec_temperature [°C]", "uptime [s]"} < set(heads)
    types = {
        "e0.undervoltage": pa.int8(),
        "e0.consumed_charge [mAh]": pa.int64(),
        "e0.battery_voltage [V]": pa.float64(),
        "e0.motor_speed [1/min]": pa.float64(),
        "e1.operating_state": pa.dictionary(pa.int32(), pa.string()),
    }
    assert {name: schema.field(name).type for name in types} == types
    for one, head in zip(fields, expected[2:], strict=True):
        assert schema.field(head).metadata[b"unit"].decode() == one.unit
    assert json.loads(schema.metadata[b"kontronik_can_gw"]) == provenance


def test_mf4_header_names_devices_that_the_capture_learnt_of_on_the_way(tmp_path: Path) -> None:
    source = tmp_path / "learnt.kcap"
    source.write_bytes(capture_bytes(devices=("KOSMIK",)))
    assert convert(source, tmp_path / "out.mf4", "--to", "mf4-log") == 0
    with asammdf.MDF(tmp_path / "out.mf4") as mdf:
        assert "e0: KOSMIK 200, firmware 1.2, V4 layout, at /dev/ttyUSB0" in mdf.header.comment
        assert "e1: unknown device, at /dev/ttyUSB1" in mdf.header.comment
        assert 0 <= mdf.header.start_time.timestamp() - WALL_NS / 1e9 < 0.1


def test_names_that_are_there_twice_get_their_message_in_front() -> None:
    names = ("A X ", "B X ", "B Y ", "B Time ", "C Z Za", "C Z Zb")
    parts = [text.split(" ") for text in names]
    fields = [
        TableColumn(name, "V", ColumnType.FLOAT, message, signal=own)
        for message, name, own in parts
    ]
    found = [field.name for field in distinct(fields)]
    assert found == ["A.X", "B.X", "Y", "B.Time", "C.Za", "C.Zb"]


TEXTS = ((0, "Plain"), (1, 'odd, "quoted"'), (7, "{braces}"), (300, "µ"))
FIELDS = (
    TableColumn("Flag", "", ColumnType.FLAG, "M"),
    TableColumn("Whole", "us", ColumnType.WHOLE, "M"),
    TableColumn("Float", "deg C", ColumnType.FLOAT, "M"),
    TableColumn("Text", "", ColumnType.TEXT, "M", TEXTS),
)
ROW = st.tuples(
    st.integers(0, 10**13),
    st.integers(0, 4 * 10**18),
    st.tuples(
        st.sampled_from((None, 0, 1)),
        st.one_of(st.none(), st.integers(-(1 << 52), 1 << 52)),
        st.one_of(st.none(), st.floats(allow_nan=False, allow_infinity=False)),
        st.sampled_from((None, *(text for _, text in TEXTS))),
    ),
)


@pytest.mark.parametrize("form", sorted(READ))
@settings(
    deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(rows=st.lists(ROW, min_size=1, max_size=20), has_utc=st.booleans())
def test_any_values_read_back_equal(
    tmp_path: Path, form: str, rows: list[Any], has_utc: bool
) -> None:
    rows.sort(key=lambda row: row[0])
    path = tmp_path / f"any.{form}"
    with path.open("wb") as file:
        writer = _table_writer(file, form, Table(FIELDS, has_utc))
        for time_ns, wall_ns, values in rows:
            writer.write(RowBlock([time_ns], [[value] for value in values], wall_ns - time_ns))
        writer.close()
    found = READ[form](path)
    assert len(found) == len(rows)
    for cells, (time_ns, wall_ns, values) in zip(found, rows, strict=True):
        assert round(cells["Time"] * 1e9) == time_ns
        if has_utc:
            assert cells["Utc"] == utc_text(wall_ns)
        assert tuple(cells[field.name] for field in FIELDS) == values


@pytest.mark.parametrize("kept", [2, 1024])
@pytest.mark.parametrize("form", ["csv", "jsonl"])
def test_row_has_the_same_text_alone_and_among_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, kept: int
) -> None:
    """Texts are kept by value, and -0.0 is equal to 0.0."""
    monkeypatch.setattr(tables, "_KEPT_TEXTS", kept)
    floats = [0.0, -0.0, 0.0, 1.5, math.inf, -math.inf, None, 1e-7, 1e300, 1.5, -0.0, 2.0, 3.0]
    wholes = [0, 1, None, 1 << 60, -5, 0, 2, 3, 4, 5, 6, 1, 0]
    columns: list[list[Any]] = [wholes, wholes, floats]
    columns.append([TEXTS[n % 4][1] if n % 3 else None for n in range(13)])
    times = [1000 * n * n for n in range(13)]
    whole = RowBlock(times, columns, WALL_NS)
    texts = []
    for blocks in ([whole], [whole.part(n, n + 1) for n in range(13)]):
        with (tmp_path / "table").open("wb") as file:
            for block in blocks:
                writer = _table_writer(file, form, Table(FIELDS, has_utc=True))
                writer.write(block)
        text = (tmp_path / "table").read_text(encoding="utf-8")
        header = text.splitlines()[0] + "\n" if form == "csv" else ""
        texts.append(text.replace(header, "") if header else text)
    assert texts[0] == texts[1]
    assert texts[0].count("-0.0") == 2


@pytest.mark.parametrize("count", [1, 2])
def test_every_signal_of_the_shipped_dbc_still_names_its_column(count: int) -> None:
    escs = [EscSettings(f"esc{n + 1}") for n in range(count)]
    fields = fields_of_values(escs)
    database = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
    assert isinstance(database, cantools.database.can.Database)
    signals = {s.name for m in database.messages for s in m.signals} - {"SentFrames"}
    for name in sorted(name for name in signals if not name.endswith(("Alive", "Crc"))):
        (index,) = Choice.of(fields, [name]).columns[:1]
        assert fields[index].source.replace("_", "") in name.lower().removesuffix("percent")
    if count == 2:
        assert Choice.of(fields, ["Esc2BatteryVoltage"]).columns == [
            [one.name for one in fields].index("esc2.battery_voltage")
        ]


def test_age_of_an_esc_that_is_lost_goes_on_in_the_rows_of_another() -> None:
    escs = [EscStream(EscSettings(name), 0) for name in ("a", "b")]
    fields = fields_of_values([esc.settings for esc in escs])
    ages = [index for index, one in enumerate(fields) if one.source == "data_age"]
    maker = RowMaker([fields[index] for index in ages], escs, GatewayStatus(), 0)
    wire = encode(LiveData(), WireLayout.V4)
    for now in range(SECOND, 3 * SECOND, 100 * MS):
        for number, esc in enumerate(escs):
            if number == 0 or now == SECOND:
                for events in esc.receive_each(wire, now, now - 5 * MS):
                    maker.on_event(number, events, now)
    rows = [row.values for row in maker.finish()]
    assert [value for _, value in rows][-3:] == [1700, 1800, 1900]
    assert {value for value, _ in rows} == {0}
