"""A user's DBC as other tools write it.

It has entries for missing objects, other units and send types, counters, checksums, flags and
signals that are bound to no value.
"""

import itertools
import json
import math
import re
from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest
from dbc_bench import FILE, compiled, gateway_with, packed, refused
from packer_oracle import UNITS

from kontronik_can_gw.assembly.capture_setup import CaptureSetup
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.names import protection
from kontronik_can_gw.dbc.prepare import is_mute, reporter, unreported
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.desk.describe.tables import held
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals.plan import SEND_TYPES, MessageLayout, Role, SendType
from kontronik_can_gw.signals.units import conversion
from kontronik_can_gw.times import MS

pytestmark = pytest.mark.promise("dbc-as-it-is")


def signal(
    name: str,
    place: str = "0|8@1+",
    unit: str = "",
    scale: str = "1,0",
    ends: str = "0|0",
) -> str:
    return f' SG_ {name} : {place} ({scale}) [{ends}] "{unit}" Other\n'


HEAD = """VERSION ""
NS_ :
\tNS_DESC_
\tVAL_
\tVAL_TABLE_
\tBA_DEF_
\tSIG_VALTYPE_

BS_:

BU_: Gateway Other

"""
MESSAGE = f"{HEAD}BO_ 256 Power: 8 Gateway\n"
STATE = MESSAGE + signal("OperatingState")
START = 'BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 0;\n'


def start_of(name: str, value: object, number: int = 256) -> str:
    return f'BA_ "GenSigStartValue" SG_ {number} {name} {value};\n'


# --- entries


def test_each_unknown_text_of_a_number_within_its_limits_is_warned_about() -> None:
    text = MESSAGE + signal("BatteryVoltage", "0|10@1+", "V", "0.1,0", "0|102.2")
    text += signal("MotorCurrent", "16|16@1-", "A") + signal("OperatingStateRaw", "32|8@1+")
    text += 'VAL_ 256 BatteryVoltage 1023 "SNA" 1022 "Fehler" 1021 "Init" 1020 "Invalid" ;\n'
    text += 'VAL_ 256 MotorCurrent -32768 "NotAvailable" -32767 "Error" -32766 "Err" ;\n'
    text += 'VAL_ 256 OperatingStateRaw 21 "Forward" ;\n'
    (line,) = [line for line in compiled(text).warnings if "value table" in line]
    assert "Power.BatteryVoltage: its value table has the texts 1022 'Fehler', 1021 'Init'" in line
    within = text.replace("0|102.2", "0|102.1")
    (line,) = [line for line in compiled(within).warnings if "value table" in line]
    assert "the texts 1021 'Init', which" in line
    without = text.replace("0|102.2", "0|102")
    assert not [line for line in compiled(without).warnings if "value table" in line]


def test_exchanged_limits_are_sorted_with_a_warning() -> None:
    text = MESSAGE + signal("BatteryVoltage", "0|16@1+", "V", "0.1,0", "600|0")
    (line,) = [line for line in compiled(text).warnings if "minimum" in line]
    assert "Power.BatteryVoltage: its minimum 600 is above its maximum 0" in line
    (plan,) = compiled(text).messages[0].signals
    assert (plan.low, plan.high) == (0, 6000)


def test_comments_and_value_texts_are_not_touched() -> None:
    comment = "first; one\nVAL_ 256 OperatingState States ;\nVAL_TABLE_ States 1 fake ;\nBA_ "
    text = f'{STATE}VAL_TABLE_ States 21 "Forward; bad" 12 "MotorOff" ;\nCM_ BO_ 256 "{comment}";\n'
    text += "VAL_ 256 OperatingState States ;\n"
    (message,) = parse_database(text.encode(), "my.dbc").messages
    assert dict(message.signals[0].choices or {}) == {21: "Forward; bad", 12: "MotorOff"}
    assert message.comment == comment


