"""Converts an hour of telemetry with every command for recordings, and checks all results.

    python tests/hour/hour_programme.py [--minutes 60]

Makes a capture of this many minutes without waiting. Converts it with the real command in a new
process, and converts the CAN logs back. Reads every file with pandas, json, pyarrow, python-can,
asammdf and cantools, and compares every value of every row with the values of the simulated ESC
(hour_truth.py). Rates, counters, states and energy are computed by the gateway alone, so they are
compared with the first table. Exits with 1 and prints the first differences if anything differs.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    tests = Path(__file__).resolve().parents[1]
    sys.path[:0] = [
        str(tests.parent),
        str(tests),
        str(tests / "capture"),
    ]

import can
import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from hour_truth import MS, SECOND, Floats, Times, Truth, value_name
from pyarrow import parquet  # type: ignore[import-untyped]

ROWS = 20_000
"""Rows that are read at a time."""
SLACK = 6e-7
"""Largest difference of two values: a table has six decimals. The error of cantools is smaller."""
LOGS = {"log": "candump", "asc": "asc", "blf": "blf", "trc": "trc", "mf4": "mf4-log"}


@dataclass
class Verdict:
    """The result of a comparison."""

    values: int = 0
    problems: list[str] = field(default_factory=list)

    def compare(
        self,
        what: str,
        got: Any,
        wanted: Any,
        slack: float = 0.0,
    ) -> None:
        """Compare two columns. NaN equals NaN."""
        if len(got) != len(wanted):
            self.problems.append(f"{what}: {len(got)}, must be {len(wanted)}")
            return
        self.values += len(got)
        both_missing = np.isnan(got) & np.isnan(wanted)
        equal = (np.abs(got - wanted) <= slack) | both_missing
        bad = np.flatnonzero(~equal)
        if len(bad):
            at = bad[0]
            first = f"the first, {at}: {got[at]}, must be {wanted[at]}"
            self.problems.append(f"{what}: {len(bad)} differ; {first}")


# --- tables


def csv_frames(path: Path) -> Iterator[pd.DataFrame]:
    """Read CSV with pandas.

    Only empty cells are missing values. A word such as NotAvailable instead would be a mistake.
    """
    options: dict[str, Any] = {"keep_default_na": False, "na_values": [""], "low_memory": False}
    if int(pd.__version__.partition(".")[0]) < 3:
        options["float_precision"] = "round_trip"
    yield from pd.read_csv(path, chunksize=ROWS, **options)


def jsonl_frames(path: Path) -> Iterator[pd.DataFrame]:
    """Read JSON lines with json."""
    with path.open(encoding="utf-8") as file:
        while rows := [json.loads(line) for line in islice(file, ROWS)]:
            yield pd.DataFrame(rows, dtype=object)


def parquet_frames(path: Path) -> Iterator[pd.DataFrame]:
    """Read Parquet with pyarrow."""
    for batch in parquet.ParquetFile(path).iter_batches(ROWS):
        yield batch.to_pandas()


READERS = {"csv": csv_frames, "jsonl": jsonl_frames, "parquet": parquet_frames}


def numbers(values: Any, texts: Mapping[str, float]) -> Floats:
    """Return a column as numbers.

    Texts are replaced by the numbers that the DBC has for them. A table may spell them with other
    capitals.
    """
    array = np.asarray(values, dtype=object)
    if not any(isinstance(value, str) for value in array):
        return array.astype(np.float64)

    def number(value: object) -> float:
        if isinstance(value, str):
            return texts.get(value.casefold(), -999.0)
        return np.nan

    return np.array([number(value) for value in array])


def nanoseconds(seconds: Any) -> Times:
    exact = np.asarray(seconds, dtype=np.float64) * 1e9
    found: Times = np.rint(exact).astype(np.int64)
    return found


def unix_ns(wall: Any) -> Times:
    stamps = pd.to_datetime(wall, utc=True, format="ISO8601")
    found: Times = stamps.astype("datetime64[ns, UTC]").astype(np.int64).to_numpy()
    return found


def table_of(path: Path, truth: Truth) -> tuple[Times, Times | None, dict[str, Floats]]:
    """Return a whole table as numbers: times, Unix times, and values by name.

    AssertionError if a value has a wrong unit.
    """
    columns: dict[str, list[Any]] = {}
    for frame in READERS[path.suffix[1:]](path):
        for head, column in frame.items():
            name, _, unit = str(head).partition(" [")
            if path.suffix != ".jsonl" and name in truth.units:
                assert unit.rstrip("]") == truth.units[name], f"{head}: is in {truth.units[name]!r}"
            read = {"Time": nanoseconds, "Utc": unix_ns}.get(name)
            found = read(column) if read else numbers(column, truth.texts.get(name, {}))
            columns.setdefault(name, []).append(found)
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    return whole.pop("Time"), whole.pop("Utc", None), whole


def check_table(truth: Truth, known: dict[str, Floats], path: Path) -> Verdict:
    """Check a table of the recording.

    ``known`` has the correct columns. It is filled from the truth when the first table is checked.
    Columns that the truth does not have are filled from that table.
    """
    times, wall, values = table_of(path, truth)
    verdict = Verdict()
    verdict.compare("Time", times, truth.row_ns - truth.row_ns[0], 500)
    # text is cut to microseconds, but Parquet has nanoseconds
    tolerance = 0 if path.suffix == ".parquet" else 999
    verdict.compare("Utc", wall, truth.wall_ns(truth.row_ns), tolerance)
    if not known:
        known |= values | truth.columns()
    for name in sorted(known.keys() ^ values.keys()):
        problem = "missing" if name in known else "too much"
        verdict.problems.append(f"{name}: is {problem}")
    for name in known.keys() & values.keys():
        verdict.compare(name, values[name], known[name], SLACK)
    return verdict


# --- CAN logs


def check_log(truth: Truth, path: Path) -> Verdict:
    """Check the ids, the bytes and the times of a log of all frames.

    The log is read by python-can, and MF4 by asammdf below it. The times are those at which the
    frames were given to the interface.
    """
    options: dict[str, Any] = {"relative_timestamp": False} if path.suffix == ".asc" else {}
    times = []
    ids = []
    data = []
    with can.LogReader(path, **options) as reader:
        for message in reader:
            assert message.dlc == 8, message
            assert not message.is_extended_id, message
            assert not message.is_rx, message
            times.append(message.timestamp)
            ids.append(message.arbitration_id)
            data.append(bytes(message.data))
    verdict = Verdict()
    # a converted log ignores that the clock was set
    first_wall = truth.wall_ns(truth.sent_ns[:1])[0]
    wall = first_wall + truth.sent_ns - truth.sent_ns[0]
    # half a microsecond of the log, and half a step of Unix seconds in a float
    slack = 1350 if path.suffix == ".trc" else 750
    verdict.compare("time", nanoseconds(times), wall, slack)
    verdict.compare("id", np.array(ids), truth.sent_ids)
    got = np.frombuffer(b"".join(data), "<u8")
    wanted = truth.sent_data
    different = np.flatnonzero(got != wanted) if len(got) == len(wanted) else got
    verdict.compare("data", different, [])
    return verdict


def decoded(truth: Truth, can_id: int) -> pd.DataFrame:
    """Return the values that cantools reads from the frames of one id, with their times ``ns``."""
    rows = np.flatnonzero(truth.sent_ids == can_id)
    message = truth.database.get_message_by_frame_id(can_id)
    payloads, at = np.unique(truth.sent_data[rows], return_inverse=True)
    found = []
    for bits in payloads.tolist():
        data = int(bits).to_bytes(8, "little")
        found.append(message.decode_simple(data))

    def number(name: str, value: Any) -> float:
        if str(value) in ("NotAvailable", "Error"):
            return np.nan
        if hasattr(value, "value"):  # a value with a name
            return truth.texts[name][str(value).casefold()]
        return float(value)

    columns = {}
    for signal in found[0]:
        name = value_name(signal)
        numbers_of = [number(name, values[signal]) for values in found]
        columns[name] = np.array(numbers_of)[at]
    times = truth.sent_ns[rows]
    return pd.DataFrame({"ns": times, "sent_ns": times} | columns)


def check_back(truth: Truth, path: Path) -> Verdict:
    """Check the CSV of a CAN log: a row has the newest value of each signal while it is fresh."""
    times, _, values = table_of(path, truth)
    verdict = Verdict()
    begun = times + truth.sent_ns[0]
    ends = np.append(begun[1:], 1 << 62) - 1500  # times of rows are rounded to microseconds
    until = pd.DataFrame({"ns": ends})
    flags = {value_name(flag) for flag in truth.flags}
    for can_id in np.unique(truth.sent_ids).tolist():
        newest = pd.merge_asof(until, decoded(truth, can_id), on="ns")
        cycle = truth.database.get_message_by_frame_id(can_id).cycle_time
        # fresh for three cycles, at least 250 ms, or for a second if it is sent on events only
        life = max(250, 3 * cycle) * MS if cycle else SECOND
        newest = newest.where(begun - newest.pop("sent_ns") <= life)
        for name in values.keys() & newest.keys():
            got = values[name]
            wanted = newest[name].to_numpy()
            if name in flags:  # a flag has no code for not available
                wanted = np.where(np.isnan(got), np.nan, wanted)
            verdict.compare(name, got, wanted, SLACK)
    return verdict


# --- frames and bytes


def check_frames(truth: Truth, _: Path) -> Verdict:
    """Compare every signal of every frame with the values of the ESC."""
    found = truth.judged_frames()
    return Verdict(found.count["values"], found.wrong)


def check_bytes(truth: Truth, path: Path) -> Verdict:
    """Compare the UART bytes of the ESC."""
    verdict = Verdict()
    got = np.fromfile(path, np.uint8).astype(int)
    verdict.compare("bytes", got, np.frombuffer(truth.wire, np.uint8).astype(int))
    return verdict


# --- the steps


@dataclass
class Step:
    """A command that writes a file, and the check of the file."""

    name: str
    words: list[str]
    output: Path
    check: Callable[[Path], Verdict]

    def run(self) -> Verdict:
        """Run the command and check the file. RuntimeError if the command failed."""
        command = [sys.executable, "-m", "kontronik_can_gw", *self.words, str(self.output)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"exit code {done.returncode}: {done.stderr.strip()}")
        return self.check(self.output)


def steps_of(folder: Path, truth: Truth) -> list[Step]:
    """Return all steps for the capture, in the order in which they must be run."""
    convert = ["convert", str(truth.path)]
    known: dict[str, Floats] = {}
    table = partial(check_table, truth, known)
    log = partial(check_log, truth)
    back = partial(check_back, truth)
    steps = []
    for form in READERS:
        steps.append(Step(f"convert to {form}", convert, folder / f"hour.{form}", table))
    bytes_step = Step("convert to bin", convert, folder / "esc1.bin", partial(check_bytes, truth))
    frames_step = Step("the CAN frames", convert, folder / "sent.log", partial(check_frames, truth))
    steps += [bytes_step, frames_step]
    for form, to in LOGS.items():
        made = folder / f"hour.{form}"
        of_log = folder / f"of_{form}.csv"
        steps.append(Step(f"convert to {form}", [*convert, "--to", to], made, log))
        steps.append(Step(f"convert {form} to csv", ["convert", str(made)], of_log, back))
    return steps


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    minutes = parser.parse_args().minutes
    bad = []
    with tempfile.TemporaryDirectory(prefix="hour.") as folder:
        truth = Truth(Path(folder, "hour.kcap"), minutes * 60)
        print(f"{minutes:g} minutes: {len(truth.row_ns)} rows, {len(truth.sent_ns)} CAN frames")
        for step in steps_of(Path(folder), truth):
            found = step.run()
            result = f"{step.name}: {found.values} values compared"
            print(result, *found.problems[:12], sep="\n    ", flush=True)
            if found.problems or not found.values:
                bad.append(step.name)
    print(f"\nnot equal: {', '.join(bad)}" if bad else "\nall equal")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
