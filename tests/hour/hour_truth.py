"""A capture of one ESC, made without waiting, and the values that the simulated ESC sent.

The capture has any length. It contains dropouts, an unplugged port, swapped devices (one without a
BEC current), errors for a while, problems of the bus, and a change of the wall clock. The judge of
the golden set (tests/golden/judge.py) computes the correct values from the frames and the protocol
specification.
"""

import random
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "golden"))

import judge
import judged_esc
import meaning
import numpy as np
from cantools.database.can.signal import Signal
from capture_bench import START, Bench, capture_file, made
from esc.reference import form_row
from numpy.typing import NDArray

from kontronik_can_gw.capture.format import Entry, EntryKind, numbers_data
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.simulator import (
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    SimulatedEsc,
    Swap,
)
from kontronik_can_gw.esc.kontronik.simulator import SimulatedFrame as Wired
from kontronik_can_gw.esc.kontronik.states import Device, OperatingError, SelfTestError
from kontronik_can_gw.status import CanState

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

MS = 1_000_000
SECOND = 1000 * MS
WALL = 1_790_000_000 * SECOND + 250_004_000
CLOCK_STEP = 1_500_250_000
"""The wall clock is moved by this time in the middle."""
BYTE_NS = 11 * SECOND // 115_200
SAME_ROW_NS = 5 * MS
"""Info data received within this time after the start of a row is part of that row."""
POLE_PAIRS = 5
GEAR = Fraction(17, 2)


def options_of(length: int) -> EscOptions:
    """Return the options of the ESC, with the faults of a flight of this length in ns."""
    # every time is a share of the length
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
    """A capture of this many seconds at ``path``, and its correct values at any time."""

    def __init__(self, path: Path, seconds: float) -> None:
        self.path = path
        self.length = int(seconds * SECOND)
        self.end_ns = START + self.length
        self.clock_set_ns = START + self.length // 2 + 1
        lost = START + self.length * 7 // 10
        self.unplugged = lost, lost + min(4 * SECOND, self.length // 15)
        of_esc: dict[str, object] = {"name": "esc1", "pole_pairs": POLE_PAIRS, "gear": str(GEAR)}
        bench = Bench(*made(1, of_esc=lambda _: of_esc))
        wired = self._record(bench)
        path.write_bytes(capture_file(bench.setup, bench.entries, wall_ns=WALL))
        self.wire = b"".join(one.wire for one in wired)
        self._keep_sent(bench)
        self._read_dbc(bench)
        self._inputs: list[tuple[int, judged_esc.Arrivals | None]] = [(lost, None)]
        for one in wired:
            kind = "live" if isinstance(one.data, LiveData) else "info"
            is_v4 = len(one.wire) == form_row(kind, "v4").length
            layout = "v4" if is_v4 else "legacy"
            end = one.time_ns + len(one.wire) * BYTE_NS
            self._inputs.append((end, [(kind, layout, one.data._asdict(), end)]))
        self._inputs.sort(key=lambda given: given[0])
        self.flags = judge.flags()
        self._rows = self._follow()
        self.row_ns = np.array([now for now, *_ in self._rows], np.int64)

    def _keep_sent(self, bench: Bench) -> None:
        """Keep the frames given to the interface, with their times."""
        self._sent = [(one.time_ns, one.frame) for one in bench.sent]
        frames = [frame for _, frame in self._sent]
        data = b"".join(frame.data for frame in frames)
        self.sent_ns = np.array([now for now, _ in self._sent], np.int64)
        self.sent_ids = np.array([frame.can_id for frame in frames], np.int64)
        self.sent_data = np.frombuffer(data, "<u8").copy()

    def _read_dbc(self, bench: Bench) -> None:
        """Read the signals of the DBC, their texts and their units, by the names of columns."""
        assert bench.setup.dbc is not None
        self.database = meaning.database(bench.setup.dbc[1])
        self.signals: dict[str, Signal] = {}
        self.texts: dict[str, dict[str, float]] = {}
        self.units: dict[str, str] = {}
        signs = {"degC": "°C", "us": "µs"}
        for message in self.database.messages:
            for signal in message.signals:
                name = value_name(signal.name)
                unit = signal.unit or ""
                texts = {}
                for number, text in (signal.choices or {}).items():
                    texts[str(text).casefold()] = float(number)
                self.signals[name] = signal
                self.texts[name] = texts
                self.units[name] = signs.get(unit, unit)

    def _record(self, bench: Bench) -> list[Wired]:
        """Let the gateway run. Returns the frames sent on the line.

        A frame is read whole or in two pieces.
        """
        gateway = bench.gateway
        chance = random.Random(1)
        wired: list[Wired] = []

        lost, again = self.unplugged
        trouble = START + self.length // 4
        wall = self.clock_set_ns - START + WALL + CLOCK_STEP
        clock = Entry(self.clock_set_ns, EntryKind.CLOCK, 0, numbers_data(wall))
        happenings: list[tuple[int, Callable[[int], object]]] = [
            (trouble, lambda at: gateway.set_can_state(CanState.ERROR_WARNING, at)),
            (trouble + 2 * SECOND, lambda at: gateway.set_can_state(CanState.ERROR_ACTIVE, at)),
            (self.clock_set_ns, lambda _: bench.entries.append(clock)),
            (lost, lambda at: gateway.port(0, False, at)),
            (again, lambda at: gateway.port(0, True, at)),
        ]

        def happens(what: Callable[[int], object], at: int) -> None:
            due = gateway.next_deadline()
            while due < at:
                gateway.advance(due)
                bench.take(due)
                due = gateway.next_deadline()
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
        """Return Unix times in ns."""
        steps = np.where(times >= self.clock_set_ns, CLOCK_STEP, 0)
        wall: Times = times - START + WALL + steps
        return wall

    def judged_frames(self) -> judge.Judge:
        """Judge every frame given to the interface by the values of the ESC."""
        found = judge.Judge([_esc()], self.database, [])
        steps: list[tuple[int, int, Any]] = []
        steps += [(now, 0, given) for now, given in self._inputs]
        steps += [(now, 1, frame) for now, frame in self._sent]
        for now, is_frame, what in sorted(steps, key=lambda step: step[:2]):
            if is_frame:
                found.sent(now, what)
            else:
                found.given(now, 0, what)
        return found

    def columns(self) -> dict[str, Floats]:
        """Return the columns of a table that follow from the values of the ESC.

        There is a row at each of ``row_ns``. Texts are numbers, and NaN means not available.
        """
        found = {}
        for name, signal in self.signals.items():
            try:
                values = [self._value(signal.name, now, state) for _, now, state in self._rows]
            except KeyError:  # computed by the gateway alone
                continue
            found[name] = np.array(values, np.float64)
        return found

    def _value(self, signal: str, now: int, state: judged_esc.State) -> float:
        if signal in self.flags:
            word, bit = self.flags[signal]
            values = state.live if word in judged_esc.LIVE else state.info
            return np.nan if values is None else values[word] >> bit & 1
        value = judged_esc.expected(signal, _esc(), state, now)
        return np.nan if value is None else float(value)

    def _follow(self) -> list[tuple[int, int, judged_esc.State]]:
        """Return a row for each live frame and each loss of the ESC.

        A row has its time, the time at which its last frame was read, and the state at that time.
        """
        esc = _esc()
        rows: list[tuple[int, int, judged_esc.State]] = []
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


def _esc() -> judged_esc.Esc:
    return judged_esc.Esc("", POLE_PAIRS, GEAR)


def value_name(signal: str) -> str:
    """Return the name of a signal's column in a table, which is the name of its value."""
    return judged_esc.snake(signal)
