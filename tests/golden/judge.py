"""Checks that the recorded values of flights and dialogues are right.

judged_esc.py finds the data of the ESCs by brute force (with tests/esc/reference.py) and computes
the correct values (with tests/specification and tests/signals/packer_oracle.py). cantools decodes
the frames. From the product the judge uses only the DBC of a configuration, as text.
"""

import io
import re
import sys
import tempfile
import tomllib
from collections import Counter
from contextlib import redirect_stderr
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [
    str(HERE),
    str(HERE.parent),
    str(HERE.parent / "signals"),
    str(HERE.parents[1]),
]

import drive  # noqa: E402
import meaning  # noqa: E402
import scenario  # noqa: E402
import specification  # noqa: E402
from cantools.database.can import Database  # noqa: E402
from cantools.database.can.signal import Signal  # noqa: E402
from judged_esc import (  # noqa: E402
    INFO,
    LIVE,
    Arrivals,
    Esc,
    expected,
    fits,
    found_frames,
    snake,
)

_DOWNLOADS = 0x20, 0xC0
"""Commands with which an SDO client begins to write (CiA 301, 7.2.4.3).

The first is for a frame or segments, the second for blocks.
"""
NOT_JUDGED = ("no_start_values.txt",)
"""Flags without a start value become 1 on loss, a false alarm and a known defect (README.md)."""