def test_attribute_with_a_text_that_its_enumeration_lacks_is_refused() -> None:
    text = (
        'BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic";\nBA_ "GenMsgSendType" BO_ 256 "Sometimes";\n'
    )
    (line,) = refused(STATE + text)
    assert '"GenMsgSendType": "Sometimes" is not one of' in line


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ('VAL_ 256 Nope 1 "x" ;', "VAL_ 256 Nope"),
        ('VAL_ 999\n  OperatingState\n 1 "x; y" ;', "VAL_ 999 OperatingState"),
        ("VAL_ 256 OperatingState States ;", "VAL_ 256 OperatingState States"),
        ("SIG_VALTYPE_ 256 Nope : 1;", "SIG_VALTYPE_ 256 Nope"),
        ('BA_ "Colour" BO_ 256 1;', 'BA_ "Colour"'),
        ('BA_DEF_DEF_ "Colour" 1;', 'BA_DEF_DEF_ "Colour"'),
    ],
)
def test_entry_for_a_missing_object_is_ignored_with_a_warning(entry: str, words: str) -> None:
    warnings: list[str] = []
    comment = entry.replace('"', "")
    text = f'{STATE}CM_ SG_ 256 OperatingState "{comment}";\n{entry}\n'
    (message,) = parse_database(text.encode(), "my.dbc", warnings).messages
    (line,) = warnings
    assert line.startswith("my.dbc: ignored")
    assert line.endswith(words)
    assert message.signals[0].choices is None
    assert message.signals[0].comment == comment


# --- units

IRRATIONAL = ("1/min", "rad/s|radians/sec|Rad/Sec|Unit_RadPerSecon", str(math.pi / 30), "0")
SPELLED = [IRRATIONAL]
for _unit, _rows in UNITS.items():
    SPELLED += [(_unit, *row) for row in _rows]


@pytest.mark.promise("units")
@pytest.mark.parametrize(("unit", "texts", "factor", "shift"), SPELLED)
def test_unit_is_recognised_in_each_of_its_spellings(
    unit: str,
    texts: str,
    factor: str,
    shift: str,
) -> None:
    for text in texts.split("|"):
        found = conversion(unit, text)
        assert found is not None, text
        assert float(found[0]) == pytest.approx(float(Fraction(factor)), rel=1e-11), text
        assert float(found[1]) == pytest.approx(float(Fraction(shift)), rel=1e-11), text


@pytest.mark.promise("units")
def test_unit_of_another_quantity_or_of_two_meanings_is_refused() -> None:
    """The lines of refusal, with the units that are possible, are in the golden set."""
    others = {
        "V": "MV A 1 x Unit_ deg m/s ° Nm",
        "%": "V",
        "degC": "deg",
        "1/min": "Hz m/s",
        "": "V %",
        "W": "MW",
    }
    for unit, texts in others.items():
        for text in texts.split():
            assert conversion(unit, text) is None, text


def test_dbc_units_overrides_the_usual_meaning_of_a_text() -> None:
    text = MESSAGE + signal("BatteryVoltage", "0|16@1+", "Zaehler", "0.01,0")
    text += signal("BecVoltage", "16|16@1+", "A")
    units = {"Zaehler": "mV", "A": "mV"}
    (plan,) = compiled(text, units=units).messages
    voltage, bec_voltage = plan.signals
    assert voltage.unit == "mV"
    assert voltage.slope == 1000
    assert bec_voltage.unit == "mV"
    assert bec_voltage.slope == 1
    (line,) = refused(text, units=units | {"Zahler": "V"})
    assert line == (
        "dbc.units.Zahler: no signal of Gateway has this unit in my_car.dbc. "
        "Did you mean 'Zaehler'?"
    )


# --- the selection of messages, and unbound signals

