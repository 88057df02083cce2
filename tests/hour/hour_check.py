"""Reads what the commands wrote, by libraries that are not ours, and compares every value of every row with what must be there.

Tables: pandas, json, pyarrow. CAN logs: python-can's readers and cantools. The comparisons are whole columns by numpy.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from hour_recording import MS, SECOND, Times
from hour_truth import (
    ALIVE,
    JIVEPRO,
    LIVE,
    OPERATING_ERRORS,
    SAME_ROW_NS,
    SELFTEST_ERRORS,
    Expected,
    Floats,
    Truth,
)
from numpy.typing import NDArray

from kontronik_can_gw.lean import without_asammdf

ROWS = 20_000
SLACK = 1e-7
"""cantools multiplies by 0.001 what is compared with the float nearest to the decimal; no signal is finer than 0.001."""
SHOWN = 12
ALIVE_MODULUS = 15
"""Alive counters run from 0 to 14."""
LOGS = ("log", "asc", "blf", "trc")
FLAGS = (*OPERATING_ERRORS, *SELFTEST_ERRORS)
BESIDE_FLAGS = (
    "OperatingState",
    "OperatingStateRaw",
    "PowerStageTemperature",
    "Variant",
    "FirmwareMain",
    "DeviceRaw",
)
"""Where all of these that a message has are not available, its flags are not either."""
_UNKNOWN_TEXT = -999.0


@dataclass
class Verdict:
    """How a comparison went."""

    rows: int = 0
    values: int = 0
    differences: int = 0
    problems: list[str] = field(default_factory=list)
    """The first differences in words."""

    @property
    def ok(self) -> bool:
        return not self.differences and self.values > 0

    def say(self, count: int, text: str) -> None:
        """So many differences, told by one line."""
        self.differences += count
        if len(self.problems) < SHOWN:
            self.problems.append(text)

    def times(self, what: str, got: Times, expected: Times, tolerance_ns: int) -> None:
        """Compare times."""
        self.values += len(got)
        bad = np.flatnonzero(np.abs(got - expected) > tolerance_ns)
        if len(bad):
            first = bad[0]
            self.say(
                len(bad),
                f"{what}: {len(bad)} times differ; row {first}: {got[first]} ns, must be {expected[first]} ns",
            )

    def column(
        self, name: str, got: Floats, low: Floats, high: Floats, first_row: int, slack: float = 0.0
    ) -> None:
        """Compare values."""
        self.values += len(got)
        nothing = np.isnan(low)
        right = np.where(nothing, np.isnan(got), (got >= low - slack) & (got <= high + slack))
        bad = np.flatnonzero(~right)
        if len(bad):
            one = bad[0]
            wanted = f"{low[one]:.10g}" + (f" to {high[one]:.10g}" if high[one] > low[one] else "")
            self.say(
                len(bad),
                f"{name}: {len(bad)} values differ; row {first_row + one}: {got[one]:.10g}, must be {wanted}",
            )


@dataclass
class Chunk:
    """Neighbouring rows of a table. Texts are numbers of the DBC."""

    times: Times
    wall: Times | None
    values: Mapping[str, Floats]


# --- tables


def check_table(truth: Truth, path: Path) -> Verdict:
    """A table of the recording."""
    chunks = READERS[path.suffix](path, truth)
    wall_ns = truth.recording.wall_ns(truth.row_ns)
    return check_rows(
        path, chunks, truth.row_ns, truth.rows(), wall_ns, WALL_TOLERANCE[path.suffix]
    )


def check_rows(
    path: Path,
    chunks: Iterator[Chunk],
    row_ns: Times,
    expected: Mapping[str, Expected],
    wall_ns: Times,
    wall_tolerance_ns: int,
    tolerance_ns: int = 500,
) -> Verdict:
    """Rows that must be at these times and have these values."""
    verdict = Verdict()
    since = row_ns - row_ns[0] if len(row_ns) else row_ns
    for chunk in chunks:
        begin, end = verdict.rows, verdict.rows + len(chunk.times)
        verdict.rows = end
        if end > len(row_ns):
            continue
        verdict.times("Time", chunk.times, since[begin:end], tolerance_ns)
        if chunk.wall is None:
            verdict.say(1, f"{path.name}: has no Utc")
        else:
            verdict.times("Utc", chunk.wall, wall_ns[begin:end], wall_tolerance_ns)
        for name in expected.keys() ^ chunk.values.keys():
            verdict.say(1, f"{name}: is {'missing' if name in expected else 'too much'}")
        for name, got in chunk.values.items():
            if (wanted := expected.get(name)) is not None:
                verdict.column(name, got, wanted.low[begin:end], wanted.high[begin:end], begin)
    if verdict.rows != len(row_ns):
        verdict.say(1, f"{path.name}: has {verdict.rows} rows, must have {len(row_ns)}")
    return verdict


def _texts(values: Sequence[Any], numbers: Mapping[str, int]) -> Floats:
    """``numbers``: by text, folded: tables spell texts as the sheet does, and the DBC as names."""
    codes = {text.casefold(): float(number) for text, number in numbers.items()}
    return np.array(
        [np.nan if v is None or v != v else codes.get(v.casefold(), _UNKNOWN_TEXT) for v in values]
    )


def _split(header: str, truth: Truth) -> str:
    """The value's name; the unit in the header must be its own."""
    name, _, unit = header.partition(" [")
    if unit.rstrip("]") != truth.value_units[name]:
        raise AssertionError(f"{header}: the unit of {name} is {truth.value_units[name]!r}")
    return name


