"""A minute of the hour: every format by every command reads back as what was meant; and a mutilated file is found out."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hour_programme import LOGS, READERS, Step, Verdict, steps_of
from hour_truth import Truth

pytestmark = pytest.mark.extended

NAMES = (
    *(f"convert to {form}" for form in (*READERS, *LOGS)),
    *(f"convert {form} to csv" for form in LOGS),
    *("the CAN frames", "convert to bin"),
)


class Minute:
    """The files of a minute, each compared."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.truth = Truth(folder / "hour.kcap", 60)
        self.steps = {step.name: step for step in steps_of(folder, self.truth)}
        for step in self.steps.values():
            step.run()

    def check(self, file: str, path: Path) -> Verdict:
        """Compare another file as the one of this name was."""
        [step] = (step for step in self.steps.values() if step.output.name == file)
        return step.check(path)


@pytest.fixture(scope="module")
def minute(tmp_path_factory: pytest.TempPathFactory) -> Minute:
    return Minute(tmp_path_factory.mktemp("minute"))


def test_the_minute_has_everything_in_it(minute: Minute) -> None:
    """What can go wrong is there: losses, a lost port, a swapped device, errors, a return of each."""
    truth, rows = minute.truth, minute.truth.rows()
    assert 4500 < len(truth.live_ns) < 6000
    assert len(truth.timed_out_ns) == 3
    assert set(rows["layout"]) == {1, 2}
    assert {1.0, 3.0} < set(rows["device"])
    assert np.isnan(rows["bec_current"]).sum() > 1000
    assert 200 < np.nansum(rows["undervoltage"]) < 400
    assert np.nansum(rows["test_eeprom_version"]) > 300
    assert np.nanmax(rows["electrical_speed"]) > 20_000
    assert np.nanmin(rows["battery_current"]) < -5
    assert np.nanmax(rows["energy_used"]) > 5
    assert np.isnan(rows["battery_voltage"]).sum() == 4  # a row for each loss


@pytest.mark.parametrize("name", NAMES)
def test_it_reads_back_equal(name: str, minute: Minute) -> None:
    verdict = minute.steps[name].verdict
    assert verdict.problems == []
    frames, rows = 2 * len(minute.truth.sent_ns), 90 * len(minute.truth.row_ns)
    is_table = name.startswith("convert") and name.endswith(("csv", "jsonl", "parquet"))
    assert verdict.values >= (190_000 if name.endswith("bin") else rows if is_table else frames)


def test_nothing_is_left_out(minute: Minute) -> None:
    assert set(minute.steps) == set(NAMES)


# --- the comparison finds what is wrong

Fault = Callable[[list[str]], object]
"""Changes the lines of a file."""
VOLTAGE = "battery_voltage [V]"


def _cell(head: str, change: Callable[[str], str], wanted: Callable[[str], bool] = bool) -> Fault:
    """Another cell in the first row after the middle, else of all, whose cell is as wanted."""

    def edit(lines: list[str]) -> None:
        at = lines[0].split(",").index(head)
        rows = [*range(len(lines) // 2, len(lines)), *range(1, len(lines) // 2)]
        row = next(row for row in rows if wanted(lines[row].split(",")[at]))
        cells = lines[row].split(",")
        cells[at] = change(cells[at])
        lines[row] = ",".join(cells)

    return edit


def _later(text: str) -> str:
    return f"{float(text) + 0.000005:.6f}"


def _without_last_column(lines: list[str]) -> None:
    lines[:] = [line.rpartition(",")[0] for line in lines]


def _add(key: str, row: int = 2000) -> Fault:
    """One more in a line of JSON."""

    def add(lines: list[str]) -> None:
        record = json.loads(lines[row])
        record[key] = (record[key] or 0) + 1
        lines[row] = json.dumps(record)

    return add


def _in_log(change: Callable[[str], str]) -> Fault:
    return lambda lines: lines.__setitem__(9000, change(lines[9000]))


IN_A_GAP = _cell(VOLTAGE, lambda _: "24.1", lambda text: not text)
FAULTS: dict[tuple[str, str], Fault] = {
    ("hour.csv", "value"): _cell(VOLTAGE, lambda text: f"{float(text) + 0.01:.2f}"),
    ("hour.csv", "value in a gap"): IN_A_GAP,
    ("hour.csv", "row"): lambda lines: lines.pop(3000),
    ("hour.csv", "time"): _cell("Time [s]", _later),
    ("hour.csv", "clock"): _cell("Utc", lambda text: text.replace("Z", "5Z")[:20] + "999999Z"),
    ("hour.csv", "text"): _cell("operating_state", lambda _: "StandBy"),
    ("hour.csv", "column"): _without_last_column,
    ("hour.jsonl", "value"): _add("pwm_input"),
    ("hour.jsonl", "what only the gateway knows"): _add("uptime"),
    ("of_log.csv", "value in a gap"): IN_A_GAP,
    ("hour.log", "byte"): _in_log(lambda line: re.sub("#(....).", r"#\g<1>5", line)),
    ("hour.log", "id"): _in_log(lambda line: line.replace(" can0 6", " can0 5")),
    ("hour.log", "time"): _in_log(lambda line: f"({_later(line[1:18])}{line[18:]}"),
    ("hour.log", "missing frame"): lambda lines: lines.pop(9000),
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
    assert minute.check(file, bad).problems


def test_a_value_that_no_esc_meant_is_found_out(minute: Minute, tmp_path: Path) -> None:
    """Where a frame was wrong as it was sent, by one step: signals are compared with the truth, not with what the gateway sent."""
    truth = minute.truth
    place = np.flatnonzero(truth.sent_ids == 1672)[200]
    truth.sent_data[place] ^= np.uint64(1 << 24)
    try:
        [step] = (one for one in steps_of(tmp_path, truth) if one.name == "the CAN frames")
        [problem] = step.check(tmp_path).problems
    finally:
        truth.sent_data[place] ^= np.uint64(1 << 24)
    assert problem.startswith("battery_voltage: 1 differ")


def test_a_command_that_fails_ends_the_programme(tmp_path: Path) -> None:
    words = ["convert", str(tmp_path / "none.kcap"), "OUT"]
    with pytest.raises(RuntimeError, match=r"exit code 1: .*none\.kcap"):
        Step("bad", words, tmp_path / "a.csv", "", lambda _: Verdict()).run()
