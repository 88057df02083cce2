"""Names of devices, operating states and error bits, with their class. Source: sheet V4, tables of the live and info frame.

Numbers without a name stay numbers: no function here raises for a value that newer firmware may send.
"""

from enum import IntEnum

from kontronik_can_gw.esc.decoder import ErrorBit, Severity


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

    @property
    def meaning(self) -> str:
        """The name in words: the sheet has nothing but the names."""
        return _STATE_MEANINGS[self]

    @property
    def remedy(self) -> str:
        """What a person should do; for most states nothing."""
        return _STATE_REMEDIES.get(self, "Nothing to do.")


_STATE_MEANINGS = {
    OperatingState.WaitForSignal: "waits for a signal at its input",
    OperatingState.WaitForMotorOff: "waits for the command motor off",
    OperatingState.WaitForMotorOn: "waits for the command motor on",
    OperatingState.Selftest: "tests itself",
    OperatingState.Error_Selftest: "the self-test found an error",
    OperatingState.CutOffDuringOperation: "switched off during operation",
    OperatingState.AcousticSignal: "gives an acoustic signal",
    OperatingState.MotorOff: "motor off",
    OperatingState.StandBy: "stands by",
    OperatingState.Brake: "brakes",
    OperatingState.BrakeTargetBackward: "brakes, target backward",
    OperatingState.BrakeTargetForward: "brakes, target forward",
    OperatingState.Programming: "is being programmed",
    OperatingState.Sync_Forward: "synchronizes, forward",
    OperatingState.Sync_Backward: "synchronizes, backward",
    OperatingState.Sync_StandBy: "synchronizes, stand-by",
    OperatingState.Forward: "runs forward",
    OperatingState.Backward: "runs backward",
    OperatingState.SpoolUpFromStill: "spools up from standstill",
    OperatingState.SpoolUpFromTurn: "spools up while it already turns",
    OperatingState.SpoolUpQuick: "spools up quickly",
    OperatingState.RPMControl: "speed control",
}
_STATE_REMEDIES = {
    OperatingState.WaitForSignal: "If it stays: switch transmitter and receiver on, check the cable from the receiver.",
    OperatingState.WaitForMotorOff: "If it stays: put the throttle to motor off.",
    OperatingState.Error_Selftest: "Do not run the motor. See the remedy of the self-test error that is set.",
    OperatingState.CutOffDuringOperation: "See the remedy of the operating error that is set.",
}

KIND_OF_STATE = {
    OperatingState[name]: kind
    for kind, names in {
        "idle": "WaitForSignal WaitForMotorOff WaitForMotorOn Selftest AcousticSignal MotorOff StandBy"
        " Programming Sync_StandBy",
        "start": "SpoolUpFromStill SpoolUpFromTurn SpoolUpQuick",
        "run": "Forward Backward Sync_Forward Sync_Backward RPMControl",
        "brake": "Brake BrakeTargetBackward BrakeTargetForward",
        "fault": "Error_Selftest CutOffDuringOperation",
    }.items()
    for name in names.split()
}
PHASE_OF_STATE = {
    OperatingState[name]: phase
    for phase, names in {
        "Motor off, standby": "MotorOff StandBy",
        "Waiting": "WaitForSignal WaitForMotorOff WaitForMotorOn",
        "Self-test, signal": "Selftest AcousticSignal",
        "Spooling up, synchronising": "SpoolUpFromStill SpoolUpFromTurn SpoolUpQuick Sync_Forward Sync_Backward"
        " Sync_StandBy",
        "Running": "Forward Backward RPMControl",
        "Braking": "Brake BrakeTargetBackward BrakeTargetForward",
        "Programming": "Programming",
        "Fault": "Error_Selftest CutOffDuringOperation",
    }.items()
    for name in names.split()
}

LARGEST_STATE = max(OperatingState)


# Two lines a bit: number, severity and meaning; remedy (common practice with any ESC: the sheet has none), emergency code, summary.
# fmt: off
_E, _W, _S = Severity.ERROR, Severity.WARNING, Severity.STATUS


