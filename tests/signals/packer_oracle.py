"""Computes raw values of signals independently, and makes random DBC layouts and telemetry.

Nothing here uses the package's tables of fields, units or positions. The values and their rules
are those of tests/specification, and bits are counted one by one. The package is used only to make
telemetry objects from encoded frames.
"""

import math
import random
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction

import cantools.database
import specification
from cantools.database.can import Database
from specification.quantities import (
    PRODUCT,
    QUANTITIES,
    Divisor,
    Quantity,
)
from specification.rule import Described, Rule

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


# --- values to publish

Reader = Callable[[EscTelemetry, GatewayStatus, int], "int | Fraction | None"]


@dataclass(frozen=True)
class Known:
    """A value: its unit, a function that reads it (None: not available), and its numbers' names."""

    unit: str
    read: Reader
    names: Mapping[int, str]
    rolls: bool
    gateway: bool
    quantity: Quantity


STATES = specification.OPERATING_STATES
DEVICES = specification.DEVICES
ERROR_BITS = [bit.name for bit in specification.OPERATING_BITS]
TEST_BITS = [bit.name for bit in specification.SELFTEST_BITS]
_NAMES = {
    **{("live", field.offset): field.name for field in specification.LIVE_FIELDS},
    **{("info", field.offset): field.name for field in specification.INFO_FIELDS},
}
"""Name of a field by the kind and the offset of its frame."""
_STEPS: dict[str, Callable[[EscTelemetry, GatewayStatus, int], int | None]] = {
    "energy_used": lambda esc, _g, _n: esc.energy_mw_ns // 10**9,
    "motor_run_time": lambda esc, _g, _n: esc.run_time_ns,
    "link_state": lambda esc, _g, _n: int(esc.link),
    "layout": lambda esc, _g, _n: esc.layout,
    "data_age": lambda esc, _, now: (
        None if esc.live_ns is None else max(0, now - esc.live_ns) // 10**6
    ),
    "frame_rate": lambda esc, _g, _n: esc.frame_rate,
    "uptime": lambda _, gateway, now: (now - gateway.started_ns) // 10**6,
    "gateway_state": lambda _e, gateway, _n: int(gateway.state),
    "can_state": lambda _e, gateway, _n: int(gateway.can_state),
}
"""Number of steps of the values that are in no frame."""
_OF_COUNTERS = {
    "crc_errors": "crc_errors",
    "dropped_bytes": "dropped_bytes",
    "live_frames": "live",
    "info_frames": "info",
    "received_bytes": "bytes",
}


def _steps(
    name: str, quantity: Quantity, esc: EscTelemetry, gateway: GatewayStatus, now: int
) -> int | None:
    read = quantity.read
    if name in _STEPS:
        return _STEPS[name](esc, gateway, now)
    if quantity.of_gateway:
        return int(getattr(gateway, name))
    if name in _OF_COUNTERS:
        return int(getattr(esc.counters, _OF_COUNTERS[name]))
    if not read.wire and read != PRODUCT:
        assert hasattr(esc, name), f"add {name} to _STEPS in {__file__}"
        return int(getattr(esc, name))
    data = esc.info if read.source == "info" else esc.live
    if data is None:
        return None
    if read == PRODUCT:
        return esc.live.battery_voltage * esc.live.battery_current if esc.live else None
    number = int(getattr(data, _NAMES[read.source, read.offset]))
    if quantity.not_on:
        known = esc.info or esc.last_info
        is_unknown = esc.info is None and not number
        if is_unknown or (known and known.device_and_variant >> 10 in quantity.not_on):
            return None
    return number >> read.shift & read.mask if read.mask else number


def _known(name: str, quantity: Quantity) -> Known:
    def read(esc: EscTelemetry, gateway: GatewayStatus, now: int) -> int | Fraction | None:
        steps = _steps(name, quantity, esc, gateway, now)
        if steps is None or (quantity.divisor is Divisor.CELLS and not esc.cells):
            return None
        value = Fraction(steps, quantity.steps)
        if quantity.divisor is Divisor.CELLS:
            value /= esc.cells
        if quantity.divisor in (Divisor.POLES, Divisor.OUTPUT):
            value /= esc.settings.pole_pairs
        if quantity.divisor is Divisor.OUTPUT:
            value /= esc.settings.gear
        return value

    return Known(
        unit=quantity.unit,
        read=read,
        names=quantity.names,
        rolls=quantity.rolls,
        gateway=quantity.of_gateway,
        quantity=quantity,
    )


KNOWN = {name: _known(name, quantity) for name, quantity in QUANTITIES.items()}

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
    def rule(self) -> Rule:
        """The meaning of its raw values."""
        own = self.start_value is not None
        described = Described(
            length=self.length,
            signed=self.signed,
            is_float=self.is_float,
            factor=Fraction(self.factor),
            offset=Fraction(self.offset),
            limits=(Fraction(self.minimum), Fraction(self.maximum)),
            texts=[*self.texts.items()],
            start=self.start_value if own else 0,  # the file's default
            has_own_start=own,
        )
        factor, shift = self.conversion
        conversion = Fraction(factor), Fraction(shift)
        return described.of_quantity(KNOWN[self.source].quantity, None, conversion)

    @property
    def not_available(self) -> int:
        return self.rule.not_available

    def physical(self, esc: EscTelemetry, gateway: GatewayStatus, now: int) -> Fraction | None:
        """Return the value in the signal's unit."""
        value = KNOWN[self.source].read(esc, gateway, now)
        if value is None:
            return None
        factor, shift = self.conversion
        return value * Fraction(factor) + Fraction(shift)

    def right(self, esc: EscTelemetry, gateway: GatewayStatus, now: int) -> int:
        """Return the correct raw value: the nearest one, half up."""
        value = KNOWN[self.source].read(esc, gateway, now)
        return self.rule.sent(None if value is None else Fraction(value))

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
        """Return the signals in a frame of this group."""
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
        """Add a selector and the signals of 1 to 3 groups, if there is a place for the selector."""
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
            taken = set(common)  # groups may overlap
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
