"""A user's DBC as other tools write it: entries for nothing, units, send types, counters, checksums, flags, unbound signals."""

import json
from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest
from dbc_bench import compiled, gateway_with, packed, refused

from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.dbc.loss import is_mute, reporter, unreported
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.dbc.timing import SEND_TYPES
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.signals.plan import Role, SendType
from kontronik_can_gw.signals.units import conversion


def signal(
    name: str, place: str = "0|8@1+", unit: str = "", scale: str = "1,0", ends: str = "0|0"
) -> str:
    return f' SG_ {name} : {place} ({scale}) [{ends}] "{unit}" Other\n'


HEAD = 'VERSION ""\nNS_ :\n\tNS_DESC_\n\tVAL_\n\tVAL_TABLE_\n\tBA_DEF_\n\tSIG_VALTYPE_\n\nBS_:\n\nBU_: Gateway Other\n\n'
MESSAGE = f"{HEAD}BO_ 256 Power: 8 Gateway\n"
STATE = MESSAGE + signal("OperatingState")
START = 'BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 0;\n'


def start_of(name: str, value: object, number: int = 256) -> str:
    return f'BA_ "GenSigStartValue" SG_ {number} {name} {value};\n'


# --- entries ------------------------------------------------------------------------------------------------------------


def test_comments_and_value_texts_are_not_touched() -> None:
    comment = "first; one\nVAL_ 256 OperatingState States ;\nVAL_TABLE_ States 1 fake ;\nBA_ "
    text = f'{STATE}VAL_TABLE_ States 21 "Forward; bad" 12 "MotorOff" ;\nCM_ BO_ 256 "{comment}";\n'
    text += "VAL_ 256 OperatingState States ;\n"
    (message,) = parse_database(text.encode(), "my.dbc").messages
    assert dict(message.signals[0].choices or {}) == {21: "Forward; bad", 12: "MotorOff"}
    assert message.comment == comment


def test_an_attribute_with_a_text_that_its_enumeration_lacks_is_refused() -> None:
    text = (
        'BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic";\nBA_ "GenMsgSendType" BO_ 256 "Sometimes";\n'
    )
    (line,) = refused(STATE + text)
    assert '"GenMsgSendType": "Sometimes" is none of' in line


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
def test_an_entry_for_what_is_not_in_the_file_is_ignored_with_a_warning(
    entry: str, words: str
) -> None:
    warnings: list[str] = []
    comment = entry.replace('"', "")
    text = f'{STATE}CM_ SG_ 256 OperatingState "{comment}";\n{entry}\n'
    (message,) = parse_database(text.encode(), "my.dbc", warnings).messages
    (line,) = warnings
    assert line.startswith("my.dbc: ignored") and line.endswith(words)
    assert message.signals[0].choices is None and message.signals[0].comment == comment


# --- units --------------------------------------------------------------------------------------------------------------

UNITS = """
battery_voltage 44.42: V|v|Volt|Volts|volt|VOLT|Unit_Volt|[V]|| |-|none|Unit_None|unitless|N/A
battery_voltage 44420: mV|mv|Unit_MilliVolt|millivolts|(mV)
battery_voltage 0.04442: kV|KV
battery_current -12.3: A|Amp|Amps|amps|ampere|Ampere|Unit_Amper|Unit_Ampere
battery_current -12300: mA|Unit_MilliAmper
battery_power -546.366: W|watts|Watt|Unit_Watt
battery_power -0.546366: kW|KW|kw|Kw|Unit_KiloWatt
battery_power -546366: mW
consumed_charge 1800: mAh|mA*h
consumed_charge 1.8: Ah|AH|A h|AmpHour|amperehour|ampere*hour|Unit_AmperHour
consumed_charge 6480: As|C|coulomb
power_stage_temperature -13: degC|DegC|Deg C|deg C|deg_C|°C|° C|ºC|Â°C|\ufffdC|C|Cel|celsius|Degrees C|degreesC|Unit_DegreCelsi|[°C]|Grad C
power_stage_temperature 260.15: K|Kelvin|degK|Unit_Kelvi
power_stage_temperature 8.6: F|degF|°F|Fahrenheit
pwm_input 1500: us|µs|μs|Âµs|usec|uSec|Unit_MicroSecon|microseconds
pwm_input 1.5: ms|msec|mSec|millisecond|Unit_MilliSecon
pwm_input 0.0015: s|sec|secs|Seconds|Unit_Secon
electrical_speed 70000: 1/min|rpm|RPM|Rpm|U/min|Umin|upm|r/min|R/min|min⁻¹|min^-1|/min|rev/min|Unit_MinutInver
electrical_speed 1166.66666667: 1/s|rps|U/sec|s⁻¹
electrical_speed 7330.38285838: rad/s|radians/sec|Rad/Sec|Unit_RadPerSecon
electrical_speed 420000: deg/s|°/s|degrees/second|Grad/sec|Unit_DegreOfArcPerSecon
throttle -7: %|percent|Percent|Unit_PerCent|pct
throttle -0.07: 1|ratio
crc_errors 3: 1|-|counts|Cnt|#|Unit_None|number
frame_rate 99.9: Hz|hz|Unit_Hertz|1/s
frame_rate 0.0999: kHz
"""
"""Of a source: a value in the unit that spellings mean; the first row of each has it in the source's own unit."""


