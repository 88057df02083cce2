"""Computes raw values of signals independently, and makes random DBC layouts and telemetry.

Nothing here uses the package's tables of fields, units or positions. They are typed again from the
telemetry sheet, here and in tests/specification, and bits are counted one by one. The package is
used only to make telemetry objects from encoded frames.
"""

import math
import random
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from typing import Any

import cantools.database
import specification
from cantools.database.can import Database

from kontronik_can_gw.core.esc_stream import EscStream
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry
from kontronik_can_gw.status import CanState, GatewayState, GatewayStatus
from kontronik_can_gw.times import MS, SECOND

# --- bits, counted one by one


def bit_places(start: int, length: int, little: bool) -> list[tuple[int, int]]:
    """Return (byte, bit in the byte) of each bit of a signal, the least significant first."""
    if little:
        return [divmod(start + n, 8) for n in range(length)]
    first = start // 8 * 8 + 7 - start % 8  # in the order of transmission
    last = first + length - 1
    return [(n // 8, 7 - n % 8) for n in range(last, first - 1, -1)]


def put(
    data: bytearray,
    raw: int,
    start: int,
    length: int,
    little: bool,
) -> None:
    """Write a raw value bit by bit, a negative one as two's complement."""
    unsigned = raw % (1 << length)
    for number, (byte, bit) in enumerate(bit_places(start, length, little)):
        if unsigned >> number & 1:
            data[byte] |= 1 << bit


def get(
    data: bytes,
    start: int,
    length: int,
    little: bool,
    signed: bool = False,
) -> int:
    """Read a raw value bit by bit."""
    raw = 0
    for number, (byte, bit) in enumerate(bit_places(start, length, little)):
        raw |= (data[byte] >> bit & 1) << number
    is_negative = signed and raw >> length - 1
    return raw - (1 << length) if is_negative else raw


# --- values to publish, typed from the sheet

Reader = Callable[[EscTelemetry, GatewayStatus, int], "int | Fraction | None"]


@dataclass(frozen=True)
class Known:
    """The oracle's own description of a source.

    It has the unit, a function that reads it in that unit (None: not available), and the names of
    its numbers.
    """

    unit: str
    read: Reader
    names: Mapping[int, str] = field(default_factory=dict)
    rolls: bool = False
    gateway: bool = False


STATES = specification.OPERATING_STATES
DEVICES = specification.DEVICES
LINKS = dict(enumerate(("NeverSeen", "Searching", "Ok", "Degraded", "Lost", "PortError")))
LAYOUTS = dict(enumerate(("Unknown", "V4", "Legacy")))
GATEWAY_STATES = dict(enumerate(("Starting", "Running", "Stopping", "Replay", "Quiet")))
CAN_STATES = dict(
    enumerate(("Unknown", "ErrorActive", "ErrorWarning", "ErrorPassive", "BusOff", "Down"))
)

ERROR_BITS = [
    "undervoltage",
    "overvoltage",
    "overcurrent_integral_error",
    "overcurrent_integral_warning",
    "power_stage_overtemp_warning",
    "power_stage_overtemp_error",
    "bec_undervoltage",
    "bec_overvoltage",
    "bec_overcurrent",
    "bec_overtemperature",
    "switched_off_by_running_down",
    "capacity_limit_reached",
    "operating_error_found",
    "operating_warning_found",
    "selftest_error",
    "eeprom_error",
    "watchdog_error_tripped",
    "programming_allowed",
    "limit_battery_voltage_minimum",
    "limit_current_maximum",
    "limit_power_stage_temperature",
    "limit_bec_temperature",
    "limit_bec_current",
    "limit_discharged_capacity",
]
TEST_BITS = [
    "test_phase_low_side",
    "test_phase_high_side",
    "test_short_to_ground",
    "test_back_emf_offset",
    "test_current_zero_point",
    "test_undervoltage",
    "test_overvoltage",
    "test_bec_undervoltage",
    "test_bec_overvoltage",
    "test_reverse_polarity_fuse",
    "test_overvoltage_fuse",
    "test_power_stage_overtemp",
    "test_bec_overtemperature",
    "test_motor_phase_missing",
    "test_eeprom_empty",
    "test_eeprom_stick_positions",
    "test_eeprom_checksum",
    "test_eeprom_size",
    "test_eeprom_version",
]

JIVEPRO = 3


def _of(part: str, reckon: Callable[[EscTelemetry, Any], "int | Fraction | None"]) -> Reader:
    """Return a function that computes a value from ``live`` or ``info`` data, or returns None."""

    def read(esc: EscTelemetry, _gateway: GatewayStatus, _now: int) -> int | Fraction | None:
        data = getattr(esc, part)
        return None if data is None else reckon(esc, data)

    return read


def _fields(part: str, fields: Sequence[specification.Field]) -> dict[str, Known]:
    """Return the sources of fields whose number is the value."""
    spelled = str.maketrans({"µ": "u", "°": "deg"})

    def reader(name: str, steps: int) -> Reader:
        return _of(part, lambda _, data: Fraction(getattr(data, name), steps))

    known = {}
    for each in fields:
        unit = each.unit.translate(spelled)
        known[each.name] = Known(unit, reader(each.name, each.steps))
    return known


def _bits(part: str, word: str, names: Sequence[str]) -> dict[str, Known]:
    def reader(bit: int) -> Reader:
        return _of(part, lambda _, data: getattr(data, word) >> bit & 1)

    return {name: Known("", reader(bit)) for bit, name in enumerate(names)}


def _bec_current(esc: EscTelemetry, live: LiveData) -> Fraction | None:
    known = esc.info or esc.last_info
    is_jive = known is not None and known.device_and_variant >> 10 == JIVEPRO
    if is_jive or (esc.info is None and not live.bec_current):
        return None
    return Fraction(live.bec_current, 1000)


def _max_bec_current(_esc: EscTelemetry, info: InfoData) -> Fraction | None:
    is_jive = info.device_and_variant >> 10 == JIVEPRO
    return None if is_jive else Fraction(info.max_bec_current, 1000)


def _counters(
    names: str,
    owner: Callable[[EscTelemetry, GatewayStatus], Any],
    gateway: bool = False,
) -> dict[str, Known]:
    def reader(path: str) -> Reader:
        return lambda esc, of_gateway, _: getattr(owner(esc, of_gateway), path)

    found = {}
    for pair in names.split():
        name, _, path = pair.partition("=")
        found[name] = Known("", reader(path or name), rolls=True, gateway=gateway)
    return found


def _motor_speed(esc: EscTelemetry, live: LiveData) -> Fraction:
    return Fraction(live.electrical_speed, esc.settings.pole_pairs)


def _output_speed(esc: EscTelemetry, live: LiveData) -> Fraction:
    return live.electrical_speed / (esc.settings.pole_pairs * esc.settings.gear)


def _battery_power(_esc: EscTelemetry, live: LiveData) -> Fraction:
    return Fraction(live.battery_voltage * live.battery_current, 1000)


def _mean_cell_voltage(esc: EscTelemetry, live: LiveData) -> Fraction | None:
    if not esc.cells:
        return None
    return Fraction(live.battery_voltage, 100 * esc.cells)


def _data_age(esc: EscTelemetry, _gateway: GatewayStatus, now: int) -> int | None:
    if esc.live_ns is None:
        return None
    return max(0, now - esc.live_ns) // 10**6


def _frame_rate(esc: EscTelemetry, _gateway: GatewayStatus, _now: int) -> Fraction | None:
    if esc.frame_rate is None:
        return None
    return Fraction(esc.frame_rate, 10)


def _uptime(_esc: EscTelemetry, gateway: GatewayStatus, now: int) -> Fraction:
    return Fraction((now - gateway.started_ns) // 10**6, 1000)


KNOWN: dict[str, Known] = {
    **_fields("live", specification.LIVE_FIELDS),
    "bec_current": Known("A", _of("live", _bec_current)),
    "operating_state": Known("", _of("live", lambda _, v: v.operating_state), STATES),
    "operating_state_raw": Known("", _of("live", lambda _, v: v.operating_state)),
    **_bits("live", "operating_errors", ERROR_BITS),
    **_bits("info", "selftest_errors", TEST_BITS),
    **_fields("info", specification.INFO_FIELDS[2:]),
    "max_bec_current": Known("A", _of("info", _max_bec_current)),
    "device": Known("", _of("info", lambda _, i: i.device_and_variant >> 10), DEVICES),
    "device_raw": Known("", _of("info", lambda _, i: i.device_and_variant >> 10)),
    "variant": Known("", _of("info", lambda _, i: i.device_and_variant & 1023)),
    "firmware_main": Known("", _of("info", lambda _, i: i.firmware_word >> 8)),
    "firmware_sub": Known("", _of("info", lambda _, i: i.firmware_word & 255)),
    "motor_speed": Known("1/min", _of("live", _motor_speed)),
    "output_speed": Known("1/min", _of("live", _output_speed)),
    "battery_power": Known("W", _of("live", _battery_power)),
    "mean_cell_voltage": Known("V", _of("live", _mean_cell_voltage)),
    "energy_used": Known("Wh", lambda e, _g, _n: Fraction(e.energy_mw_ns // 10**9, 3600 * 1000)),
    "motor_run_time": Known("s", lambda e, _g, _n: Fraction(e.run_time_ns, 10**9)),
    "link_state": Known("", lambda e, _g, _n: int(e.link), LINKS),
    "layout": Known("", lambda e, _g, _n: e.layout, LAYOUTS),
    "data_age": Known("ms", _data_age),
    "frame_rate": Known("Hz", _frame_rate),
    **_counters("losses suspect_frames", lambda e, _: e),
    **_counters(
        "crc_errors dropped_bytes live_frames=live info_frames=info received_bytes=bytes",
        lambda e, _: e.counters,
    ),
    "gateway_state": Known("", lambda _e, g, _n: int(g.state), GATEWAY_STATES, gateway=True),
    "can_state": Known("", lambda _e, g, _n: int(g.can_state), CAN_STATES, gateway=True),
    "esc_count": Known("", lambda _e, g, _n: g.esc_count, gateway=True),
    "escs_ok": Known("", lambda _e, g, _n: g.escs_ok, gateway=True),
    "uptime": Known("s", _uptime, gateway=True),
    **_counters(
        "sent_frames replaced_frames send_failures received_frames bus_off_count dropped_frames "
        "id_conflicts can_restarts",
        lambda _, gateway: gateway,
        gateway=True,
    ),
}

UNITS: dict[str, list[tuple[str, str, str]]] = {
    "V": [
        ("V|v|Volt|Volts|volt|VOLT|Unit_Volt|[V]|| |-|none|Unit_None|unitless|N/A", "1", "0"),
        ("mV|mv|Unit_MilliVolt|millivolts|(mV)", "1000", "0"),
        ("kV|KV", "1/1000", "0"),
    ],
    "A": [
        ("A|Amp|Amps|amps|ampere|Ampere|Unit_Amper|Unit_Ampere", "1", "0"),
        ("mA|Unit_MilliAmper", "1000", "0"),
        ("kA", "1/1000", "0"),
    ],
    "W": [
        ("W|watts|Watt|Unit_Watt", "1", "0"),
        ("kW|KW|kw|Kw|Unit_KiloWatt", "1/1000", "0"),
        ("mW", "1000", "0"),
    ],
    "Wh": [
        ("Wh", "1", "0"),
        ("kWh", "1/1000", "0"),
        ("J", "3600", "0"),
        ("kJ", "18/5", "0"),
        ("mWh", "1000", "0"),
    ],
    "mAh": [
        ("mAh|mA*h", "1", "0"),
        ("Ah|AH|A h|AmpHour|amperehour|ampere*hour|Unit_AmperHour", "1/1000", "0"),
        ("As|C|coulomb", "18/5", "0"),
    ],
    "s": [
        ("s|sec|secs|Seconds|Unit_Secon", "1", "0"),
        ("ms", "1000", "0"),
        ("min", "1/60", "0"),
        ("h", "1/3600", "0"),
        ("us", "1000000", "0"),
    ],
    "us": [
        ("us|µs|μs|Âµs|usec|uSec|Unit_MicroSecon|microseconds", "1", "0"),
        ("ms|msec|mSec|millisecond|Unit_MilliSecon", "1/1000", "0"),
        ("s", "1/1000000", "0"),
    ],
    "ms": [
        ("ms", "1", "0"),
        ("s", "1/1000", "0"),
        ("us", "1000", "0"),
    ],
    "Hz": [
        ("Hz|hz|Unit_Hertz|1/s", "1", "0"),
        ("kHz", "1/1000", "0"),
    ],
    "1/min": [
        (
            (
                "1/min|rpm|RPM|Rpm|U/min|Umin|upm|r/min|R/min|min⁻¹|min^-1|/min|rev/min"
                "|Unit_MinutInver"
            ),
            "1",
            "0",
        ),
        ("rps|1/s|U/sec|s⁻¹", "1/60", "0"),
        ("deg/s|°/s|degrees/second|Grad/sec|Unit_DegreOfArcPerSecon", "6", "0"),
    ],
    "%": [
        ("%|percent|Percent|Unit_PerCent|pct", "1", "0"),
        ("1|ratio", "1/100", "0"),
    ],
    "degC": [
        (
            (
                "degC|DegC|Deg C|deg C|deg_C|°C|° C|ºC|Â°C|\ufffdC|C|Cel|Celsius|celsius"
                "|Degrees C|Unit_DegreCelsi|[°C]|Grad C"
            ),
            "1",
            "0",
        ),
        ("K|Kelvin|degK|Unit_Kelvi", "1", "273.15"),
        ("F|degF|°F|Fahrenheit", "9/5", "32"),
    ],
    "": [("|-|1|count|counts|Cnt|#|Unit_None|number", "1", "0")],
}
"""For the unit of a source, other units with factor and shift.

The value in the other unit is value * factor + shift.
"""


# --- a signal and its correct raw value


@dataclass
class Sig:
    """A signal as it is written into the DBC. Numbers in the file are decimal texts."""

    name: str
    start: int
    length: int
    little: bool = True
    signed: bool = False
    is_float: bool = False
    factor: str = "1"
    offset: str = "0"
    minimum: str = "0"
    maximum: str = "0"
    unit: str = ""
    mux: str = ""
    texts: dict[int, str] = field(default_factory=dict)
    start_value: int | None = None
    source: str = ""
    esc: int = 0
    bind: str | float | None = None
    conversion: tuple[str, str] = ("1", "0")
    constant: int | None = None

    @property
    def line(self) -> str:
        sign = "-" if self.signed else "+"
        order = 1 if self.little else 0
        mux = f" {self.mux}" if self.mux else ""
        place = f"{self.start}|{self.length}@{order}{sign}"
        scale = f"({self.factor},{self.offset})"
        limits = f"[{self.minimum}|{self.maximum}]"
        return f' SG_ {self.name}{mux} : {place} {scale} {limits} "{self.unit}" Logger'

    @property
    def range(self) -> tuple[int, int]:
        """Smallest and greatest raw value."""
        codes = 1 << self.length
        if self.signed:
            return -(codes // 2), codes // 2 - 1
        return 0, codes - 1

    def code(self, text: str) -> int | None:
        for number, name in self.texts.items():
            if name == text:
                return number
        return None

    @property
    def not_available(self) -> int:
        listed = self.code("NotAvailable")
        if listed is not None:
            return listed
        if self.start_value is not None:
            return self.start_value
        if self.length == 1:
            return 0  # the file's default of GenSigStartValue, because a flag has no code
        return self.range[0] if self.signed else self.range[1]

    @property
    def error(self) -> int:
        listed = self.code("Error")
        return self.not_available if listed is None else listed

    @property
    def limits(self) -> tuple[int, int]:
        """Smallest and greatest raw value that is not a code."""
        low, high = self.range
        factor = Fraction(self.factor)
        offset = Fraction(self.offset)
        least = Fraction(self.minimum)
        most = Fraction(self.maximum)
        if least or most:
            ends = sorted(((least - offset) / factor, (most - offset) / factor))
            low = max(low, math.ceil(ends[0]))
            high = min(high, math.floor(ends[1]))
        codes = {self.code("NotAvailable"), self.code("Error")}
        while high in codes:
            high -= 1
        while low in codes:
            low += 1
        return low, high

    def physical(self, esc: EscTelemetry, gateway: GatewayStatus, now: int) -> Fraction | None:
        """Return the value in the signal's unit."""
        value = KNOWN[self.source].read(esc, gateway, now)
        if value is None:
            return None
        factor, shift = self.conversion
        return value * Fraction(factor) + Fraction(shift)

    def right(self, esc: EscTelemetry, gateway: GatewayStatus, now: int) -> int:
        """Return the correct raw value: the nearest one, halves up."""
        known = KNOWN[self.source]
        value = self.physical(esc, gateway, now)
        if value is None:
            return self.not_available
        codes = {plain(name): code for code, name in self.texts.items()}
        by_text = {}
        for number, text in known.names.items():
            if plain(text) in codes:
                by_text[number] = codes[plain(text)]
        if by_text:
            return by_text.get(int(value), self.error)
        low, high = self.limits
        if known.rolls:
            counted = [high + 1, *(code for code in codes.values() if code >= 0)]
            return int(value) % min(counted)
        exact = (value - Fraction(self.offset)) / Fraction(self.factor)
        raw = math.floor(exact + Fraction(1, 2))
        looks_like_none = raw == self.not_available and self.length > 1
        if low <= raw <= high and not looks_like_none:
            return raw
        return self.error

    def float_is_right(
        self,
        raw: int,
        esc: EscTelemetry,
        gateway: GatewayStatus,
        now: int,
    ) -> bool:
        """Return True if the IEEE 754 bits are correct, within the rounding of double and type.

        NaN is correct for a value that is not available.
        """
        kind = "f" if self.length == 32 else "d"
        sent: float
        (sent,) = struct.unpack(f"<{kind}", raw.to_bytes(self.length // 8, "little"))
        value = self.physical(esc, gateway, now)
        if value is None:
            return math.isnan(sent)
        factor = Fraction(self.factor)
        offset = Fraction(self.offset)
        exact = (value - offset) / factor
        if math.isnan(sent):
            return self.length == 32 and abs(exact) > Fraction(3.4028234e38)
        if math.isinf(sent):
            return False
        shift = Fraction(self.conversion[1])
        size = max(abs(exact), abs(offset / factor), abs(shift))
        bits = 24 if self.length == 32 else 52
        rounding = abs(exact) / Fraction(2) ** bits
        return abs(Fraction(sent) - exact) <= rounding + size / 10**14 + Fraction(1, 10**40)


def plain(name: str) -> str:
    """Return the letters and digits in lower case."""
    return "".join(c for c in name.lower() if c.isalnum())


@dataclass
class Msg:
    """A message as it is written into the DBC."""

    name: str
    can_id: int
    length: int
    signals: list[Sig]
    extended: bool = False
    sender: str = "Gateway"

    @property
    def dbc_id(self) -> int:
        return self.can_id | (0x80000000 if self.extended else 0)

    @property
    def pages(self) -> list[int | None]:
        multiplexed = [signal for signal in self.signals if signal.mux.startswith("m")]
        if not multiplexed:
            return [None]
        return [*sorted({int(signal.mux[1:]) for signal in multiplexed})]

    def page_of(self, number: int | None) -> list[Sig]:
        """Return the signals in a frame of this page."""
        return [s for s in self.signals if not s.mux.startswith("m") or s.mux == f"m{number}"]


ATTRIBUTES = """BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgDelayTime" INT 0 65535;
BA_DEF_ BO_ "GenMsgSendType" ENUM
 "Cyclic","Event","OnChange","CyclicAndEvent","CyclicAndOnChange","None","Wrong";
BA_DEF_ SG_ "GenSigStartValue" FLOAT -9223372036854775808 18446744073709551615;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "GenMsgDelayTime" 0;
BA_DEF_DEF_ "GenMsgSendType" "None";
BA_DEF_DEF_ "GenSigStartValue" 0;"""


def dbc_text(messages: Iterable[Msg], more: str = "") -> str:
    """Return the messages as a DBC. ``more`` is added after the attribute definitions."""
    messages = list(messages)
    lines = ['VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: Gateway Logger Other\n']
    for message in messages:
        lines.append(f"BO_ {message.dbc_id} {message.name}: {message.length} {message.sender}")
        lines += [*(signal.line for signal in message.signals), ""]
    lines.append(ATTRIBUTES)
    pairs = [(message.dbc_id, signal) for message in messages for signal in message.signals]
    for can_id, signal in pairs:
        if signal.start_value is not None:
            value = signal.start_value
            lines.append(f'BA_ "GenSigStartValue" SG_ {can_id} {signal.name} {value};')
    lines.append(more)
    for can_id, signal in pairs:
        if signal.texts:
            texts = " ".join(f'{number} "{text}"' for number, text in signal.texts.items())
            lines.append(f"VAL_ {can_id} {signal.name} {texts} ;")
        if signal.is_float:
            kind = 1 if signal.length == 32 else 2
            lines.append(f"SIG_VALTYPE_ {can_id} {signal.name} : {kind};")
    return "\n".join(lines) + "\n"


def read(text: str) -> Database:
    """Parse a DBC with cantools in its strict mode."""
    database = cantools.database.load_string(text, "dbc", strict=True)
    assert isinstance(database, Database)
    return database


def bindings(messages: Iterable[Msg]) -> dict[str, str | float]:
    """Return the bindings that the messages need in ``[dbc.bind]``."""
    found: dict[str, str | float] = {}
    for message in messages:
        for signal in message.signals:
            if signal.bind is not None:
                found[f"{message.name}.{signal.name}"] = signal.bind
    return found


# --- random layouts

FACTORS = [
    "1", "1", "1", "0.1", "0.01", "0.001", "0.5", "2", "5",
    "-1", "-0.1", "0.25", "0.0625", "100", "3", "0.3", "-7",
]  # fmt: skip
OFFSETS = ["0", "0", "0", "0", "-40", "100", "0.5", "-273.15", "1000", "-0.05", "32768"]


def pascal(source: str) -> str:
    return "".join(part.capitalize() for part in source.split("_"))


def spelled(rng: random.Random, text: str) -> str:
    """Return a name in a random style: lower case, upper case, with or without underscores."""
    ways = [
        text,
        text.upper(),
        text.lower(),
        text.replace("_", ""),
        f"{text[:2]}_{text[2:]}",
    ]
    return rng.choice(ways)


class LayoutMaker:
    """Makes random messages with signals that are bound to random sources of the ESCs."""

    def __init__(
        self,
        rng: random.Random,
        escs: Sequence[EscSettings],
        fd: bool = True,
    ) -> None:
        self.rng = rng
        self.escs = escs
        self.fd = fd
        self.ids: set[tuple[int, bool]] = set()
        self.count = 0

    def message(self) -> Msg:
        """Make one message with 1 to 8 signals."""
        rng = self.rng
        self.count += 1
        extended = rng.random() < 0.3
        can_id = rng.randrange(1 << 29 if extended else 1 << 11)
        while (can_id, extended) in self.ids:
            can_id = rng.randrange(1 << 29 if extended else 1 << 11)
        self.ids.add((can_id, extended))
        length = rng.randint(1, 8)
        if self.fd and rng.random() < 0.15:
            length = rng.choice((12, 16, 20, 24, 32, 48, 64))
        message = Msg(f"M{self.count}", can_id, length, [], extended)
        common: set[tuple[int, int]] = set()
        wanted = rng.randint(1, 8)
        if rng.random() < 0.2:
            self._add_pages(message, common)
        for _ in range(wanted):
            self._add(message, common, "")
        if not message.signals or all(s.mux == "M" for s in message.signals):
            self.ids.discard((can_id, extended))
            self.count -= 1
            return self.message()
        return message

    def _add_pages(self, message: Msg, common: set[tuple[int, int]]) -> None:
        """Add a selector and the signals of 1 to 3 pages, if there is a place for the selector."""
        rng = self.rng
        width = rng.randint(1, 8)
        place = self._position(common, width, message.length)
        if place is None:
            return
        start, little = place
        message.signals.append(Sig("Selector", start, width, little, mux="M"))
        numbers = range(1 << width)
        used: set[tuple[int, int]] = set()
        for page in rng.sample(numbers, min(len(numbers), rng.randint(1, 3))):
            taken = set(common)  # pages may overlap
            for _ in range(rng.randint(1, 3)):
                self._add(message, taken, f"m{page}")
            used |= taken
        common |= used

    def _position(
        self,
        taken: set[tuple[int, int]],
        width: int,
        length: int,
    ) -> tuple[int, bool] | None:
        rng = self.rng
        for _ in range(12):
            start = rng.randrange(length * 8)
            little = rng.random() < 0.5
            places = bit_places(start, width, little)
            is_inside = all(0 <= byte < length for byte, _ in places)
            if is_inside and not taken & set(places):
                taken.update(places)
                return start, little
        return None

    def _add(
        self,
        message: Msg,
        taken: set[tuple[int, int]],
        mux: str,
    ) -> None:
        rng = self.rng
        source = rng.choice(list(KNOWN))
        known = KNOWN[source]
        is_number = not known.rolls and not known.names
        is_float = rng.random() < 0.12 and is_number
        signed = is_float or (rng.random() < 0.5 and not known.rolls)
        lengths = (1, 2, 4, 7, 8, 8, 12, 15, 16, 16, 17, 24, 32, 33, 48, 63, 64)
        length = rng.choice((32, 64) if is_float else lengths)
        if length == 1 and (signed or not is_number):
            length = 8
        place = self._position(taken, length, message.length)
        if place is None:
            return
        start, little = place
        name = f"S{len(message.signals)}"
        signal = Sig(name, start, length, little, signed, is_float, mux=mux, source=source)
        signal.esc = rng.randrange(len(self.escs))
        texts, factor, shift = rng.choice(UNITS[known.unit])
        signal.unit = rng.choice(texts.split("|"))
        signal.conversion = (factor, shift)
        if is_number and length > 1:
            signal.factor = rng.choice(FACTORS)
            signal.offset = rng.choice(OFFSETS)
        if not is_float and length > 1:
            self._codes(signal, known)
            if not known.names:
                self._limits(signal, known)
        self._name(message, signal)
        message.signals.append(signal)

    def _name(self, message: Msg, signal: Sig) -> None:
        """Give a signal the name of its source in a random style, or bind it to the source."""
        rng = self.rng
        source = signal.source
        number_name = signal.name
        prefix = "" if KNOWN[source].gateway else self.escs[signal.esc].name
        if rng.random() < 0.3:
            own = f"{prefix}_{source}".strip("_")
            name = pascal(own) if rng.random() < 0.5 else spelled(rng, own)
            if signal.unit == "%" and rng.random() < 0.5:
                name += "Percent"
            if all(s.name != name for s in message.signals):
                signal.name = name
        if signal.name == number_name:
            signal.bind = f"{prefix}.{source}" if prefix else source

    def _codes(self, signal: Sig, known: Known) -> None:
        rng = self.rng
        low, high = signal.range
        usual = (low, low + 1) if signal.signed else (high, high - 1)
        last = min(high, low + 4000)
        free = [code for code in range(low, last + 1) if code not in usual]
        if known.names and rng.random() < 0.7 and len(free) >= len(known.names):
            codes = rng.sample(free, len(known.names))
            for text, code in zip(known.names.values(), codes, strict=True):
                if rng.random() < 0.85:
                    signal.texts[code] = spelled(rng, text)
        if rng.random() < 0.5:
            signal.texts[usual[0]] = "NotAvailable"
        elif rng.random() < 0.3 and not known.rolls and signal.length >= 7:
            middle = [code for code in free if code not in signal.texts]
            if middle:
                signal.texts[rng.choice(middle)] = "NotAvailable"
        if rng.random() < 0.5 and usual[1] not in signal.texts:
            signal.texts[usual[1]] = "Error"
        if rng.random() < 0.3 and signal.length <= 50:
            start = rng.randint(low, high)
            if start != signal.code("Error"):
                signal.start_value = start

    def _limits(self, signal: Sig, known: Known) -> None:
        rng = self.rng
        if signal.length > 32 or rng.random() < 0.5:
            return
        low, high = signal.range
        if known.rolls:
            ends = [0, rng.randint(max(1, high // 2), high)]
        else:
            ends = sorted((rng.randint(low, high), rng.randint(low, high)))
        factor = Decimal(signal.factor)
        offset = Decimal(signal.offset)
        least, most = sorted(end * factor + offset for end in ends)
        signal.minimum = str(least)
        signal.maximum = str(most)


# --- random telemetry


def random_integer(rng: random.Random, low: int, high: int) -> int:
    """Return a limit or a neighbour of zero often, otherwise any integer in the range."""
    if rng.random() < 0.3:
        often = (low, low + 1, -1, 0, 1, 99, 100, high - 1, high)
        return rng.choice([value for value in often if low <= value <= high])
    if rng.random() < 0.5:
        return rng.randint(max(low, -200), min(high, 3000))
    return rng.randint(low, high)


def random_fields(rng: random.Random, types: str) -> list[int]:
    return [random_integer(rng, *specification.TYPE_RANGES[code]) for code in types]


def random_live(rng: random.Random) -> LiveData:
    values = random_fields(rng, specification.LIVE_STRUCT[1:])
    if rng.random() < 0.8:
        values[14] = rng.randint(0, 30)
    return LiveData(*values)


def random_info(rng: random.Random) -> InfoData:
    values = random_fields(rng, specification.INFO_STRUCT[1:])
    values[0] = rng.randint(0, 7) << 10 | rng.randrange(1024)
    values[3] = rng.choice((0, 1, 3, 6, 7, 12, 255))
    return InfoData(*values)


def random_escs(
    rng: random.Random,
    settings: Sequence[EscSettings],
    now: int,
) -> tuple[list[EscStream], int]:
    """Return ESCs that received random frames, and the time after that.

    Some are up, some are stale, some have info, and some never received anything.
    """
    escs = [EscStream(each, now) for each in settings]
    for _ in range(rng.randint(0, 3)):
        for esc in escs:
            layout = rng.choice((WireLayout.V4, WireLayout.LEGACY))
            if rng.random() < 0.7:
                live = encode(random_live(rng), layout)
                list(esc.receive_each(live, now, now))
            if rng.random() < 0.4:
                info = encode(random_info(rng), layout)
                list(esc.receive_each(info, now, now))
            if rng.random() < 0.2:
                noise = rng.randbytes(rng.randint(1, 50))
                list(esc.receive_each(noise, now, now))
        now += rng.choice((1, 10, 33, 200)) * MS + rng.randrange(MS)
    if rng.random() < 0.15:
        now += 400 * MS
    for esc in escs:
        esc.advance(now)
        if rng.random() < 0.3:
            sign = rng.choice((1, -1))
            most = 10 ** rng.choice((17, 19))
            esc.energy_mw_ns = sign * rng.randrange(most) * SECOND
            esc.run_time_ns = rng.randrange(10**14)
            esc.losses = rng.randrange(10**6)
            esc.frame_rate = rng.choice((None, 0, 5, 999, 1004))
    return escs, now


def random_gateway(rng: random.Random, now: int) -> GatewayStatus:
    states = rng.choice(list(GatewayState)), rng.choice(list(CanState))
    status = GatewayStatus(*states, rng.randint(0, 9), rng.randint(0, 9))
    status.started_ns = now - rng.randrange(10**14)
    status.sent_frames = rng.randrange(10**10)
    for name, known in KNOWN.items():
        if known.gateway and known.rolls and name != "sent_frames":
            setattr(status, name, rng.randrange(100000))
    return status
