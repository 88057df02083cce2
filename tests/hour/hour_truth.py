"""What every signal must be at a time, from what the ESCs meant: computed with numpy, by the protocol's page and the DBC's comments.

Nothing here is taken from the program that is checked, but names of fields and the frames that were handed to the interface. An
``Expected`` is the least and the greatest value that is right; both are the same but where the gateway's own counters are read at most
110 ms before.
NaN: not available. Texts are their numbers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import cantools.database
import numpy as np
from cantools.database.can import Database
from esc.sheet import INFO_FIELDS, LIVE_FIELDS, Field
from hour_recording import CELLS, GEAR, MS, SECOND, START, TIMEOUT_NS, Meant, Recording, Times
from numpy.typing import NDArray

from kontronik_can_gw.dbc.expand import copies_of, expand

Floats = NDArray[np.float64]
LATE_NS = 110 * MS
"""The gateway's own values in a row are at most so old."""
SAME_ROW_NS = 5 * MS
"""What comes so soon behind a row's begin belongs to it."""
INFO_TIMEOUT_NS = 10 * SECOND
JIVEPRO = 3


def signals_of(fields: Sequence[Field], *but: str) -> dict[str, tuple[str, int]]:
    """Of signals that stand in a frame as they are: field, and steps to one unit."""
    return {
        "".join(map(str.capitalize, one.name.split("_"))) + "Percent" * (one.unit == "%"): (
            one.name,
            one.steps,
        )
        for one in fields
        if one.name not in but
    }


LIVE = signals_of(LIVE_FIELDS, "bec_current", "operating_errors")
LIVE["OperatingStateRaw"] = LIVE["OperatingState"]
INFO = signals_of(INFO_FIELDS, "device_and_variant", "firmware_word", "selftest_errors")
_OPERATING_ERRORS = """
    Undervoltage Overvoltage OvercurrentIntegralError OvercurrentIntegralWarning PowerStageOvertempWarning
    PowerStageOvertempError BecUndervoltage BecOvervoltage BecOvercurrent BecOvertemperature SwitchedOffByRunningDown
    CapacityLimitReached OperatingErrorFound OperatingWarningFound SelftestError EepromError WatchdogErrorTripped ProgrammingAllowed
    LimitBatteryVoltageMinimum LimitCurrentMaximum LimitPowerStageTemperature LimitBecTemperature LimitBecCurrent
    LimitDischargedCapacity
"""
_SELFTEST_ERRORS = """
    TestPhaseLowSide TestPhaseHighSide TestShortToGround TestBackEmfOffset TestCurrentZeroPoint TestUndervoltage TestOvervoltage
    TestBecUndervoltage TestBecOvervoltage TestReversePolarityFuse TestOvervoltageFuse TestPowerStageOvertemp TestBecOvertemperature
    TestMotorPhaseMissing TestEepromEmpty TestEepromStickPositions TestEepromChecksum TestEepromSize TestEepromVersion
"""
OPERATING_ERRORS = tuple(_OPERATING_ERRORS.split())
SELFTEST_ERRORS = tuple(_SELFTEST_ERRORS.split())
LENGTHS = {"live": (40, 38), "info": (44, 41)}
"""Bytes of a frame in V4 and legacy layout."""
ALIVE = "Alive"
"""How alive counters are called at their end."""
ONLY_IN_ROWS = (
    *("operating_errors", "selftest_errors", "motor_run_time", "live_frames", "info_frames"),
    *("received_bytes", "suspect_frames"),
)
"""Values that no signal of the DBC holds."""
ONLY_IN_ROWS_OF_GATEWAY = ("received_frames", "bus_off_count", "dropped_frames", "id_conflicts")
NEVER_SEEN, OK, LOST, PORT_ERROR = 0, 2, 4, 5
RUNNING, STOPPING = 1, 2


@dataclass
class Expected:
    """Least and greatest right value of one signal at each time; NaN where it is not available."""

    low: Floats
    high: Floats


def _one(values: Any) -> Expected:
    array = np.array(values, dtype=np.float64)
    return Expected(array, array)


def _steps(values: Any, steps: int) -> Floats:
    return np.asarray(values, dtype=np.float64) / steps


def _rounded(numerator: Any, denominator: int) -> NDArray[np.int64]:
    """To the nearest, halves up."""
    found: NDArray[np.int64] = (2 * numerator + denominator) // (2 * denominator)
    return found


class _Steps:
    """A whole number that holds from a time on; -1 is none."""

    def __init__(self, events: list[tuple[int, int]]) -> None:
        events = sorted(events)
        self._times = np.array([at for at, _ in events], dtype=np.int64)
        self._values = np.array(
            [np.nan if value < 0 else value for _, value in events], dtype=np.float64
        )

    def __call__(self, times: Times) -> Floats:
        return self._values[np.searchsorted(self._times, times, "right") - 1]