def spelled() -> list[tuple[str, str, str, str]]:
    own: dict[str, str] = {}
    rows = []
    for row in UNITS.strip().splitlines():
        head, _, texts = row.partition(": ")
        source, meant = head.split()
        rows += [(source, own.setdefault(source, meant), meant, text) for text in texts.split("|")]
    return rows


@pytest.mark.parametrize(("source", "value", "meant", "text"), spelled())
def test_a_unit_is_known_however_it_is_spelled(
    source: str, value: str, meant: str, text: str
) -> None:
    found = conversion(VALUES[source].unit, text)
    assert found is not None
    assert float(Fraction(value) * found[0] + found[1]) == pytest.approx(float(meant), rel=1e-11)


@pytest.mark.parametrize(
    ("source", "texts", "possible"),
    [
        ("battery_voltage", "MV A 1 x Unit_ deg m/s ° Nm", "V, mV, kV"),
        ("throttle", "V", "%, ‰, 1"),
        ("power_stage_temperature", "deg", "degC, K, degF"),
        ("electrical_speed", "Hz m/s", "1/min, krpm, rps, rad/s, deg/s"),
        ("crc_errors", "V %", "1"),
        ("battery_power", "MW", "W, mW, kW, hp, PS"),
    ],
)
def test_a_unit_of_another_quantity_or_of_two_meanings_is_refused(
    source: str, texts: str, possible: str
) -> None:
    for text in texts.split():
        (line,) = refused(MESSAGE + signal("X", "0|16@1+", text), bind={"X": source})
        assert f"'{text}'" in line and f"Possible: {possible};" in line and "dbc.units" in line


def test_dbc_units_says_what_a_text_means_whatever_it_means_elsewhere() -> None:
    text = MESSAGE + signal("BatteryVoltage", "0|16@1+", "Zaehler", "0.01,0")
    text += signal("BecVoltage", "16|16@1+", "A")
    units = {"Zaehler": "mV", "A": "mV"}
    (plan,) = compiled(text, units=units).messages
    assert [(s.unit, float(s.slope)) for s in plan.signals] == [("mV", 1000), ("mV", 1)]
    assert refused(text, units=units | {"Zahler": "V"}) == [
        "dbc.units.Zahler: no signal of Gateway has this unit in my_car.dbc. Did you mean 'Zaehler'?"
    ]


# --- which messages, and signals bound to nothing ----------------------------------------------------------------------

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


def test_a_pattern_that_names_no_message_of_ours_is_refused() -> None:
    lines = refused(ECU, messages=["Motr_11", "Motor_11", "Motor_9*", "qqq*"], **GATEWAYS)
    assert lines == [
        "dbc.messages: 'Motr_11' is no message of Gateway in my_car.dbc. Did you mean Motor_11?",
        "dbc.messages: 'Motor_9*' is no message of Gateway in my_car.dbc. Motor_90 is sent by Other.",
        "dbc.messages: 'qqq*' is no message of Gateway in my_car.dbc.",
    ]


def test_only_what_is_chosen_has_to_be_right_and_many_unbound_signals_come_with_advice() -> None:
    *lines, advice = refused(ECU, node="Gateway")
    assert len(lines) == 8
    assert all(words in advice for words in ("8 signals of Gateway", "dbc.messages", "start_value"))
    (line,) = refused(ECU, node="Gateway", messages=["Motor_11"])
    assert "Motor_11.Motor_11X: no such source" in line


