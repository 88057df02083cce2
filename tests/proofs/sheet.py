"""The right content of each signal of the shipped DBC, from the sheet and the DBC's text alone.

Nothing here imports the gateway. The rows below are the tables of the sheet ("Telemetrieprotokoll",
V4): offset, type and unit of each field, and the meaning of bits and numbers. The DBC is read with
regular expressions. The names of states and devices are those of the tests' copy of the sheet.
`header` writes both as tables for `every_value.c`.
"""

import re
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from specification import DEVICES
from specification import OPERATING_STATES as STATES


@dataclass(frozen=True)
class Field:
    """A row of the sheet: a field of a frame."""

    name: str
    offset: int
    """In bytes from the beginning of the frame."""
    type: str
    """u or i, and the number of bits."""
    unit: Fraction
    """One step, in the unit of the DBC's signal."""
    is_info: bool = False

    @property
    def bits(self) -> int:
        return int(self.type[1:])


ONE = Fraction(1)
TENTH = Fraction(1, 10)
CENTI = Fraction(1, 100)
MILLI = Fraction(1, 1000)
LIVE = (
    Field("ElectricalSpeed", 4, "u32", ONE),
    Field("BatteryVoltage", 8, "u16", CENTI),
    Field("BatteryCurrent", 10, "i16", TENTH),
    Field("MotorCurrent", 12, "i16", TENTH),
    Field("PeakCurrent", 14, "i16", TENTH),
    Field("ConsumedCharge", 16, "u16", ONE),
    Field("BecCurrent", 18, "u16", MILLI),
    Field("BecVoltage", 20, "u16", MILLI),
    Field("PwmInput", 22, "u16", ONE),
    Field("ThrottlePercent", 24, "i8", ONE),
    Field("OutputOpeningPercent", 25, "u8", ONE),
    Field("PowerStageTemperature", 26, "i8", ONE),
    Field("BecTemperature", 27, "i8", ONE),
    Field("OperatingErrors", 28, "u32", ONE),
    Field("OperatingStateRaw", 32, "u8", ONE),
    Field("Timing", 33, "u8", ONE),
)
INFO = (
    Field("DeviceAndVariant", 4, "u16", ONE, is_info=True),
    Field("Firmware", 6, "u16", ONE, is_info=True),
    Field("SelftestErrors", 8, "u32", ONE, is_info=True),
    Field("CellCount", 12, "u8", ONE, is_info=True),
    Field("MaxElectricalSpeed", 13, "u32", ONE, is_info=True),
    Field("MinBatteryVoltage", 17, "u16", CENTI, is_info=True),
    Field("MaxBatteryVoltage", 19, "u16", CENTI, is_info=True),
    Field("MaxBatteryCurrent", 21, "i16", TENTH, is_info=True),
    Field("MaxMotorCurrent", 23, "i16", TENTH, is_info=True),
    Field("MaxPeakCurrent", 25, "i16", TENTH, is_info=True),
    Field("MaxBecCurrent", 27, "u16", MILLI, is_info=True),
    Field("MinBecVoltage", 29, "u16", MILLI, is_info=True),
    Field("MaxThrottlePercent", 31, "i8", ONE, is_info=True),
    Field("MaxOutputOpeningPercent", 32, "u8", ONE, is_info=True),
    Field("MinPowerStageTemperature", 33, "i8", ONE, is_info=True),
    Field("MaxPowerStageTemperature", 34, "i8", ONE, is_info=True),
    Field("MinBecTemperature", 35, "i8", ONE, is_info=True),
    Field("MaxBecTemperature", 36, "i8", ONE, is_info=True),
)
FIELDS = (*LIVE, *INFO)
OPERATING_ERRORS = (
    *("Undervoltage", "Overvoltage", "OvercurrentIntegralError", "OvercurrentIntegralWarning"),
    *("PowerStageOvertempWarning", "PowerStageOvertempError", "BecUndervoltage", "BecOvervoltage"),
    *("BecOvercurrent", "BecOvertemperature", "SwitchedOffByRunningDown", "CapacityLimitReached"),
    *("OperatingErrorFound", "OperatingWarningFound", "SelftestError", "EepromError"),
    *("WatchdogErrorTripped", "ProgrammingAllowed", "LimitBatteryVoltageMinimum"),
    *("LimitCurrentMaximum", "LimitPowerStageTemperature", "LimitBecTemperature"),
    *("LimitBecCurrent", "LimitDischargedCapacity"),
)
"""Signals of the bits of the operating errors, from bit 0 on."""
SELFTEST_ERRORS = (
    *("TestPhaseLowSide", "TestPhaseHighSide", "TestShortToGround", "TestBackEmfOffset"),
    *("TestCurrentZeroPoint", "TestUndervoltage", "TestOvervoltage", "TestBecUndervoltage"),
    *("TestBecOvervoltage", "TestReversePolarityFuse", "TestOvervoltageFuse"),
    *("TestPowerStageOvertemp", "TestBecOvertemperature", "TestMotorPhaseMissing"),
    *("TestEepromEmpty", "TestEepromStickPositions", "TestEepromChecksum", "TestEepromSize"),
    "TestEepromVersion",
)
JIVE_PRO = 3
BEC_CURRENTS = ("BecCurrent", "MaxBecCurrent")
"""The values that a JIVEPro does not supply."""
FREE, POLES, OUTPUT, CELLS, POWER, TABLE = range(6)
"""How a value is computed from its field: as it is, divided by the pole pairs, by pole pairs times
gear or by the cells, multiplied by the battery current, or looked up by its name."""


