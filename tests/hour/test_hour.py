"""A minute of the hour: every format by every command reads back as what was meant; and a mutilated file is found out."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import hour_check
import numpy as np
import pytest
from hour_check import Decoded, Verdict, check_log, check_table, check_table_of_log
from hour_programme import Step, run, steps_of, table
from hour_recording import record
from hour_truth import Truth

pytestmark = pytest.mark.extended

NAMES = (
    *(f"convert to {form}" for form in (*hour_check.TABLES, *hour_check.LOGS)),
    *(f"convert {form} to csv" for form in hour_check.LOGS),
    *("replay to log", "convert to bin", "decode the bin", "report", "monitor --once"),
)


class Minute:
    """The files of a minute, and how each compared."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.truth = Truth(record(folder / "hour.kcap", 60))
        self.told: list[str] = []
        self.results = {
            one.name: one for one in run(steps_of(folder, self.truth), folder, self.told.append)
        }
        self.decoded = Decoded(self.truth)

    def log_of(self, path: Path) -> Verdict:
        """Compare a log."""
        return check_log(path, self.truth, self.decoded)[0]


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


def _changed_value(lines: list[str]) -> None:
    at = lines[0].split(",").index("battery_voltage [V]")
    row = next(n for n, line in enumerate(lines) if n >= 3000 and line.split(",")[at])
    _edit(lines, row, "battery_voltage [V]", lambda text: f"{float(text) + 0.01:.2f}")


def _old_value_in_a_gap(lines: list[str]) -> None:
    at = lines[0].split(",").index("battery_voltage [V]")
    gap = next(n for n, line in enumerate(lines) if not line.split(",")[at])
    _edit(lines, gap, "battery_voltage [V]", lambda _: lines[gap - 1].split(",")[at])


def _bec_current_of_a_jivepro(lines: list[str]) -> None:
    at = lines[0].split(",").index("device")
    row = next(n for n, line in enumerate(lines) if line.split(",")[at] == "JIVEPro")
    _edit(lines, row, "bec_current [A]", lambda _: "0.0")


def _edit(lines: list[str], row: int, head: str, change: Callable[[str], str]) -> None:
    at, cells = lines[0].split(",").index(head), lines[row].split(",")
    cells[at] = change(cells[at])
    lines[row] = ",".join(cells)


def _without_last_column(lines: list[str]) -> None:
    lines[:] = [line.rpartition(",")[0] for line in lines]


TABLE_FAULTS: dict[str, Callable[[list[str]], object]] = {
    "value": _changed_value,
    "value in a gap": _old_value_in_a_gap,
    "row": lambda lines: lines.pop(3000),
    "time": lambda lines: _edit(
        lines, 3000, "Time [s]", lambda text: f"{float(text) + 0.000005:.6f}"
    ),
    "clock": lambda lines: _edit(lines, 3000, "Utc", lambda _: lines[2000].split(",")[1]),
    "text": lambda lines: _edit(lines, 3000, "operating_state", lambda _: "StandBy"),
    "value of a JIVEPro": _bec_current_of_a_jivepro,
    "column": _without_last_column,
}


def _mutilated(path: Path, fault: Callable[[list[str]], object], folder: Path) -> Path:
    lines = path.read_text().splitlines()
    fault(lines)
    bad = folder / f"bad{path.suffix}"
    bad.write_text("\n".join(lines) + "\n")
    return bad


@pytest.mark.parametrize("fault", TABLE_FAULTS)
def test_a_mutilated_table_is_found_out(fault: str, minute: Minute, tmp_path: Path) -> None:
    verdict = check_table(
        minute.truth, _mutilated(minute.folder / "hour.csv", TABLE_FAULTS[fault], tmp_path)
    )
    assert not verdict.ok
    assert verdict.differences >= 1
    assert verdict.problems


