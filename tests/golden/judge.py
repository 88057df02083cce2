"""Is what is golden right? Each flight and dialogue against a brute-force search, the sheet and cantools.

UART bytes are searched by tests/esc/reference.py, fields and scales are those of tests/esc/sheet.py, values are reckoned by
tests/signals/packer_oracle.py, frames are decoded by cantools. Nothing of the product is used but the DBC of a configuration, as text.
"""

import io
import re
import struct
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Mapping
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from itertools import accumulate
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent / "signals"), str(HERE.parents[1])]

import drive  # noqa: E402
import meaning  # noqa: E402
import scenario  # noqa: E402
from cantools.database.can import Database  # noqa: E402
from cantools.database.can.signal import Signal  # noqa: E402
from esc import reference, sheet  # noqa: E402
from packer_oracle import KNOWN  # noqa: E402

_DOWNLOADS = 0x20, 0xC0
"""Command of an SDO client that begins to write, in one frame or segments, or in blocks (CiA 301, 7.2.4.3)."""
NOT_JUDGED = ("no_start_values.txt",)
"""Flags without a start value go to 1 on loss, which is a false alarm: a known defect (README.md)."""
NS_PER_BYTE = 11 * 10**9 // 115_200
INFO_NS = 10 * 10**9
CONVERSIONS: dict[tuple[str, str], int | Fraction] = {
    ("V", "mV"): 1000,
    ("A", "mA"): 1000,
    ("us", "ms"): Fraction(1, 1000),
}
LIVE = {f.name: f for f in sheet.LIVE_FIELDS}
INFO = {f.name: f for f in sheet.INFO_FIELDS}
OF_SETTINGS = {"motor_speed", "output_speed", "mean_cell_voltage"}
JUDGED = {"operating_state_raw", "battery_power", "device", "device_raw", "variant", "firmware_main", "firmware_sub", "layout", "data_age",
          *OF_SETTINGS, *LIVE, *INFO} & KNOWN.keys()  # fmt: skip
"""What depends on telemetry alone, which is followed here."""
Values = Mapping[str, int]
Bytes = tuple[int, bytes | None]
"""(time, bytes that are read; None where the port is lost)."""
Arrivals = list[tuple[str, str, Values, int]]
"""Frames that are certain with an input: kind, layout, values, time of the last byte."""


class State(NamedTuple):
    """What is known of an ESC: the newest data where it is fresh, when the newest came, and what came last."""

    live: Values | None = None
    live_ns: int | None = None
    info: Values | None = None
    info_ns: int = 0
    last_info: Values | None = None
    layout: int = 0


@dataclass
class Esc:
    """An ESC: its settings, what it sent by time, and its state."""

    prefix: str
    pole_pairs: int = 1
    gear: Fraction = Fraction(1)
    cells: int = 0
    timeout: int = 250_000_000
    state: State = State()
    passed: list[State] = field(default_factory=list)
    """States since the time of the last input."""
    sure: bool = True
    """False where settings were changed by what is not followed here."""

    def expire(self, now: int) -> bool:
        """Forget what is too old."""
        before = self.state
        if before.live is not None and now - (before.live_ns or 0) > self.timeout:
            self.lose()
        if self.state.info is not None and now - self.state.info_ns > INFO_NS:
            self.state = self.state._replace(info=None)
        return before is not self.state

    def lose(self) -> None:
        self.state = self.state._replace(live=None, info=None)

    def take(self, kind: str, layout: str, values: Values, when: int) -> None:
        """A frame whose last byte came at ``when``."""
        number = 1 if layout == "v4" else 2
        if number != self.state.layout:
            self.state = self.state._replace(layout=number, info=None, last_info=None)
        if kind == "info":
            self.state = self.state._replace(info=values, info_ns=when, last_info=values)
        else:
            when = max(when, self.state.live_ns or 0)
            self.state = self.state._replace(live=values, live_ns=when)


def found_frames(inputs: list[Bytes], timeout: int) -> list[Arrivals | None]:
    """For each input the frames that no further byte could take away, by brute force; None where the port is lost."""
    found: list[Arrivals] = [[] for _ in inputs]
    begin = 0
    while begin < len(inputs):
        end = begin
        while end < len(inputs) and inputs[end][1] is not None:
            end += 1
            if end < len(inputs) and inputs[end][0] - inputs[end - 1][0] > timeout:
                break  # what was unfinished is given up
        if end > begin:
            _search(inputs, begin, end, timeout, found)
        begin = end if end > begin else end + 1
    return [None if inputs[n][1] is None else arrivals for n, arrivals in enumerate(found)]


