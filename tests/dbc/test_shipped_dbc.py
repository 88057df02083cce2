"""The shipped DBC keeps every rule of a DBC that every tool reads, and every rule is shown able to fail."""

import re
from decimal import Decimal
from pathlib import Path

import pytest
from dbc_rules import (
    ESCS,
    FIRST_ID,
    LAST_ID,
    RULES,
    Database,
    Message,
    Signal,
    bus_load,
    findings,
    parse,
    worst_frame_bits,
)

SHIPPED = Path(__file__).parents[2] / "dbc" / "kontronik_esc.dbc"
DATA = SHIPPED.read_bytes()


def message(name: str) -> Message:
    return next(message for message in parse(DATA).messages if message.name == name)


def signal(name: str) -> Signal:
    return next(signal for signal in parse(DATA).signals if signal.name == name)


@pytest.mark.parametrize("rule", RULES)
def test_the_shipped_dbc_keeps_the_rule(rule: str) -> None:
    assert list(RULES[rule](parse(DATA))) == []


MUTATIONS: list[tuple[str, str, str]] = [
    # (rule, first match of this pattern, its replacement)
    ("text_is_ascii_with_line_feeds", r'"degC"', '"\u00b0C"'),
    ("text_is_ascii_with_line_feeds", r'"us"', '"\u00b5s"'),
    ("text_is_ascii_with_line_feeds", r"\n", "\r\n"),
    ("every_line_is_understood", r"^NS_ :$", "NS_ :\n\tNS_DESC_\n\tCM_"),
    ("every_line_is_understood", r"^CM_ ", 'VAL_TABLE_ States 1 "On" ;\nCM_ '),
    ("every_line_is_understood", r"^BA_DEF_DEF_", 'BA_DEF_REL_ BU_SG_REL_ "GenSigTimeoutTime" INT 0 1;\nBA_DEF_DEF_'),
    ("header_is_plain", r'^VERSION ""', 'VERSION "1.0.0"'),
    ("header_is_plain", r'^VERSION ""', '\nVERSION ""'),
    ("header_is_plain", r"^BS_:\n", ""),
    ("sections_are_in_order", r"^(BA_DEF_ .*\n)\n(BA_DEF_DEF_ .*\n)", r"\n\2\1"),
    ("sections_are_in_order", r"^(BS_:)\n\n(BU_:.*)$", r"\2\n\n\1"),
    ("sections_are_in_order", r"^BO_ 1672 ", 'CM_ "Too early.";\nBO_ 1672 '),
    ("names_are_pascal_case", r"SG_ BatteryVoltage", "SG_ Battery_Voltage"),
    ("names_are_pascal_case", r"SG_ BatteryVoltage", "SG_ batteryVoltage"),
    ("names_are_pascal_case", r"SG_ Undervoltage", "SG_ Reserved1"),
    ("names_are_unique", r"SG_ BecVoltage", "SG_ BatteryVoltage"),
    ("names_are_unique", r"SG_ BecVoltage", "SG_ BATTERYVoltage"),
    ("names_are_unique", r"EscSpeed", "EscStatus"),
    ("percent_signals_say_so", r"SG_ ThrottlePercent", "SG_ Throttle"),
    ("percent_signals_say_so", r"SG_ Timing", "SG_ TimingPercent"),
    ("nodes_are_gateway_and_logger", r"^BU_: .*", "BU_: KontronikGateway"),
    ("nodes_are_gateway_and_logger", r"8 KontronikGateway", "8 Vector__XXX"),
    ("nodes_are_gateway_and_logger", r"Logger$", "Vector__XXX"),
    ("ids_are_in_the_free_range", r"^BO_ 1664 ", "BO_ 1663 "),
    ("ids_are_in_the_free_range", r"^BO_ 1753 ", "BO_ 1760 "),
    ("ids_are_in_the_free_range", r"^BO_ 1664 ", "BO_ 2147485312 "),
    ("eight_escs_fit", r"^BO_ 1672 ", "BO_ 1671 "),
    ("eight_escs_fit", r"^BO_ 1744 ", "BO_ 1745 "),
    ("eight_escs_fit", r"^BO_ 1753 ", "BO_ 1752 "),
    ("messages_have_eight_bytes", r": 8 Kon", ": 7 Kon"),
    ("messages_have_eight_bytes", r"^CM_ ", "BO_ 1754 GatewayEmpty: 8 KontronikGateway\n\nCM_ "),
    ("signals_are_intel_on_byte_borders", r"24\|16@1", "31|16@0"),
    ("signals_are_intel_on_byte_borders", r"SG_ BatteryVoltage : 24\|16", "SG_ BatteryVoltage : 25|15"),
    ("signals_are_intel_on_byte_borders", r"SG_ Variant : 0\|16", "SG_ Variant : 0|10"),
    ("signals_do_not_overlap", r"SG_ Timing : 48\|8", "SG_ Timing : 40|8"),
    ("signals_do_not_overlap", r"SG_ Uptime : 32\|32", "SG_ Uptime : 40|32"),
    ("flags_are_plain_bits", r"(SG_ Undervoltage .*)\[0\|1\]", r"\1[0|0]"),
    ("flags_are_plain_bits", r"^VAL_ ", 'VAL_ 1664 Undervoltage 0 "Off" 1 "On" ;\nVAL_ '),
    ("alive_counters_are_where_they_belong", r"^ SG_ SpeedAlive .*\n", ""),
    ("alive_counters_are_where_they_belong", r"^ SG_ LinkAlive .*\n", ""),
    ("alive_counters_are_where_they_belong", r"(SG_ SpeedAlive .*)\[0\|14\]", r"\1[0|15]"),
    ("not_available_and_error_are_named", r"^VAL_ 1672 BatteryVoltage .*\n", ""),
    ("not_available_and_error_are_named", r'65534 "Error" ', ""),
    ("not_available_and_error_are_named", r'65535 "NotAvailable"', '65533 "NotAvailable"'),
    ("limits_leave_out_the_codes", r"\|655\.33\]", "|655.35]"),
    ("limits_leave_out_the_codes", r"\[-126\|127\]", "[-128|127]"),
    ("limits_leave_out_the_codes", r"\[-126\|127\]", "[0|0]"),
    ("value_tables_belong_to_signals", r"^VAL_ 1672 BatteryVoltage", "VAL_ 1680 BatteryVoltage"),
    ("value_tables_belong_to_signals", r"^(VAL_ 1672 BatteryVoltage .*)$", r"\1\n\1"),
    ("value_tables_belong_to_signals", r'"Lost"', '"Ok"'),
    ("enums_are_closed", r'25 "SpoolUpQuick" ', ""),
    ("enums_are_closed", r'"SyncForward"', '"Rudder"'),
    ("enums_are_closed", r"^(VAL_ 1664 OperatingState) ", r'\1 0 "Unknown" '),
    ("everything_has_one_comment", r'^CM_ "(.*)\n', ""),
    ("everything_has_one_comment", r"^CM_ BU_ Logger .*\n", ""),
    ("everything_has_one_comment", r"^CM_ BO_ 1672 .*\n", ""),
    ("attributes_are_declared", r'^(BA_DEF_ SG_ "GenSigStartValue") FLOAT', r"\1 INT"),
    ("attributes_are_declared", r'^BA_DEF_ "LayoutVersion" .*\n', ""),
    ("attributes_are_declared", r'^BA_DEF_DEF_ "GenMsgDelayTime" .*\n', ""),
    ("attributes_belong_to_something", r'^(BA_ "GenMsgCycleTime" BO_) 1664', r"\1 1665"),
    ("attributes_belong_to_something", r'^(BA_ "GenSigStartValue" SG_) 1672 Timing', r"\1 1680 Timing"),
    ("attributes_belong_to_something", r'^(BA_ "GenMsgCycleTime" BO_ 1664 .*)$', r"\1\n\1"),
    ("enum_attributes_are_set_by_index", r'^(BA_ "GenMsgSendType" BO_ 1664) .*', r'\1 "CyclicAndOnChange";'),
    ("enum_attributes_are_set_by_index", r'^(BA_ "GenMsgSendType" BO_ 1664) .*', r"\1 6;"),
    ("enum_attributes_are_set_by_index", r'^(BA_ "LayoutVersion") .*', r"\1 1;"),
    ("bus_is_can_and_not_j1939", r'^BA_ "BusType" "CAN"', 'BA_ "BusType" "CAN FD"'),
    (
        "bus_is_can_and_not_j1939",
        r'^BA_DEF_DEF_ "BusType"',
        'BA_DEF_DEF_ "ProtocolType" "J1939";\nBA_DEF_DEF_ "BusType"',
    ),
    ("bus_is_can_and_not_j1939", r'^BA_ "BusType"', 'BA_ "ProtocolType" "J1939";\nBA_ "BusType"'),
    ("version_is_in_attribute_and_comment", r'^(BA_ "LayoutVersion") .*', r'\1 "1.0.1";'),
    ("version_is_in_attribute_and_comment", r'^(BA_ "LayoutVersion") .*', r'\1 "one";'),
    ("messages_have_a_schedule", r'^BA_ "GenMsgCycleTime" BO_ 1664 .*\n', ""),
    ("messages_have_a_schedule", r'^BA_ "GenMsgSendType" BO_ 1664 .*\n', ""),
    ("messages_have_a_schedule", r'^BA_ "GenMsgDelayTime" BO_ 1664 .*\n', ""),
    ("start_values_are_raw_not_available", r'^BA_ "GenSigStartValue" SG_ 1672 BatteryVoltage .*\n', ""),
    ("start_values_are_raw_not_available", r'^(BA_ "GenSigStartValue" SG_ 1672 BatteryVoltage) .*', r"\1 655.35;"),
    ("start_values_are_raw_not_available", r'^(BA_ "GenSigStartValue" SG_ 1672 ThrottlePercent) .*', r"\1 128;"),
    ("one_esc_loads_the_bus_below_ten_percent", r'^(BA_ "GenMsgDelayTime" BO_ 1664) .*', r"\1 5;"),
    ("one_esc_loads_the_bus_below_ten_percent", r'^(BA_ "GenMsgSendType" BO_ 1712) .*', r"\1 1;"),
    ("one_esc_loads_the_bus_below_ten_percent", r'^BA_DEF_ BO_ "GenMsgSendType" .*\n', ""),
]