def test_a_wrong_unit_is_found_out(minute: Minute, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(
        (minute.folder / "hour.csv")
        .read_text()
        .replace("battery_voltage [V]", "battery_voltage [mV]", 1)
    )
    with pytest.raises(AssertionError, match="the unit of battery_voltage"):
        check_table(minute.truth, path)


def test_a_mutilated_file_of_each_other_format_is_found_out(minute: Minute, tmp_path: Path) -> None:
    from asammdf import MDF
    from pyarrow import compute, parquet  # type: ignore[import-untyped]

    _mutilated(minute.folder / "hour.jsonl", lambda lines: _add(lines, 3000, "pwm_input"), tmp_path)
    found = parquet.read_table(minute.folder / "hour.parquet")
    place = found.schema.names.index("motor_current [A]")
    other = compute.add(found.column(place), 0.1)
    parquet.write_table(
        found.set_column(place, found.schema.field(place), other), tmp_path / "bad.parquet"
    )
    with MDF(minute.folder / "hour.mf4") as mdf:
        mdf.cut(start=10, stop=50).save(tmp_path / "bad.mf4")
    for name in ("bad.jsonl", "bad.parquet", "bad.mf4"):
        assert not check_table(minute.truth, tmp_path / name).ok, name


def _add(lines: list[str], row: int, key: str) -> None:
    """One more in a line of JSON."""
    record = json.loads(lines[row])
    record[key] = (record[key] or 0) + 1
    lines[row] = json.dumps(record)


def _flip(line: str) -> str:
    at = line.index("#") + 4
    return line[:at] + ("0" if line[at] != "0" else "1") + line[at + 1 :]


def _later(line: str) -> str:
    seconds, _, rest = line[1:].partition(")")
    whole, _, fraction = seconds.partition(".")
    return f"({whole}.{(int(fraction) + 3) % 1_000_000:06d}){rest}"


LOG_FAULTS: dict[str, Callable[[list[str]], Any]] = {
    "changed byte": lambda lines: lines.__setitem__(9000, _flip(lines[9000])),
    "missing frame": lambda lines: lines.pop(9000),
    "doubled frame": lambda lines: lines.insert(9000, lines[9000]),
    "shifted time": lambda lines: lines.__setitem__(9000, _later(lines[9000])),
    "another id": lambda lines: lines.__setitem__(9000, lines[9000].replace(" can0 6", " can0 5")),
    "two frames change places": lambda lines: lines.__setitem__(
        slice(9000, 9002), [lines[9001], lines[9000]]
    ),
}


@pytest.mark.parametrize("fault", LOG_FAULTS)
def test_a_mutilated_log_is_found_out(fault: str, minute: Minute, tmp_path: Path) -> None:
    assert not minute.log_of(_mutilated(minute.folder / "hour.log", LOG_FAULTS[fault], tmp_path)).ok


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

    def wrong(lines: list[str]) -> None:
        assert f"#{old}" in lines[index]
        lines[index] = lines[index].replace(old, new)

    path = _mutilated(minute.folder / "hour.log", wrong, tmp_path)
    sent.data[index] = before ^ 1 << bit
    try:
        verdict = minute.log_of(path)
    finally:
        sent.data[index] = before
    assert verdict.differences == 1
    assert verdict.problems[0].startswith(f"{name}: 1 values differ")


def test_a_mutilated_table_of_a_log_is_found_out(minute: Minute, tmp_path: Path) -> None:
    _, frames = check_log(minute.folder / "hour.log", minute.truth, minute.decoded)
    for name, fault in list(TABLE_FAULTS.items())[:4]:
        path = _mutilated(minute.folder / "of_log.csv", fault, tmp_path)
        assert not check_table_of_log(path, minute.truth, frames, minute.decoded).ok, name


def test_mutilated_bytes_and_records_are_found_out(minute: Minute, tmp_path: Path) -> None:
    data = bytearray((minute.folder / "esc1.bin").read_bytes())
    data[5000] ^= 1
    (tmp_path / "bad.bin").write_bytes(data)
    assert not hour_check.check_bytes(minute.truth, 0, tmp_path / "bad.bin").ok
    faults: list[Callable[[list[str]], object]] = [lambda lines: lines.pop()]
    faults += [
        partial(_add, row=2000, key=key)
        for key in ("throttle", "operating_errors", "battery_current")
    ]
    for fault in faults:
        path = _mutilated(minute.folder / "esc1.decoded.jsonl", fault, tmp_path)
        assert not hour_check.check_decoded(minute.truth, 0, path).ok, fault
    last = json.loads((minute.folder / "last.json").read_text())
    last["escs"][0]["values"]["battery_voltage"] += 0.01
    (tmp_path / "last.json").write_text(json.dumps(last))
    assert not hour_check.check_last(minute.truth, minute.decoded, tmp_path / "last.json").ok


def test_a_file_without_values_is_no_success(tmp_path: Path) -> None:
    step = Step("nothing", ["schema"], tmp_path / "nothing", "", Verdict, to_output=True)
    [result] = run([step], tmp_path, lambda _: None)
    assert result.differences == 1


def test_a_command_that_fails_ends_the_programme(tmp_path: Path) -> None:
    arguments = ["convert", str(tmp_path / "none.kcap"), str(tmp_path / "a.csv")]
    with pytest.raises(RuntimeError, match=r"exit code 1: .*none\.kcap"):
        run([Step("bad", arguments, tmp_path / "a.csv", "", Verdict)], tmp_path, lambda _: None)