def _search(inputs: list[Bytes], begin: int, end: int, timeout: int, found: list[Arrivals]) -> None:
    parts = [data or b"" for _, data in inputs[begin:end]]
    stream, ends = b"".join(parts), list(accumulate(map(len, parts)))
    moment = gap = 0
    for frame in reference.frames_of(stream):
        moment = max(moment, frame.end)
        for at in range(gap, frame.offset):
            moment = max(moment, at + reference.LONGEST_OF.get(stream[at : at + 4], 0))
        gap = frame.end
        if moment > len(stream):
            continue  # it comes to light only when the stream is given up
        index = next(n for n, size in enumerate(ends) if size >= moment)
        now = inputs[begin + index][0]
        when = now - (ends[index] - frame.end) * NS_PER_BYTE
        if now - when <= timeout:
            values = fields_of(frame.kind, frame.raw)
            found[begin + index].append((frame.kind, frame.layout, values, when))


def fields_of(kind: str, raw: bytes) -> Values:
    listed = sheet.LIVE_FIELDS if kind == "live" else sheet.INFO_FIELDS
    return {f.name: struct.unpack_from(f"<{f.code}", raw, f.offset)[0] for f in listed}


def snake(name: str) -> str:
    return re.sub("(?<!^)(?=[A-Z])", "_", name.removesuffix("Percent")).lower()


def expected(name: str, esc: Esc, state: State, now: int) -> Fraction | int | None:
    """The value that a signal is to have, in the sheet's unit; None: not available. KeyError for what is not judged."""
    plain = snake(name)
    if plain not in JUDGED or (plain in OF_SETTINGS and not esc.sure):
        raise KeyError(name)
    live, info, last = (
        None if values is None else SimpleNamespace(**values)
        for values in (state.live, state.info, state.last_info)
    )
    cells = esc.cells or (state.info or {}).get("cell_count", 0)
    made: Any = SimpleNamespace(
        live=live, info=info, last_info=last, layout=state.layout, live_ns=state.live_ns,
        settings=esc, cells=cells,
    )  # fmt: skip
    of_gateway: Any = None
    return KNOWN[plain].read(made, of_gateway, now)


def fits(signal: Signal, raw: float, value: Fraction | int | None, unit: str) -> bool:
    """True where the raw value says this."""
    texts: dict[str, int] = {str(text): number for number, text in (signal.choices or {}).items()}
    if value is None:
        if signal.is_float and signal.raw_initial is None:
            return raw != raw
        lowest = -1 << signal.length - 1 if signal.is_signed else (1 << signal.length) - 1
        code = lowest if signal.raw_initial is None else signal.raw_initial
        return bool(raw == texts.get("NotAvailable", int(code)))
    value = Fraction(value) * CONVERSIONS.get((unit, signal.unit or ""), 1)
    if signal.is_float:
        return bool(abs(raw * signal.scale + signal.offset - float(value)) <= 1e-6 * abs(value))
    ideal = float((value - Fraction(str(signal.offset))) / Fraction(str(signal.scale)))
    numbers = [number for text, number in texts.items() if text not in ("NotAvailable", "Error")]
    limits = (signal.minimum or 0, signal.maximum or 0)
    out_of_range = bool(numbers) and value not in numbers
    if limits != (0, 0) and not numbers:
        low, high = (round((limit - signal.offset) / signal.scale) for limit in limits)
        out_of_range = not min(low, high) - 0.5 <= ideal < max(low, high) + 0.5
    codes = 1 << signal.length
    top = codes // 2 - 1 if signal.is_signed else codes - 1
    if out_of_range or not top - codes < ideal < top + 0.5:
        return "Error" not in texts or raw == texts["Error"]
    return abs(raw - ideal) <= 0.5 + 1e-9