OURS = ("Motor_11", "Motor_12", "Brake_1")
ECU = (
    HEAD
    + "".join(
        f"BO_ {n} {name}: 8 Gateway\n{signal(name + 'X')}\n" for n, name in enumerate(OURS, 1)
    )
    + f"BO_ 4 Motor_90: 8 Other\n{signal('Motor_90X')}\nBO_ 5 Motor_20: 8 Gateway\n"
    + signal("BatteryVoltage", "0|16@1+", "V", "0.01,0")
    + signal("Torque", "16|16@1-", "Nm", "0.5,-509")
    + signal("Warm", "32|4@1+")
    + signal("Gear", "36|4@1+")
    + "\nBO_ 6 Motor_21: 8 Gateway\n"
    + signal("Ratio", "0|32@1-")
    + signal("Cool", "39|8@0-")
    + f'\n{START}BA_DEF_DEF_ "GenSigStartValue" 3;\n'
    + start_of("Torque", -7, 5)
    + start_of("Ratio", 1.5, 6)
    + start_of("Cool", -2, 6)
    + 'VAL_ 5 Warm 15 "SNA" 0 "Cold" ;\nSIG_VALTYPE_ 6 Ratio : 1;\n'
)
GATEWAYS: dict[str, Any] = {"node": "Gateway", "unbound": "start_value"}


def test_pattern_without_a_message_of_this_gateway_is_refused() -> None:
    lines = refused(ECU, messages=["Motr_11", "Motor_11", "Motor_9*", "qqq*"], **GATEWAYS)
    words = "matches no message of Gateway in my_car.dbc."
    assert lines == [
        f"dbc.messages: 'Motr_11' {words} Did you mean Motor_11?",
        f"dbc.messages: 'Motor_9*' {words} Motor_90 is sent by Other.",
        f"dbc.messages: 'qqq*' {words}",
    ]


def test_only_selected_messages_are_checked_and_others_cause_advice() -> None:
    *lines, advice = refused(ECU, node="Gateway")
    assert len(lines) == 8
    assert all(words in advice for words in ("8 signals of Gateway", "dbc.messages", "start_value"))
    (line,) = refused(ECU, node="Gateway", messages=["Motor_11"])
    assert "Motor_11.Motor_11X: no such source" in line


def test_unbound_signal_has_its_start_value_as_cantools_reads_it() -> None:
    layout = compiled(ECU, messages=["Motor_2?"], bind={"Gear": 5}, **GATEWAYS)
    gateway = gateway_with(layout, LiveData(battery_voltage=4442))
    database = parse_database(ECU.encode(), "my.dbc")
    read: dict[str, Any] = {}
    for plan in layout.messages:
        theirs = database.get_message_by_frame_id(plan.can_id)
        read |= dict(theirs.decode_simple(packed(plan, gateway), decode_choices=False))
    expected = {"BatteryVoltage": 44.42, "Torque": -512.5, "Warm": 15, "Gear": 5}
    assert read == expected | {"Ratio": 1.5, "Cool": -2}
    shown: dict[str, str] = {}
    for plan in layout.messages:
        shown |= {signal.name: held(signal) for signal in plan.signals if signal.is_unbound}
    assert shown == {"Torque": "-512.5 Nm", "Warm": "15", "Ratio": "1.5", "Cool": "-2"}
    (once,) = [line for line in layout.warnings if "sent only once" in line]
    assert once.startswith("my_car.dbc: sent only once, at the start, ")
    assert once.endswith(": Motor_21")


def test_start_value_may_be_any_number_that_fits_into_the_signal() -> None:
    text = MESSAGE + signal("Foo", "7|12@0-") + START
    (theirs,) = parse_database(text.encode(), "my.dbc").messages
    for value in (-2048, 2047):
        layout = compiled(text + start_of("Foo", value), unbound="start_value")
        data = packed(layout.messages[0], gateway_with(layout))
        assert theirs.decode_simple(data) == {"Foo": value}
    for number in (-2049, 2048, 0.5):
        (line,) = refused(text + start_of("Foo", number), unbound="start_value")
        assert "Power.Foo" in line
        assert f"GenSigStartValue {number}" in line


# --- send types