@pytest.mark.parametrize(("rule", "pattern", "replacement"), MUTATIONS)
def test_a_violation_is_reported_by_its_rule(rule: str, pattern: str, replacement: str) -> None:
    mutant, changes = re.subn(pattern, replacement, DATA.decode("ascii"), count=1, flags=re.MULTILINE)
    assert changes == 1
    assert [finding for finding in findings(mutant.encode("latin-1")) if finding.startswith(f"{rule}: ")]


def test_every_rule_is_shown_able_to_fail() -> None:
    assert {rule for rule, _, _ in MUTATIONS} == set(RULES)


@pytest.mark.parametrize("data", [b"", b"\n", b"BO_", b' SG_ Lost : 0|1@1+ (1,0) [0|1] "" Logger\n', bytes(range(256))])
def test_rubbish_is_reported_and_never_raises(data: bytes) -> None:
    assert findings(data)


def test_a_file_cut_anywhere_is_reported_and_never_raises() -> None:
    for length in range(0, len(DATA), 997):
        assert findings(DATA[:length])


def test_the_id_range_is_free_of_what_canopen_uses() -> None:
    """CiA 301: the restricted ids, and the ids of NMT, SYNC, EMCY, PDOs, SDOs and heartbeats of nodes 1..127."""
    restricted = [*range(0x80), *range(0x101, 0x181), *range(0x581, 0x600), *range(0x601, 0x680)]
    restricted += [*range(0x6E0, 0x700), *range(0x701, 0x800)]
    canopen = {0x000, 0x080, 0x100, 0x7E4, 0x7E5, *restricted}
    for base in (0x080, 0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500, 0x580, 0x600, 0x700):
        canopen.update(range(base + 1, base + 128))
    assert canopen.isdisjoint(range(FIRST_ID, LAST_ID + 1))