class Judge:
    """One golden file. ``wrong``: what does not agree; ``count``: what was judged."""

    def __init__(self, escs: list[Esc], database: Database | None, node_ids: list[int]) -> None:
        self.escs = escs
        self.database = database
        self.node_ids = node_ids
        self.wrong: list[str] = []
        self.count: Counter[str] = Counter()
        self._now = -1
        self._pdos = _canopen_database()
        self._flags = flags()

    def given(self, now: int, index: int, arrivals: Arrivals | None) -> None:
        """An input of an ESC; None: its port is lost."""
        esc = self._at(now, self.escs[index])
        if arrivals is None:
            esc.lose()
        for arrival in arrivals or ():
            esc.take(*arrival)
            esc.passed.append(esc.state)
        if not arrivals:
            esc.passed.append(esc.state)

    def _note(self, now: int, what: str) -> None:
        self.wrong.append(f"{scenario.seconds(now)} {what}")

    def _at(self, now: int, esc: Esc) -> Esc:
        if now != self._now:
            self._now = now
            for other in self.escs:
                other.passed = []
        if esc.expire(now):
            esc.passed.append(esc.state)
        return esc

    def received(self, frame: drive.CanFrame) -> None:
        """A frame from the bus: what a master writes by itself to 2100h, or resets, is not followed."""
        is_write = frame.data[1:3] == b"\x00\x21" and frame.data[0] & 0xE0 in _DOWNLOADS
        if is_write or (frame.can_id == 0 and frame.data[:1] == b"\x81"):
            for esc in self.escs:
                esc.sure = False

    def setting(self, node: int, entry: int, data: bytes) -> None:
        """A confirmed download to 2100h."""
        if node not in self.node_ids:
            return
        esc, value = self.escs[self.node_ids.index(node)], int.from_bytes(data, "little")
        match entry:
            case 1:
                esc.pole_pairs = value
            case 2:
                esc.gear = Fraction(value, esc.gear.denominator)
            case 3:
                esc.gear = Fraction(esc.gear.numerator, value)
            case 4:
                esc.timeout = value * 10**6
            case 7:
                esc.cells = value

    def sent(self, now: int, frame: drive.CanFrame) -> None:
        """A frame of the gateway."""
        for esc in self.escs:
            self._at(now, esc)
        self.count["frames"] += 1
        node = frame.can_id & 0x7F
        if not frame.extended and 0x180 < frame.can_id < 0x400 and node in self.node_ids:
            owner = self.escs[self.node_ids.index(node)]
            self._message(now, frame, self._pdos, frame.can_id - node + 1, owner)
        elif self.database is not None:
            self._message(now, frame, self.database, frame.can_id, None)

    def _message(
        self, now: int, frame: drive.CanFrame, database: Database, can_id: int, owner: Esc | None
    ) -> None:
        message = _by_id(database).get((can_id, frame.extended))
        if message is None:
            return
        if message.length != len(frame.data):
            self._note(now, f"{message.name}: {len(frame.data)} bytes")
            return
        raw: Any = message.decode(frame.data, decode_choices=False, scaling=False)
        for signal in message.signals:
            if signal.name in raw:
                named = (e for e in self.escs if e.prefix and signal.name.startswith(e.prefix))
                esc = owner or next(named, self.escs[0])
                self._signal(now, message.name, signal, raw[signal.name], esc, owner is not None)

    def _signal(
        self, now: int, message: str, signal: Signal, raw: float, esc: Esc, pdo: bool
    ) -> None:
        name = signal.name.removeprefix(esc.prefix)
        states = esc.passed or [esc.state]
        if name in self._flags:
            word, bit = self._flags[name]
            known = [s.live if word in LIVE else s.info for s in states]
            good = any(((values or {}).get(word, 0) >> bit & 1) == raw for values in known)
        elif name == "EscsOk":
            live = [{s.live is not None for s in e.passed or [e.state]} for e in self.escs]
            good = sum(map(min, live)) <= raw <= sum(map(max, live))
        else:
            plain = snake(name)
            row = (LIVE | INFO).get(plain, LIVE["battery_voltage"])
            unit = row.unit.replace("µ", "u")
            try:
                good = any(fits(signal, raw, expected(name, esc, s, now), unit) for s in states)
            except KeyError:
                return
            # CiA 301 has no code for what is not available: as it stands on the wire
            good = good or (pdo and any(s.live and raw == s.live.get(plain) for s in states))
        self.count["values"] += 1
        if not good:
            self._note(now, f"{message}.{signal.name} = {raw} with {states}")


@cache
def _by_id(database: Database) -> dict[tuple[int, bool], Any]:
    return {(each.frame_id, each.is_extended_frame): each for each in database.messages}