SPELLINGS = {
    "Cyclic": "Cyclic cyclic cyclicX fixedCyclic FixedPeriodic Periodic cyclicIfActive IfActive "
    "EnabledPeriodic cyclicIfActiveX CyclicIfActiveFast",
    "Event": "Event spontaneous spontan spontanX spontaneousWithDelay spontanWithDelay "
    "spontaneousWithRepetition OnWrite OnWriteWithRepetition",
    "OnChange": "OnChange OnChangeWithRepetition",
    "CyclicAndEvent": "cyclicAndSpontaneous cyclicAndSpontanX cyclicAndSpontanWithDelay "
    "CyclicAndSpontaneousWithDelay EventPeriodic cyclicIfActiveAndSpontanWD PeriodicAndEvent",
    "CyclicAndOnChange": "CyclicAndOnChange OnChangeAndIfActive OnChangeAndIfActiveWithRepetition",
    "": "vector_leerstring NoMsgSendType None NotUsed NoSigSendType nomsgsendtype",
}


def all_sent(text: str, cycle: int = 20) -> str:
    """Return a DBC whose messages have this send type."""
    return (
        f'{STATE}BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","{text}";\n'
        f'BA_DEF_DEF_ "GenMsgSendType" "{text}";\n'
        'BA_DEF_ BO_ "GenMsgCycleTimeFast" INT 0 0;\nBA_DEF_DEF_ "GenMsgCycleTimeFast" 0;\n'
        f'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 0;\nBA_DEF_DEF_ "GenMsgCycleTime" {cycle};\n'
    )


@pytest.mark.parametrize("meant", SPELLINGS)
def test_send_type_is_recognised_by_each_of_its_usual_names(meant: str) -> None:
    for text in SPELLINGS[meant].split():
        (plan,) = compiled(all_sent(text)).messages
        assert plan.send_type == (SEND_TYPES[meant] if meant else SendType.CYCLIC), text
        if not meant:
            assert compiled(all_sent(text, 0)).messages[0].send_type == SendType.EVENT


@pytest.mark.parametrize("text", ["No", "Wrong", "OnRequest", "cyclically"])
def test_unknown_send_type_is_refused_unless_dbc_send_type_defines_it(text: str) -> None:
    (line,) = refused(all_sent(text))
    assert f"unknown GenMsgSendType {text!r}" in line
    assert f"dbc.send_type.{text!r}" in line
    for name, meaning in ((text, "CyclicAndEvent"), ("OnChange", "Event")):
        (plan,) = compiled(all_sent(name), send_type={name: meaning}).messages
        assert plan.send_type == SEND_TYPES[meaning]
    (line,) = refused(all_sent("Event"), send_type={"Evnt": "Cyclic"})
    assert line == (
        "dbc.send_type.Evnt: no message of Gateway has this GenMsgSendType in my_car.dbc. "
        "Did you mean 'Event'?"
    )


# --- counters and checksums


NAMES = {
    Role.ALIVE: "MsgCntr AliveCnt COUNTER Counter CTR Motor_11_BZ SQC Gear_SQC XMsgCnt "
    "LWI_Botschaftszaehler AliveCtr",
    Role.CRC: "CHKSM CRC8 Checksum Motor_11_CRC Chksum EPS_CKS Mdps_CS",
    None: "ErrorCounter AliveCnt2 COUNTER_PEDAL Alive_1 ABZ Brebz Gas_CSX",
}


def test_alive_counters_and_checksums_are_recognised_by_their_names() -> None:
    for role, names in NAMES.items():
        assert {name: protection(name) for name in names.split()} == dict.fromkeys(
            names.split(), role
        )


def test_counter_is_sent_and_a_doubtful_counter_is_refused_unless_bound() -> None:
    text = MESSAGE + signal("COUNTER")
    other = MESSAGE + signal("ErrorCounter")
    (line,) = refused(other)
    assert "no such source" in line
    found = [
        compiled(text),
        compiled(other, bind={"ErrorCounter": "alive"}),
        compiled(text, bind={"COUNTER": 1}),
    ]
    roles = [layout.messages[0].signals[0].role for layout in found]
    assert roles == [Role.ALIVE, Role.ALIVE, Role.CONSTANT]