def _ns(seconds: Any) -> Times:
    found: Times = np.rint(np.asarray(seconds, dtype=np.float64) * 1e9).astype(np.int64)
    return found


def _column(values: Any, name: str, truth: Truth) -> Floats:
    """A pandas column as numbers."""
    if values.dtype.kind in "iuf":
        return np.asarray(values, dtype=np.float64)
    if values.isna().all():
        return np.full(len(values), np.nan)
    return _texts(list(values), truth.value_texts[name])


def _wall(frame: Any) -> Times | None:
    """The column Utc of a text, read by pandas."""
    import pandas as pd  # type: ignore[import-untyped]

    if "Utc" not in frame:
        return None
    found = (
        pd.to_datetime(frame["Utc"], format="ISO8601").dt.tz_convert(None).astype("datetime64[ns]")
    )
    wall: Times = found.astype(np.int64).to_numpy()
    return wall


def csv_chunks(path: Path, truth: Truth) -> Iterator[Chunk]:
    """By pandas."""
    import pandas as pd

    names: dict[str, str] | None = None
    exact: dict[str, Any] = (
        {"float_precision": "round_trip"} if int(pd.__version__.partition(".")[0]) < 3 else {}
    )
    # only what is empty is missing: a word such as NotAvailable in its place would be a mistake
    for frame in pd.read_csv(
        path, chunksize=ROWS, keep_default_na=False, na_values=[""], low_memory=False, **exact
    ):
        if names is None:
            names = {head: _split(head, truth) for head in frame.columns[1:] if head != "Utc"}
            assert frame.columns[0] == "Time [s]"
        values = {name: _column(frame[head], name, truth) for head, name in names.items()}
        yield Chunk(_ns(frame["Time [s]"]), _wall(frame), values)


def jsonl_chunks(path: Path, truth: Truth) -> Iterator[Chunk]:
    """By json and pandas."""
    import pandas as pd

    with path.open(encoding="utf-8") as file:
        while lines := list(islice(file, ROWS)):
            frame = pd.DataFrame([json.loads(line) for line in lines])
            values = {
                name: _column(frame[name], name, truth)
                for name in frame.columns
                if name not in ("Time", "Utc")
            }
            yield Chunk(_ns(frame["Time"]), _wall(frame), values)