def test_the_worst_frame_of_eight_bytes_has_135_bits() -> None:
    assert worst_frame_bits(8) == 135
    assert worst_frame_bits(0) == 55


def test_the_bus_load_of_five_event_messages_is_about_thirteen_percent_of_500_kbit() -> None:
    events = Database(b"", [""])
    events.messages = [Message(FIRST_ID + 8 * n, f"Esc{n}", 8, "KontronikGateway", ()) for n in range(5)]
    events.definitions = parse(DATA).definitions
    events.attributes = [("GenMsgSendType", ("BO_", message.id), "1") for message in events.messages]
    assert bus_load(events) == pytest.approx(0.135)
    assert bus_load(events, bit_rate=125_000) == pytest.approx(0.54)


def test_eight_escs_fit_on_a_bus_of_500_kbit() -> None:
    assert 0.5 < bus_load(parse(DATA), escs=ESCS) < 0.8


# --- against the telemetry sheet ------------------------------------------------------------------------------------

SHEET = """
ElectricalSpeed 1/min 1 0 1000000, BatteryVoltage V 0.01 0 10000, BatteryCurrent A 0.1 -10000 10000,
MotorCurrent A 0.1 -10000 10000, PeakCurrent A 0.1 -10000 10000, ConsumedCharge mAh 1 0 65533,
BecCurrent A 0.001 0 65533, BecVoltage V 0.001 0 65533, PwmInput us 1 0 65533, ThrottlePercent % 1 -100 100,
OutputOpeningPercent % 1 0 100, PowerStageTemperature degC 1 -126 127, BecTemperature degC 1 -126 127,
OperatingStateRaw - 1 0 253, Timing us 1 0 253, DeviceRaw - 1 0 63, Variant - 1 0 1023, FirmwareMain - 1 0 253,
FirmwareSub - 1 0 253, CellCount - 1 0 253, MaxElectricalSpeed 1/min 1 0 1000000,
MinBatteryVoltage V 0.01 0 10000, MaxBatteryVoltage V 0.01 0 10000, MaxBatteryCurrent A 0.1 -10000 10000,
MaxMotorCurrent A 0.1 -10000 10000, MaxPeakCurrent A 0.1 -10000 10000, MaxBecCurrent A 0.001 0 65533,
MinBecVoltage V 0.001 0 65533, MaxThrottlePercent % 1 -100 100, MaxOutputOpeningPercent % 1 0 100,
MinPowerStageTemperature degC 1 -126 127, MaxPowerStageTemperature degC 1 -126 127,
MinBecTemperature degC 1 -126 127, MaxBecTemperature degC 1 -126 127
"""
"""signal, unit, one step on the UART in this unit, least and greatest raw value that the sheet allows"""