class OperatingError(ErrorBit):
    """Bits of the live frame's error word, offset 28."""

    UNDERVOLTAGE = (0, _E, "battery voltage too low",
        "Stop soon. Charge or check the battery. Check connectors and cables: long or thin ones lose voltage under load.", 0x3220)
    OVERVOLTAGE = (1, _E, "battery voltage too high",
        "Check that the number of cells suits the ESC. If it comes while braking: a full battery or a power supply takes no energy back.",
        0x3210)
    OVERCURRENT_INTEGRAL_ERROR = (2, _E, "current too high for too long: switched off",
        "Do not go on. Check that motor and drive turn freely. Reduce the load: smaller propeller or pinion, less pitch, less throttle.",
        0x2350)
    OVERCURRENT_INTEGRAL_WARNING = (3, _W, "current high for long",
        "Reduce the load before the ESC switches off.", 0x2351)
    POWER_STAGE_OVERTEMP_WARNING = (4, _W, "power stage hot",
        "Reduce the load. Let the ESC cool and give it more air.")
    POWER_STAGE_OVERTEMP_ERROR = (5, _E, "power stage too hot",
        "Stop and let the ESC cool. Then give it more air, or reduce the load.", 0x4210)
    BEC_UNDERVOLTAGE = (6, _E, "BEC voltage too low",
        "Stop soon: receiver and servos may fail. Check the battery, the BEC's wiring and what the servos draw.", 0x5114)
    BEC_OVERVOLTAGE = (7, _E, "BEC voltage too high",
        "Check what else supplies the receiver: a second BEC, a backup battery. If nothing does, have the ESC checked.", 0x5115)
    BEC_OVERCURRENT = (8, _E, "BEC current too high",
        "Look for a blocked or short-circuited servo. If all are well, take load off the BEC.", 0x2220)
    BEC_OVERTEMPERATURE = (9, _E, "BEC too hot",
        "Take load off the BEC. Let the ESC cool and give it more air.", 0x4410)
    SWITCHED_OFF_BY_RUNNING_DOWN = (10, _S, "switched off by running down (in speed control)",
        "No alarm. If the motor was meant to go on, check battery and load.")
    CAPACITY_LIMIT_REACHED = (11, _W, "set capacity limit reached",
        "Stop and charge the battery. The limit is a setting of the ESC.")
    OPERATING_ERROR_FOUND = (12, _E, "summary: an operating error was found",
        "See which other error is set: its remedy holds. If none is, see the operating state.", 0x1000, True)
    OPERATING_WARNING_FOUND = (13, _W, "summary: an operating warning was found",
        "See which other warning is set: its remedy holds.", None, True)
    SELFTEST_ERROR = (14, _E, "self-test failed: see the self-test error bits",
        "Do not run the motor. See the remedy of the self-test error that is set.", 0x5000)
    EEPROM_ERROR = (15, _E, "EEPROM error",
        "Switch the ESC off and on. If it stays, set the ESC up anew; if it stays even then, have it checked.", 0x5530)
    WATCHDOG_ERROR_TRIPPED = (16, _E, "the ESC's watchdog had tripped",
        "Switch the ESC off and on. If it comes again, have the ESC checked: its program had hung.", 0x6010)
    PROGRAMMING_ALLOWED = (17, _S, "programming still allowed (set in every idle frame: no alarm)",
        "Nothing to do.", None, False, True)
    LIMIT_BATTERY_VOLTAGE_MINIMUM = (18, _W, "preset threshold: battery voltage minimum",
        "Stop and charge the battery. The threshold is a setting of the ESC.")
    LIMIT_CURRENT_MAXIMUM = (19, _W, "preset threshold: current maximum",
        "Reduce the load. The threshold is a setting of the ESC.")
    LIMIT_POWER_STAGE_TEMPERATURE = (20, _W, "preset threshold: power stage temperature",
        "Reduce the load, give the ESC more air. The threshold is a setting of the ESC.")
    LIMIT_BEC_TEMPERATURE = (21, _W, "preset threshold: BEC temperature",
        "Take load off the BEC, give the ESC more air. The threshold is a setting of the ESC.")
    LIMIT_BEC_CURRENT = (22, _W, "preset threshold: BEC current",
        "Take load off the BEC; look for a blocked servo. The threshold is a setting of the ESC.")
    LIMIT_DISCHARGED_CAPACITY = (23, _W, "preset threshold: discharged capacity",
        "Stop and charge the battery. The threshold is a setting of the ESC.")


