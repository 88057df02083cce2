"""Runs the cores across every wrap of a time or a counter, with the oracle of years.c.

``WRAPS`` lists them. years_run.py runs the core in C for years.
"""

import ctypes as c
import sys
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "native"))

from built import built

from kontronik_can_gw.canopen.bound_values import compile_pdo
from kontronik_can_gw.canopen.dictionary import Variable
from kontronik_can_gw.canopen.eds import TYPE_BITS
from kontronik_can_gw.canopen.eds import load as load_eds
from kontronik_can_gw.canopen.objects import BINDINGS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.core.slots import SlotSettings
from kontronik_can_gw.desk.recordings.layouts import layout_of_dbc
from kontronik_can_gw.dronecan import wire
from kontronik_can_gw.dronecan.esc_report import fill, plans_of
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import Group, steps
from kontronik_can_gw.frames import EXTENDED, FIRST_PART, PARTS
from kontronik_can_gw.native.binding import load
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.objects import FOLDER, OPTIONS
from kontronik_can_gw.status import CanState, GatewayState
from kontronik_can_gw.times import END_OF_TIME, MS, SECOND

HERE = Path(__file__).resolve().parent
SETTINGS = EscSettings("esc", 7, Fraction(41, 12), 6)
"""As in years.c."""
STEP_NS = 10 * MS
YEAR_S = 365 * 86_400 + 86_400 // 4
DBC = shipped("dbc/kontronik_esc.dbc")
EDS = load_eds(shipped("eds/kontronik_esc.eds").read_bytes(), "kontronik_esc.eds")
ENTRIES = {(entry.index, entry.sub): entry for entry in EDS.entries}
PDOS = {
    0x181: ((0x2001, 4), (0x2001, 6)),
    0x182: ((0x2021, 3), (0x2021, 5)),
    0x183: ((0x2021, 7), (0x2021, 1)),
    0x184: ((0x2020, 2), (0x2020, 11), (0x2000, 6)),
}
"""Objects of the PDOs that the core in C runs."""
PDOS_IN_PYTHON = {
    0x185: ((0x2020, 5), (0x2020, 6)),
    0x186: ((0x2020, 7), (0x2020, 9)),
    0x187: ((0x2020, 10), (0x2020, 3), (0x2020, 4)),
}
"""Their values only Python has."""
TRANSFERS = {wire.STATUS: 10, wire.TEMPERATURE: 1}
"""Types of DroneCAN, and how often a second each is sent."""


_BEFORE = {
    "bytes": 20_000,
    "lives": 400,
    "infos": 4,
    "crc_errors": 4,
    "dropped": 160,
    "losses": 1,
    "sent": 1_000,
    "replaced": 4,
    "failures": 4,
    "restarts": 4,
    "energy_seconds": 40_000_000,
    "run_time": 5 * SECOND,
}
"""What each counter gains in about five seconds. The energy is in mW s."""
_TENTH_OF_WH = 360_000
"""In mW s."""