class EscTruth:
    """What is true of one ESC at any time."""

    def __init__(self, meant: Meant, end_ns: int) -> None:
        self.meant = meant
        self.live_ns = np.array(meant.live_ns, dtype=np.int64)
        self.read_ns = np.array(meant.read_ns, dtype=np.int64)
        self.info_ns = np.array(meant.info_ns, dtype=np.int64)
        self.live = meant.live_fields()
        self.info = meant.info_fields()
        self.devices = np.array(meant.devices)
        self.legacy = np.array(meant.legacy)
        following = np.append(self.live_ns[1:], end_ns)
        silent = self.live_ns[following - self.live_ns > TIMEOUT_NS] + TIMEOUT_NS + 1
        self.timed_out_ns = np.array(
            [at for at in silent if at < end_ns and not self._is_out(int(at))], dtype=np.int64
        )
        self.out_ns = np.array([lost for lost, _ in meant.unplugged], dtype=np.int64)
        self.lost_ns = np.sort(np.concatenate((self.timed_out_ns, self.out_ns)))
        """When fresh data ended."""
        changes = np.flatnonzero(np.diff(self.legacy)) + 1
        self.forgotten_ns = np.sort(np.concatenate((self.lost_ns, self.live_ns[changes])))
        """When the device on the line was not known any more."""
        self.energy = self._energies()
        self._links()
        self._rates(end_ns)

    def _is_out(self, at: int) -> bool:
        """Whether a time-out at this time finds the port lost already."""
        return any(lost < at <= lost + TIMEOUT_NS + 1 for lost, _ in self.meant.unplugged)

    def _energies(self) -> list[int]:
        """Energy in mW ns up to each live frame: the power of the frame before it, for as long as it was the newest one and fresh."""
        power = (self.live["battery_voltage"] * self.live["battery_current"]).tolist()
        times = self.live_ns.tolist()
        lost = set(np.searchsorted(self.live_ns, self.lost_ns).tolist())
        total, energies = 0, [0]
        for index in range(1, len(times)):
            if index not in lost:
                total += max(0, power[index - 1]) * (times[index] - times[index - 1])
            energies.append(total)
        return energies

    def _turning(self) -> list[int]:
        """How long the motor had turned up to each live frame, in ns, by the frames before."""
        speeds, times = self.live["electrical_speed"].tolist(), self.live_ns.tolist()
        lost = set(np.searchsorted(self.live_ns, self.lost_ns).tolist())
        total, found = 0, [0]
        for index in range(1, len(times)):
            if index not in lost and speeds[index - 1]:
                total += times[index] - times[index - 1]
            found.append(total)
        return found

    def _links(self) -> None:
        returns = self.live_ns[
            np.searchsorted(self.live_ns, self.lost_ns[self.lost_ns < self.live_ns[-1]])
        ]
        events = [(START - SECOND, NEVER_SEEN), (int(self.live_ns[0]), OK)]
        events += [(int(at), OK) for at in returns]
        events += [(int(at), LOST) for at in self.timed_out_ns]
        for lost, again in self.meant.unplugged:
            events += [(lost, PORT_ERROR), (again, LOST)]
        events.sort()
        self.link_ns = np.array([at for at, _ in events], dtype=np.int64)
        self.links = np.array([code for _, code in events])

    def _rates(self, end_ns: int) -> None:
        """Live frames of the last full second, none before there is one; at the very time at which it ends, and just behind it."""
        events: list[tuple[int, int]] = [(START - SECOND, 0)]
        ended: list[tuple[int, int]] = []
        for begun, code in zip(self.link_ns.tolist(), self.links.tolist(), strict=True):
            if code != OK:
                events.append((begun, 0))
                continue
            events.append((begun, -1))  # none
            end = min([int(at) for at in self.lost_ns if at > begun], default=end_ns)
            edges = np.arange(begun, end, SECOND)
            counted = edges.copy()
            counted[0] = self.read_ns[np.searchsorted(self.live_ns, begun)]
            counts = np.diff(np.searchsorted(self.read_ns, counted, "right"))
            ended += [(int(at), int(count)) for at, count in zip(edges[1:], counts, strict=True)]
        self._rate_at = _Steps(events + ended)
        self._rate_behind = _Steps(events + [(at + 1, rate) for at, rate in ended])

    def signals(
        self, times: Times, told_ns: Times | None = None, aged_ns: Times | None = None
    ) -> dict[str, Expected]:
        """Each signal of the ESC at these times, as the gateway can know it.

        ``told_ns``, ``aged_ns``: of rows: when the rate, or the age, of the data was last told, which are not new in every row.
        """
        newest = np.searchsorted(self.read_ns, times, "right") - 1
        at = np.maximum(newest, 0)
        lost = np.searchsorted(self.lost_ns, times, "right")
        fresh = (newest >= 0) & (
            (lost == 0) | (self.live_ns[at] > self.lost_ns[np.maximum(lost - 1, 0)])
        )
        told = times if told_ns is None else told_ns
        found: dict[str, Expected] = {}

        def live(name: str, values: Any, available: Any = True) -> None:
            found[name] = _one(np.where(fresh & available, values, np.nan))

        for name, (source, steps) in LIVE.items():
            live(name, _steps(self.live[source][at], steps))
        live("BecCurrent", _steps(self.live["bec_current"][at], 1000), self.devices[at] != JIVEPRO)
        errors = self.live["operating_errors"][at]
        for bit, name in enumerate(OPERATING_ERRORS):
            found[name] = _one(np.where(fresh, errors >> bit & 1, np.nan))
        speed, pole_pairs = self.live["electrical_speed"][at], self.meant.pole_pairs
        gear = GEAR * pole_pairs
        power = self.live["battery_voltage"][at] * self.live["battery_current"][at]
        if told_ns is None:
            live("MotorSpeed", _rounded(speed, pole_pairs))
            live("OutputSpeed", _rounded(speed * gear.denominator, gear.numerator))
            live("BatteryPower", _rounded(power, 5000) * 5)
        else:
            live("MotorSpeed", np.round(speed / pole_pairs, 6))
            live("OutputSpeed", np.round(speed * gear.denominator / gear.numerator, 6))
            live("BatteryPower", power / 1000)
            live("OperatingErrors", errors)
        self._infos(times, fresh, at, found, told_ns is not None)
        aged = times if aged_ns is None else aged_ns
        found["DataAge"] = _one(np.where(newest >= 0, (aged - self.live_ns[at]) // MS, np.nan))
        self._link(times, told, told_ns is not None, newest, at, found)
        return found

    def _infos(
        self, times: Times, fresh: Any, at: Any, found: dict[str, Expected], rows: bool
    ) -> None:
        newest = np.searchsorted(self.info_ns, times, "right") - 1
        info = np.maximum(newest, 0)
        forgotten = np.searchsorted(self.forgotten_ns, times, "right")
        known = (newest >= 0) & (times - self.info_ns[info] <= INFO_TIMEOUT_NS)
        known &= (forgotten == 0) | (
            self.info_ns[info] > self.forgotten_ns[np.maximum(forgotten - 1, 0)]
        )

        def put(name: str, values: Any) -> None:
            found[name] = _one(np.where(known, values, np.nan))

        for name, (source, steps) in INFO.items():
            put(name, _steps(self.info[source][info], steps))
        found["MaxBecCurrent"].low[self.info["device_and_variant"][info] >> 10 == JIVEPRO] = np.nan
        pair, firmware = self.info["device_and_variant"][info], self.info["firmware_word"][info]
        put("Device", pair >> 10)
        put("DeviceRaw", pair >> 10)
        put("Variant", pair & 1023)
        put("FirmwareMain", firmware >> 8)
        put("FirmwareSub", firmware & 255)
        for bit, name in enumerate(SELFTEST_ERRORS):
            found[name] = _one(
                np.where(known, self.info["selftest_errors"][info] >> bit & 1, np.nan)
            )
        if rows:
            put("SelftestErrors", self.info["selftest_errors"][info])
            cells = np.round(self.live["battery_voltage"][at] / CELLS / 100, 6)
        else:
            cells = _rounded(self.live["battery_voltage"][at] * 10, CELLS) / 1000
        found["MeanCellVoltage"] = _one(np.where(fresh & known, cells, np.nan))

    def _link(
        self,
        times: Times,
        told: Times,
        rows: bool,
        newest: Any,
        at: Any,
        found: dict[str, Expected],
    ) -> None:
        step = Fraction(3_600_000 * SECOND, 10)  # 0.1 Wh in mW ns
        tenths = np.array(
            [(2 * e + int(step)) // (2 * int(step)) for e in self.energy], dtype=np.int64
        )
        found["EnergyUsed"] = _one(np.where(newest >= 0, tenths[at] / 10, 0.0))
        if rows:
            energy = np.array([round(e // SECOND / 3_600_000, 6) for e in self.energy])
            found["EnergyUsed"] = _one(np.where(newest >= 0, energy[at], 0.0))
            self._counted(times, newest, at, found)
        found["Losses"] = _one(np.searchsorted(self.timed_out_ns, times, "right"))
        found["Layout"] = _one(np.where(newest >= 0, 1 + self.legacy[at], 0))
        found["LinkState"] = _one(self.links[np.searchsorted(self.link_ns, times, "right") - 1])
        # what a frame tells at the very time at which a second ends may be either; in rows a second ends behind the live frame
        behind, now = self._rate_behind(told), self._rate_at(told)
        if rows or np.any(np.isnan(behind) != np.isnan(now)):
            found["FrameRate"] = _one(behind)
        else:
            found["FrameRate"] = Expected(np.fmin(behind, now), np.fmax(behind, now))
        for name in ("CrcErrors", "DroppedBytes"):
            found[name] = _one(np.zeros(len(times)))

    def _counted(self, times: Times, newest: Any, at: Any, found: dict[str, Expected]) -> None:
        """What only rows hold: counters, and how long the motor has turned."""
        infos = np.searchsorted(
            self.info_ns, times + 1, "right"
        )  # read with a live frame: counted with it
        found["LiveFrames"] = _one(newest + 1)
        found["InfoFrames"] = _one(infos)
        found["SuspectFrames"] = _one(np.zeros(len(times)))
        lives = np.cumsum(np.where(self.legacy == 1, LENGTHS["live"][1], LENGTHS["live"][0]))
        of_info = self.legacy[np.maximum(np.searchsorted(self.live_ns, self.info_ns) - 1, 0)]
        info_bytes = np.cumsum(np.where(of_info == 1, LENGTHS["info"][1], LENGTHS["info"][0]))
        received = np.where(newest >= 0, lives[at], 0)
        found["ReceivedBytes"] = _one(received + np.append(0, info_bytes)[infos])
        turning = np.array(self._turning(), dtype=np.int64)
        found["MotorRunTime"] = _one(np.where(newest >= 0, np.round(turning[at] / SECOND, 6), 0.0))


class Truth:
    """What is true of a recording at any time."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.escs = [EscTruth(meant, recording.end_ns) for meant in recording.escs]
        self.prefixes = (
            [""] if len(self.escs) == 1 else [f"Esc{n + 1}" for n in range(len(self.escs))]
        )
        self.sent_ns = np.array(recording.sent.times, dtype=np.int64)
        self.database = database_of(recording)
        self.texts = {
            signal.name: {str(text): number for number, text in (signal.choices or {}).items()}
            for message in self.database.messages
            for signal in message.signals
        }
        self.units = {
            s.name: s.unit or "" for message in self.database.messages for s in message.signals
        }
        self.value_texts = {
            self.value_name(name): {text.casefold(): number for text, number in texts.items()}
            for name, texts in self.texts.items()
        }
        signs = {"degC": "°C", "us": "µs"}
        self.value_units = {
            self.value_name(name): signs.get(unit, unit) for name, unit in self.units.items()
        }
        for prefix in (self.value_name(one) for one in self.prefixes):
            self.value_units |= dict.fromkeys(
                (f"{prefix}{name}" for name in ONLY_IN_ROWS if name != "motor_run_time"), ""
            )
            self.value_units[f"{prefix}motor_run_time"] = "s"
        self.value_units |= dict.fromkeys(ONLY_IN_ROWS_OF_GATEWAY, "")
        self._row_times()

    def value_name(self, name: str) -> str:
        """How a table calls a signal: by the value that it holds."""
        prefix = next((one for one in self.prefixes if one and name.startswith(one)), "")
        text = name.removeprefix(prefix).removesuffix("Percent")
        words = "".join(f"_{c.lower()}" if c.isupper() else c for c in text).lstrip("_")
        return f"{prefix.lower()}.{words}" if prefix else words

    def _row_times(self) -> None:
        """A row begins with a live frame, or a loss; what other ESCs say within 5 ms belongs to it, until one speaks again.

        In the order in which it was read; a row's time is that of the wire. An info frame, or a port that is back, begins no row, but
        ends one that is old.
        """
        events: list[tuple[int, int, bool, int]] = []
        for index, esc in enumerate(self.escs):
            of_it = [index] * len(esc.read_ns), [False] * len(esc.read_ns)
            events += zip(esc.read_ns.tolist(), *of_it, esc.live_ns.tolist(), strict=True)
            events += [(at, index, False, at) for at in esc.lost_ns.tolist()]
            events += [(at, index, True, at) for at in esc.info_ns.tolist()]
            events += [(at, index, True, at) for _, at in esc.meant.unplugged]
        rows: list[int] = []
        until: list[int] = []
        told: list[list[tuple[int, int]]] = [[] for _ in self.escs]
        by_any: list[tuple[int, int]] = []
        seen: set[int] | None = None
        for read, esc_index, info, at in sorted(events):
            if seen is not None and (
                at - rows[-1] > SAME_ROW_NS or (esc_index in seen and not info)
            ):
                seen = None
            if seen is None and not info:
                rows.append(at)
                until.append(read)
                seen = set()
            if seen is not None:
                until[-1] = read
                if not info:
                    seen.add(esc_index)
            by_any.append((read, at if seen is None else max(at, rows[-1])))
            told[esc_index].append(by_any[-1])
        self.row_ns = np.array(rows, dtype=np.int64)
        self._until_ns = np.array(until, dtype=np.int64)
        """When the last of a row was read."""
        self._by_any = np.array(by_any, dtype=np.int64)
        self._told = [np.array(one, dtype=np.int64) for one in told]
        """Of each ESC when something was read, and what time it was given."""

    def rows(self) -> dict[str, Expected]:
        """The table: values by name, a row at each of ``row_ns``."""
        until = self._until_ns
        found: dict[str, Expected] = {}

        def last(told: Times) -> Times:
            """When something was last told; ages are told anew with what any ESC says."""
            found: Times = told[np.maximum(np.searchsorted(told[:, 0], until, "right") - 1, 0), 1]
            return found

        for prefix, esc, told in zip(self.prefixes, self.escs, self._told, strict=True):
            for name, expected in esc.signals(until, last(told), last(self._by_any)).items():
                for end in (expected.low, expected.high):
                    end[until < told[0, 0]] = np.nan  # nothing was ever heard of it
                found[prefix + name] = expected
        found |= self.gateway(until, LATE_NS)
        del found["SentFrames"]
        found["Uptime"].low[:] = np.maximum(until - LATE_NS - START, 0) // MS / 1000
        found["Uptime"].high[:] = np.maximum(until - START, 0) // MS / 1000
        none = dict.fromkeys(ONLY_IN_ROWS_OF_GATEWAY, _one(np.zeros(len(until))))
        return {self.value_name(name): expected for name, expected in found.items()} | none

    def gateway(self, times: Times, late_ns: int) -> dict[str, Expected]:
        """The gateway's own values, read at most so long before."""
        before = times - late_ns
        stopping = self.recording.end_ns
        states = np.array([START - SECOND, *(at for at, _ in self.recording.can_states)])
        codes = np.array([0, *(code for _, code in self.recording.can_states)])

        def between(value: Callable[[Times], Any]) -> Expected:
            ends = np.asarray(value(before), np.float64), np.asarray(value(times), np.float64)
            return Expected(np.minimum(*ends), np.maximum(*ends))

        def up(at: Times) -> Any:
            return sum(esc.signals(at)["LinkState"].low == OK for esc in self.escs)

        def sent(at: Times) -> Any:
            return np.searchsorted(self.sent_ns, at, "right")

        found = {
            "GatewayState": between(lambda at: np.where(at >= stopping, STOPPING, RUNNING)),
            "CanState": between(lambda at: codes[np.searchsorted(states, at, "right") - 1]),
            "EscCount": _one(np.full(len(times), len(self.escs))),
            "EscsOk": between(up),
            "Uptime": between(lambda at: _rounded(np.maximum(at - START, 0) // MS, 1000)),
            "SentFrames": between(sent),
            "ReplacedFrames": _one(np.zeros(len(times))),
            "SendFailures": _one(np.zeros(len(times))),
        }
        if not late_ns:  # the frames of the same moment are counted before them or behind them
            found["SentFrames"].low = np.searchsorted(self.sent_ns, times, "left").astype(
                np.float64
            )
        return found

    def at(self, times: Times) -> dict[str, Expected]:
        """Every signal at these times, as it is sent then."""
        found = self.gateway(times, 0)
        for prefix, esc in zip(self.prefixes, self.escs, strict=True):
            found |= {prefix + name: expected for name, expected in esc.signals(times).items()}
        return found


def database_of(recording: Recording) -> Database:
    """The DBC by cantools: the file of one ESC, for several as the command ``dbc`` writes it."""
    assert recording.setup.dbc is not None
    if len(recording.escs) == 1:
        found = cantools.database.load_string(recording.setup.dbc[1].decode("latin-1"), "dbc")
        assert isinstance(found, Database)
        return found
    setup = recording.setup
    made = setup.database()
    assert made is not None
    database, layout = made
    return expand(database, copies_of(database, layout.file, setup.escs, setup.dbc_settings))