def parquet_chunks(path: Path, truth: Truth) -> Iterator[Chunk]:
    """By pyarrow."""
    from pyarrow import parquet  # type: ignore[import-untyped]

    file = parquet.ParquetFile(path)
    for batch in file.iter_batches(ROWS):
        values: dict[str, Floats] = {}
        wall = None
        for head in batch.schema.names[1:]:
            column = batch.column(head)
            if head == "Utc":
                wall = column.cast("int64").to_numpy(zero_copy_only=False)
                continue
            name = _split(head, truth)
            if hasattr(column, "dictionary"):
                codes = _texts(column.dictionary.to_pylist(), truth.value_texts[name])
                at = column.indices.cast("float64").to_numpy(zero_copy_only=False)
                values[name] = np.where(
                    np.isnan(at), np.nan, codes[np.nan_to_num(at).astype(np.int64)]
                )
            else:
                values[name] = column.cast("float64").to_numpy(zero_copy_only=False)
        yield Chunk(_ns(batch.column("Time [s]").to_numpy()), wall, values)


TABLES = {"csv": "pandas", "jsonl": "json, pandas", "parquet": "pyarrow"}
"""Forms, and by what they are read."""
READERS = {
    ".csv": csv_chunks,
    ".jsonl": jsonl_chunks,
    ".parquet": parquet_chunks,
}
# text cuts at a microsecond, Parquet keeps nanoseconds
WALL_TOLERANCE = {".csv": 999, ".jsonl": 999, ".parquet": 0}


# --- CAN logs


@dataclass
class Frames:
    """CAN frames of a log."""

    times: Times
    """ns, as python-can's seconds are."""
    ids: NDArray[np.int64]
    data: NDArray[np.uint64]


def read_log(path: Path) -> Frames:
    """By python-can."""
    with without_asammdf():
        import can
    times: list[float] = []
    ids: list[int] = []
    data: list[bytes] = []
    more: dict[str, Any] = {"relative_timestamp": False} if path.suffix == ".asc" else {}
    with can.LogReader(path, **more) as reader:
        for message in reader:
            assert message.dlc == 8 and not message.is_extended_id and not message.is_rx, (
                f"{path.name}: {message}"
            )
            times.append(message.timestamp)
            ids.append(message.arbitration_id)
            data.append(bytes(message.data))
    return Frames(_ns(times), np.array(ids, np.int64), np.frombuffer(b"".join(data), dtype="<u8"))


