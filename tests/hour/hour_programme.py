"""An hour of telemetry through every command that reads recordings, and each result read back by libraries that are not ours.

    python tests/hour/hour_programme.py [--minutes 60]

Makes a capture of so many minutes without waiting, converts it by the real command as a process of its own, converts the CAN logs back,
reads every file by pandas, json, pyarrow, python-can, asammdf and cantools, and compares every value of every row with what the simulated
ESC meant (hour_truth.py); of what only the gateway knows (rates, counters, states, energy) with the first table.
Exits with 1 and the first differences where anything is not equal.
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
    sys.path[:0] = [str(tests.parent), str(tests), str(tests / "capture")]

import can
import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from hour_truth import MS, SECOND, Floats, Times, Truth, value_name
from pyarrow import parquet  # type: ignore[import-untyped]

ROWS = 20_000
SLACK = 6e-7
"""A table has six decimals; what cantools multiplies is nearer still."""
LOGS = {"log": "candump", "asc": "asc", "blf": "blf", "trc": "trc", "mf4": "mf4-log"}


@dataclass
class Verdict:
    """How a comparison went."""

    values: int = 0
    problems: list[str] = field(default_factory=list)

    def compare(self, what: str, got: Any, wanted: Any, slack: float = 0.0) -> None:
        """Two columns, of which NaN is equal to NaN."""
        if len(got) != len(wanted):
            self.problems.append(f"{what}: {len(got)}, must be {len(wanted)}")
            return
        self.values += len(got)
        equal = (np.abs(got - wanted) <= slack) | (np.isnan(got) & np.isnan(wanted))
        if len(bad := np.flatnonzero(~equal)):
            at = bad[0]
            first = f"the first, {at}: {got[at]}, must be {wanted[at]}"
            self.problems.append(f"{what}: {len(bad)} differ; {first}")


# --- tables


def csv_frames(path: Path) -> Iterator[pd.DataFrame]:
    """By pandas. Only what is empty is missing: a word such as NotAvailable in its place would be a mistake."""
    options: dict[str, Any] = {"keep_default_na": False, "na_values": [""], "low_memory": False}
    if int(pd.__version__.partition(".")[0]) < 3:
        options["float_precision"] = "round_trip"
    yield from pd.read_csv(path, chunksize=ROWS, **options)


def jsonl_frames(path: Path) -> Iterator[pd.DataFrame]:
    """By json."""
    with path.open(encoding="utf-8") as file:
        while rows := [json.loads(line) for line in islice(file, ROWS)]:
            yield pd.DataFrame(rows, dtype=object)


def parquet_frames(path: Path) -> Iterator[pd.DataFrame]:
    """By pyarrow."""
    return (batch.to_pandas() for batch in parquet.ParquetFile(path).iter_batches(ROWS))


READERS = {"csv": csv_frames, "jsonl": jsonl_frames, "parquet": parquet_frames}


def numbers(values: Any, texts: Mapping[str, float]) -> Floats:
    """A column as numbers; of texts those of the DBC, whose names a table may spell with other capitals."""
    array = np.asarray(values, dtype=object)
    if not any(isinstance(value, str) for value in array):
        return array.astype(np.float64)
    return np.array(
        [texts.get(v.casefold(), -999.0) if isinstance(v, str) else np.nan for v in array]
    )


def nanoseconds(seconds: Any) -> Times:
    found: Times = np.rint(np.asarray(seconds, dtype=np.float64) * 1e9).astype(np.int64)
    return found


def unix_ns(wall: Any) -> Times:
    stamps = pd.to_datetime(wall, utc=True, format="ISO8601")
    found: Times = stamps.astype("datetime64[ns, UTC]").astype(np.int64).to_numpy()
    return found


def table_of(path: Path, truth: Truth) -> tuple[Times, Times | None, dict[str, Floats]]:
    """The whole table as numbers: times, Unix times, values by name. AssertionError for a unit that is not the value's."""
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
    """A table of the recording. ``known``: its columns, filled by the truth, and of the first table with what the truth does not know."""
    times, wall, values = table_of(path, truth)
    verdict = Verdict()
    verdict.compare("Time", times, truth.row_ns - truth.row_ns[0], 500)
    # text cuts at a microsecond, Parquet keeps nanoseconds
    tolerance = 0 if path.suffix == ".parquet" else 999
    verdict.compare("Utc", wall, truth.wall_ns(truth.row_ns), tolerance)
    if not known:
        known |= values | truth.columns()
    for name in sorted(known.keys() ^ values.keys()):
        verdict.problems.append(f"{name}: is {'missing' if name in known else 'too much'}")
    for name in known.keys() & values.keys():
        verdict.compare(name, values[name], known[name], SLACK)
    return verdict


# --- CAN logs


