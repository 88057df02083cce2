"""Every value that a DBC can send: its source, and the size of its step.

These tables are typed from the vendor's sheet a second time, and do not import esc/kontronik. A
misplaced row in either of the two is refuted by the proof. Sizes of units are repeated here for the
same reason.
"""

from dataclasses import dataclass
from enum import Enum
from fractions import Fraction

HEADER = 4
"""Bytes of a UART frame before its first field."""
WIRE_RANGES = {
    "u8": (0, 0xFF),
    "i8": (-0x80, 0x7F),
    "u16": (0, 0xFFFF),
    "i16": (-0x8000, 0x7FFF),
    "u32": (0, 0xFFFF_FFFF),
}
"""Smallest and greatest number of each type of field."""
_MOST_COUNTED = 1 << 48
"""Limit of a counter."""
_MOST_ENERGY = 1 << 55
"""Limit of an energy in mW s."""
_MOST_NS = 1 << 61
"""Limit of a time in ns."""
_JIVEPRO = 3
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
    """Type of the field, "" for a counter or state."""
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


_LIVE = """
electrical_speed         4 u32 1/min 1
battery_voltage          8 u16 V     100
battery_current         10 i16 A     10
motor_current           12 i16 A     10
peak_current            14 i16 A     10
consumed_charge         16 u16 mAh   1
bec_current             18 u16 A     1000
bec_voltage             20 u16 V     1000
pwm_input               22 u16 us    1
throttle                24 i8  %     1
output_opening          25 u8  %     1
power_stage_temperature 26 i8  degC  1
bec_temperature         27 i8  degC  1
operating_errors        28 u32 -     1
operating_state         32 u8  -     1
operating_state_raw     32 u8  -     1
timing                  33 u8  us    1
"""
_INFO = """
selftest_errors          8 u32 -     1
cell_count              12 u8  -     1
max_electrical_speed    13 u32 1/min 1
min_battery_voltage     17 u16 V     100
max_battery_voltage     19 u16 V     100
max_battery_current     21 i16 A     10
max_motor_current       23 i16 A     10
max_peak_current        25 i16 A     10
max_bec_current         27 u16 A     1000
min_bec_voltage         29 u16 V     1000
max_throttle            31 i8  %     1
max_output_opening      32 u8  %     1
min_power_stage_temperature 33 i8 degC 1
max_power_stage_temperature 34 i8 degC 1
min_bec_temperature     35 i8  degC  1
max_bec_temperature     36 i8  degC  1
"""
_PARTS = """
device        4 10 6
device_raw    4 10 6
variant       4 0 10
firmware_main 6 8 8
firmware_sub  6 0 8
"""
"""Name, offset in the info frame, lowest bit and number of bits."""
_OPERATING_BITS = """
undervoltage overvoltage overcurrent_integral_error overcurrent_integral_warning
power_stage_overtemp_warning power_stage_overtemp_error bec_undervoltage bec_overvoltage
bec_overcurrent bec_overtemperature switched_off_by_running_down capacity_limit_reached
operating_error_found operating_warning_found selftest_error eeprom_error watchdog_error_tripped
programming_allowed limit_battery_voltage_minimum limit_current_maximum
limit_power_stage_temperature limit_bec_temperature limit_bec_current limit_discharged_capacity
"""
"""The flags of the operating errors, from bit 0."""
_SELFTEST_BITS = """
test_phase_low_side test_phase_high_side test_short_to_ground test_back_emf_offset
test_current_zero_point test_undervoltage test_overvoltage test_bec_undervoltage
test_bec_overvoltage test_reverse_polarity_fuse test_overvoltage_fuse test_power_stage_overtemp
test_bec_overtemperature test_motor_phase_missing test_eeprom_empty test_eeprom_stick_positions
test_eeprom_checksum test_eeprom_size test_eeprom_version
"""
"""The flags of the self-test errors, from bit 0."""
_COUNTERS = """
losses crc_errors dropped_bytes live_frames info_frames received_bytes suspect_frames
"""
_COUNTERS_OF_GATEWAY = """
sent_frames replaced_frames send_failures received_frames bus_off_count dropped_frames
id_conflicts can_restarts
"""
_STATES = """
link_state 5
layout 2
"""
"""Name and greatest number."""
_STATES_OF_GATEWAY = """
gateway_state 4
can_state 5
esc_count 255
escs_ok 255
"""
_NOT_ON_JIVEPRO = {"bec_current", "max_bec_current"}
_PRODUCT = Read("battery voltage times battery current")
_MS_PER_S = 1000
_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000
_ENERGY_STEPS = 3_600_000


def _fields(text: str, source: str, presence: Presence) -> dict[str, Quantity]:
    found = {}
    for line in text.split("\n")[1:-1]:
        name, offset, wire, unit, steps = line.split()
        low, high = WIRE_RANGES[wire]
        found[name] = Quantity(
            Read(source, int(offset), wire),
            low,
            high,
            presence,
            unit.strip("-"),
            int(steps),
            not_on=frozenset({_JIVEPRO}) if name in _NOT_ON_JIVEPRO else frozenset(),
        )
    return found


def _flags(text: str, source: str, offset: int, presence: Presence) -> dict[str, Quantity]:
    found = {}
    for bit, name in enumerate(text.split()):
        found[name] = Quantity(Read(source, offset, "u32", bit, 1), 0, 1, presence)
    return found


def _parts() -> dict[str, Quantity]:
    found = {}
    for line in _PARTS.split("\n")[1:-1]:
        name, offset, shift, width = line.split()
        mask = (1 << int(width)) - 1
        read = Read("info", int(offset), "u16", int(shift), mask)
        found[name] = Quantity(read, 0, mask, Presence.INFO)
    return found


def _measured() -> dict[str, Quantity]:
    """Return the values that are computed from others, from time, or counted."""
    speed = Read("live", 4, "u32")
    most_speed = WIRE_RANGES["u32"][1]
    voltage = WIRE_RANGES["u16"][1]
    low_current, high_current = WIRE_RANGES["i16"]
    live = Presence.LIVE
    always = Presence.ALWAYS
    found = {
        "motor_speed": Quantity(speed, 0, most_speed, live, "1/min", 1, Divisor.POLES),
        "output_speed": Quantity(speed, 0, most_speed, live, "1/min", 1, Divisor.OUTPUT),
        "mean_cell_voltage": Quantity(
            Read("live", 8, "u16"), 0, voltage, live, "V", 100, Divisor.CELLS
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
    for names, of_gateway in ((_COUNTERS, False), (_COUNTERS_OF_GATEWAY, True)):
        for name in names.split():
            most = _MOST_COUNTED
            found[name] = Quantity(Read(name), 0, most, always, rolls=True, of_gateway=of_gateway)
    for lines, of_gateway in ((_STATES, False), (_STATES_OF_GATEWAY, True)):
        for line in lines.split("\n")[1:-1]:
            name, number = line.split()
            found[name] = Quantity(Read(name), 0, int(number), always, of_gateway=of_gateway)
    return found


QUANTITIES = {
    **_fields(_LIVE, "live", Presence.LIVE),
    **_fields(_INFO, "info", Presence.INFO),
    **_flags(_OPERATING_BITS, "live", 28, Presence.LIVE),
    **_flags(_SELFTEST_BITS, "info", 8, Presence.INFO),
    **_parts(),
    **_measured(),
}
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