def test_a_signal_bound_to_nothing_holds_its_start_value_as_cantools_reads_it() -> None:
    layout = compiled(ECU, messages=["Motor_2?"], bind={"Gear": 5}, **GATEWAYS)
    gateway = gateway_with(layout, LiveData(battery_voltage=4442))
    database = parse_database(ECU.encode(), "my.dbc")
    read: dict[str, Any] = {}
    for plan in layout.messages:
        theirs = database.get_message_by_frame_id(plan.can_id)
        read |= dict(theirs.decode_simple(packed(plan, gateway), decode_choices=False))
    expected = {"BatteryVoltage": 44.42, "Torque": -512.5, "Warm": 15, "Gear": 5}
    assert read == expected | {"Ratio": 1.5, "Cool": -2}
    unbound = {s.name for plan in layout.messages for s in plan.signals if s.unbound}
    assert unbound == {"Torque", "Warm", "Ratio", "Cool"}
    assert [line for line in layout.warnings if "sent once" in line] == [
        "my_car.dbc: sent once at the start, without a cycle and a value that changes: Motor_21"
    ]


@pytest.mark.parametrize(
    ("place", "fits", "beyond"),
    [
        ("0|8@1+", (0, 255), (-1, 256, 0.5)),
        ("0|1@1-", (-1, 0), (-2, 1)),
        ("7|12@0-", (-2048, 2047), (-2049, 2048)),
    ],
)
def test_a_start_value_may_be_every_number_that_the_signal_holds(
    place: str, fits: tuple[int, int], beyond: tuple[float, ...]
) -> None:
    text = MESSAGE + signal("Foo", place) + START
    (theirs,) = parse_database(text.encode(), "my.dbc").messages
    for value in fits:
        layout = compiled(text + start_of("Foo", value), unbound="start_value")
        data = packed(layout.messages[0], gateway_with(layout))
        assert theirs.decode_simple(data) == {"Foo": value}
    for number in beyond:
        (line,) = refused(text + start_of("Foo", number), unbound="start_value")
        assert "Power.Foo" in line and f"GenSigStartValue {number}" in line


# --- send types ---------------------------------------------------------------------------------------------------------

SPELLINGS = {
    "Cyclic": "Cyclic cyclic cyclicX fixedCyclic FixedPeriodic Periodic cyclicIfActive IfActive EnabledPeriodic cyclicIfActiveX "
    "CyclicIfActiveFast",
    "Event": "Event spontaneous spontan spontanX spontaneousWithDelay spontanWithDelay spontaneousWithRepetition OnWrite "
    "OnWriteWithRepetition",
    "OnChange": "OnChange OnChangeWithRepetition",
    "CyclicAndEvent": "cyclicAndSpontaneous cyclicAndSpontanX cyclicAndSpontanWithDelay CyclicAndSpontaneousWithDelay EventPeriodic "
    "cyclicIfActiveAndSpontanWD PeriodicAndEvent",
    "CyclicAndOnChange": "CyclicAndOnChange OnChangeAndIfActive OnChangeAndIfActiveWithRepetition",
    "": "vector_leerstring NoMsgSendType None NotUsed NoSigSendType nomsgsendtype",
}


def all_sent(text: str, cycle: int = 20) -> str:
    """A DBC whose messages have this send type."""
    return (
        f'{STATE}BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","{text}";\nBA_DEF_DEF_ "GenMsgSendType" "{text}";\n'
        'BA_DEF_ BO_ "GenMsgCycleTimeFast" INT 0 0;\nBA_DEF_DEF_ "GenMsgCycleTimeFast" 0;\n'
        f'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 0;\nBA_DEF_DEF_ "GenMsgCycleTime" {cycle};\n'
    )


@pytest.mark.parametrize(
    ("meant", "text"),
    [(meant, text) for meant, texts in SPELLINGS.items() for text in texts.split()],
)
def test_a_send_type_is_known_by_its_names_in_use(meant: str, text: str) -> None:
    layout = compiled(all_sent(text))
    assert layout.messages[0].send_type == (SEND_TYPES[meant] if meant else SendType.CYCLIC)
    if not meant:
        assert compiled(all_sent(text, 0)).messages[0].send_type == SendType.EVENT