@pytest.mark.parametrize("counter", ["COUNTER", "Nothing"])
def test_checksum_is_refused_until_the_configuration_defines_it(
    counter: str,
) -> None:
    text = MESSAGE + signal("CHKSM") + signal(counter, "8|4@1+")
    for settings in ({}, {"unbound": "start_value"}):
        (line,) = refused(text, bind={"Nothing": 0} if counter == "Nothing" else {}, **settings)
        assert "Power.CHKSM: " in line
        assert "dbc.e2e_data_ids.Power = 0x100" in line
        assert "dbc.messages" in line
    bind: dict[str, str | float] = {counter: "alive"}
    for said in (
        {"e2e_data_ids": {"Power": 7}, "bind": bind},
        {"bind": {"CHKSM": "crc"} | bind},
    ):
        layout = compiled(text, **said)
        assert roles_of(layout) == [Role.CRC, Role.ALIVE]
        assert not layout.warnings[:-1]
    constant = compiled(text, bind=bind | {"CHKSM": 0})
    assert constant.messages[0].signals[0].role is Role.CONSTANT


def roles_of(layout: MessageLayout) -> list[Role]:
    """Return the roles of the signals of the only message."""
    (message,) = layout.messages
    return [signal.role for signal in message.signals]


def test_names_that_0_5_0_took_for_e2e_profile_1_cause_a_warning() -> None:
    text = MESSAGE + signal("Crc") + signal("Alive", "8|4@1+")
    warned = "".join(compiled(text).warnings)
    assert "AUTOSAR E2E profile 1" in warned
    assert "= 0x100" in warned
    assert "E2E" not in "".join(compiled(text, e2e_data_ids={"Power": 0x100}).warnings)
    # a counter that is bound counts in the same way as one found by its name
    other = compiled(text.replace("Alive", "MsgNo"), bind={"MsgNo": "alive"})
    assert roles_of(other) == [Role.CRC, Role.ALIVE]


# --- flags without telemetry

FLAG = MESSAGE + signal("Undervoltage", "0|1@1+", ends="0|1")
INVERTED = FLAG.replace("(1,0)", "(-1,1)")
SNA = 'VAL_ 256 Undervoltage 1 "NotAvailable" ;\n'


@pytest.mark.parametrize(
    ("text", "on_loss", "raw"),
    [
        (FLAG, None, 0),
        (FLAG, 0, 0),
        (FLAG, 1, 1),
        # a default of the attribute does not apply to the flag
        (f'{FLAG}{START}BA_DEF_DEF_ "GenSigStartValue" 1;', None, 0),
        (FLAG + START + start_of("Undervoltage", 1), None, 1),
        (FLAG + START + start_of("Undervoltage", 2), None, 0),
        (FLAG + START + start_of("Undervoltage", 1), 0, 0),
        (FLAG + START + start_of("Undervoltage", 0), 1, 1),
        (FLAG + SNA, None, 1),
        (FLAG + SNA, 0, 1),
        (FLAG + 'VAL_ 256 Undervoltage 0 "Ok" 1 "Error" ;\n', None, 0),
        (INVERTED, None, 1),
        (INVERTED, 1, 0),
        (FLAG.replace("@1+ (1,0)", "@1- (-1,0)"), None, 0),
        (FLAG.replace("0|1@1+", "0|2@1+"), None, 3),  # two bits have room for a code
    ],
)
def test_without_telemetry_a_flag_is_0_or_its_configured_value(
    text: str,
    on_loss: int | None,
    raw: int,
) -> None:
    layout = compiled(text, flags_on_loss=on_loss)
    (plan,) = layout.messages
    assert packed(plan, gateway_with(layout))[0] == raw
    for word in (0, 1):
        (found,) = plan.signals
        value = (word - found.offset) / found.factor % (1 << found.length)
        gateway = gateway_with(layout, LiveData(operating_errors=word))
        assert packed(plan, gateway)[0] == value


def test_bit_that_cannot_hold_both_values_of_a_flag_is_refused() -> None:
    (line,) = refused(FLAG.replace("@1+", "@1-"))
    assert "both values of a flag" in line
    assert "unsigned" in line