@dataclass
class Signal:
    """A signal of the DBC, with raw limits and codes."""

    name: str
    can_id: int
    start: int
    length: int
    is_signed: bool
    factor: Fraction
    offset: Fraction
    low: int
    high: int
    texts: dict[str, int] = field(default_factory=dict)
    """Raw values of the entries of its value table."""
    start_value: int = 0

    @property
    def not_available(self) -> int:
        """The raw value without data. A flag has no code and is 0 then."""
        return self.texts.get("notavailable", self.start_value)


def plain(name: str) -> str:
    """Return a name as the DBC and the sheet have it in common."""
    return re.sub(r"[-_ ]", "", name).lower()


def signals_of(text: str) -> dict[str, Signal]:
    """Return the signals of a DBC by name. All of them are little-endian."""
    found: dict[str, Signal] = {}
    can_id = 0
    for line in text.splitlines():
        if message := re.match(r"BO_ (\d+) ", line):
            can_id = int(message[1])
        elif row := re.match(
            r" SG_ (\w+) : (\d+)\|(\d+)@1([+-]) \(([^,]+),([^)]+)\) \[([^|]+)\|([^]]+)\]", line
        ):
            factor, offset, low, high = map(Fraction, row.group(5, 6, 7, 8))
            limits = [(limit - offset) / factor for limit in (low, high)]
            assert all(limit.denominator == 1 for limit in limits), row[1]
            found[row[1]] = Signal(
                name=row[1],
                can_id=can_id,
                start=int(row[2]),
                length=int(row[3]),
                is_signed=row[4] == "-",
                factor=factor,
                offset=offset,
                low=int(limits[0]),
                high=int(limits[1]),
            )
        elif table := re.match(r"VAL_ \d+ (\w+) (.*);", line):
            entries = re.findall(r'(-?\d+) "([^"]*)"', table[2])
            found[table[1]].texts = {plain(text): int(raw) for raw, text in entries}
        elif start := re.match(r'BA_ "GenSigStartValue" SG_ \d+ (\w+) (-?\d+);', line):
            found[start[1]].start_value = int(start[2])
    return found


@dataclass(frozen=True)
class Source:
    """Where a signal's value comes from."""

    of: str
    shift: int = 0
    mask: int = 0
    """The bits of the field after the shift. 0: the whole field."""
    rule: int = FREE
    names: dict[int, str] = field(default_factory=dict)
    """Names of numbers, for TABLE."""


def sources() -> dict[str, Source]:
    """Return the source of each signal that depends on a field of the wire, by its name."""
    whole = [each for each in FIELDS if each.bits != 32 or "Speed" in each.name]
    found = {each.name: Source(each.name) for each in whole}
    del found["DeviceAndVariant"], found["Firmware"]
    for bit, name in enumerate(OPERATING_ERRORS):
        found[name] = Source("OperatingErrors", bit, 1)
    for bit, name in enumerate(SELFTEST_ERRORS):
        found[name] = Source("SelftestErrors", bit, 1)
    found["OperatingState"] = Source("OperatingStateRaw", rule=TABLE, names=STATES)
    found["Device"] = Source("DeviceAndVariant", 10, 0x3F, TABLE, DEVICES)
    found["DeviceRaw"] = Source("DeviceAndVariant", 10, 0x3F)
    found["Variant"] = Source("DeviceAndVariant", 0, 0x3FF)
    found["FirmwareMain"] = Source("Firmware", 8, 0xFF)
    found["FirmwareSub"] = Source("Firmware", 0, 0xFF)
    found["MotorSpeed"] = Source("ElectricalSpeed", rule=POLES)
    found["OutputSpeed"] = Source("ElectricalSpeed", rule=OUTPUT)
    found["MeanCellVoltage"] = Source("BatteryVoltage", rule=CELLS)
    found["BatteryPower"] = Source("BatteryVoltage", rule=POWER)
    return found


OF_THE_GATEWAY = 25
"""Signals without a field: alive counters, and values that the gateway counts or knows itself."""


def header(dbc: Path) -> str:
    """Return the fields and signals as constants in C."""
    signals = signals_of(dbc.read_text(encoding="utf-8"))
    places = {each.name: place for place, each in enumerate(FIELDS)}
    used = sources()
    assert len(used) + OF_THE_GATEWAY == len(signals), len(signals) - len(used)
    fields = []
    for each in FIELDS:
        place_and_type = (each.offset, each.bits // 8, int(each.type[0] == "i"), int(each.is_info))
        fields.append(f'    {{"{each.name}", {", ".join(map(str, place_and_type))}}},')
    rows = []
    tables = list[str]()
    for name, source in used.items():
        signal = signals[name]
        place = places[source.of]
        unit = FIELDS[place].unit
        if source.rule == POWER:
            unit *= FIELDS[places["BatteryCurrent"]].unit
        first = len(tables)
        for number, text in source.names.items():
            tables.append(f"{{{number}, {signal.texts[plain(text)]}}}")
        numbers = (
            *(signal.can_id, signal.start, signal.length, int(signal.is_signed)),
            *(signal.factor.numerator, signal.factor.denominator),
            *(signal.offset.numerator, signal.offset.denominator),
            *(signal.low, signal.high, signal.texts.get("error", 0), signal.not_available),
            *(place, source.shift, source.mask, source.rule, unit.numerator, unit.denominator),
            *(first, len(source.names), int(name in BEC_CURRENTS)),
        )
        rows.append(f'    {{"{name}", {", ".join(map(str, numbers))}}},')
    lines = [
        "static const struct field fields[] = {",
        *fields,
        "};",
        "static const struct expected expected[] = {",
        *rows,
        "};",
        f"static const struct named named[] = {{{', '.join(tables)}}};",
        f"enum {{ JIVE_PRO = {JIVE_PRO} }};",
    ]
    return "\n".join([*lines, ""])