@pytest.mark.parametrize("row", SHEET.split(","))
def test_a_field_of_the_sheet_fits_its_signal_step_by_step(row: str) -> None:
    name, unit, step, *ends = row.split()
    least, greatest = map(int, ends)
    found = signal(name)
    assert (found.unit, found.factor, found.offset) == (unit.strip("-"), Decimal(step), Decimal(0))
    assert found.minimum <= least * found.factor
    assert greatest * found.factor <= found.maximum


OPERATING_ERRORS = [
    "Undervoltage", "Overvoltage", "OvercurrentIntegralError", "OvercurrentIntegralWarning",
    "PowerStageOvertempWarning", "PowerStageOvertempError", "BecUndervoltage", "BecOvervoltage", "BecOvercurrent",
    "BecOvertemperature", "SwitchedOffByRunningDown", "CapacityLimitReached", "OperatingErrorFound",
    "OperatingWarningFound", "SelftestError", "EepromError", "WatchdogErrorTripped", "ProgrammingAllowed",
    "LimitBatteryVoltageMinimum", "LimitCurrentMaximum", "LimitPowerStageTemperature", "LimitBecTemperature",
    "LimitBecCurrent", "LimitDischargedCapacity",
]  # fmt: skip
SELFTEST_ERRORS = [
    "TestPhaseLowSide", "TestPhaseHighSide", "TestShortToGround", "TestBackEmfOffset", "TestCurrentZeroPoint",
    "TestUndervoltage", "TestOvervoltage", "TestBecUndervoltage", "TestBecOvervoltage", "TestReversePolarityFuse",
    "TestOvervoltageFuse", "TestPowerStageOvertemp", "TestBecOvertemperature", "TestMotorPhaseMissing",
    "TestEepromEmpty", "TestEepromStickPositions", "TestEepromChecksum", "TestEepromSize", "TestEepromVersion",
]  # fmt: skip


