"""Names of devices, operating states and error bits (sheet V4, tables of the live and info frame).

Newer firmware may send numbers that have no name here. They are shown as numbers.
"""

from enum import IntEnum
from typing import Self

from kontronik_can_gw.esc.decoder import ErrorBit, Severity, StateText


class Device(IntEnum):
    """Number of the device: the high six bits of the info frame's first word. 0 is reserved.

    A member is written ``NAME = (number, text, peak_current_of)``.
    """

    text: str
    """The name as the manufacturer writes it."""
    peak_current_of: str | None
    """Origin of the peak current, a held maximum: ``motor`` or ``battery``. None if unknown."""

    def __new__(cls, number: int, text: str, peak_current_of: str | None) -> Self:
        member = int.__new__(cls, number)
        member._value_ = number
        member.text = text
        member.peak_current_of = peak_current_of
        return member

    KOSMIK = (1, "KOSMIK", "motor")
    KOLIBRI = (2, "KOLIBRI", "motor")
    JIVEPRO = (3, "JIVEPro", "battery")
    KONTROL_X = (4, "KONTROL-X", "motor")
    UHV = (5, "UHV", None)


# fmt: off
class OperatingState(IntEnum):
    """Operating state: live frame, offset 32. 0, 4, 5, 6 and 8 have no name.

    All recorded idle frames contain 12. A member is written
    ``NAME = (number, meaning, kind, phase, remedy)``, as described in ``StateText``. Its name has
    the spelling of the protocol specification, which describes nothing but the names.
    """

    about: StateText

    def __new__(
        cls, number: int, meaning: str, kind: str, phase: str, remedy: str = "Nothing to do."
    ) -> Self:
        member = int.__new__(cls, number)
        member._value_ = number
        member.about = StateText("", meaning, remedy, kind, phase)
        return member

    def __init__(self, *_: object) -> None:
        self.about = self.about._replace(text=self.name)

    WaitForSignal = (1, "waits for a signal at its input", "idle", "Waiting",
        ("If this state persists: switch on transmitter and receiver, "
         "and check the cable from the receiver."))
    WaitForMotorOff = (2, "waits for the command motor off", "idle", "Waiting",
        "If this state persists: move the throttle to motor off.")
    WaitForMotorOn = (3, "waits for the command motor on", "idle", "Waiting")
    Selftest = (7, "tests itself", "idle", "Self-test, signal")
    Error_Selftest = (9, "the self-test found an error", "fault", "Fault",
        "Do not run the motor. Follow the remedy of the self-test error that is set.")
    CutOffDuringOperation = (10, "switched off during operation", "fault", "Fault",
        "Follow the remedy of the operating error that is set.")
    AcousticSignal = (11, "gives an acoustic signal", "idle", "Self-test, signal")
    MotorOff = (12, "motor off", "idle", "Motor off, standby")
    StandBy = (13, "stand-by", "idle", "Motor off, standby")
    Brake = (14, "brakes", "brake", "Braking")
    BrakeTargetBackward = (15, "brakes, target backward", "brake", "Braking")
    BrakeTargetForward = (16, "brakes, target forward", "brake", "Braking")
    Programming = (17, "is being programmed", "idle", "Programming")
    Sync_Forward = (18, "synchronizes, forward", "run", "Spooling up, synchronising")
    Sync_Backward = (19, "synchronizes, backward", "run", "Spooling up, synchronising")
    Sync_StandBy = (20, "synchronizes, stand-by", "idle", "Spooling up, synchronising")
    Forward = (21, "runs forward", "run", "Running")
    Backward = (22, "runs backward", "run", "Running")
    SpoolUpFromStill = (23, "spools up from standstill", "start", "Spooling up, synchronising")
    SpoolUpFromTurn = (24, "spools up while already turning", "start", "Spooling up, synchronising")
    SpoolUpQuick = (25, "spools up quickly", "start", "Spooling up, synchronising")
    RPMControl = (26, "speed control", "run", "Running")


LARGEST_STATE = max(OperatingState)


# The parts of a member are described in ``ErrorBit``. The protocol specification has no remedies:
# they are common practice with any ESC.
_E = Severity.ERROR
_W = Severity.WARNING
_S = Severity.STATUS


