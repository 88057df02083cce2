"""The vendor's protocol specification, typed a second time by hand.

Imports nothing of the tested package, and all tests use it. Offsets are written out here, while the
package derives them. So a misplaced row in either list is found. `quantities` has the values that
are derived from the fields, and `rule` the raw values of signals.
"""

from typing import NamedTuple


class Field(NamedTuple):
    """One field of a frame."""

    name: str
    offset: int
    """Position of its first byte."""
    code: str
    """struct code of its type."""
    unit: str
    steps: int = 1
    """Number of steps that make one unit."""


# The specification has BEC current and voltage in mA and mV. They are published in A and V.
LIVE_FIELDS = [
    Field("electrical_speed", 4, "I", "1/min"),
    Field("battery_voltage", 8, "H", "V", 100),
    Field("battery_current", 10, "h", "A", 10),
    Field("motor_current", 12, "h", "A", 10),
    Field("peak_current", 14, "h", "A", 10),
    Field("consumed_charge", 16, "H", "mAh"),
    Field("bec_current", 18, "H", "A", 1000),
    Field("bec_voltage", 20, "H", "V", 1000),
    Field("pwm_input", 22, "H", "µs"),
    Field("throttle", 24, "b", "%"),
    Field("output_opening", 25, "B", "%"),
    Field("power_stage_temperature", 26, "b", "°C"),
    Field("bec_temperature", 27, "b", "°C"),
    Field("operating_errors", 28, "I", ""),
    Field("operating_state", 32, "B", ""),
    Field("timing", 33, "B", "µs"),
]

INFO_FIELDS = [
    Field("device_and_variant", 4, "H", ""),
    Field("firmware_word", 6, "H", ""),
    Field("selftest_errors", 8, "I", ""),
    Field("cell_count", 12, "B", ""),
    Field("max_electrical_speed", 13, "I", "1/min"),
    Field("min_battery_voltage", 17, "H", "V", 100),
    Field("max_battery_voltage", 19, "H", "V", 100),
    Field("max_battery_current", 21, "h", "A", 10),
    Field("max_motor_current", 23, "h", "A", 10),
    Field("max_peak_current", 25, "h", "A", 10),
    Field("max_bec_current", 27, "H", "A", 1000),
    Field("min_bec_voltage", 29, "H", "V", 1000),
    Field("max_throttle", 31, "b", "%"),
    Field("max_output_opening", 32, "B", "%"),
    Field("min_power_stage_temperature", 33, "b", "°C"),
    Field("max_power_stage_temperature", 34, "b", "°C"),
    Field("min_bec_temperature", 35, "b", "°C"),
    Field("max_bec_temperature", 36, "b", "°C"),
]

LIVE_STRUCT = "<" + "".join(field.code for field in LIVE_FIELDS)
INFO_STRUCT = "<" + "".join(field.code for field in INFO_FIELDS)

TYPE_RANGES = {
    "B": (0, 255),
    "b": (-128, 127),
    "H": (0, 65_535),
    "h": (-32_768, 32_767),
    "I": (0, 4_294_967_295),
}

# Ranges in steps, as far as the description of the wire states them.
STATED_RANGES = {
    "battery_voltage": (0, 10_000),
    "battery_current": (-10_000, 10_000),
    "motor_current": (-10_000, 10_000),
    "peak_current": (-10_000, 10_000),
    "throttle": (-100, 100),
    "min_battery_voltage": (0, 10_000),
    "max_battery_voltage": (0, 10_000),
    "max_battery_current": (-10_000, 10_000),
    "max_motor_current": (-10_000, 10_000),
    "max_peak_current": (-10_000, 10_000),
}


class FormRow(NamedTuple):
    """One of the four frame forms. The CRC covers bytes 0 to ``covered`` - 1."""

    kind: str
    layout: str
    header: bytes
    length: int
    covered: int
    crc_at: int
    body_end: int


FORM_ROWS = [
    FormRow("live", "legacy", b"\x4b\x4f\x44\x4c", 38, 32, 34, 34),
    FormRow("info", "legacy", b"\x4b\x4f\x44\x49", 41, 36, 37, 37),
    FormRow("live", "v4", b"\x4b\x4f\x44\x4c", 40, 36, 36, 34),
    FormRow("info", "v4", b"\x4b\x4f\x44\x49", 44, 40, 40, 37),
]

DEVICES = {1: "KOSMIK", 2: "KOLIBRI", 3: "JIVEPro", 4: "KONTROL-X", 5: "UHV"}

JIVEPRO = 3

PEAK_CURRENT_OF = {1: "motor", 2: "motor", 3: "battery", 4: "motor"}

OPERATING_STATES = {
    1: "WaitForSignal",
    2: "WaitForMotorOff",
    3: "WaitForMotorOn",
    7: "Selftest",
    9: "Error_Selftest",
    10: "CutOffDuringOperation",
    11: "AcousticSignal",
    12: "MotorOff",
    13: "StandBy",
    14: "Brake",
    15: "BrakeTargetBackward",
    16: "BrakeTargetForward",
    17: "Programming",
    18: "Sync_Forward",
    19: "Sync_Backward",
    20: "Sync_StandBy",
    21: "Forward",
    22: "Backward",
    23: "SpoolUpFromStill",
    24: "SpoolUpFromTurn",
    25: "SpoolUpQuick",
    26: "RPMControl",
}


