"""Names of devices, operating states and error bits, with their class. Source: sheet V4, tables of the live and info frame.

Numbers without a name stay numbers: no function here raises for a value that newer firmware may send.
"""

from enum import Enum, IntEnum
from typing import Self


class Severity(Enum):
    """Class of a bit: an error, a warning, or a mere status that is no alarm."""

    ERROR = "error"
    WARNING = "warning"
    STATUS = "status"


class Device(IntEnum):
    """High six bits of the info frame's first word. 0 is reserved."""

    KOSMIK = 1
    KOLIBRI = 2
    JIVEPRO = 3
    KONTROL_X = 4
    UHV = 5

    @property
    def text(self) -> str:
        """The maker's spelling."""
        return _DEVICE_TEXTS[self]


_DEVICE_TEXTS = {
    Device.KOSMIK: "KOSMIK",
    Device.KOLIBRI: "KOLIBRI",
    Device.JIVEPRO: "JIVEPro",
    Device.KONTROL_X: "KONTROL-X",
    Device.UHV: "UHV",
}


class OperatingState(IntEnum):
    """Live frame, offset 32. 0, 4, 5, 6 and 8 have no name; 12 stands in every recorded idle frame."""

    WaitForSignal = 1
    WaitForMotorOff = 2
    WaitForMotorOn = 3
    Selftest = 7
    Error_Selftest = 9
    CutOffDuringOperation = 10
    AcousticSignal = 11
    MotorOff = 12
    StandBy = 13
    Brake = 14
    BrakeTargetBackward = 15
    BrakeTargetForward = 16
    Programming = 17
    Sync_Forward = 18
    Sync_Backward = 19
    Sync_StandBy = 20
    Forward = 21
    Backward = 22
    SpoolUpFromStill = 23
    SpoolUpFromTurn = 24
    SpoolUpQuick = 25
    RPMControl = 26

    @property
    def text(self) -> str:
        """The sheet's spelling."""
        return self.name


LARGEST_STATE = max(OperatingState)


class ErrorBit(IntEnum):
    """A bit number with a severity and a meaning; the base of both error words."""

    severity: Severity
    meaning: str

    def __new__(cls, bit: int, severity: Severity, meaning: str) -> Self:
        member = int.__new__(cls, bit)
        member._value_ = bit
        member.severity = severity
        member.meaning = meaning
        return member

    @property
    def text(self) -> str:
        """The name as decode prints it and DBC signals bind to it."""
        return self.name.lower()


_E, _W, _S = Severity.ERROR, Severity.WARNING, Severity.STATUS


class OperatingError(ErrorBit):
    """Bits of the live frame's error word, offset 28."""

    UNDERVOLTAGE = 0, _E, "battery voltage too low"
    OVERVOLTAGE = 1, _E, "battery voltage too high"
    OVERCURRENT_INTEGRAL_ERROR = 2, _E, "current too high for too long: switched off"
    OVERCURRENT_INTEGRAL_WARNING = 3, _W, "current high for long"
    POWER_STAGE_OVERTEMP_WARNING = 4, _W, "power stage hot"
    POWER_STAGE_OVERTEMP_ERROR = 5, _E, "power stage too hot"
    BEC_UNDERVOLTAGE = 6, _E, "BEC voltage too low"
    BEC_OVERVOLTAGE = 7, _E, "BEC voltage too high"
    BEC_OVERCURRENT = 8, _E, "BEC current too high"
    BEC_OVERTEMPERATURE = 9, _E, "BEC too hot"
    SWITCHED_OFF_BY_RUNNING_DOWN = 10, _S, "switched off by running down (in speed control)"
    CAPACITY_LIMIT_REACHED = 11, _W, "set capacity limit reached"
    OPERATING_ERROR_FOUND = 12, _E, "summary: an operating error was found"
    OPERATING_WARNING_FOUND = 13, _W, "summary: an operating warning was found"
    SELFTEST_ERROR = 14, _E, "self-test failed: see the self-test error bits"
    EEPROM_ERROR = 15, _E, "EEPROM error"
    WATCHDOG_ERROR_TRIPPED = 16, _E, "the ESC's watchdog had tripped"
    PROGRAMMING_ALLOWED = 17, _S, "programming still allowed (set in every idle frame: no alarm)"
    LIMIT_BATTERY_VOLTAGE_MINIMUM = 18, _W, "preset threshold: battery voltage minimum"
    LIMIT_CURRENT_MAXIMUM = 19, _W, "preset threshold: current maximum"
    LIMIT_POWER_STAGE_TEMPERATURE = 20, _W, "preset threshold: power stage temperature"
    LIMIT_BEC_TEMPERATURE = 21, _W, "preset threshold: BEC temperature"
    LIMIT_BEC_CURRENT = 22, _W, "preset threshold: BEC current"
    LIMIT_DISCHARGED_CAPACITY = 23, _W, "preset threshold: discharged capacity"


class SelfTestError(ErrorBit):
    """Bits of the info frame's self-test word, offset 8. All are errors."""

    TEST_PHASE_LOW_SIDE = 0, _E, "motor phase low side does not switch"
    TEST_PHASE_HIGH_SIDE = 1, _E, "motor phase high side does not switch"
    TEST_SHORT_TO_GROUND = 2, _E, "short to GND or rest level"
    TEST_BACK_EMF_OFFSET = 3, _E, "back-EMF offset"
    TEST_CURRENT_ZERO_POINT = 4, _E, "current zero point"
    TEST_UNDERVOLTAGE = 5, _E, "undervoltage"
    TEST_OVERVOLTAGE = 6, _E, "overvoltage"
    TEST_BEC_UNDERVOLTAGE = 7, _E, "BEC undervoltage"
    TEST_BEC_OVERVOLTAGE = 8, _E, "BEC overvoltage"
    TEST_REVERSE_POLARITY_FUSE = 9, _E, "reverse-polarity fuse"
    TEST_OVERVOLTAGE_FUSE = 10, _E, "overvoltage fuse"
    TEST_POWER_STAGE_OVERTEMP = 11, _E, "power stage overtemperature"
    TEST_BEC_OVERTEMPERATURE = 12, _E, "BEC overtemperature"
    TEST_MOTOR_PHASE_MISSING = 13, _E, "not all three motor phases connected"
    TEST_EEPROM_EMPTY = 14, _E, "EEPROM empty"
    TEST_EEPROM_STICK_POSITIONS = 15, _E, "stick positions of the EEPROM configuration"
    TEST_EEPROM_CHECKSUM = 16, _E, "EEPROM checksum"
    TEST_EEPROM_SIZE = 17, _E, "EEPROM size"
    TEST_EEPROM_VERSION = 18, _E, "EEPROM version"


def device_text(number: int) -> str | None:
    """The device's name, or None for a number that has none."""
    return Device(number).text if number in Device._value2member_map_ else None


def state_text(number: int) -> str | None:
    """The operating state's name, or None for a number that has none."""
    return OperatingState(number).text if number in OperatingState._value2member_map_ else None


def bit_texts(word: int, names: type[ErrorBit]) -> list[str]:
    """Names of the bits set in a 32-bit error word, lowest first; a bit without a name is ``bit24`` and the like."""
    known = {int(bit): bit.text for bit in names}
    return [known.get(bit, f"bit{bit}") for bit in range(32) if word >> bit & 1]


def peak_current_of(device: int) -> str | None:
    """Whose peak current the device reports (a held maximum): ``motor``, ``battery``, or None where unknown."""
    if device == Device.JIVEPRO:
        return "battery"
    return "motor" if device in (Device.KOSMIK, Device.KOLIBRI, Device.KONTROL_X) else None