def percent(ends: str, code: int | None = None) -> str:
    text = signal("Throttle", "32|32@1-", "%", ends=ends) + "SIG_VALTYPE_ 256 Throttle : 1;\n"
    return text if code is None else text + f'VAL_ 256 Throttle {code} "NotAvailable" ;\n'


STATES = signal("OperatingState", "8|8@1+") + 'VAL_ 256 OperatingState 7 "MotorOff" ;\n'


@pytest.mark.parametrize(
    ("beside", "name"),
    [
        ("", None),
        (signal("BatteryVoltage", "8|16@1+", "V", "0.01,0"), None),
        (signal("BatteryVoltage", "8|16@1+", "V", "0.01,0", "0|100"), "BatteryVoltage"),
        (signal("LinkState", "8|8@1+"), "LinkState"),
        # the device is an info value, which stays available for longer than the link
        (signal("Device", "8|8@1+", ends="0|5"), None),
        (signal("BecCurrent", "8|16@1+", "A", "0.01,0", "0|100"), None),  # never on a JIVEPro
        (percent("0|0"), "Throttle"),
        (signal("MessageAlive", "8|8@1+"), None),
        (percent("0|100", 101), "Throttle"),
        (percent("0|100", -1), "Throttle"),
        (percent("0|100", 100), None),  # the code is one of the values
        (percent("0|100", 0), None),
        (STATES, "OperatingState"),
        (STATES + START + start_of("OperatingState", 7), None),
    ],
)
def test_layout_without_a_signal_that_reports_the_loss_causes_a_warning(
    beside: str, name: str | None
) -> None:
    layout = compiled(FLAG + beside)
    (message,) = layout.messages
    (flag,) = [signal for signal in message.signals if signal.name == "Undervoltage"]
    found = reporter(message, flag)
    assert is_mute(flag)
    assert (found.name if found else None) == name
    warned = list(unreported(CoreSettings((), layout)))
    assert len(warned) == (name is None)
    assert all('on_loss = "silent"' in line and "Undervoltage" in line for line in warned)
    assert not list(unreported(CoreSettings((), layout, silent_on_loss=True)))


def test_each_flag_needs_a_signal_of_its_own_esc_to_report_the_loss() -> None:
    text = MESSAGE + signal("LeftUndervoltage", "0|1@1+") + signal("RightUndervoltage", "1|1@1+")
    layout = compiled(text + signal("LeftLinkState", "8|8@1+"), ("left", "right"))
    (line,) = unreported(CoreSettings((), layout))
    assert "RightUndervoltage" in line
    assert "LeftUndervoltage" not in line


def test_float_of_24_bits_is_refused_even_with_a_start_value() -> None:
    float_24 = signal("Throttle", "0|24@1-", "%") + "SIG_VALTYPE_ 256 Throttle : 1;\n"
    (line,) = refused(MESSAGE + float_24 + START + start_of("Throttle", 5))
    assert "a float of 24 bits is not supported" in line


def test_capture_stores_the_dbc_settings_and_0_5_0_stored_fewer() -> None:
    old = DbcConfig(bind={"A.B": 1}, base_id=5, e2e_data_ids={"M": 7}, on_loss="silent")
    later: dict[str, Any] = {
        "units": {"x": "V"},
        "messages": ("Motor_*",),
        "flags_on_loss": 1,
    }
    new = replace(old, send_type={"y": "Event"}, unbound="start_value", **later)
    setup = CaptureSetup((EscSettings(),), ("-",), ("my.dbc", b""), new, False)
    header = json.loads(json.dumps(setup.header()))
    assert CaptureSetup.of(header).dbc_settings == new
    for key in (*later, "send_types", "unbound"):
        del header["dbc"][key]
    assert CaptureSetup.of(header).dbc_settings == old


# --- entries that the grammar allows, and that cantools refuses or misreads


@pytest.mark.parametrize(
    "line", ["BS_: 250000 : 0,0", "BS_ : 500000 : 1 , 28 ;", "\tBS_:125000:0,0", "BS_:"]
)
def test_bus_with_a_baud_rate_is_read(line: str) -> None:
    text = f'VERSION ""\nNS_ :\n{line}\nBU_: GW\nBO_ 673 ESC_1: 8 GW\n' + signal("BatteryVoltage")
    (message,) = compiled(text).messages
    assert message.name == "ESC_1"
    assert message.can_id == 673


