"""A minute of the hour: every format by every command reads back as what was meant; and a mutilated file is found out."""

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import hour_check
import numpy as np
import pytest
from hour_check import Verdict
from hour_programme import Step, run, steps_of, table
from hour_recording import record
from hour_truth import Truth

pytestmark = pytest.mark.extended

NAMES = (
    *(f"convert to {form}" for form in (*hour_check.TABLES, *hour_check.LOGS)),
    *(f"convert {form} to csv" for form in hour_check.LOGS),
    *("convert to bin", "decode the bin", "report", "monitor --once"),
)


class Minute:
    """The files of a minute, and how each compared."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.truth = Truth(record(folder / "hour.kcap", 60))
        self.told: list[str] = []
        self.steps = steps_of(folder, self.truth)
        self.results = {one.name: one for one in run(self.steps, folder, self.told.append)}

    def check(self, file: str, path: Path) -> Verdict:
        """Compare another file as the one of this name was."""
        [step] = (one for one in self.steps if one.output.name == file)
        verdict: Verdict = step.check.func(*step.check.args[:-1], path)
        return verdict


@pytest.fixture(scope="module")
def minute(tmp_path_factory: pytest.TempPathFactory) -> Minute:
    return Minute(tmp_path_factory.mktemp("minute"))


def test_the_minute_has_everything_in_it(minute: Minute) -> None:
    """What can go wrong is there: losses, a lost port, a swapped device, errors, a return of each."""
    truth = minute.truth
    rows = truth.rows()
    assert 5000 < minute.truth.recording.telemetry_frames < 6000
    assert len(truth.escs[0].timed_out_ns) == 3
    assert set(rows["link_state"].low) == {2, 4, 5}
    assert set(rows["layout"].low) == {1, 2}
    assert {1.0, 3.0} < set(rows["device"].low)
    assert np.isnan(rows["bec_current"].low).sum() > 1000
    assert 200 < np.nansum(rows["undervoltage"].low) < 400
    assert np.nansum(rows["test_eeprom_version"].low) > 300
    assert np.nanmax(rows["electrical_speed"].low) > 20_000
    assert np.nanmin(rows["battery_current"].low) < -5
    assert set(rows["can_state"].high) == {1, 2}
    assert np.nanmax(rows["energy_used"].low) > 5
    assert np.isnan(rows["battery_voltage"].low).sum() == 4  # a row for each loss


@pytest.mark.parametrize("name", NAMES)
def test_it_reads_back_equal(name: str, minute: Minute) -> None:
    result = minute.results[name]
    assert result.differences == 0, "\n".join(minute.told)
    rows = len(minute.truth.row_ns)
    least = {"report": 5, "monitor --once": 40, "convert to bin": 190_000, "decode the bin": 80_000}
    frames = 9 * len(minute.truth.sent_ns)
    assert result.values >= least.get(
        name, 99 * rows if name[-3:] in ("csv", "onl", "uet", "mf4") else frames
    )


def test_nothing_is_left_out(minute: Minute) -> None:
    assert set(minute.results) == set(NAMES)
    assert "differ" not in table(list(minute.results.values()))


# --- the comparison finds what is wrong

Fault = Callable[[list[str]], object]
"""Changes the lines of a file."""


def _edit(lines: list[str], row: int, head: str, change: Callable[[str], str]) -> None:
    at, cells = lines[0].split(",").index(head), lines[row].split(",")
    cells[at] = change(cells[at])
    lines[row] = ",".join(cells)


def _row(lines: list[str], head: str, wanted: Callable[[str], bool], since: int = 1) -> int:
    """The first row whose cell is as wanted."""
    at = lines[0].split(",").index(head)
    return next(n for n in range(since, len(lines)) if wanted(lines[n].split(",")[at]))


VOLTAGE = "battery_voltage [V]"


def _changed_value(lines: list[str]) -> None:
    row = _row(lines, VOLTAGE, bool, 3000)
    _edit(lines, row, VOLTAGE, lambda text: f"{float(text) + 0.01:.2f}")


def _old_value_in_a_gap(lines: list[str]) -> None:
    gap = _row(lines, VOLTAGE, lambda text: not text)
    old = lines[gap - 1].split(",")[lines[0].split(",").index(VOLTAGE)]
    _edit(lines, gap, VOLTAGE, lambda _: old)


def _bec_current_of_a_jivepro(lines: list[str]) -> None:
    row = _row(lines, "device", "JIVEPro".__eq__)
    _edit(lines, row, "bec_current [A]", lambda _: "0.0")


def _without_last_column(lines: list[str]) -> None:
    lines[:] = [line.rpartition(",")[0] for line in lines]


def _later(text: str) -> str:
    return f"{float(text) + 0.000005:.6f}"


def _add(key: str, row: int = 2000) -> Fault:
    """One more in a line of JSON."""

    def add(lines: list[str]) -> None:
        record = json.loads(lines[row])
        record[key] = (record[key] or 0) + 1
        lines[row] = json.dumps(record)

    return add


def _in_log(change: Callable[[str], str]) -> Fault:
    return lambda lines: lines.__setitem__(9000, change(lines[9000]))


FAULTS: dict[tuple[str, str], Fault] = {
    ("hour.csv", "value"): _changed_value,
    ("hour.csv", "value in a gap"): _old_value_in_a_gap,
    ("hour.csv", "row"): lambda lines: lines.pop(3000),
    ("hour.csv", "time"): lambda lines: _edit(lines, 3000, "Time [s]", _later),
    ("hour.csv", "clock"): lambda lines: _edit(
        lines, 3000, "Utc", lambda _: lines[2000].split(",")[1]
    ),
    ("hour.csv", "text"): lambda lines: _edit(lines, 3000, "operating_state", lambda _: "StandBy"),
    ("hour.csv", "value of a JIVEPro"): _bec_current_of_a_jivepro,
    ("hour.csv", "column"): _without_last_column,
    ("hour.csv", "unit"): lambda lines: lines.__setitem__(0, lines[0].replace("[V]", "[mV]", 1)),
    ("hour.jsonl", "value"): _add("pwm_input"),
    ("of_log.csv", "value"): _changed_value,
    ("of_log.csv", "value in a gap"): _old_value_in_a_gap,
    ("of_log.csv", "row"): lambda lines: lines.pop(3000),
    ("of_log.csv", "time"): lambda lines: _edit(lines, 3000, "Time [s]", _later),
    ("hour.log", "byte"): _in_log(lambda line: re.sub("#(....).", r"#\g<1>5", line)),
    ("hour.log", "id"): _in_log(lambda line: line.replace(" can0 6", " can0 5")),
    ("hour.log", "time"): _in_log(lambda line: f"({_later(line[1:18])}{line[18:]}"),
    ("hour.log", "missing frame"): lambda lines: lines.pop(9000),
    ("hour.log", "doubled frame"): lambda lines: lines.insert(9000, lines[9000]),
    ("hour.log", "order"): lambda lines: lines.insert(9000, lines.pop(9001)),
    ("esc1.decoded.jsonl", "last"): lambda lines: lines.pop(),
    ("esc1.decoded.jsonl", "value"): _add("throttle"),
    ("esc1.decoded.jsonl", "word"): _add("operating_errors"),
    ("esc1.decoded.jsonl", "signed value"): _add("battery_current"),
}


@pytest.mark.parametrize(("file", "fault"), FAULTS)
def test_a_mutilated_file_is_found_out(
    file: str, fault: str, minute: Minute, tmp_path: Path
) -> None:
    lines = (minute.folder / file).read_text().splitlines()
    before = list(lines)
    FAULTS[file, fault](lines)
    assert lines != before
    bad = tmp_path / f"bad{Path(file).suffix}"
    bad.write_text("\n".join(lines) + "\n")
    if fault == "unit":
        with pytest.raises(AssertionError, match="the unit of battery_voltage"):
            minute.check(file, bad)
        return
    verdict = minute.check(file, bad)
    assert not verdict.ok
    assert verdict.problems


def test_a_mutilated_file_of_libraries_and_of_bytes_is_found_out(
    minute: Minute, tmp_path: Path
) -> None:
    from pyarrow import compute, parquet  # type: ignore[import-untyped]

    found = parquet.read_table(minute.folder / "hour.parquet")
    place = found.schema.names.index("motor_current [A]")
    other = compute.add(found.column(place), 0.1)
    changed = found.set_column(place, found.schema.field(place), other)
    parquet.write_table(changed, tmp_path / "hour.parquet")
    data = bytearray((minute.folder / "esc1.bin").read_bytes())
    data[5000] ^= 1
    (tmp_path / "esc1.bin").write_bytes(data)
    last = json.loads((minute.folder / "last.json").read_text())
    last["escs"][0]["values"]["battery_voltage"] += 0.01
    (tmp_path / "last.json").write_text(json.dumps(last))
    for path in tmp_path.iterdir():
        assert not minute.check(path.name, path).ok, path.name


@pytest.mark.parametrize(
    ("can_id", "bit", "name"),
    [(1672, 24, "BatteryVoltage"), (1664, 0, "Undervoltage"), (1704, 16, "EnergyUsed")],
)
def test_a_value_that_no_esc_meant_is_found_out(
    can_id: int, bit: int, name: str, minute: Minute, tmp_path: Path
) -> None:
    """Where a frame was wrong as it was sent, by one step: signals are compared with the truth, not with what the gateway sent."""
    sent = minute.truth.recording.sent
    index = [place for place, one in enumerate(sent.ids) if one == can_id][200]
    before = sent.data[index]
    old, new = (bits.to_bytes(8, "little").hex().upper() for bits in (before, before ^ 1 << bit))
    lines = (minute.folder / "hour.log").read_text().splitlines()
    assert f"#{old}" in lines[index]
    lines[index] = lines[index].replace(old, new)
    (tmp_path / "bad.log").write_text("\n".join(lines) + "\n")
    sent.data[index] = before ^ 1 << bit
    try:
        verdict = minute.check("hour.log", tmp_path / "bad.log")
    finally:
        sent.data[index] = before
    assert verdict.differences == 1
    assert verdict.problems[0].startswith(f"{name}: 1 values differ")


def test_a_file_without_values_is_no_success(tmp_path: Path) -> None:
    step = Step("nothing", ["schema"], tmp_path / "nothing", "", partial(Verdict), to_output=True)
    [result] = run([step], tmp_path, lambda _: None)
    assert result.differences == 1


def test_a_command_that_fails_ends_the_programme(tmp_path: Path) -> None:
    arguments = ["convert", str(tmp_path / "none.kcap"), str(tmp_path / "a.csv")]
    step = Step("bad", arguments, tmp_path / "a.csv", "", partial(Verdict))
    with pytest.raises(RuntimeError, match=r"exit code 1: .*none\.kcap"):
        run([step], tmp_path, lambda _: None)