class Judge:
    """The judgement of one golden file.

    ``wrong`` has a line for each wrong value, ``count`` the numbers of judged frames and values.
    """

    def __init__(
        self,
        escs: list[Esc],
        database: Database | None,
        node_ids: list[int],
    ) -> None:
        self.escs = escs
        self.database = database
        self.node_ids = node_ids
        self.wrong: list[str] = []
        self.count: Counter[str] = Counter()
        self._now = -1
        self._pdos = _canopen_database()
        self._flags = flags()

    def given(self, now: int, index: int, arrivals: Arrivals | None) -> None:
        """Receive an input of an ESC. None means that its port was lost."""
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
        """Receive a frame from the bus.

        The judge does not understand a master's own writes to 2100h, nor a reset of the node.
        """
        is_write = frame.data[1:3] == b"\x00\x21" and frame.data[0] & 0xE0 in _DOWNLOADS
        if is_write or (frame.can_id == 0 and frame.data[:1] == b"\x81"):
            for esc in self.escs:
                esc.sure = False

    def setting(self, node: int, entry: int, data: bytes) -> None:
        """Apply a confirmed download to 2100h."""
        if node not in self.node_ids:
            return
        esc = self.escs[self.node_ids.index(node)]
        value = int.from_bytes(data, "little")
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
        """Judge a frame of the gateway."""
        for esc in self.escs:
            self._at(now, esc)
        self.count["frames"] += 1
        node = frame.can_id & 0x7F
        is_pdo = not frame.extended and 0x180 < frame.can_id < 0x400
        if is_pdo and node in self.node_ids:
            owner = self.escs[self.node_ids.index(node)]
            self._message(now, frame, self._pdos, frame.can_id - node + 1, owner)
        elif self.database is not None:
            self._message(now, frame, self.database, frame.can_id, None)

    def _message(
        self,
        now: int,
        frame: drive.CanFrame,
        database: Database,
        can_id: int,
        owner: Esc | None,
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
                esc = owner or self._named_in(signal.name)
                self._signal(now, message.name, signal, raw[signal.name], esc, owner is not None)

    def _named_in(self, signal: str) -> Esc:
        """Return the ESC with whose name a signal begins, or the first ESC."""
        named = (esc for esc in self.escs if esc.prefix and signal.startswith(esc.prefix))
        return next(named, self.escs[0])

    def _signal(
        self,
        now: int,
        message: str,
        signal: Signal,
        raw: float,
        esc: Esc,
        pdo: bool,
    ) -> None:
        name = signal.name.removeprefix(esc.prefix)
        states = esc.passed or [esc.state]
        if name in self._flags:
            word, bit = self._flags[name]
            known = [state.live if word in LIVE else state.info for state in states]
            bits = [(values or {}).get(word, 0) >> bit & 1 for values in known]
            good = raw in bits
        elif name == "EscsOk":
            good = self._is_count_of_live(raw)
        else:
            plain = snake(name)
            row = (LIVE | INFO).get(plain, LIVE["battery_voltage"])
            unit = row.unit.replace("µ", "u")
            try:
                values = [expected(name, esc, state, now) for state in states]
            except KeyError:
                return
            good = any(fits(signal, raw, value, unit) for value in values)
            if pdo and not good:
                # CiA 301 has no code for "not available", so the value of the UART frame is sent
                good = any(state.live and raw == state.live.get(plain) for state in states)
        self.count["values"] += 1
        if not good:
            self._note(now, f"{message}.{signal.name} = {raw} with {states}")

    def _is_count_of_live(self, raw: float) -> bool:
        """Return True if so many ESCs have had live data since the last input."""
        least = 0
        most = 0
        for esc in self.escs:
            is_live = [state.live is not None for state in esc.passed or [esc.state]]
            least += min(is_live)
            most += max(is_live)
        return least <= raw <= most


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
    """Return the word and the bit of each shipped flag.

    The flags are in the order of their bits. The name of each has a word of its row in the protocol
    specification.
    """
    found: dict[str, tuple[str, int]] = {}
    for message, word, bits in (
        ("EscStatus", "operating_errors", specification.OPERATING_BITS),
        ("EscInfo", "selftest_errors", specification.SELFTEST_BITS),
    ):
        signals = _dbc([]).get_message_by_name(message).signals
        single = [signal for signal in signals if signal.length == 1]
        single.sort(key=lambda signal: signal.start)
        for bit, signal in zip(bits, single, strict=True):
            plain = [re.sub("[^a-z]", "", text).removesuffix("s") for text in bit.words]
            name = signal.name.lower()
            assert any(text in name for text in plain), f"{signal.name} is not {bit.words}"
            found[signal.name] = (word, bit.number)
    return found


def follow(found: Judge, steps: list[tuple[int, str, Any]]) -> Judge:
    """Judge all steps of a file, which are in the order of time.

    A step is ``bytes`` with the number of an ESC and its input, ``<-`` or ``->`` with a frame, or
    ``write`` with a setting.
    """
    queues = []
    for index, esc in enumerate(found.escs):
        inputs = []
        for now, verb, what in steps:
            if verb == "bytes" and what[0] == index:
                inputs.append((now, what[1]))
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
        made = Esc(
            prefix,
            pole_pairs=esc.get("pole_pairs", 1),
            gear=Fraction(str(esc.get("gear", 1))),
            cells=esc.get("cell_count", 0),
            timeout=esc.get("telemetry_timeout_ms", 250) * 10**6,
        )
        escs.append(made)
    canopen = tables.get("canopen", {})
    node_ids = []
    if canopen.get("enabled"):
        first = canopen.get("node_id", 1)
        node_ids = list(range(first, first + len(escs)))
    database = None
    if tables.get("dbc", {}).get("enabled", True):
        plain = re.sub(r"^\[golden[^\[]*", "", header, flags=re.MULTILINE)
        database = _dbc_of(plain.replace('"my_car.dbc"', f'"{scenario.INPUTS}/my_car.dbc"'))
    return follow(Judge(escs, database, node_ids), _steps(lines))


def _steps(lines: list[str]) -> list[tuple[int, str, Any]]:
    """Return the steps of a scenario's lines that the judge needs, as ``follow`` describes them."""
    steps: list[tuple[int, str, Any]] = []
    for line in lines:
        body = line.partition(";")[0].split()
        if not body:
            continue
        time, verb, *words = body
        now = scenario.nanoseconds(time)
        if verb in ("uart", "port_lost"):
            data = scenario.uart_bytes(words[1:]) if verb == "uart" else None
            steps.append((now, "bytes", (int(words[0]) - 1, data)))
        elif verb in ("<-", "->"):
            steps.append((now, verb, words[0]))
        elif verb == "write" and words[1].startswith("2100:") and "!" not in words:
            node = int(words[0])
            entry = int(words[1].removeprefix("2100:"), 16)
            steps.append((now, verb, (node, entry, bytes.fromhex(words[2]))))
    return steps


def files() -> list[Path]:
    """Return all files that can be judged."""
    found = sorted([*HERE.glob("flights/*.txt"), *HERE.glob("dialogues/*.txt")])
    return [file for file in found if file.name not in NOT_JUDGED]