def test_comment_that_looks_like_a_baud_rate_is_kept() -> None:
    comment = "seen:\nBS_: 250000 : 0,0\nSG_ X : 0|16@3+"
    (message,) = parse_database(f'{STATE}CM_ BO_ 256 "{comment}";\n'.encode(), "my.dbc").messages
    assert message.comment == comment


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ("2", "2"),
        ("3", "3"),
        ("10", "10"),
        ("01", "01"),
    ],
)
def test_unknown_byte_order_is_refused_with_the_name_of_the_signal(order: str, said: str) -> None:
    (line,) = refused(STATE.replace("@1", f"@{order}"))
    assert line == (
        f"{FILE}: Power.OperatingState: byte order {said} is neither 0 (Motorola) nor 1 (Intel). "
        "Write @0 or @1. SIG_VALTYPE_ declares floats."
    )


UNSENT = "".join(
    f"BO_ {673 + n} ESC_{n + 1}: 8 Vector__XXX\n{signal('BatteryVoltage')}" for n in range(3)
)


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        (("ESC_1",), ["ESC_1"]),
        (("ESC_[13]",), ["ESC_1", "ESC_3"]),
        (("*",), ["ESC_1", "ESC_2", "ESC_3"]),
    ],
)
def test_messages_without_a_transmitter_are_selected_by_name(
    patterns: tuple[str, ...], names: list[str]
) -> None:
    assert [each.name for each in compiled(HEAD + UNSENT, messages=patterns).messages] == names


def test_messages_without_a_transmitter_need_a_selection_and_a_match() -> None:
    (line,) = refused(HEAD + UNSENT)
    assert "Choose messages with dbc.messages, or name a transmitter" in line
    (line,) = refused(HEAD + UNSENT, messages=("ESC_4",))
    assert line.startswith("dbc.messages: 'ESC_4' matches no message of")
    assert "ESC_" in line[-30:]


def test_message_with_a_transmitter_is_not_selected_by_name_alone() -> None:
    text = HEAD + UNSENT + "BO_ 700 Theirs: 8 Other\n" + signal("BatteryVoltage")
    (line,) = refused(text, messages=("ESC_1",))
    assert "ESC_1 has no transmitter" in line


@pytest.mark.parametrize("kind", ["FLOAT 0 65535", "INT 0 65535", "STRING"])
@pytest.mark.parametrize(
    ("written", "used_ns"),
    [("12.5", 12_500_000), ("0.25", MS), ("33.333", 33_333_000), ("10", 10 * MS)],
)
def test_cycle_time_with_a_fraction_is_exact_or_causes_a_warning(
    kind: str,
    written: str,
    used_ns: int,
) -> None:
    quoted = f'"{written}"' if kind == "STRING" else written
    default = '""' if kind == "STRING" else "0"
    text = (
        f'BA_DEF_ BO_ "GenMsgCycleTime" {kind};\nBA_DEF_DEF_ "GenMsgCycleTime" {default};\n'
        f'BA_ "GenMsgCycleTime" BO_ 256 {quoted};\n'
    )
    layout = compiled(STATE + text)
    assert layout.messages[0].cycle_ns == used_ns
    said = [f"{FILE}: Power: GenMsgCycleTime is 0.25 ms. The shortest time is used, 1 ms."]
    assert [line for line in layout.warnings if "CycleTime" in line] == said * (written == "0.25")


def test_minimum_distance_with_a_fraction_is_exact() -> None:
    text = 'BA_DEF_ BO_ "GenMsgDelayTime" INT 0 9;\nBA_DEF_DEF_ "GenMsgDelayTime" 7.5;\n'
    assert compiled(STATE + text).messages[0].delay_ns == 7_500_000


