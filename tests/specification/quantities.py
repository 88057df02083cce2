"""Every value that a DBC can send: its source, and the size of its step.

They are derived from the fields of the protocol specification. Nothing of the package is used, so
the proof refutes a misplaced row in either of the two descriptions. Sizes of units are repeated
here for the same reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction

import specification
from specification import TYPE_RANGES

HEADER = 4
"""Bytes of a UART frame before its first field."""
_MOST_COUNTED = 1 << 48
"""Limit of a counter."""
_MOST_ENERGY = 1 << 55
"""Limit of an energy in mW s."""
_MOST_NS = 1 << 61
"""Limit of a time in ns."""
_BY_LIVE_DATA = ("energy_used", "motor_run_time")
"""Sums that increase with live data."""


class Presence(Enum):
    """When a value is available."""

    LIVE = "live data is fresh"
    INFO = "info data is fresh"
    KNOWN_INFO = "info data was received from the present device"
    AFTER_LIVE = "a live frame was received"
    RATED = "the rate is known"
    ALWAYS = "always"


class Pace(Enum):
    """The event that changes a value."""

    LIVE = "live data"
    INFO = "info data"
    LINK = "a state or counter of the link, or a second"
    GATEWAY = "the gateway"


class Divisor(Enum):
    """The setting that divides a number of steps."""

    ONE = "1"
    POLES = "pole pairs"
    OUTPUT = "pole pairs times gear"
    CELLS = "number of cells"


@dataclass(frozen=True)
class Read:
    """The source of a number of steps."""

    source: str
    """"live" or "info" for a field of a frame. Otherwise the name of a counter or state."""
    offset: int = 0
    """Position of the field in the frame, header included."""
    wire: str = ""
    """struct code of the field, "" for a counter or state."""
    shift: int = 0
    mask: int = 0
    """The steps are ``field >> shift & mask``. 0: the whole field."""


@dataclass(frozen=True)
class Quantity:
    """One value."""

    read: Read
    low: int
    high: int
    """Smallest and greatest number of steps."""
    presence: Presence
    unit: str = ""
    steps: int = 1
    """Number of steps that make one unit."""
    divisor: Divisor = Divisor.ONE
    not_on: frozenset[int] = frozenset()
    """Devices that do not supply the value."""
    rolls: bool = False
    """True for a counter that restarts at 0 after the greatest value of its signal."""
    of_gateway: bool = False
    names: Mapping[int, str] = field(default_factory=dict)
    """Names of its numbers."""

    @property
    def pace(self) -> Pace:
        if self.of_gateway:
            return Pace.GATEWAY
        if self.read.source == "info":
            return Pace.INFO
        of_live = self.presence is Presence.LIVE or self.read.source in _BY_LIVE_DATA
        return Pace.LIVE if of_live else Pace.LINK

    @property
    def is_flag(self) -> bool:
        return self.read.mask == 1


_PARTS = """
device        4 10 6
device_raw    4 10 6
variant       4 0 10
firmware_main 6 8 8
firmware_sub  6 0 8
"""
"""Name, offset in the info frame, lowest bit and number of bits."""
_COUNTERS = """
losses crc_errors dropped_bytes live_frames info_frames received_bytes suspect_frames
"""
_COUNTERS_OF_GATEWAY = """
sent_frames replaced_frames send_failures received_frames bus_off_count dropped_frames
id_conflicts can_restarts
"""
LINKS = dict(enumerate(("NeverSeen", "Searching", "Ok", "Degraded", "Lost", "PortError")))
LAYOUTS = dict(enumerate(("Unknown", "V4", "Legacy")))
GATEWAY_STATES = dict(enumerate(("Starting", "Running", "Stopping", "Replay", "Quiet")))
CAN_STATES = dict(
    enumerate(("Unknown", "ErrorActive", "ErrorWarning", "ErrorPassive", "BusOff", "Down"))
)
_STATES: dict[str, Mapping[int, str]] = {"link_state": LINKS, "layout": LAYOUTS}
_STATES_OF_GATEWAY: dict[str, Mapping[int, str]] = {
    "gateway_state": GATEWAY_STATES,
    "can_state": CAN_STATES,
    "esc_count": {},
    "escs_ok": {},
}
_MOST_ESCS = 255
_NOT_ON_JIVEPRO = {"bec_current", "max_bec_current"}
_SPELLINGS = str.maketrans({"µ": "u", "°": "deg"})
_ARE_PARTS = ("device_and_variant", "firmware_word")
"""Fields that are no value as a whole."""
_PRODUCT = Read("battery voltage times battery current")
_MS_PER_S = 1000
_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000
_ENERGY_STEPS = 3_600_000


def _fields(
    fields: Sequence[specification.Field], source: str, presence: Presence
) -> dict[str, Quantity]:
    found = {}
    for each in fields:
        if each.name in _ARE_PARTS:
            continue
        low, high = TYPE_RANGES[each.code]
        found[each.name] = Quantity(
            Read(source, each.offset, each.code),
            low,
            high,
            presence,
            each.unit.translate(_SPELLINGS),
            each.steps,
            not_on=frozenset({specification.JIVEPRO} if each.name in _NOT_ON_JIVEPRO else ()),
        )
    return found


def _flags(
    bits: Sequence[specification.Bit], source: str, offset: int, presence: Presence
) -> dict[str, Quantity]:
    found = {}
    for bit in bits:
        found[bit.name] = Quantity(Read(source, offset, "I", bit.number, 1), 0, 1, presence)
    return found


def _parts() -> dict[str, Quantity]:
    found = {}
    for line in _PARTS.split("\n")[1:-1]:
        name, offset, shift, width = line.split()
        mask = (1 << int(width)) - 1
        read = Read("info", int(offset), "H", int(shift), mask)
        found[name] = Quantity(read, 0, mask, Presence.INFO)
    return found


def _measured() -> dict[str, Quantity]:
    """Return the values that are computed from others, from time, or counted."""
    speed = Read("live", 4, "I")
    most_speed = TYPE_RANGES["I"][1]
    voltage = TYPE_RANGES["H"][1]
    low_current, high_current = TYPE_RANGES["h"]
    live = Presence.LIVE
    always = Presence.ALWAYS
    found = {
        "motor_speed": Quantity(speed, 0, most_speed, live, "1/min", 1, Divisor.POLES),
        "output_speed": Quantity(speed, 0, most_speed, live, "1/min", 1, Divisor.OUTPUT),
        "mean_cell_voltage": Quantity(
            Read("live", 8, "H"), 0, voltage, live, "V", 100, Divisor.CELLS
        ),
        # 0.01 V times 0.1 A is 1 mW
        "battery_power": Quantity(
            _PRODUCT, voltage * low_current, voltage * high_current, live, "W", 1000
        ),
        "energy_used": Quantity(Read("energy_used"), 0, _MOST_ENERGY, always, "Wh", _ENERGY_STEPS),
        "motor_run_time": Quantity(Read("motor_run_time"), 0, _MOST_NS, always, "s", _NS_PER_S),
        "data_age": Quantity(
            Read("data_age"), 0, _MOST_NS // _NS_PER_MS, Presence.AFTER_LIVE, "ms"
        ),
        "frame_rate": Quantity(Read("frame_rate"), 0, (1 << 31) - 1, Presence.RATED, "Hz", 10),
        "uptime": Quantity(
            Read("uptime"),
            -(_MOST_NS // _NS_PER_MS),
            _MOST_NS // _NS_PER_MS,
            always,
            "s",
            _MS_PER_S,
            of_gateway=True,
        ),
    }
    for words, of_gateway in ((_COUNTERS, False), (_COUNTERS_OF_GATEWAY, True)):
        for name in words.split():
            counter = Quantity(Read(name), 0, _MOST_COUNTED, always, rolls=True)
            found[name] = replace(counter, of_gateway=of_gateway)
    for states, of_gateway in ((_STATES, False), (_STATES_OF_GATEWAY, True)):
        for name, names in states.items():
            state = Quantity(Read(name), 0, max(names, default=_MOST_ESCS), always, names=names)
            found[name] = replace(state, of_gateway=of_gateway)
    return found


def _all() -> dict[str, Quantity]:
    live = _fields(specification.LIVE_FIELDS, "live", Presence.LIVE)
    state = live["operating_state"]
    found = {
        **live,
        "operating_state": replace(state, names=specification.OPERATING_STATES),
        "operating_state_raw": state,
        **_fields(specification.INFO_FIELDS, "info", Presence.INFO),
        **_flags(specification.OPERATING_BITS, "live", 28, Presence.LIVE),
        **_flags(specification.SELFTEST_BITS, "info", 8, Presence.INFO),
        **_parts(),
        **_measured(),
    }
    found["device"] = replace(found["device"], names=specification.DEVICES)
    return found


QUANTITIES = _all()
"""Every value by its name."""
PRODUCT = _PRODUCT

_UNIT_SIZES: dict[str, dict[str, str]] = {
    "voltage": {"V": "1", "mV": "1/1000", "kV": "1000"},
    "current": {"A": "1", "mA": "1/1000", "kA": "1000"},
    "power": {
        "W": "1",
        "mW": "1/1000",
        "kW": "1000",
        "hp": "745.69987158227022",
        "PS": "735.49875",
    },
    "energy": {"Wh": "3600", "mWh": "36/10", "kWh": "3600000", "J": "1", "kJ": "1000"},
    "charge": {"mAh": "36/10", "Ah": "3600", "As": "1"},
    "time": {"s": "1", "ms": "1/1000", "us": "1/1000000", "min": "60", "h": "3600"},
    "frequency": {"Hz": "1", "kHz": "1000"},
    "rotation": {
        "1/min": "1/60",
        "krpm": "1000/60",
        "rps": "1",
        "deg/s": "1/360",
    },
    "share": {"%": "1/100", "‰": "1/1000", "1": "1"},
    "number": {"1": "1"},
}
"""Size of each unit in the SI unit of its quantity."""
_RADIAN_PER_S = Fraction("9.549296585513720146133025802350861722617")
"""In 1/min: 60 / (2 pi). The digits are the definition."""
_ZERO_CELSIUS = Fraction("273.15")


def kelvin(unit: str) -> tuple[Fraction, Fraction]:
    """Return (m, b) of a unit of temperature, so that ``kelvin = number * m + b``."""
    if unit == "degC":
        return Fraction(1), _ZERO_CELSIUS
    if unit == "degF":
        fahrenheit = Fraction(5, 9)
        return fahrenheit, _ZERO_CELSIUS - 32 * fahrenheit
    return Fraction(1), Fraction(0)


def size(quantity: str, unit: str) -> tuple[Fraction, Fraction]:
    """Return (m, b) of a unit, so that ``number in the SI unit = number * m + b``.

    Raises KeyError for an unknown unit.
    """
    if quantity == "temperature":
        return kelvin(unit)
    if unit == "rad/s":
        return _RADIAN_PER_S / 60, Fraction(0)
    return Fraction(_UNIT_SIZES[quantity][unit]), Fraction(0)