@pytest.mark.parametrize("text", ["No", "Wrong", "OnRequest", "cyclically"])
def test_another_send_type_is_refused_unless_dbc_send_type_says_what_it_means(text: str) -> None:
    (line,) = refused(all_sent(text))
    assert f"GenMsgSendType {text!r} is not known" in line and f"dbc.send_type.{text!r}" in line
    for name, meaning in ((text, "CyclicAndEvent"), ("OnChange", "Event")):
        (plan,) = compiled(all_sent(name), send_types={name: meaning}).messages
        assert plan.send_type == SEND_TYPES[meaning]
    assert refused(all_sent("Event"), send_types={"Evnt": "Cyclic"}) == [
        "dbc.send_type.Evnt: no message of Gateway has this GenMsgSendType in my_car.dbc. Did you mean 'Event'?"
    ]


# --- counters and checksums ---------------------------------------------------------------------------------------------


def role(name: str, **bind: str | float) -> Role:
    """What becomes of a signal of this name."""
    text = MESSAGE + signal(name) + signal("Beside", "8|4@1+")
    (plan,) = compiled(text, bind={"Beside": 0} | bind).messages
    return plan.signals[0].role


COUNTERS = "MsgCntr AliveCnt COUNTER Counter CTR Motor_11_BZ SQC Gear_SQC XMsgCnt LWI_Botschaftszaehler AliveCtr"


@pytest.mark.parametrize("name", COUNTERS.split())
def test_a_counter_of_frames_is_known_by_its_name(name: str) -> None:
    assert role(name) is Role.ALIVE
    assert role(name, **{name: 1}) is Role.CONSTANT


@pytest.mark.parametrize(
    "name", ["ErrorCounter", "AliveCnt2", "COUNTER_PEDAL", "Alive_1", "ABZ", "Brebz", "Gas_CSX"]
)
def test_what_may_count_something_else_is_refused_unless_it_is_bound(name: str) -> None:
    (line,) = refused(MESSAGE + signal(name))
    assert "no such source" in line
    assert role(name, **{name: "alive"}) is Role.ALIVE


@pytest.mark.parametrize(
    "crc", ["CHKSM", "CRC8", "Checksum", "Motor_11_CRC", "Chksum", "EPS_CKS", "Mdps_CS"]
)
@pytest.mark.parametrize("counter", ["COUNTER", "Motor_11_BZ", "AliveCnt", "Nothing"])
def test_a_checksum_of_unknown_making_is_refused_until_somebody_says_what_it_is(
    crc: str, counter: str
) -> None:
    text = MESSAGE + signal(crc) + signal(counter, "8|4@1+")
    for settings in ({}, {"unbound": "start_value"}):
        (line,) = refused(text, bind={"Nothing": 0} if counter == "Nothing" else {}, **settings)
        assert f"Power.{crc}: " in line
        assert "dbc.e2e_data_ids.Power = 0x100" in line and "dbc.messages" in line
    bind: dict[str, str | float] = {counter: "alive"}
    for said in ({"data_ids": {"Power": 7}, "bind": bind}, {"bind": {crc: "crc"} | bind}):
        layout = compiled(text, **said)
        assert [signal.role for signal in layout.messages[0].signals] == [Role.CRC, Role.ALIVE]
        assert not layout.warnings[:-1]
    assert compiled(text, bind=bind | {crc: 0}).messages[0].signals[0].role is Role.CONSTANT


def test_what_0_5_0_sent_as_e2e_profile_1_by_its_names_goes_on_with_a_warning() -> None:
    text = MESSAGE + signal("Crc") + signal("Alive", "8|4@1+")
    warned = "".join(compiled(text).warnings)
    assert "AUTOSAR E2E profile 1" in warned and "= 0x100" in warned
    assert "E2E" not in "".join(compiled(text, data_ids={"Power": 0x100}).warnings)
    # a counter by its binding is one by its name
    other = compiled(text.replace("Alive", "MsgNo"), bind={"MsgNo": "alive"})
    assert [signal.role for signal in other.messages[0].signals] == [Role.CRC, Role.ALIVE]


# --- flags without telemetry --------------------------------------------------------------------------------------------