def test_frames_with_a_cycle_of_a_fraction_keep_it_on_average() -> None:
    text = 'BA_DEF_ BO_ "GenMsgCycleTime" FLOAT 0 9;\nBA_DEF_DEF_ "GenMsgCycleTime" 12.5;\n'
    gateway = gateway_with(compiled(STATE + text))
    times = []
    now = 0
    while now < 2000 * MS:
        gateway.advance(now)
        times += [now] * len(gateway.take_frames(now))
        now = max(now, gateway.next_deadline())
    distances = {after - before for before, after in itertools.pairwise(times)}
    assert distances == {12_500_000}


# --- messages that cannot exist


@pytest.mark.parametrize(
    ("number", "place", "words"),
    [
        (13274, "0|8@1+", "the id 33DAh, which is beyond 7FFh (a 29-bit id"),
        (0xE0000001, "0|8@1+", "the id 60000001h, which is beyond 1FFFFFFFh"),
        (100, "0|0@1+", "a signal of 0 bits, A"),
    ],
)
@pytest.mark.parametrize("sender", ["Other", "Gateway"])
def test_impossible_message_is_left_out_unless_the_gateway_sends_it(
    number: int, place: str, words: str, sender: str
) -> None:
    text = f'{STATE}BO_ {number} Theirs: 8 {sender}\n{signal("A", place)}VAL_ {number} A 1 "x" ;\n'
    if sender == "Gateway":
        (line,) = refused(text)
        assert line.startswith(f"{FILE}: Theirs: has {words}")
        assert compiled(text, messages=["Power"])
        return
    warnings: list[str] = []
    (message,) = parse_database(text.encode(), "my.dbc", warnings).messages
    assert message.name == "Power"
    (line,) = warnings
    assert f"Theirs (Other) has {words}" in line
    layout = compiled(text, node="Gateway")
    assert [plan.name for plan in layout.messages] == ["Power"]


def test_file_whose_only_message_of_the_gateway_is_impossible_is_refused() -> None:
    text = STATE.replace("BO_ 256 ", "BO_ 4000 ")
    assert text != STATE
    for base_id in (None, 0x300):
        (line,) = refused(text, base_id=base_id)
        assert line.startswith(f"{FILE}: Power: has the id FA0h")


def test_equal_names_and_ids_are_warnings_with_the_file_and_not_of_the_library(
    capfd: pytest.CaptureFixture[str],
) -> None:
    other = f"BO_ 100 Theirs: 8 Other\n{signal('A')}\n"
    warnings: list[str] = []
    parse_database((STATE + other + other).encode(), "my.dbc", warnings)
    assert warnings == [
        "my.dbc: several messages have the same name: Theirs",
        "my.dbc: several messages have the same id: 64h",
    ]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("factor", "notes"),
    [
        ("0.05,0", ("changes in steps of 0.1 A, as the value itself",)),
        ("0.1,0", ()),
        ("1,0", ()),
    ],
)
def test_factor_finer_than_the_value_is_noted(factor: str, notes: tuple[str, ...]) -> None:
    text = MESSAGE + signal("BatteryCurrent", "0|16@1-", "A", factor, "-100|100")
    (plan,) = compiled(text).messages
    (only,) = plan.signals
    assert only.notes == notes


@pytest.mark.parametrize(
    ("name", "beginning", "said"),
    [
        ("a.sym", "FormatVersion=6.0 // x\nTitle=x\n", "is a PCAN Symbol file (.sym), not a DBC"),
        ("a.kcd", '<?xml version="1.0"?>\n<NetworkDefinition>', "is a KCD, not a DBC"),
        ("a.kcd", "<NetworkDefinition>", "cantools: cantools convert a.kcd a_converted.dbc"),
        ("a.arxml", '<?xml version="1.0"?>\n<AUTOSAR>', "is an ARXML, not a DBC"),
        (
            "a.dbf",
            "//****BUSMASTER\n\n[DATABASE_VERSION] 1.3\n",
            "canconvert a.dbf a_",
        ),
    ],
)
def test_database_of_another_format_is_named_with_its_converter(
    name: str, beginning: str, said: str
) -> None:
    with pytest.raises(UserError, match=re.escape(said)):
        parse_database(beginning.encode(), name)