class SelfTestError(ErrorBit):
    """Bits of the info frame's self-test word, offset 8. All are errors."""

    TEST_PHASE_LOW_SIDE = (0, _E, "motor phase low side does not switch",
        "Check the motor's wires and plugs for a short. If they are well, have the ESC checked.")
    TEST_PHASE_HIGH_SIDE = (1, _E, "motor phase high side does not switch",
        "Check the motor's wires and plugs for a short. If they are well, have the ESC checked.")
    TEST_SHORT_TO_GROUND = (2, _E, "short to GND or rest level",
        "Unplug the battery. Look for a short of the motor's wires, to each other or to ground. If there is none, have the ESC checked.")
    TEST_BACK_EMF_OFFSET = (3, _E, "back-EMF offset",
        "Let the motor stand still and switch on again. If it stays, have the ESC checked.")
    TEST_CURRENT_ZERO_POINT = (4, _E, "current zero point",
        "Let the motor stand still and switch on again. If it stays, have the ESC checked.")
    TEST_UNDERVOLTAGE = (5, _E, "undervoltage",
        "Charge or check the battery. Check its connectors and cables.")
    TEST_OVERVOLTAGE = (6, _E, "overvoltage",
        "Check that the number of cells suits the ESC.")
    TEST_BEC_UNDERVOLTAGE = (7, _E, "BEC undervoltage",
        "Take load off the BEC: unplug the servos one by one. If it stays, have the ESC checked.")
    TEST_BEC_OVERVOLTAGE = (8, _E, "BEC overvoltage",
        "Check what else supplies the receiver: a second BEC, a backup battery. If nothing does, have the ESC checked.")
    TEST_REVERSE_POLARITY_FUSE = (9, _E, "reverse-polarity fuse",
        "Unplug the battery and check its polarity. If it is right, have the ESC checked.")
    TEST_OVERVOLTAGE_FUSE = (10, _E, "overvoltage fuse",
        "Unplug the battery and check that its number of cells suits the ESC. If it does, have the ESC checked.")
    TEST_POWER_STAGE_OVERTEMP = (11, _E, "power stage overtemperature",
        "Let the ESC cool, then switch on again.")
    TEST_BEC_OVERTEMPERATURE = (12, _E, "BEC overtemperature",
        "Let the ESC cool, then switch on again. If it stays, take load off the BEC.")
    TEST_MOTOR_PHASE_MISSING = (13, _E, "not all three motor phases connected",
        "Check all three wires and plugs between ESC and motor, and the motor's winding.")
    TEST_EEPROM_EMPTY = (14, _E, "EEPROM empty",
        "Set the ESC up anew. If it stays, have it checked.")
    TEST_EEPROM_STICK_POSITIONS = (15, _E, "stick positions of the EEPROM configuration",
        "Teach the ESC the stick positions again.")
    TEST_EEPROM_CHECKSUM = (16, _E, "EEPROM checksum",
        "Set the ESC up anew. If it stays, have it checked.")
    TEST_EEPROM_SIZE = (17, _E, "EEPROM size",
        "Set the ESC up anew, as after a firmware update. If it stays, have it checked.")
    TEST_EEPROM_VERSION = (18, _E, "EEPROM version",
        "Set the ESC up anew, as after a firmware update. If it stays, have it checked.")


# fmt: on


def device_text(number: int) -> str | None:
    """The device's name, or None for a number that has none."""
    return Device(number).text if number in Device._value2member_map_ else None


def state_text(number: int) -> str | None:
    """The operating state's name, or None for a number that has none."""
    return OperatingState(number).text if number in OperatingState._value2member_map_ else None


def peak_current_of(device: int) -> str | None:
    """Whose peak current the device reports (a held maximum): ``motor``, ``battery``, or None where unknown."""
    if device == Device.JIVEPRO:
        return "battery"
    return "motor" if device in (Device.KOSMIK, Device.KOLIBRI, Device.KONTROL_X) else None
