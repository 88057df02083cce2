"""A capture of any length of one ESC, made without waiting, and the truth of it: what the simulated ESC meant, frame by frame.

In it: dropouts, a port that is unplugged, devices that are swapped (one gives no BEC current), errors for a while, a bus in trouble, a wall
clock that is set. What follows from the frames is worked out by the golden set's judge (tests/golden/judge.py), by the sheet.
"""

import random
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "golden"))

import judge
import meaning
import numpy as np
from capture_bench import START, Bench, capture_file, made
from esc.reference import form_row
from numpy.typing import NDArray

from kontronik_can_gw.capture.format import Entry, Kind, numbers_data
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.simulator import (
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    SimulatedEsc,
    Swap,
)
from kontronik_can_gw.esc.kontronik.simulator import Sent as Wired
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError, SelfTestError
from kontronik_can_gw.status import CanState

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

MS = 1_000_000
SECOND = 1000 * MS
WALL = 1_790_000_000 * SECOND + 250_004_000
CLOCK_STEP = 1_500_250_000
"""The wall clock is set by so much in the middle."""
BYTE_NS = 11 * SECOND // 115_200
SAME_ROW_NS = 5 * MS
"""What comes so soon after a row's begin belongs to it."""
POLE_PAIRS, GEAR = 5, Fraction(17, 2)


