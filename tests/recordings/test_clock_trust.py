"""Tables, logs and reports state when dates and times of day were not reliable."""

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from capture_bench import START, Bench, capture, made
from command_line import run

from kontronik_can_gw.capture.format import CLOCK_FLAGS, Entry, EntryKind, numbers_data
from kontronik_can_gw.native import load
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("log-times", "clock")

WALL_NS = 1_700_000_000 * SECOND
NOT_RELIABLE = "dates and times of day are not reliable then"


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(*made()).live(3, 6, wild=False)


def recorded(bench: Bench, path: Path, first: object, *changes: tuple[float, bool | None]) -> Path:
    """Write a capture in which the state of the clock changes after these seconds."""
    entries = []
    due = [(START + int(seconds * SECOND), state) for seconds, state in changes]
    for entry in bench.entries:
        while due and entry.time_ns >= due[0][0]:
            _, state = due.pop(0)
            now = entry.time_ns
            data = numbers_data(WALL_NS + now - START)
            entries.append(Entry(now, EntryKind.CLOCK, 0, data, CLOCK_FLAGS[state]))
        entries.append(entry)
    clock = {} if first == "missing" else {"clock": {"synchronized": first, "hardware": ""}}
    return capture(path, bench.setup, entries, wall_ns=WALL_NS, **clock)


@contextmanager
def core_in(language: str) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if language == "Python":
            patch.setattr(load, "library", lambda: (None, "asked for"))
        yield


def column(path: Path) -> list[tuple[float, str]]:
    """Return time and cell of UtcTrusted in each row of a CSV file."""
    with path.open() as file:
        rows = list(csv.reader(file))
    assert rows[0][:3] == ["Time [s]", "Utc", "UtcTrusted"]
    return [(float(row[0]), row[2]) for row in rows[1:]]


@pytest.mark.parametrize("language", ["C", "Python"])
def test_column_has_the_state_of_the_clock_in_each_row(
    tmp_path: Path, bench: Bench, language: str
) -> None:
    path = recorded(bench, tmp_path / "a.kcap", False, (2, True), (4, None), (5, False))
    out = tmp_path / "a.csv"
    with core_in(language):
        assert run("convert", "-q", path, out).code == 0
    found = column(out)
    assert len(found) > 400
    for seconds, cell in found:
        if min(abs(seconds - edge) for edge in (2, 4, 5)) > 0.1:
            assert cell == (
                "0" if seconds < 2 else "1" if seconds < 4 else "" if seconds < 5 else "0"
            )


def test_all_tables_have_the_same_column(tmp_path: Path, bench: Bench) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    path = recorded(bench, tmp_path / "a.kcap", False, (2, True), (4, None))
    for suffix in ("csv", "jsonl", "parquet"):
        assert run("convert", "-q", path, tmp_path / f"a.{suffix}").code == 0
    cells = [cell for _, cell in column(tmp_path / "a.csv")]
    assert {"0", "1", ""} == set(cells)
    numbers = [None if cell == "" else int(cell) for cell in cells]
    lines = (tmp_path / "a.jsonl").read_text().splitlines()
    assert [json.loads(line)["UtcTrusted"] for line in lines] == numbers
    table = parquet.read_table(tmp_path / "a.parquet")
    assert table["UtcTrusted"].to_pylist() == numbers
    provenance = json.loads(table.schema.metadata[b"kontronik_can_gw"])
    assert provenance["clock at the start"] == "not synchronised, no hardware clock"


@pytest.mark.parametrize(
    ("first", "changes", "said"),
    [
        (False, [], "the clock was not synchronised: "),
        (False, [(2, True)], "the clock was not synchronised until 2.0 s: "),
        (True, [(3, False), (4, True)], "the clock was not synchronised from 3.0 s until 4.0 s: "),
        (True, [(3, False)], "the clock was not synchronised from 3.0 s: "),
    ],
)
def test_every_command_states_when_times_were_not_reliable(
    tmp_path: Path, bench: Bench, first: bool, changes: list[tuple[float, bool]], said: str
) -> None:
    path = recorded(bench, tmp_path / "a.kcap", first, *changes)
    note = f"{said}{NOT_RELIABLE}"
    for out in ("a.csv", "a.log"):
        assert f"a.kcap: {note}" in run("convert", path, tmp_path / out).err
    assert f"a.kcap: {note}" in run("report", path, "-o", tmp_path / "a.html").err
    assert note in (tmp_path / "a.html").read_text()
    assert note in run("monitor", "--once", path).err


@pytest.mark.parametrize("first", [True, None, "missing", "nonsense", {}])
def test_reliable_or_unknown_clock_is_not_mentioned(
    tmp_path: Path, bench: Bench, first: object
) -> None:
    path = recorded(bench, tmp_path / "a.kcap", first)
    done = run("convert", path, tmp_path / "a.csv")
    assert done.code == 0
    assert "synchronised" not in done.err
    head = (tmp_path / "a.csv").read_text().partition("\n")[0]
    assert ("UtcTrusted" in head) == (first is True)


def test_old_capture_has_the_same_table_as_before(tmp_path: Path, bench: Bench) -> None:
    tables = []
    for first in ("missing", True):
        path = recorded(bench, tmp_path / "a.kcap", first)
        assert run("convert", "-q", path, tmp_path / "a.csv", "--force").code == 0
        with (tmp_path / "a.csv").open() as file:
            tables.append(list(csv.reader(file)))
    assert tables[0] == [[*row[:2], *row[3:]] for row in tables[1]]
