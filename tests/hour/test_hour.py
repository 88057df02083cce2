"""A minute of the hour: every format written by every command reads back equal.

A falsified file is detected.
"""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hour_programme import LOGS, Step, Verdict, steps_of
from hour_truth import Truth

pytestmark = [
    pytest.mark.promise("tables"),
    pytest.mark.extended,
]


class Minute:
    """The files of a minute, and the results of their checks."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.truth = Truth(folder / "hour.kcap", 60)
        self.steps = {step.name: step for step in steps_of(folder, self.truth)}
        self.verdicts = {name: step.run() for name, step in self.steps.items()}


@pytest.fixture(scope="module")
def minute(tmp_path_factory: pytest.TempPathFactory) -> Minute:
    return Minute(tmp_path_factory.mktemp("minute"))


def test_minute_contains_every_kind_of_event(minute: Minute) -> None:
    """There are losses, a lost port, a swapped device and errors, and each of them ends."""
    rows = minute.truth.columns()
    assert 4500 < len(minute.truth.row_ns) < 6000
    assert set(rows["layout"]) == {1, 2}
    assert {1.0, 3.0} < set(rows["device"])
    assert np.isnan(rows["bec_current"]).sum() > 1000
    assert 200 < np.nansum(rows["undervoltage"]) < 400
    assert np.nansum(rows["test_eeprom_version"]) > 300
    assert np.nanmax(rows["electrical_speed"]) > 20_000
    assert np.nanmin(rows["battery_current"]) < -5
    assert np.isnan(rows["battery_voltage"]).sum() == 4  # a row for each loss


def test_every_file_of_the_minute_reads_back_equal(minute: Minute) -> None:
    assert len(minute.verdicts) == 5 + 2 * len(LOGS)
    of_frames = 2 * len(minute.truth.sent_ns)
    of_rows = 90 * len(minute.truth.row_ns)
    for name, one in minute.verdicts.items():
        assert one.problems == [], name
        is_table = name.startswith("convert") and name.endswith(("csv", "jsonl", "parquet"))
        assert one.values >= (of_rows if is_table else of_frames), name


# --- the comparison finds wrong values

Edit = Callable[[str], str]


def other_digit(number: int, digit: int = -1) -> Edit:
    """Return an edit that increases a digit of this number of a line."""

    def edit(line: str) -> str:
        found = [*re.finditer(r"\d+", line)][number]
        at = range(*found.span())[digit]
        changed = (int(line[at]) + 1) % 10
        return f"{line[:at]}{changed}{line[at + 1 :]}"

    return edit


def no_line(_: str) -> str:
    return ""


def filled_gap(line: str) -> str:
    return line.replace(",,", ",1,", 1)


FAULTS: tuple[tuple[str, str, Edit], ...] = (
    ("hour.csv", "time", other_digit(1, 4)),
    ("hour.jsonl", "time", other_digit(1, 4)),
    ("hour.log", "time", other_digit(1, 4)),
    ("hour.csv", "clock", other_digit(8, 4)),
    ("hour.jsonl", "clock", other_digit(8, 4)),
    ("hour.csv", "value", other_digit(9)),
    ("hour.jsonl", "value", other_digit(9)),
    ("of_log.csv", "value", other_digit(9)),
    ("hour.csv", "last value", other_digit(-1)),
    ("hour.jsonl", "last value", other_digit(-1)),
    ("of_log.csv", "last value", other_digit(-1)),
    ("hour.csv", "row", no_line),
    ("hour.jsonl", "row", no_line),
    ("hour.log", "row", no_line),
    ("hour.csv", "gap", filled_gap),
    ("of_log.csv", "gap", filled_gap),
    ("hour.log", "id", other_digit(3)),
    ("hour.log", "byte", other_digit(4)),
)


@pytest.mark.parametrize(("file", "what", "edit"), FAULTS, ids=lambda given: str(given)[:12])
def test_falsified_file_is_detected(
    file: str,
    what: str,
    edit: Edit,
    minute: Minute,
    tmp_path: Path,
) -> None:
    lines = (minute.folder / file).read_text().splitlines(keepends=True)
    half = len(lines) // 2
    at = half
    while what == "gap" and ",," not in lines[at]:
        at += 1
    before = lines[at]
    lines[at] = edit(before)
    assert lines[at] != before
    bad = tmp_path / f"bad{Path(file).suffix}"
    bad.write_text("".join(lines))
    [step] = (step for step in minute.steps.values() if step.output.name == file)
    assert step.check(bad).problems


def test_command_that_fails_ends_the_programme(tmp_path: Path) -> None:
    words = ["convert", str(tmp_path / "none.kcap")]
    with pytest.raises(RuntimeError, match=r"exit code 2: .*none\.kcap"):
        Step("bad", words, tmp_path / "a.csv", lambda _: Verdict()).run()