class Decoded:
    """Values of frames by cantools; equal frames are decoded once."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._known: dict[int, dict[int, list[float]]] = {}
        self.names = {m.frame_id: [s.name for s in m.signals] for m in truth.database.messages}

    def table(self, can_id: int, data: NDArray[np.uint64]) -> dict[str, Floats]:
        """A column for each signal of the message with this id."""
        message = self._truth.database.get_message_by_frame_id(can_id)
        names = self.names[can_id]
        known = self._known.setdefault(can_id, {})
        unique, at = np.unique(data, return_inverse=True)
        rows = []
        for bits in unique.tolist():
            row = known.get(bits)
            if row is None:
                found = message.decode_simple(int(bits).to_bytes(8, "little"))
                row = known[bits] = [self._number(name, found[name]) for name in names]
            rows.append(row)
        table = np.array(rows, dtype=np.float64)[at]
        return {name: table[:, index] for index, name in enumerate(names)}

    def _number(self, name: str, value: Any) -> float:
        text = str(value)
        if text in ("NotAvailable", "Error"):
            return np.nan
        return float(self._truth.texts[name][text] if hasattr(value, "value") else value)


def check_log(path: Path, truth: Truth, decoded: Decoded) -> tuple[Verdict, Frames]:
    """A log of all frames of the recording: ids, bytes, times, and every signal by cantools against what the ESCs meant."""
    verdict = Verdict()
    got = read_log(path)
    sent = truth.recording.sent
    times = truth.sent_ns
    ids, data = np.array(sent.ids, np.int64), np.array(sent.data, np.uint64)
    verdict.rows = len(got.times)
    if len(got.times) != len(times):
        verdict.say(1, f"{path.name}: has {len(got.times)} frames, must have {len(times)}")
        return verdict, got
    # a converted log goes on with the clock as it began
    wall = truth.recording.wall_ns(times[:1])[0] + times - times[0]
    # its own microsecond, and half of what a float of Unix seconds can tell apart
    verdict.times("time", got.times, wall, 500 + 250 + (600 if path.suffix == ".trc" else 0))
    for what, mine, theirs in (("id", got.ids, ids), ("data", got.data, data)):
        verdict.values += len(mine)
        bad = np.flatnonzero(mine != theirs)
        if len(bad):
            verdict.say(
                len(bad),
                f"{what}: {len(bad)} differ; frame {bad[0]}: {mine[bad[0]]:X}, must be {theirs[bad[0]]:X}",
            )
    if verdict.differences:
        return verdict, got
    for can_id in np.unique(got.ids).tolist():
        of_it = np.flatnonzero(got.ids == can_id)
        wanted = truth.at(times[of_it])
        for name, values in decoded.table(can_id, got.data[of_it]).items():
            if name.endswith(FLAGS):  # a flag has no code for not available
                low, high = np.nan_to_num(wanted[name].low), np.nan_to_num(wanted[name].high)
                verdict.column(name, values, low, high, 0)
            elif name.endswith(ALIVE):
                verdict.values += len(values)
                steps = np.flatnonzero((np.diff(values) - 1) % ALIVE_MODULUS)
                if len(steps):
                    verdict.say(
                        len(steps), f"{name}: does not count by one at its frame {steps[0] + 1}"
                    )
            else:
                verdict.column(name, values, wanted[name].low, wanted[name].high, 0, SLACK)
    return verdict, got


def check_table_of_log(path: Path, truth: Truth, frames: Frames, decoded: Decoded) -> Verdict:
    """The CSV of a CAN log: rows of the groups of its frames, values of each signal's newest frame."""
    row_ns, until = _groups(truth, frames)
    expected: dict[str, Expected] = {}
    for can_id, names in decoded.names.items():
        of_it = np.flatnonzero(frames.ids == can_id)
        at = np.searchsorted(frames.times[of_it], until, "right") - 1
        life = _life(truth, can_id)
        seen = frames.times[of_it][np.maximum(at, 0)]
        fresh = (at >= 0) & ((life is None) | (until - seen <= (life or 0)))
        table = decoded.table(can_id, frames.data[of_it])
        flags = [name for name in names if name.endswith(FLAGS)]
        beside = [
            table[name] for name in names if name.endswith(BESIDE_FLAGS) and name not in flags
        ]
        valid = ~np.all(np.isnan(beside), axis=0) if beside else None
        for name in names:
            if name in flags and valid is not None:
                table[name] = np.where(valid, table[name], np.nan)
            if not name.endswith(ALIVE):
                values = np.where(fresh, table[name][np.maximum(at, 0)], np.nan)
                # cantools multiplies by 0.01 where the table holds the float nearest to the decimal
                values = np.where(np.isnan(values), values, np.round(values, 6))
                expected[truth.value_name(name)] = Expected(values, values)
    return check_rows(path, csv_chunks(path, truth), row_ns, expected, row_ns, 1500, 1500)


def _life(truth: Truth, can_id: int) -> int | None:
    """How long a message's values hold: three cycles, at least 250 ms; a second where it comes with telemetry only."""
    message = truth.database.get_message_by_frame_id(can_id)
    if message.cycle_time:
        return max(250, 3 * message.cycle_time) * MS
    return SECOND


def _groups(truth: Truth, frames: Frames) -> tuple[Times, Times]:
    """When the rows of a log begin, and up to when their frames came."""
    lives = {can_id: _life(truth, can_id) or 0 for can_id in np.unique(frames.ids).tolist()}
    expiry: dict[int, int] = {}
    due = 1 << 62
    rows: list[tuple[int, int]] = []
    begun: int | None = None
    last = 0
    group: set[int] = set()
    for now, can_id in zip(frames.times.tolist(), frames.ids.tolist(), strict=True):
        if begun is not None and (can_id in group or now - begun > SAME_ROW_NS):
            rows.append((begun, last))
            begun, group = None, set()
        while due < now:  # a message stayed away: a row tells so
            over = [one for one, when in expiry.items() if when <= due]
            for one in over:
                del expiry[one]
            rows.append((due + 1, due + 1))
            begun, group = None, set()
            due = min(expiry.values(), default=1 << 62)
        expiry[can_id] = now + lives[can_id]
        due = min(expiry.values())
        group.add(can_id)
        begun = now if begun is None else begun
        last = now
    if begun is not None:
        rows.append((begun, last))
    found = np.array(rows, dtype=np.int64)
    return found[:, 0], found[:, 1]