class Bit(NamedTuple):
    """One bit of an error word."""

    number: int
    name: str
    """Name of its value."""
    words: tuple[str, ...]
    """Words that its name or meaning must contain."""
    severity: str | None = None
    """Its class, or None if the specification does not state it."""


OPERATING_BITS = [
    Bit(0, "undervoltage", ("undervoltage", "battery")),
    Bit(1, "overvoltage", ("overvoltage", "battery")),
    Bit(2, "overcurrent_integral_error", ("overcurrent", "integral", "error"), "error"),
    Bit(3, "overcurrent_integral_warning", ("overcurrent", "integral", "warning"), "warning"),
    Bit(4, "power_stage_overtemp_warning", ("power_stage", "overtemp", "warning"), "warning"),
    Bit(5, "power_stage_overtemp_error", ("power_stage", "overtemp", "error"), "error"),
    Bit(6, "bec_undervoltage", ("bec", "undervoltage")),
    Bit(7, "bec_overvoltage", ("bec", "overvoltage")),
    Bit(8, "bec_overcurrent", ("bec", "overcurrent")),
    Bit(9, "bec_overtemperature", ("bec", "overtemp")),
    Bit(10, "switched_off_by_running_down", ("switched off by running down", "speed control")),
    Bit(11, "capacity_limit_reached", ("capacity", "limit", "reached")),
    Bit(12, "operating_error_found", ("summary", "operating error"), "error"),
    Bit(13, "operating_warning_found", ("summary", "operating warning"), "warning"),
    Bit(14, "selftest_error", ("selftest", "error"), "error"),
    Bit(15, "eeprom_error", ("eeprom", "error"), "error"),
    Bit(16, "watchdog_error_tripped", ("watchdog", "error", "tripped"), "error"),
    Bit(17, "programming_allowed", ("programming", "allowed", "no alarm"), "status"),
    Bit(18, "limit_battery_voltage_minimum", ("preset threshold", "battery voltage", "minimum")),
    Bit(19, "limit_current_maximum", ("preset threshold", "current", "maximum")),
    Bit(20, "limit_power_stage_temperature", ("preset threshold", "power stage temperature")),
    Bit(21, "limit_bec_temperature", ("preset threshold", "bec temperature")),
    Bit(22, "limit_bec_current", ("preset threshold", "bec current")),
    Bit(23, "limit_discharged_capacity", ("preset threshold", "discharged capacity")),
]

SELFTEST_BITS = [
    Bit(0, "test_phase_low_side", ("motor phase", "low side", "does not switch"), "error"),
    Bit(1, "test_phase_high_side", ("motor phase", "high side", "does not switch"), "error"),
    Bit(2, "test_short_to_ground", ("short", "gnd", "rest level"), "error"),
    Bit(3, "test_back_emf_offset", ("back-emf", "offset"), "error"),
    Bit(4, "test_current_zero_point", ("current", "zero point"), "error"),
    Bit(5, "test_undervoltage", ("undervoltage",), "error"),
    Bit(6, "test_overvoltage", ("overvoltage",), "error"),
    Bit(7, "test_bec_undervoltage", ("bec", "undervoltage"), "error"),
    Bit(8, "test_bec_overvoltage", ("bec", "overvoltage"), "error"),
    Bit(9, "test_reverse_polarity_fuse", ("reverse-polarity", "fuse"), "error"),
    Bit(10, "test_overvoltage_fuse", ("overvoltage", "fuse"), "error"),
    Bit(11, "test_power_stage_overtemp", ("power stage", "overtemperature"), "error"),
    Bit(12, "test_bec_overtemperature", ("bec", "overtemperature"), "error"),
    Bit(13, "test_motor_phase_missing", ("not all three", "motor phases", "connected"), "error"),
    Bit(14, "test_eeprom_empty", ("eeprom", "empty"), "error"),
    Bit(15, "test_eeprom_stick_positions", ("eeprom", "stick positions", "configuration"), "error"),
    Bit(16, "test_eeprom_checksum", ("eeprom", "checksum"), "error"),
    Bit(17, "test_eeprom_size", ("eeprom", "size"), "error"),
    Bit(18, "test_eeprom_version", ("eeprom", "version"), "error"),
]

# Recorded from an idle JIVE PRO 120, firmware 1.14, in the legacy layout. All other frames in these
# tests are synthetic.
RECORDED_LIVE = bytes.fromhex(
    "4B4F444C 00000000 8A09 0000 0000 0000 0000 0000 581F E903 00 00 1D 20 00000200 0C 00 39234C14"
)
RECORDED_INFO = bytes.fromhex(
    "4B4F4449 780C 0E01 00000000 06 00000000 6E09 0000 0000 0000 0000 0000 DF15 "
    "00 00 1B 1E 1C 21 904AE8A9"
)