def options_of(length: int) -> EscOptions:
    """What ESC it is, and what happens to it in so many ns."""
    windows = (
        ErrorWindow(OperatingError.UNDERVOLTAGE, length // 5, length // 20),
        ErrorWindow(OperatingError.OPERATING_ERROR_FOUND, length // 5, length // 19),
        ErrorWindow(OperatingError.BEC_OVERTEMPERATURE, length * 3 // 5, length // 30),
        ErrorWindow(SelfTestError.TEST_EEPROM_VERSION, length // 2, length // 10),
    )
    swaps = (
        Swap(length * 2 // 5 + 3 * MS, Device.JIVEPRO),
        Swap(length * 4 // 5 + 3 * MS, Device.KOSMIK),
    )
    dropout = Dropout(2 * SECOND, min(400 * SECOND, int(length / 3.7)))
    return EscOptions(faults=Faults(dropout=dropout, errors=windows, swaps=swaps))


class Truth:
    """A capture of so many seconds at ``path``, and what is true of it at any time."""

    def __init__(self, path: Path, seconds: float) -> None:
        self.path, self.length = path, int(seconds * SECOND)
        self.end_ns = START + self.length
        self.clock_set_ns = START + self.length // 2 + 1
        lost = START + self.length * 7 // 10
        self.unplugged = lost, lost + min(4 * SECOND, self.length // 15)
        of_esc: dict[str, object] = {"name": "esc1", "pole_pairs": POLE_PAIRS, "gear": str(GEAR)}
        bench = Bench(*made(1, of_esc=lambda _: of_esc))
        wired = self._record(bench)
        path.write_bytes(capture_file(bench.setup, bench.entries, wall_ns=WALL))
        self.wire = b"".join(one.wire for one in wired)
        self._sent = [(one.time_ns, one.frame) for one in bench.sent]
        self.sent_ns = np.array([now for now, _ in self._sent], np.int64)
        self.sent_ids = np.array([frame.can_id for _, frame in self._sent], np.int64)
        self.sent_data = np.frombuffer(b"".join(f.data for _, f in self._sent), "<u8").copy()
        assert bench.setup.dbc is not None
        self.database = meaning.database(bench.setup.dbc[1])
        self.signals = {
            value_name(signal.name): signal
            for message in self.database.messages
            for signal in message.signals
        }
        self.texts = {
            name: {str(text).casefold(): float(n) for n, text in (signal.choices or {}).items()}
            for name, signal in self.signals.items()
        }
        signs = {"degC": "°C", "us": "µs", None: ""}
        self.units = {name: signs.get(one.unit, one.unit) for name, one in self.signals.items()}
        self._inputs: list[tuple[int, judge.Arrivals | None]] = [(lost, None)]
        for one in wired:
            kind = "live" if isinstance(one.data, LiveData) else "info"
            is_v4 = len(one.wire) == form_row(kind, "v4").length
            end = one.time_ns + len(one.wire) * BYTE_NS
            meant = kind, "v4" if is_v4 else "legacy", one.data._asdict(), end
            self._inputs.append((end, [meant]))
        self._inputs.sort(key=lambda given: given[0])
        self.flags = judge.flags()
        self._rows = self._follow()
        self.row_ns = np.array([now for now, *_ in self._rows], np.int64)

    def _record(self, bench: Bench) -> list[Wired]:
        """Let the gateway run; the frames that left on the line. A frame comes whole or in two pieces."""
        gateway, chance = bench.gateway, random.Random(1)
        wired: list[Wired] = []

        lost, again = self.unplugged
        trouble, wall = START + self.length // 4, self.clock_set_ns - START + WALL + CLOCK_STEP
        clock = Entry(self.clock_set_ns, Kind.CLOCK, 0, numbers_data(wall))
        happenings: list[tuple[int, Callable[[int], object]]] = [
            (trouble, lambda at: gateway.set_can_state(CanState.ERROR_WARNING, at)),
            (trouble + 2 * SECOND, lambda at: gateway.set_can_state(CanState.ERROR_ACTIVE, at)),
            (self.clock_set_ns, lambda _: bench.entries.append(clock)),
            (lost, lambda at: gateway.port(0, False, at)),
            (again, lambda at: gateway.port(0, True, at)),
        ]

        def happens(what: Callable[[int], object], at: int) -> None:
            while (due := gateway.next_deadline()) < at:
                gateway.advance(due)
                bench.take(due)
            what(at)
            gateway.advance(at)
            bench.take(at)

        def read(data: bytes, at: int) -> None:
            while happenings and happenings[0][0] <= at:
                when, what = happenings.pop(0)
                happens(what, when)
            happens(lambda at: gateway.receive_bytes(0, data, at, at), at)

        gateway.port(0, True, START)
        gateway.start(START)
        bench.take(START)
        esc = SimulatedEsc(options_of(self.length), seed=1, start_ns=START + 5 * MS)
        for one in esc.frames_until(self.end_ns):
            last = one.time_ns + len(one.wire) * BYTE_NS
            if last >= self.end_ns or (lost <= last and one.time_ns <= again):
                continue
            cut = chance.randrange(1, len(one.wire)) if wired else 0
            wired.append(one)
            if cut and chance.random() < 0.15:
                read(one.wire[:cut], one.time_ns + cut * BYTE_NS)
                read(one.wire[cut:], last)
            else:
                read(one.wire, last)
        happens(gateway.stop, self.end_ns)
        return wired

    def wall_ns(self, times: Times) -> Times:
        """Unix time in ns."""
        wall: Times = times - START + WALL + np.where(times >= self.clock_set_ns, CLOCK_STEP, 0)
        return wall

    def judged_frames(self) -> judge.Judge:
        """Every frame that was handed to the interface against what the ESC meant."""
        found = judge.Judge([_esc()], self.database, [])
        steps: list[tuple[int, int, Any]] = [(now, 0, given) for now, given in self._inputs]
        steps += [(now, 1, frame) for now, frame in self._sent]
        for now, is_frame, what in sorted(steps, key=lambda step: step[:2]):
            if is_frame:
                found.sent(now, what)
            else:
                found.given(now, 0, what)
        return found

    def columns(self) -> dict[str, Floats]:
        """Those of a table that follow from what the ESC meant: a row at each of ``row_ns``; NaN: not available; texts as numbers."""
        found = {}
        for name, signal in self.signals.items():
            try:
                values = [self._value(signal.name, now, state) for _, now, state in self._rows]
            except KeyError:  # only the gateway knows it
                continue
            found[name] = np.array(values, np.float64)
        return found

    def _value(self, signal: str, now: int, state: judge.State) -> float:
        if signal in self.flags:
            word, bit = self.flags[signal]
            values = state.live if word in judge.LIVE else state.info
            return np.nan if values is None else values[word] >> bit & 1
        value = judge.expected(signal, _esc(), state, now)
        return np.nan if value is None else float(value)

    def _follow(self) -> list[tuple[int, int, judge.State]]:
        """A row with each live frame and each loss of the ESC: its time, when the last of it was read, and what was known then."""
        esc, rows = _esc(), list[tuple[int, int, judge.State]]()
        for now, arrivals in [*self._inputs, (self.end_ns, [])]:
            before = esc.state
            due = (before.live_ns or 0) + esc.timeout + 1
            if esc.expire(now) and before.live is not None and esc.state.live is None:
                rows.append((due, due, esc.state))
            if arrivals is None:
                esc.lose()
                rows.append((now, now, esc.state))
            for kind, layout, values, when in arrivals or ():
                esc.take(kind, layout, values, when)
                if kind == "live":
                    rows.append((now, now, esc.state))
                elif now - rows[-1][0] <= SAME_ROW_NS:
                    rows[-1] = rows[-1][0], now, esc.state
        return rows


def _esc() -> judge.Esc:
    return judge.Esc("", POLE_PAIRS, GEAR)


def value_name(signal: str) -> str:
    """How a table calls a signal of the DBC: by the value that it holds."""
    text = signal.removesuffix("Percent")
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in text).lstrip("_")