class OperatingError(ErrorBit):
    """Bits of the error word: live frame, offset 28."""

    UNDERVOLTAGE = (0, _E, "battery voltage too low",
        ("Stop soon. Charge or check the battery. "
         "Check connectors and cables: long or thin ones lose voltage under load."), 0x3220)
    OVERVOLTAGE = (1, _E, "battery voltage too high",
        ("Check that the number of cells suits the ESC. "
         "If it occurs while braking: a full battery or a power supply cannot take energy back."),
        0x3210)
    OVERCURRENT_INTEGRAL_ERROR = (2, _E, "current too high for too long: switched off",
        ("Stop. Check that motor and drive turn freely. "
         "Reduce the load: smaller propeller or pinion, less pitch, less throttle."),
        0x2350)
    OVERCURRENT_INTEGRAL_WARNING = (3, _W, "current high for a long time",
        "Reduce the load before the ESC switches off.", 0x2351)
    POWER_STAGE_OVERTEMP_WARNING = (4, _W, "power stage hot",
        "Reduce the load. Let the ESC cool and give it more air.")
    POWER_STAGE_OVERTEMP_ERROR = (5, _E, "power stage too hot",
        "Stop and let the ESC cool. Then give it more air, or reduce the load.", 0x4210)
    BEC_UNDERVOLTAGE = (6, _E, "BEC voltage too low",
        ("Stop soon: receiver and servos may fail. "
         "Check the battery, the BEC's wiring and the current of the servos."), 0x5114)
    BEC_OVERVOLTAGE = (7, _E, "BEC voltage too high",
        ("Check what else supplies the receiver: a second BEC, a backup battery. "
         "If nothing does, have the ESC checked."), 0x5115)
    BEC_OVERCURRENT = (8, _E, "BEC current too high",
        ("Look for a blocked or short-circuited servo. "
         "If all servos work, reduce the load on the BEC."), 0x2220)
    BEC_OVERTEMPERATURE = (9, _E, "BEC too hot",
        "Reduce the load on the BEC. Let the ESC cool and give it more air.", 0x4410)
    SWITCHED_OFF_BY_RUNNING_DOWN = (10, _S, "switched off by running down (in speed control)",
        "This is not an alarm. If the motor should have kept running, check battery and load.")
    CAPACITY_LIMIT_REACHED = (11, _W, "set capacity limit reached",
        "Stop and charge the battery. The limit is a setting of the ESC.")
    OPERATING_ERROR_FOUND = (12, _E, "summary: an operating error was found",
        ("Follow the remedy of the other error that is set. "
         "If no other error is set, see the operating state."), 0x1000, True)
    OPERATING_WARNING_FOUND = (13, _W, "summary: an operating warning was found",
        "Follow the remedy of the other warning that is set.", None, True)
    SELFTEST_ERROR = (14, _E, "self-test failed: see the self-test error bits",
        "Do not run the motor. Follow the remedy of the self-test error that is set.", 0x5000)
    EEPROM_ERROR = (15, _E, "EEPROM error",
        ("Switch the ESC off and on. If the error persists, set up the ESC again. "
         "If it still persists, have the ESC checked."), 0x5530)
    WATCHDOG_ERROR_TRIPPED = (16, _E, "the ESC's watchdog had tripped",
        ("Switch the ESC off and on. "
         "If the error returns, have the ESC checked, because its program had hung."), 0x6010)
    PROGRAMMING_ALLOWED = (17, _S, "programming still allowed (set in every idle frame: no alarm)",
        "Nothing to do.", None, False, True)
    LIMIT_BATTERY_VOLTAGE_MINIMUM = (18, _W, "preset threshold: battery voltage minimum",
        "Stop and charge the battery. The threshold is a setting of the ESC.")
    LIMIT_CURRENT_MAXIMUM = (19, _W, "preset threshold: current maximum",
        "Reduce the load. The threshold is a setting of the ESC.")
    LIMIT_POWER_STAGE_TEMPERATURE = (20, _W, "preset threshold: power stage temperature",
        "Reduce the load, or give the ESC more air. The threshold is a setting of the ESC.")
    LIMIT_BEC_TEMPERATURE = (21, _W, "preset threshold: BEC temperature",
        ("Reduce the load on the BEC, or give the ESC more air. "
         "The threshold is a setting of the ESC."))
    LIMIT_BEC_CURRENT = (22, _W, "preset threshold: BEC current",
        ("Reduce the load on the BEC, and look for a blocked servo. "
         "The threshold is a setting of the ESC."))
    LIMIT_DISCHARGED_CAPACITY = (23, _W, "preset threshold: discharged capacity",
        "Stop and charge the battery. The threshold is a setting of the ESC.")


