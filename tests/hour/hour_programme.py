"""An hour of telemetry through every command that reads recordings, and each result read back by libraries that are not ours.

    python tests/hour/hour_programme.py [--minutes 60]

Makes a capture of so many minutes without waiting, converts it by the real command as a process of its own, converts the CAN logs back,
reads every file by pandas, json, pyarrow, python-can, asammdf and cantools, and compares every value of every row with what the simulated
ESC meant (hour_truth.py); of what only the gateway knows (rates, counters, states) with the first table.
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

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from hour_truth import (
    MS,
    OPERATING_ERRORS,
    SECOND,
    SELFTEST_ERRORS,
    Floats,
    Times,
    Truth,
    value_name,
)
from pyarrow import parquet  # type: ignore[import-untyped]

ROWS = 20_000
SLACK = 1e-7
"""cantools multiplies by 0.001 what is compared with the float nearest to the decimal; no signal is finer than 0.001."""
LOGS = {"log": "candump", "asc": "asc", "blf": "blf", "trc": "trc", "mf4": "mf4-log"}
FLAGS = {*OPERATING_ERRORS, *SELFTEST_ERRORS}
BESIDE_FLAGS = ("operating_state", "operating_state_raw", "power_stage_temperature", "variant", "firmware_main", "device_raw")  # fmt: skip
"""Where all of these that a message has are not available, its flags are not either."""


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


def check_table(truth: Truth, seen: dict[str, Floats], path: Path) -> Verdict:
    """A table of the recording. ``seen``: of the first one, what the truth does not know."""
    times, wall, values = table_of(path, truth)
    verdict = Verdict()
    verdict.compare("Time", times, truth.row_ns - truth.row_ns[0], 500)
    # text cuts at a microsecond, Parquet keeps nanoseconds
    tolerance = 0 if path.suffix == ".parquet" else 999
    verdict.compare("Utc", wall, truth.wall_ns(truth.row_ns), tolerance)
    wanted = truth.rows()
    if not seen:
        seen |= {name: column for name, column in values.items() if name not in wanted}
    wanted |= seen
    for name in sorted(wanted.keys() ^ values.keys()):
        verdict.problems.append(f"{name}: is {'missing' if name in wanted else 'too much'}")
    for name in wanted.keys() & values.keys():
        verdict.compare(name, values[name], wanted[name])
    return verdict


# --- CAN logs


def check_log(truth: Truth, path: Path) -> Verdict:
    """A log of all frames: ids, bytes, times as they were handed to the interface, by python-can (MF4: by asammdf below it)."""
    import can

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


class Decoded:
    """The frames that were handed to the interface, by cantools; equal ones are decoded once."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self.frames = {
            can_id: self._table(can_id, np.flatnonzero(truth.sent_ids == can_id))
            for can_id in np.unique(truth.sent_ids).tolist()
        }
        """By id: when they were sent, and a column for each value (alive counters by their signal's name)."""

    def _table(self, can_id: int, rows: Times) -> tuple[Times, dict[str, Floats]]:
        message = self._truth.database.get_message_by_frame_id(can_id)
        unique, at = np.unique(self._truth.sent_data[rows], return_inverse=True)
        found = [message.decode_simple(int(bits).to_bytes(8, "little")) for bits in unique.tolist()]
        columns = {}
        for signal in (one.name for one in message.signals):
            name = signal if signal.endswith("Alive") else value_name(signal)
            of_it = [self._number(name, values[signal]) for values in found]
            columns[name] = np.array(of_it, np.float64)[at]
        return self._truth.sent_ns[rows], columns

    def _number(self, name: str, value: Any) -> float:
        text = str(value)
        if text in ("NotAvailable", "Error"):
            return np.nan
        return self._truth.texts[name][text.casefold()] if hasattr(value, "value") else float(value)

    def check_sent(self, _: Path) -> Verdict:
        """Every signal of every frame against what the ESC meant."""
        verdict = Verdict()
        for times, columns in self.frames.values():
            wanted = self._truth.frames(times)
            for name, values in columns.items():
                if name.endswith("Alive"):
                    verdict.compare(name, np.diff(values) % 15, np.ones(len(values) - 1))
                elif name in FLAGS:  # a flag has no code for not available
                    verdict.compare(name, values, np.nan_to_num(wanted[name]))
                elif name in wanted:
                    verdict.compare(name, values, wanted[name], SLACK)
        return verdict

    def check_table(self, path: Path) -> Verdict:
        """The CSV of a CAN log: in each row the newest value of each signal while it is fresh."""
        times, _, values = table_of(path, self._truth)
        verdict = Verdict()
        begun = times + self._truth.sent_ns[0]
        until = np.append(begun[1:], 1 << 62) - 1500  # its own microsecond
        for can_id, (sent, columns) in self.frames.items():
            cycle = self._truth.database.get_message_by_frame_id(can_id).cycle_time
            # three cycles, at least 250 ms; a second where it comes with telemetry only
            life = max(250, 3 * cycle) * MS if cycle else SECOND
            at = np.searchsorted(sent, until, "right") - 1
            fresh = (at >= 0) & (begun - sent[np.maximum(at, 0)] <= life)
            beside = [columns[name] for name in BESIDE_FLAGS if name in columns]
            valid = ~np.all(np.isnan(beside), axis=0) if beside else np.full(len(sent), True)
            for name, column in columns.items():
                if name not in values:
                    continue
                shown = np.where(valid, column, np.nan) if name in FLAGS else column
                newest = np.where(fresh, shown[np.maximum(at, 0)], np.nan)
                verdict.compare(name, values[name], newest, SLACK)
        return verdict


# --- bytes


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
    convert, decoded, seen = ["convert", str(truth.path)], Decoded(truth), dict[str, Floats]()
    table, log = partial(check_table, truth, seen), partial(check_log, truth)
    steps = [
        *(Step(f"convert to {form}", convert, folder / f"hour.{form}", table) for form in READERS),
        Step("the CAN frames", convert, folder / "sent.log", decoded.check_sent),
        Step("convert to bin", convert, folder / "esc1.bin", partial(check_bytes, truth)),
    ]
    for form, to in LOGS.items():
        made, of_log = folder / f"hour.{form}", folder / f"of_{form}.csv"
        steps.append(Step(f"convert to {form}", [*convert, "--to", to], made, log))
        back = ["convert", str(made)]
        steps.append(Step(f"convert {form} to csv", back, of_log, decoded.check_table))
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