@pytest.mark.parametrize(
    ("owner", "first_bit", "names"), [("EscStatus", 0, OPERATING_ERRORS), ("EscInfo", 32, SELFTEST_ERRORS)]
)
def test_the_flags_stand_in_the_order_of_the_sheet(owner: str, first_bit: int, names: list[str]) -> None:
    flags = [signal for signal in message(owner).signals if signal.is_flag]
    assert [(flag.name, flag.start) for flag in flags] == [(name, first_bit + n) for n, name in enumerate(names)]


def test_every_message_has_the_timing_that_its_readers_expect() -> None:
    db = parse(DATA)
    timing = {
        message.name: (
            message.id, db.send_type(message), db.number("GenMsgCycleTime", message),
            db.number("GenMsgDelayTime", message),
        )
        for message in db.messages
    }  # fmt: skip
    assert timing == {
        "EscStatus": (0x680, "CyclicAndOnChange", 100, 10),
        "EscSpeed": (0x688, "Event", 0, 5),
        "EscCurrent": (0x690, "Event", 0, 5),
        "EscShaft": (0x698, "Cyclic", 50, 5),
        "EscBec": (0x6A0, "Cyclic", 100, 10),
        "EscEnergy": (0x6A8, "Cyclic", 100, 10),
        "EscLink": (0x6B0, "Cyclic", 100, 20),
        "EscInfo": (0x6B8, "CyclicAndOnChange", 1000, 500),
        "EscExtremesA": (0x6C0, "CyclicAndOnChange", 1000, 500),
        "EscExtremesB": (0x6C8, "CyclicAndOnChange", 1000, 500),
        "EscExtremesC": (0x6D0, "CyclicAndOnChange", 1000, 500),
        "GatewayStatus": (0x6D8, "CyclicAndOnChange", 1000, 100),
        "GatewayTraffic": (0x6D9, "Cyclic", 1000, 100),
    }


@pytest.mark.parametrize(
    ("name", "fact"),
    [
        ("PeakCurrent", "held maximum"),
        ("PeakCurrent", "Of the motor on KOSMIK, KOLIBRI and KONTROL-X, of the battery on JIVEPro"),
        ("MaxPeakCurrent", "Of the motor on KOSMIK, KOLIBRI and KONTROL-X, of the battery on JIVEPro"),
        ("BecCurrent", "Not supplied by a JIVEPro"),
        ("MaxBecCurrent", "Not supplied by a JIVEPro"),
        ("ProgrammingAllowed", "No alarm"),
        ("EnergyUsed", "since the gateway started"),
        ("EnergyUsed", "Energy fed back is not subtracted"),
        ("OperatingState", "not covered by the checksum"),
        ("Timing", "not covered by the checksum"),
        ("MaxBecTemperature", "not covered by the checksum"),
        *((flag, "Valid while OperatingState is not NotAvailable") for flag in OPERATING_ERRORS),
        *((flag, "Valid while Device is not NotAvailable") for flag in SELFTEST_ERRORS),
    ],
)
def test_a_comment_tells_what_a_reader_must_know(name: str, fact: str) -> None:
    assert fact in dict(parse(DATA).comments)[("SG_", *signal(name).key)]


@pytest.mark.parametrize(
    "name", ["Losses", "CrcErrors", "DroppedBytes", "SentFrames", "ReplacedFrames", "SendFailures"]
)
def test_the_comment_of_a_rolling_counter_tells_its_greatest_value(name: str) -> None:
    found = signal(name)
    assert f"starts again at 0 after {found.maximum}." in dict(parse(DATA).comments)[("SG_", *found.key)]