FLAG = MESSAGE + signal("Undervoltage", "0|1@1+", ends="0|1")
INVERTED = FLAG.replace("(1,0)", "(-1,1)")
SNA = 'VAL_ 256 Undervoltage 1 "NotAvailable" ;\n'


@pytest.mark.parametrize(
    ("text", "on_loss", "raw"),
    [
        (FLAG, None, 0),
        (FLAG, 0, 0),
        (FLAG, 1, 1),
        (f'{FLAG}{START}BA_DEF_DEF_ "GenSigStartValue" 1;', None, 0),  # says nothing of this flag
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
def test_a_flag_without_a_code_is_0_without_telemetry_or_what_is_asked_for(
    text: str, on_loss: int | None, raw: int
) -> None:
    layout = compiled(text, flags_on_loss=on_loss)
    (plan,) = layout.messages
    assert packed(plan, gateway_with(layout))[0] == raw
    for word in (0, 1):
        (found,) = plan.signals
        value = (word - found.offset) / found.factor % (1 << found.length)
        gateway = gateway_with(layout, LiveData(operating_errors=word))
        assert packed(plan, gateway)[0] == value


def test_a_bit_that_cannot_hold_both_values_of_a_flag_is_refused() -> None:
    (line,) = refused(FLAG.replace("@1+", "@1-"))
    assert "both values of a flag" in line and "unsigned" in line


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
        # of the information, which outlives the link
        (signal("Device", "8|8@1+", ends="0|5"), None),
        (signal("BecCurrent", "8|16@1+", "A", "0.01,0", "0|100"), None),  # never on a JIVEPro
        (percent("0|0"), "Throttle"),
        (signal("MessageAlive", "8|8@1+"), None),
        (percent("0|100", 101), "Throttle"),
        (percent("0|100", -1), "Throttle"),
        (percent("0|100", 100), None),  # a code amid the values
        (percent("0|100", 0), None),
        (STATES, "OperatingState"),
        (STATES + START + start_of("OperatingState", 7), None),
    ],
)
def test_the_signal_that_reports_the_loss_is_known_and_a_warning_where_there_is_none(
    beside: str, name: str | None
) -> None:
    layout = compiled(FLAG + beside)
    (message,) = layout.messages
    (flag,) = [signal for signal in message.signals if signal.name == "Undervoltage"]
    found = reporter(message, flag)
    assert is_mute(flag) and (found.name if found else None) == name
    warned = unreported(layout, silent=False)
    assert len(warned) == (name is None)
    assert all('on_loss = "silent"' in line and "Undervoltage" in line for line in warned)
    assert not unreported(layout, silent=True)


def test_of_two_escs_each_flag_needs_a_signal_of_its_own_esc() -> None:
    text = MESSAGE + signal("LeftUndervoltage", "0|1@1+") + signal("RightUndervoltage", "1|1@1+")
    layout = compiled(text + signal("LeftLinkState", "8|8@1+"), ("left", "right"))
    (line,) = unreported(layout, silent=False)
    assert "RightUndervoltage" in line and "LeftUndervoltage" not in line


@pytest.mark.parametrize("bits", [8, 16, 24, 63])
def test_a_float_of_another_length_is_refused_whatever_it_begins_with(bits: int) -> None:
    text = HEAD + "BO_ 256 Message: 8 Gateway\n" + signal("Throttle", f"0|{bits}@1-", "%")
    more = "SIG_VALTYPE_ 256 Throttle : 1;\n" + START + start_of("Throttle", 5)
    (line,) = refused(text + more)
    assert f"a float of {bits} bits cannot be sent" in line


def test_a_capture_holds_how_a_dbc_is_used_and_one_of_0_5_0_has_less() -> None:
    old = DbcSettings({"A.B": 1}, base_id=5, data_ids={"M": 7})
    later: dict[str, Any] = {"units": {"x": "V"}, "send_types": {"y": "Event"}}
    later |= {"messages": ("Motor_*",), "unbound": "start_value", "flags_on_loss": 1}
    new = replace(old, **later)
    setup = CaptureSetup((EscSettings(),), ("-",), ("my.dbc", b""), new, False, False, None)
    header = json.loads(json.dumps(setup.header()))
    assert CaptureSetup.of(header).dbc_settings == new
    for key in later:
        del header["dbc"][key]
    assert CaptureSetup.of(header).dbc_settings == old
