"""A minute of the hour: every format by every command reads back as what was meant; and a mutilated file is found out."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hour_programme import LOGS, Step, Verdict, steps_of
from hour_truth import Truth

pytestmark = pytest.mark.extended


class Minute:
    """The files of a minute, each compared."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.truth = Truth(folder / "hour.kcap", 60)
        self.steps = {step.name: step for step in steps_of(folder, self.truth)}
        self.verdicts = {name: step.run() for name, step in self.steps.items()}


@pytest.fixture(scope="module")
def minute(tmp_path_factory: pytest.TempPathFactory) -> Minute:
    return Minute(tmp_path_factory.mktemp("minute"))


def test_the_minute_contains_every_kind_of_event(minute: Minute) -> None:
    """What can go wrong is there: losses, a lost port, a swapped device, errors, a return of each."""
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
    assert {name: one.problems for name, one in minute.verdicts.items() if one.problems} == {}
    assert len(minute.verdicts) == 5 + 2 * len(LOGS)
    frames, rows = 2 * len(minute.truth.sent_ns), 90 * len(minute.truth.row_ns)
    for name, one in minute.verdicts.items():
        is_table = name.startswith("convert") and name.endswith(("csv", "jsonl", "parquet"))
        assert one.values >= (rows if is_table else frames), name


# --- the comparison finds what is wrong

Edit = Callable[[str], str]


def other_digit(number: int, digit: int = -1) -> Edit:
    """Counts a digit of this number of a line up."""

    def edit(line: str) -> str:
        at = range(*[*re.finditer(r"\d+", line)][number].span())[digit]
        return f"{line[:at]}{(int(line[at]) + 1) % 10}{line[at + 1 :]}"

    return edit


FAULTS: tuple[tuple[str, str, Edit], ...] = (
    *((file, "time", other_digit(1, 4)) for file in ("hour.csv", "hour.jsonl", "hour.log")),
    *((file, "clock", other_digit(8, 4)) for file in ("hour.csv", "hour.jsonl")),
    *((file, "value", other_digit(9)) for file in ("hour.csv", "hour.jsonl", "of_log.csv")),
    *((file, "last value", other_digit(-1)) for file in ("hour.csv", "hour.jsonl", "of_log.csv")),
    *((file, "row", lambda _: "") for file in ("hour.csv", "hour.jsonl", "hour.log")),
    *((file, "gap", lambda line: line.replace(",,", ",1,", 1)) for file in ("hour.csv", "of_log.csv")),
    *(("hour.log", what, other_digit(at)) for what, at in {"id": 3, "byte": 4}.items()),
)  # fmt: skip


@pytest.mark.parametrize(("file", "what", "edit"), FAULTS, ids=lambda given: str(given)[:12])
def test_a_falsified_file_is_detected(
    file: str, what: str, edit: Edit, minute: Minute, tmp_path: Path
) -> None:
    lines = (minute.folder / file).read_text().splitlines(keepends=True)
    half = len(lines) // 2
    at = next(n for n in range(half, len(lines)) if what != "gap" or ",," in lines[n])
    before, lines[at] = lines[at], edit(lines[at])
    assert lines[at] != before
    bad = tmp_path / f"bad{Path(file).suffix}"
    bad.write_text("".join(lines))
    [step] = (step for step in minute.steps.values() if step.output.name == file)
    assert step.check(bad).problems


def test_a_command_that_fails_ends_the_programme(tmp_path: Path) -> None:
    words = ["convert", str(tmp_path / "none.kcap")]
    with pytest.raises(RuntimeError, match=r"exit code 2: .*none\.kcap"):
        Step("bad", words, tmp_path / "a.csv", lambda _: Verdict()).run()
