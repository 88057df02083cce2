"""A capture of any length of one ESC, made without waiting, and the truth of it: what the simulated ESC meant, frame by frame.

In it: dropouts, a port that is unplugged, devices that are swapped (one gives no BEC current), errors for a while, a bus in trouble, a wall
clock that is set. The truth is computed with numpy, by the protocol's page and the DBC's comments; nothing of it is taken from the program
that is checked, but names of fields and the CAN frames that were handed to the interface. NaN: not available. Texts are their numbers.
"""

import random
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cantools.database
import numpy as np
from cantools.database.can import Database
from capture_bench import START, Bench, capture_file, made
from esc.sheet import INFO_FIELDS, LIVE_FIELDS
from numpy.typing import NDArray

from kontronik_can_gw.capture.format import Entry, Kind, numbers_data
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
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
from kontronik_can_gw.gateway_status import CanState

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

MS = 1_000_000
SECOND = 1000 * MS
WALL = 1_790_000_000 * SECOND + 250_004_000
CLOCK_STEP = 1_500_250_000
"""The wall clock is set by so much in the middle."""
BYTE_NS = 11 * SECOND // 115_200
TIMEOUT_NS, INFO_TIMEOUT_NS = 250 * MS, 10 * SECOND
SAME_ROW_NS = 5 * MS
"""What comes so soon after a row's begin belongs to it."""
POLE_PAIRS, GEAR, CELLS = 5, Fraction(17, 2), 6
STEPS = {one.name: one.steps for one in (*LIVE_FIELDS, *INFO_FIELDS)}
_OPERATING_ERRORS = """
    undervoltage overvoltage overcurrent_integral_error overcurrent_integral_warning power_stage_overtemp_warning
    power_stage_overtemp_error bec_undervoltage bec_overvoltage bec_overcurrent bec_overtemperature
    switched_off_by_running_down capacity_limit_reached operating_error_found operating_warning_found selftest_error
    eeprom_error watchdog_error_tripped programming_allowed limit_battery_voltage_minimum limit_current_maximum
    limit_power_stage_temperature limit_bec_temperature limit_bec_current limit_discharged_capacity
"""
OPERATING_ERRORS = tuple(_OPERATING_ERRORS.split())
_SELFTEST_ERRORS = """
    test_phase_low_side test_phase_high_side test_short_to_ground test_back_emf_offset test_current_zero_point
    test_undervoltage test_overvoltage test_bec_undervoltage test_bec_overvoltage test_reverse_polarity_fuse
    test_overvoltage_fuse test_power_stage_overtemp test_bec_overtemperature test_motor_phase_missing test_eeprom_empty
    test_eeprom_stick_positions test_eeprom_checksum test_eeprom_size test_eeprom_version
"""
SELFTEST_ERRORS = tuple(_SELFTEST_ERRORS.split())


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
        lives, infos = self._record(bench)
        path.write_bytes(capture_file(bench.setup, bench.entries, wall_ns=WALL))
        self.sent_ns = np.array([one.time_ns for one in bench.sent], np.int64)
        self.sent_ids = np.array([one.frame.can_id for one in bench.sent], np.int64)
        self.sent_data = np.frombuffer(b"".join(o.frame.data for o in bench.sent), "<u8").copy()
        self.wire = b"".join(one.wire for one in sorted((*lives, *infos)))
        assert bench.setup.dbc is not None
        database = cantools.database.load_string(bench.setup.dbc[1].decode("latin-1"), "dbc")
        assert isinstance(database, Database)
        self.database = database
        signals = [signal for message in database.messages for signal in message.signals]
        self.texts = {
            value_name(signal.name): {
                str(text).casefold(): float(number)
                for number, text in (signal.choices or {}).items()
            }
            for signal in signals
        }
        signs = {"degC": "°C", "us": "µs", None: ""}
        self.units = {value_name(one.name): signs.get(one.unit, one.unit) for one in signals}
        self._understand(lives, infos)

    def _record(self, bench: Bench) -> tuple[list[Wired], list[Wired]]:
        """Let the gateway run; the live and info frames that left on the line. A frame comes whole or in two pieces."""
        gateway, chance = bench.gateway, random.Random(1)
        lives: list[Wired] = []
        infos: list[Wired] = []

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
            (lives if isinstance(one.data, LiveData) else infos).append(one)
            cut = chance.randrange(1, len(one.wire)) if len(lives) > 1 else 0
            if cut and chance.random() < 0.15:
                read(one.wire[:cut], one.time_ns + cut * BYTE_NS)
                read(one.wire[cut:], last)
            else:
                read(one.wire, last)
        happens(gateway.stop, self.end_ns)
        return lives, infos

    def _understand(self, lives: list[Wired], infos: list[Wired]) -> None:
        """Columns of what was meant, when it ended, and what follows from it."""

        def columns(frames: list[Wired], names: tuple[str, ...]) -> tuple[Times, dict[str, Times]]:
            ends = [one.time_ns + len(one.wire) * BYTE_NS for one in frames]
            table = np.array([one.data for one in frames], np.int64)
            return np.array(ends, np.int64), dict(zip(names, table.T.copy(), strict=True))

        self.live_ns, self.live = columns(lives, LiveData._fields)
        self.info_ns, self.info = columns(infos, InfoData._fields)
        self.legacy = np.array([len(one.wire) == 38 for one in lives], np.int64)
        swaps = [START + 5 * MS + one.time_ns for one in options_of(self.length).faults.swaps]
        begun = [one.time_ns for one in lives]
        self.is_jive = np.searchsorted(swaps, begun, "right") == 1
        following = np.append(self.live_ns[1:], self.end_ns)
        over = self.live_ns[following - self.live_ns > TIMEOUT_NS] + TIMEOUT_NS + 1
        lost = self.unplugged[0]
        was_out = (over > lost) & (over <= lost + TIMEOUT_NS + 1)
        self.timed_out_ns = over[~was_out & (over < self.end_ns)]
        self.lost_ns = np.sort(np.append(self.timed_out_ns, lost))
        """When fresh data ended."""
        changes = np.flatnonzero(np.diff(self.legacy)) + 1
        self.forgotten_ns = np.sort(np.concatenate((self.lost_ns, self.live_ns[changes])))
        """When the device on the line was not known any more."""
        self.row_ns = np.sort(np.concatenate((self.live_ns, self.lost_ns)))
        after = np.append(self.info_ns, 1 << 62)[np.searchsorted(self.info_ns, self.row_ns)]
        self.until_ns = np.where(after - self.row_ns <= SAME_ROW_NS, after, self.row_ns)
        """When the last of each row was read."""
        spans = np.append(0, np.diff(self.live_ns))
        spans[np.searchsorted(self.live_ns, self.lost_ns[self.lost_ns < self.live_ns[-1]])] = 0
        power = self.live["battery_voltage"] * self.live["battery_current"]
        self.energy = np.cumsum(np.maximum(0, np.append(0, power[:-1])).astype(object) * spans)
        """mW ns up to each live frame: the power of the frame before it, for as long as it was the newest one and fresh."""
        turned = np.append(0, self.live["electrical_speed"][:-1]) > 0
        self.run_ns = np.cumsum(turned * spans)

    def wall_ns(self, times: Times) -> Times:
        """Unix time in ns."""
        wall: Times = times - START + WALL + np.where(times >= self.clock_set_ns, CLOCK_STEP, 0)
        return wall

    def rows(self) -> dict[str, Floats]:
        """Columns of a table: a row at each of ``row_ns``, in the resolution of the wire."""
        return self._values(self.until_ns, in_rows=True)

    def frames(self, times: Times) -> dict[str, Floats]:
        """Each value as a CAN frame of these times has it, in the steps of the DBC."""
        return self._values(times, in_rows=False)

    def _values(self, times: Times, in_rows: bool) -> dict[str, Floats]:
        newest = np.searchsorted(self.live_ns, times, "right") - 1
        at = np.maximum(newest, 0)
        ever, live = newest >= 0, {name: column[at] for name, column in self.live.items()}
        fresh = ever & _since(self.live_ns[at], self.lost_ns, times)
        info_at = np.searchsorted(self.info_ns, times, "right") - 1
        info_ns = self.info_ns[np.maximum(info_at, 0)]
        info = {name: column[np.maximum(info_at, 0)] for name, column in self.info.items()}
        known = (info_at >= 0) & (times - info_ns <= INFO_TIMEOUT_NS)
        known &= _since(info_ns, self.forgotten_ns, times)
        found: dict[str, Any] = {}

        def put(available: Any, **values: Any) -> None:
            found.update({name: np.where(available, one, np.nan) for name, one in values.items()})

        def divided(numerator: Any, denominator: int, digits: int = 6) -> Any:
            return (
                np.round(numerator / denominator, digits)
                if in_rows
                else _rounded(numerator, denominator)
            )

        put(fresh, **{name: column / STEPS[name] for name, column in live.items()})
        put(fresh, operating_state_raw=live["operating_state"])
        device = info["device_and_variant"] >> 10
        put(fresh & ~self.is_jive[at], bec_current=live["bec_current"] / 1000)
        errors = {
            name: live["operating_errors"] >> bit & 1 for bit, name in enumerate(OPERATING_ERRORS)
        }
        put(fresh, **errors)
        speed, power = live["electrical_speed"], live["battery_voltage"] * live["battery_current"]
        gear = GEAR * POLE_PAIRS
        put(fresh, motor_speed=divided(speed, POLE_PAIRS))
        put(fresh, output_speed=divided(speed * gear.denominator, gear.numerator))
        put(fresh, battery_power=power / 1000 if in_rows else _rounded(power, 5000) * 5)
        put(known, **{name: column / STEPS[name] for name, column in info.items()})
        put(known & (device != int(Device.JIVEPRO)), max_bec_current=info["max_bec_current"] / 1000)
        put(known, device=device, device_raw=device, variant=info["device_and_variant"] & 1023)
        put(
            known,
            firmware_main=info["firmware_word"] >> 8,
            firmware_sub=info["firmware_word"] & 255,
        )
        bits = {
            name: info["selftest_errors"] >> bit & 1 for bit, name in enumerate(SELFTEST_ERRORS)
        }
        put(known, **bits)
        volts = live["battery_voltage"]
        cell = np.round(volts / CELLS / 100, 6) if in_rows else _rounded(volts * 10, CELLS) / 1000
        put(fresh & known, mean_cell_voltage=cell)
        put(True, losses=np.searchsorted(self.timed_out_ns, times, "right"))
        put(True, layout=np.where(ever, 1 + self.legacy[at], 0))
        hours = 3600 * SECOND * (1000 if in_rows else 100)
        energy = [
            round(e // SECOND / 3_600_000, 6) if in_rows else _rounded(e, hours) / 10
            for e in self.energy
        ]
        put(True, energy_used=np.where(ever, np.array(energy)[at], 0.0))
        put(True, motor_run_time=np.where(ever, np.round(self.run_ns[at] / SECOND, 6), 0.0))
        for name in ("device_and_variant", "firmware_word"):
            del found[name]
        return found


def value_name(signal: str) -> str:
    """How a table calls a signal of the DBC: by the value that it holds."""
    text = signal.removesuffix("Percent")
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in text).lstrip("_")


def _since(when: Times, ends: Times, times: Times) -> Any:
    """True where ``when`` is after the last of ``ends`` before each of the times."""
    passed = np.searchsorted(ends, times, "right")
    return (passed == 0) | (when > ends[np.maximum(passed - 1, 0)])


def _rounded(numerator: Any, denominator: int) -> Any:
    """To the nearest, halves up."""
    return (2 * numerator + denominator) // (2 * denominator)
