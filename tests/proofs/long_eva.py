"""Frama-C's Eva finds no undefined behaviour in core.c, except the listed alarms.

Eva follows all runs of any_calls.c at once: any bytes, times, settings and order of calls, within
the preconditions of core.h, with the tables of the shipped DBC. eva_hints.toml lists annotations
that make its results more exact. An alarm is a place where Eva cannot exclude undefined behaviour.
alarms.toml lists each alarm with the reason why it is false. A new alarm fails the first test. Only
this test refutes the faults that put_in_faults.py puts in. The second test keeps the list short: an
alarm that Eva no longer reports must be removed from it.

Eva needs about 600 s of CPU time. A step of `make release`:
python -m pytest -s --timeout=0 -o faulthandler_timeout=0 tests/proofs/long_eva.py
"""

import csv
import os
import re
import shutil
import subprocess
import tomllib
from collections import Counter
from pathlib import Path

import pytest
from built import there
from every_value import export_shipped

pytestmark = [
    pytest.mark.promise("no-undefined-behaviour"),
    pytest.mark.usefixtures("c_compiler"),
]
HERE = Path(__file__).parent
ALARMS = HERE / "alarms.toml"
HINTS = HERE / "eva_hints.toml"
OPTIONS = (
    *("-machdep", "gcc_x86_64", "-eva", "-eva-precision", "0", "-eva-auto-loop-unroll", "14"),
    *("-eva-domains", "equality,symbolic-locations", "-eva-plevel", "256"),
    *("-eva-split-return-function", "kcg_next_event:-1"),
    *("-eva-no-print", "-eva-no-show-progress", "-cpp-extra-args=-I."),
)
LIMIT_S = 3600


def find_alarms(folder: Path) -> Counter[str]:
    """Run Eva. Return each alarm in core.c as its function and what cannot be excluded.

    Places of a function with the same text are counted.
    """
    export_shipped(folder)
    shutil.copy(HERE / "any_calls.c", folder)
    add_hints(folder / "core.c")
    command = ["frama-c", *OPTIONS, "any_calls.c", "tables.c", "-then", "-report-csv", "alarms.csv"]
    done = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | {"PWD": str(folder)},  # which Frama-C believes
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return read_alarms(folder / "alarms.csv")


def add_hints(core: Path) -> None:
    """Insert the annotations of eva_hints.toml into a copy of the core."""
    text = core.read_text(encoding="utf-8")
    for hint in tomllib.loads(HINTS.read_text(encoding="utf-8"))["hint"]:
        for place in hint["after"]:
            assert text.count(place) == 1, f"{text.count(place)} times in core.c: {place}"
            text = text.replace(place, f"{place}\n{hint['add']}")
    core.write_text(text, encoding="utf-8")


def read_alarms(report: Path) -> Counter[str]:
    """Return the alarms of a report. The rows about headers repeat the rows of their callers."""
    found = Counter[str]()
    with report.open(newline="") as file:
        for row in csv.DictReader(file, delimiter="\t"):
            is_open = row["status"] in ("Unknown", "Invalid", "Invalid or unreachable")
            if is_open and row["file"].endswith(("core.c", "any_calls.c", "tables.c")):
                function = row["function"].partition("_with_KCG")[0]
                found[f"{function}: {_without_numbers(row['property'])}"] += 1
    return found


def _without_numbers(text: str) -> str:
    """Remove the numbers that Frama-C adds to the names of variables."""
    return re.sub(r"\b(tmp|now|frames)_\d+\b", r"\1", text)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Counter[str]:
    """The alarms of one run of Eva, for all tests."""
    there("frama-c")
    return find_alarms(tmp_path_factory.mktemp("eva"))


@pytest.fixture(scope="module")
def listed() -> Counter[str]:
    """The alarms of alarms.toml."""
    groups = tomllib.loads(ALARMS.read_text(encoding="utf-8"))["group"]
    assert all(len(group["why"]) > 20 for group in groups)
    return Counter(alarm for group in groups for alarm in group["alarms"])


def test_eva_finds_no_undefined_behaviour_except_the_listed_alarms(
    found: Counter[str],
    listed: Counter[str],
) -> None:
    print(f"{found.total()} alarms, {(found & listed).total()} of them listed with a reason")
    new = sorted((found - listed).elements())
    assert not new


def test_eva_still_reports_each_listed_alarm(found: Counter[str], listed: Counter[str]) -> None:
    gone = sorted((listed - found).elements())
    assert not gone