@dataclass(frozen=True)
class Wrap:
    """A number that a run crosses a few seconds after a jump in time."""

    name: str
    at_ns: int = 1_000_000 * SECOND
    """The time in the middle of the run."""
    started_ns: int = 0
    """The core was started at this time."""
    counters: dict[str, int] = field(default_factory=dict)
    """Counters, and the number that each of them reaches in the middle of the run."""
    silent_s: int = 0
    """The ESC is silent this long after the jump."""

    @property
    def preset(self) -> dict[str, int]:
        """The numbers after the jump."""
        return {name: number - _BEFORE[name] for name, number in self.counters.items()}

    def cross(self, run: "RunInC | RunInBoth", half_s: float) -> None:
        """Run a second, jump, and run ``half_s`` seconds before the wrap and after it."""
        numbers = run.oracle.numbers
        numbers.is_rushed = 1
        run.run(SECOND // STEP_NS)
        # no step is at the wrap itself
        begin = self.at_ns - int(half_s * SECOND) - STEP_NS // 3
        run.jump(begin, self.preset)
        numbers.silent_until = begin + self.silent_s * SECOND
        run.run(int(2 * half_s + self.silent_s) * SECOND // STEP_NS)
        numbers.silent_until = numbers.now + SECOND // 3
        run.run(SECOND // STEP_NS)


def _all(number: int, *without: str) -> dict[str, int]:
    return {name: number for name in _BEFORE if name not in without}


_TIMES = {
    "2^31 us": (1 << 31) * 1_000,
    "2^32 us": (1 << 32) * 1_000,
    "2^31 ms": (1 << 31) * MS,
    "2^32 ms": (1 << 32) * MS,
    "2^53 ns": 1 << 53,
    "2^60 ns": 1 << 60,
    "2^31 s": (1 << 31) * SECOND,
}
_COUNTS = {
    "2^8": _all(1 << 8, "bytes", "lives", "sent", "energy_seconds", "run_time"),
    "the limits of the DBC": {
        "crc_errors": 65_534,
        "dropped": 65_534,
        "losses": 254,
        "sent": 4_294_967_294,
        "replaced": 65_534,
        "failures": 65_534,
        "restarts": 14,
        "energy_seconds": 16_777_214 * _TENTH_OF_WH,
    },
    "2^16": _all(1 << 16, "energy_seconds", "run_time"),
    "2^31": _all(1 << 31, "run_time"),
    "2^32": _all(1 << 32, "run_time"),
    "2^31 of an object's steps": {
        "energy_seconds": (1 << 31) * _TENTH_OF_WH,
        "run_time": (1 << 31) * SECOND,
    },
    "2^32 of an object's steps": {"energy_seconds": (1 << 32) * _TENTH_OF_WH},
    "2^47": _all((1 << 47), "run_time"),
    "2^48 mW s": {"energy_seconds": 1 << 48},
    "2^53": {"energy_seconds": 1 << 53, "run_time": 1 << 53},
    "10 years of 100 kW": {"energy_seconds": 100_000_000 * 10 * YEAR_S},
}
WRAPS = (
    *(Wrap(f"time {name}", at, max(0, at - 90 * SECOND)) for name, at in _TIMES.items()),
    *(Wrap(f"uptime {name}", at + 5_000 * SECOND, 5_000 * SECOND) for name, at in _TIMES.items()),
    *(Wrap(f"counters {name}", counters=counts) for name, counts in _COUNTS.items()),
    Wrap("an age of 65.5 s", silent_s=70),
    Wrap("the end of time", END_OF_TIME - 80 * SECOND),
)


class Numbers(c.Structure):
    """The first fields of ``years`` in years.c."""

    _fields_ = (
        ("now", c.c_int64),
        ("started", c.c_int64),
        *((name, c.c_uint64) for name in ("sent", "replaced", "failures", "restarts")),
        *((name, c.c_uint64) for name in ("bytes", "lives", "infos")),
        *((name, c.c_uint64) for name in ("crc_errors", "dropped", "losses")),
        ("energy_seconds", c.c_uint64),
        ("energy_rest", c.c_uint64),
        ("run_time", c.c_int64),
        ("frames", c.c_uint64),
        ("steps", c.c_uint64),
        ("silent_until", c.c_int64),
        ("is_rushed", c.c_uint64),
        ("problem", c.c_char * 512),
    )


def build(folder: Path) -> Path:
    """Compile the core in C together with years.c. Return the path of both."""
    options = ("-O2", *OPTIONS, f"-I{FOLDER}", str(HERE / "years.c"))
    return built(folder / "years.so", *options)


def load_both(path: Path) -> Any:
    """Load the core in C together with years.c. Return both."""
    found = load(path)
    together = c.CDLL(str(path))
    pointer = c.c_void_p
    number = c.c_uint64
    time_ns = c.c_int64
    functions = {
        "make": (c.c_int,),
        "size": (c.c_size_t,),
        "start": (None, pointer, time_ns),
        "jump": (None, pointer, time_ns),
        "preset": (None, pointer, pointer),
        "pass": (None, pointer, time_ns),
        "step": (c.c_int, pointer, c.c_char_p),
        "pdo": (number, pointer, time_ns, c.c_uint32),
        "frame": (None, pointer, time_ns, c.c_uint32, c.c_char_p, c.c_int),
        "end_step": (None, pointer, c.c_int),
        "run": (c.c_int, pointer, pointer, number),
    }
    for name, (result, *arguments) in functions.items():
        function = getattr(together, f"years_{name}")
        function.restype = result
        function.argtypes = arguments
        setattr(found, f"years_{name}", function)
    assert found.years_make(), "the frames of the generator are ambiguous"
    return found


def add_slots(core: Any, now: int, with_python: bool) -> None:
    """Configure and start the PDOs and the DroneCAN messages of a core."""
    settings = []
    for cob_id, objects in (PDOS | (PDOS_IN_PYTHON if with_python else {})).items():
        mapped = []
        for index_and_sub in objects:
            variable = Variable(ENTRIES[index_and_sub])
            variable.bound = BINDINGS[index_and_sub]
            mapped.append(variable)
        timer_ns = 500 * MS if cob_id == 0x181 else SECOND
        settings.append(SlotSettings(compile_pdo(mapped), cob_id, True, 100 * MS, timer_ns))
    plans = plans_of(PROTOCOLS[0], "motor_speed", False)
    for place, (kind, rate) in enumerate(TRANSFERS.items()):
        period = SECOND // rate
        settings.append(
            SlotSettings(
                plan=plans[kind],
                can_id=wire.message_id(kind.number, 100, wire.LOW),
                by_event=True,
                inhibit_ns=period * 3 // 4,
                timer_ns=period * 5 // 4,
                fill=fill(kind, 3, 0),
                page=FIRST_PART + PARTS * place,
            )
        )
    for each in settings:
        slot = core.slot(0)
        slot.configure(each, now)
        slot.start(now)


def set_running(core: Any) -> None:
    core.status.state = GatewayState.RUNNING
    core.status.can_state = CanState.ERROR_ACTIVE


class Oracle:
    """A run: the generator and the oracle of years.c."""

    def __init__(self, library: Any, started: int) -> None:
        self.library = library
        self.memory = c.create_string_buffer(library.years_size())
        library.years_start(self.memory, started)
        self.numbers = Numbers.from_buffer(self.memory)
        self._bytes = c.create_string_buffer(256)

    @property
    def problem(self) -> str:
        return bytes(self.numbers.problem).decode()

    def jump(self, to: int, preset: dict[str, int]) -> None:
        """Let time jump, and change these numbers."""
        self.library.years_jump(self.memory, to)
        for name, number in preset.items():
            setattr(self.numbers, name, number)

    def step(self) -> bytes:
        """Make the next step. Return the bytes of the ESC."""
        size = self.library.years_step(self.memory, self._bytes)
        return self._bytes.raw[:size]


class RunInC:
    """The core in C, which runs in the loop of years.c."""

    def __init__(self, library: Any, started: int) -> None:
        self.oracle = Oracle(library, started)
        layout = layout_of_dbc(DBC).layout
        slots = len(PDOS) + len(TRANSFERS)
        self.core = NativeCore(library, CoreSettings((SETTINGS,), layout, slots=slots), started)
        set_running(self.core)
        add_slots(self.core, started, with_python=False)

    def jump(self, to: int, preset: dict[str, int]) -> None:
        """Let time jump, and change the numbers of the core and of the oracle."""
        self.oracle.jump(to, preset)
        self.oracle.library.years_preset(self.oracle.memory, self.core.core)

    def run(self, steps: int) -> None:
        """Raises AssertionError with the first difference."""
        self.oracle.library.years_run(self.oracle.memory, self.core.core, steps)
        assert not self.oracle.problem, self.oracle.problem


class RunInBoth:
    """The cores in Python and in C, which must make equal frames. The oracle checks them."""

    def __init__(self, library: Any, started: int) -> None:
        self.oracle = Oracle(library, started)
        layout = layout_of_dbc(DBC).layout
        slots = len(PDOS) + len(PDOS_IN_PYTHON) + len(TRANSFERS)
        self.native = NativeCore(library, CoreSettings((SETTINGS,), layout, slots=slots), started)
        self.python = PythonCore(CoreSettings((SETTINGS,), layout), started)
        self.cores = (self.python, self.native)
        for core in self.cores:
            set_running(core)
            add_slots(core, started, with_python=True)

    def jump(self, to: int, preset: dict[str, int]) -> None:
        """Let time jump, and change the numbers of both cores and of the oracle."""
        self.oracle.jump(to, preset)
        self.oracle.library.years_preset(self.oracle.memory, self.native.core)
        numbers = self.oracle.numbers
        esc: Any = self.python.escs[0]
        counters = esc.decoder.counters
        counters.bytes = numbers.bytes
        counters.live_v4 = numbers.lives
        counters.info_v4 = numbers.infos
        counters.crc_errors = numbers.crc_errors
        counters.dropped_noise = numbers.dropped
        counters.dropped_crc = 0
        esc.decoder._base = numbers.bytes
        esc.decoder._rejected_until = numbers.bytes
        esc.losses = numbers.losses
        esc.energy_mw_ns = numbers.energy_seconds * SECOND + numbers.energy_rest
        esc.run_time_ns = numbers.run_time
        self._give_gateway()

    def run(self, steps: int) -> None:
        """Raises AssertionError with the first difference."""
        oracle = self.oracle
        numbers = oracle.numbers
        for _ in range(steps):
            after = numbers.now + STEP_NS
            now = numbers.now
            while (due := self.python.next_deadline()) <= after:
                assert due == self.native.next_deadline()
                now = max(now, due)
                oracle.library.years_pass(oracle.memory, now)
                for core in self.cores:
                    core.advance(now)
                self._take(now)
            data = oracle.step()
            self._give_gateway()
            if data:
                for core in self.cores:
                    core.receive(0, data, after, after)
            self._take(after)
            oracle.library.years_end_step(oracle.memory, 2)
            assert not oracle.problem, oracle.problem
            if numbers.steps % (SECOND // STEP_NS) == 0:
                self._read_objects(after)

    def _read_objects(self, now: int) -> None:
        """Read the objects of the PDOs as SDO does. An unavailable value is all ones here."""
        for cob_id, objects in (PDOS | PDOS_IN_PYTHON).items():
            right = self.oracle.library.years_pdo(self.oracle.memory, now, cob_id)
            if any(BINDINGS[place].source.group is Group.LIVE for place in objects):
                continue  # after a loss it is not sent, but SDO has an answer
            for core in self.cores:
                bits = at = 0
                for place in objects:
                    length = TYPE_BITS[ENTRIES[place].data_type]
                    high = (1 << length) - 1
                    bound = BINDINGS[place]
                    esc = core.escs[0]
                    value = bound.shown(esc, steps(bound.source, esc, core.status, now), high)
                    bits |= (high if value is None else value) << at
                    at += length
                assert bits == right, f"SDO of {cob_id:X}h: {bits:016x} instead of {right:016x}"

    def _take(self, now: int) -> None:
        oracle = self.oracle
        frames = self.python.take(now)
        assert frames == self.native.take(now), f"at {now} ns the cores differ"
        for frame in frames:
            can_id = frame.can_id | (EXTENDED if frame.extended else 0)
            size = len(frame.data)
            oracle.library.years_frame(oracle.memory, now, can_id, frame.data, size)
        oracle.numbers.sent += len(frames)
        self._give_gateway()
        assert not oracle.problem, oracle.problem

    def _give_gateway(self) -> None:
        numbers = self.oracle.numbers
        for core in self.cores:
            status = core.status
            status.sent_frames = numbers.sent
            status.replaced_frames = numbers.replaced
            status.send_failures = numbers.failures
            status.can_restarts = numbers.restarts