class SelfTestError(ErrorBit):
    """Bits of the self-test word: info frame, offset 8. All are errors."""

    TEST_PHASE_LOW_SIDE = (0, _E, "motor phase low side does not switch",
        "Check the motor's wires and plugs for a short. If there is none, have the ESC checked.")
    TEST_PHASE_HIGH_SIDE = (1, _E, "motor phase high side does not switch",
        "Check the motor's wires and plugs for a short. If there is none, have the ESC checked.")
    TEST_SHORT_TO_GROUND = (2, _E, "short to GND or rest level",
        ("Unplug the battery. Look for a short between the motor's wires, or to ground. "
         "If there is none, have the ESC checked."))
    TEST_BACK_EMF_OFFSET = (3, _E, "back-EMF offset",
        ("Wait until the motor has stopped, then switch on again. "
         "If the error persists, have the ESC checked."))
    TEST_CURRENT_ZERO_POINT = (4, _E, "current zero point",
        ("Wait until the motor has stopped, then switch on again. "
         "If the error persists, have the ESC checked."))
    TEST_UNDERVOLTAGE = (5, _E, "undervoltage",
        "Charge or check the battery. Check its connectors and cables.")
    TEST_OVERVOLTAGE = (6, _E, "overvoltage",
        "Check that the number of cells suits the ESC.")
    TEST_BEC_UNDERVOLTAGE = (7, _E, "BEC undervoltage",
        ("Reduce the load on the BEC: unplug the servos one by one. "
         "If the error persists, have the ESC checked."))
    TEST_BEC_OVERVOLTAGE = (8, _E, "BEC overvoltage",
        ("Check what else supplies the receiver: a second BEC, a backup battery. "
         "If nothing does, have the ESC checked."))
    TEST_REVERSE_POLARITY_FUSE = (9, _E, "reverse-polarity fuse",
        "Unplug the battery and check its polarity. If it is right, have the ESC checked.")
    TEST_OVERVOLTAGE_FUSE = (10, _E, "overvoltage fuse",
        ("Unplug the battery and check that its number of cells suits the ESC. "
         "If it does, have the ESC checked."))
    TEST_POWER_STAGE_OVERTEMP = (11, _E, "power stage overtemperature",
        "Let the ESC cool, then switch on again.")
    TEST_BEC_OVERTEMPERATURE = (12, _E, "BEC overtemperature",
        ("Let the ESC cool, then switch on again. "
         "If the error persists, reduce the load on the BEC."))
    TEST_MOTOR_PHASE_MISSING = (13, _E, "not all three motor phases connected",
        "Check all three wires and plugs between ESC and motor, and the motor's winding.")
    TEST_EEPROM_EMPTY = (14, _E, "EEPROM empty",
        "Set up the ESC again. If the error persists, have the ESC checked.")
    TEST_EEPROM_STICK_POSITIONS = (15, _E, "stick positions of the EEPROM configuration",
        "Teach the ESC the stick positions again.")
    TEST_EEPROM_CHECKSUM = (16, _E, "EEPROM checksum",
        "Set up the ESC again. If the error persists, have the ESC checked.")
    TEST_EEPROM_SIZE = (17, _E, "EEPROM size",
        ("Set up the ESC again, as after a firmware update. "
         "If the error persists, have the ESC checked."))
    TEST_EEPROM_VERSION = (18, _E, "EEPROM version",
        ("Set up the ESC again, as after a firmware update. "
         "If the error persists, have the ESC checked."))


# fmt: on