# --- bytes


def check_bytes(truth: Truth, esc: int, path: Path) -> Verdict:
    """The UART bytes of one ESC."""
    verdict = Verdict()
    got, wanted = (
        np.fromfile(path, np.uint8),
        np.frombuffer(bytes(truth.recording.escs[esc].wire), np.uint8),
    )
    verdict.values = len(got)
    if len(got) != len(wanted):
        verdict.say(1, f"{path.name}: has {len(got)} bytes, must have {len(wanted)}")
    elif len(bad := np.flatnonzero(got != wanted)):
        verdict.say(len(bad), f"{path.name}: {len(bad)} bytes differ, the first at {bad[0]}")
    return verdict


_WIRE_STEPS = dict([*LIVE.values(), ("bec_current", 1000)])
_WIRE_NAMES = {"operating_state": "operating_state_raw"}


def check_decoded(truth: Truth, esc: int, path: Path) -> Verdict:
    """The JSON lines of ``decode``: live frames in their order, every field as meant."""
    verdict = Verdict()
    one = truth.escs[esc]
    keys = [_WIRE_NAMES.get(name, name) for name in one.live]
    with path.open(encoding="utf-8") as file:
        rows = [[row[key] for key in keys] for row in map(json.loads, file)]
    verdict.rows, count = len(rows), len(next(iter(one.live.values())))
    if len(rows) != count:
        verdict.say(1, f"{len(rows)} rows, must be {count}")
        return verdict
    for place, (name, raw) in enumerate(one.live.items()):
        values = [row[place] for row in rows]
        got = np.array([np.nan if value is None else value for value in values], np.float64)
        wanted = raw / _WIRE_STEPS.get(name, 1)
        if name == "bec_current":
            # of a JIVEPro none, as soon as an info frame has told what it is
            wanted = np.where((one.devices == JIVEPRO) & np.isnan(got), np.nan, wanted)
        verdict.column(name, got, wanted, wanted, 0)
    return verdict


# --- monitor and report


def check_last(truth: Truth, decoded: Decoded, path: Path) -> Verdict:
    """What ``monitor --once`` says: the values of each message's last frame."""
    verdict = Verdict()
    told = json.loads(path.read_text(encoding="utf-8"))
    ids, data = np.array(truth.recording.sent.ids), np.array(truth.recording.sent.data, np.uint64)
    expected: dict[str, Floats] = {}
    for can_id in np.unique(ids).tolist():
        expected |= decoded.table(can_id, data[np.flatnonzero(ids == can_id)[-1:]])
    for prefix, esc in zip(truth.prefixes, told["escs"], strict=True):
        values = esc["values"]
        for name, wanted in expected.items():
            key = truth.value_name(name).rpartition(".")[2]
            if not name.startswith(prefix) or key not in values or key == "data_age":  # it goes on
                continue
            value = values[key]
            texts = truth.texts[name]
            number = (
                np.nan
                if value is None
                else texts.get(value, _UNKNOWN_TEXT)
                if isinstance(value, str)
                else value
            )
            verdict.column(name, np.array([number], np.float64), wanted, wanted, 0, 1e-9)
    verdict.rows = len(told["escs"])
    return verdict


def check_report(truth: Truth, path: Path) -> Verdict:
    """The report's page: rows, charge, extremes with their numbers, as the truth has them."""
    verdict = Verdict(rows=1)
    text = path.read_text(encoding="utf-8").replace("\u202f", "")  # between thousands
    rows = truth.rows()
    wanted = [f"{len(truth.row_ns)} rows"]
    if len(truth.escs) == 1:
        wanted += [
            f"<b>{np.nanmax(rows['battery_power'].low):.0f} W</b>",
            f"<b>{np.nanmax(rows['battery_current'].low):.1f} A</b>",
            f"<b>{np.nanmin(rows['battery_voltage'].low):.2f} V</b>",
            f"<b>{np.nanmax(rows['power_stage_temperature'].low):.0f} °C</b>",
        ]
    for words in wanted:
        verdict.values += 1
        if words not in text:
            verdict.say(1, f"{path.name}: does not say {words!r}")
    return verdict