def check_log(truth: Truth, path: Path) -> Verdict:
    """A log of all frames: ids, bytes, times as they were handed to the interface, by python-can (MF4: by asammdf below it)."""
    options: dict[str, Any] = {"relative_timestamp": False} if path.suffix == ".asc" else {}
    times, ids, data = [], [], []
    with can.LogReader(path, **options) as reader:
        for message in reader:
            assert message.dlc == 8 and not message.is_extended_id and not message.is_rx, message
            times.append(message.timestamp)
            ids.append(message.arbitration_id)
            data.append(bytes(message.data))
    verdict = Verdict()
    # a converted log goes on with the clock as it began
    wall = truth.wall_ns(truth.sent_ns[:1])[0] + truth.sent_ns - truth.sent_ns[0]
    # its own microsecond, and half of what a float of Unix seconds can tell apart
    verdict.compare("time", nanoseconds(times), wall, 750 + 600 * (path.suffix == ".trc"))
    verdict.compare("id", np.array(ids), truth.sent_ids)
    got, wanted = np.frombuffer(b"".join(data), "<u8"), truth.sent_data
    verdict.compare("data", np.flatnonzero(got != wanted) if len(got) == len(wanted) else got, [])
    return verdict


def decoded(truth: Truth, can_id: int) -> pd.DataFrame:
    """What cantools reads in the frames of one id: ``ns``, when each was sent, and a column for each value."""
    rows = np.flatnonzero(truth.sent_ids == can_id)
    message = truth.database.get_message_by_frame_id(can_id)
    payloads, at = np.unique(truth.sent_data[rows], return_inverse=True)
    found = [message.decode_simple(int(bits).to_bytes(8, "little")) for bits in payloads.tolist()]

    def number(name: str, value: Any) -> float:
        if str(value) in ("NotAvailable", "Error"):
            return np.nan
        return truth.texts[name][str(value).casefold()] if hasattr(value, "value") else float(value)

    columns = {}
    for signal in found[0]:
        name = value_name(signal)
        columns[name] = np.array([number(name, values[signal]) for values in found])[at]
    return pd.DataFrame({"ns": truth.sent_ns[rows], "sent_ns": truth.sent_ns[rows]} | columns)


def check_back(truth: Truth, path: Path) -> Verdict:
    """The CSV of a CAN log: in each row the newest value of each signal while it is fresh."""
    times, _, values = table_of(path, truth)
    verdict = Verdict()
    begun = times + truth.sent_ns[0]
    until = pd.DataFrame({"ns": np.append(begun[1:], 1 << 62) - 1500})  # its own microsecond
    flags = {value_name(flag) for flag in truth.flags}
    for can_id in np.unique(truth.sent_ids).tolist():
        newest = pd.merge_asof(until, decoded(truth, can_id), on="ns")
        cycle = truth.database.get_message_by_frame_id(can_id).cycle_time
        # three cycles, at least 250 ms; a second where it comes with telemetry only
        life = max(250, 3 * cycle) * MS if cycle else SECOND
        newest = newest.where(begun - newest.pop("sent_ns") <= life)
        for name in values.keys() & newest.keys():
            got, wanted = values[name], newest[name].to_numpy()
            if name in flags:  # a flag has no code for not available
                wanted = np.where(np.isnan(got), np.nan, wanted)
            verdict.compare(name, got, wanted, SLACK)
    return verdict


# --- frames and bytes


def check_frames(truth: Truth, _: Path) -> Verdict:
    """Every signal of every frame against what the ESC meant."""
    found = truth.judged_frames()
    return Verdict(found.count["values"], found.wrong)


def check_bytes(truth: Truth, path: Path) -> Verdict:
    """The UART bytes of the ESC."""
    verdict = Verdict()
    got = np.fromfile(path, np.uint8).astype(int)
    verdict.compare("bytes", got, np.frombuffer(truth.wire, np.uint8).astype(int))
    return verdict


# --- the programme


@dataclass
class Step:
    """A command that makes a file, and what is compared."""

    name: str
    words: list[str]
    output: Path
    check: Callable[[Path], Verdict]

    def run(self) -> Verdict:
        """RuntimeError where the command failed."""
        command = [sys.executable, "-m", "kontronik_can_gw", *self.words, str(self.output)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"exit code {done.returncode}: {done.stderr.strip()}")
        return self.check(self.output)


def steps_of(folder: Path, truth: Truth) -> list[Step]:
    """All that is done with the capture."""
    convert, known = ["convert", str(truth.path)], dict[str, Floats]()
    table = partial(check_table, truth, known)
    log, back = partial(check_log, truth), partial(check_back, truth)
    steps = [
        *(Step(f"convert to {form}", convert, folder / f"hour.{form}", table) for form in READERS),
        Step("convert to bin", convert, folder / "esc1.bin", partial(check_bytes, truth)),
        Step("the CAN frames", convert, folder / "sent.log", partial(check_frames, truth)),
    ]
    for form, to in LOGS.items():
        made, of_log = folder / f"hour.{form}", folder / f"of_{form}.csv"
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
            bad += [step.name] if found.problems or not found.values else []
    print(f"\nnot equal: {', '.join(bad)}" if bad else "\nall equal")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