@cache
def _canopen_database() -> Database:
    return _dbc(["--canopen"])


def _dbc(words: list[str]) -> Database:
    with tempfile.TemporaryDirectory() as folder:
        with redirect_stderr(io.StringIO()):
            assert drive.command(["dbc", *words, "-o", f"{folder}/out.dbc"]) == 0
        return meaning.database(Path(f"{folder}/out.dbc").read_bytes())


def _dbc_of(configuration: str) -> Database:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.toml").write_text(configuration)
        return _dbc(["-c", f"{folder}/a.toml"])


@cache
def flags() -> dict[str, tuple[str, int]]:
    """Names of the shipped flags, in the order of their bits; each has a word of the sheet's row in it."""
    found: dict[str, tuple[str, int]] = {}
    for message, word, bits in (
        ("EscStatus", "operating_errors", sheet.OPERATING_BITS),
        ("EscInfo", "selftest_errors", sheet.SELFTEST_BITS),
    ):
        signals = [s for s in _dbc([]).get_message_by_name(message).signals if s.length == 1]
        for bit, signal in zip(bits, sorted(signals, key=lambda s: s.start), strict=True):
            plain = [re.sub("[^a-z]", "", text).removesuffix("s") for text in bit.words]
            assert any(text in signal.name.lower() for text in plain), (
                f"{signal.name} is not {bit.words}"
            )
            found[signal.name] = (word, bit.number)
    return found


def follow(found: Judge, steps: list[tuple[int, str, Any]]) -> Judge:
    """What happened, in order: bytes (ESC, what; None: the port is lost), frames <- and ->, settings that are written."""
    queues = []
    for index, esc in enumerate(found.escs):
        mine = [(now, what) for now, verb, what in steps if verb == "bytes" and what[0] == index]
        inputs = [(now, data) for now, (_, data) in mine]
        queues.append(iter(found_frames(inputs, esc.timeout)))
    for now, verb, what in steps:
        if verb == "bytes":
            found.given(now, what[0], next(queues[what[0]]))
        elif verb == "<-":
            found.received(scenario.read_frame(what))
        elif verb == "->":
            found.sent(now, scenario.read_frame(what))
        elif verb == "write":
            found.setting(*what)
    return found


def judge(file: Path) -> Judge:
    """Judge a flight or a dialogue."""
    header, lines = scenario.split(file.read_text(encoding="utf-8"))
    tables = tomllib.loads(header)
    escs = []
    for number, esc in enumerate(tables["esc"], 1):
        prefix = esc.get("name", f"esc{number}").title() if len(tables["esc"]) > 1 else ""
        timeout = esc.get("telemetry_timeout_ms", 250) * 10**6
        gear = Fraction(str(esc.get("gear", 1)))
        escs.append(Esc(prefix, esc.get("pole_pairs", 1), gear, esc.get("cell_count", 0), timeout))
    canopen, dbc = tables.get("canopen", {}), tables.get("dbc", {})
    node_ids = (
        [canopen.get("node_id", 1) + n for n in range(len(escs))] if canopen.get("enabled") else []
    )
    database = None
    if dbc.get("enabled", True):
        plain = re.sub(r"^\[golden[^\[]*", "", header, flags=re.MULTILINE)
        database = _dbc_of(plain.replace('"my_car.dbc"', f'"{scenario.INPUTS}/my_car.dbc"'))
    steps: list[tuple[int, str, Any]] = []
    for time, verb, *words in filter(None, (line.partition(";")[0].split() for line in lines)):
        now = scenario.nanoseconds(time)
        if verb in ("uart", "port_lost"):
            data = scenario.uart_bytes(words[1:]) if verb == "uart" else None
            steps.append((now, "bytes", (int(words[0]) - 1, data)))
        elif verb in ("<-", "->"):
            steps.append((now, verb, words[0]))
        elif verb == "write" and words[1].startswith("2100:") and "!" not in words:
            setting = int(words[0]), int(words[1][5:], 16), bytes.fromhex(words[2])
            steps.append((now, verb, setting))
    return follow(Judge(escs, database, node_ids), steps)


def files() -> list[Path]:
    """Each file that can be judged."""
    found = sorted([*HERE.glob("flights/*.txt"), *HERE.glob("dialogues/*.txt")])
    return [file for file in found if file.name not in NOT_JUDGED]
