"""A user's DBC as other tools write it: entries for nothing, units, send types, counters, checksums, flags, unbound signals."""

import json
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import pytest

from kontronik_can_gw.capture.setup import CaptureSetup
from kontronik_can_gw.cli import check
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.dbc.loss import unreported
from kontronik_can_gw.dbc.names import protection
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.dbc.timing import SEND_TYPES as NAMES
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.kontronik.codec import Layout as WireLayout
from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.signals.packer import compile_pack
from kontronik_can_gw.signals.plan import Layout, Role, SendType
from kontronik_can_gw.signals.units import conversion

HEAD = 'VERSION ""\nNS_ :\n\tNS_DESC_\n\tVAL_\n\tVAL_TABLE_\n\tBA_DEF_\n\tSIG_VALTYPE_\n\nBS_:\n\nBU_: Gateway Other\n\n'
MESSAGE = "BO_ 256 Power: 8 Gateway\n"
STATE = f'{MESSAGE} SG_ OperatingState : 0|8@1+ (1,0) [0|0] "" Other\n'


def compiled(text: str, names: Sequence[str] = ("esc1",), **settings: Any) -> Layout:
    database = parse_database((HEAD + text).encode(), "my.dbc")
    return prepare(
        database, "my.dbc", [EscSettings(name, 7) for name in names], DbcSettings(**settings), True
    )[1]


def refused(text: str, **settings: Any) -> list[str]:
    with pytest.raises(UserError) as caught:
        compiled(text, **settings)
    assert all(
        line.startswith(("my.dbc: ", "dbc.")) and "\n" not in line for line in caught.value.problems
    )
    return list(caught.value.problems)


# --- entries ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("comment", "read"),
    [
        (
            'CM_ BO_ 256 "first\nVAL_ 256 OperatingState States ;\nBA_ ";',
            "first\nVAL_ 256 OperatingState States ;\nBA_ ",
        ),
        (
            'CM_ BO_ 256 "one; two\nVAL_TABLE_ States 1 fake ;";',
            "one; two\nVAL_TABLE_ States 1 fake ;",
        ),
    ],
)
def test_comments_and_value_texts_are_not_touched(comment: str, read: str) -> None:
    text = f'VAL_TABLE_ States 21 "Forward; bad" 12 "MotorOff" ;\n{STATE}{comment}\nVAL_ 256 OperatingState States ;\n'
    (message,) = parse_database((HEAD + text).encode(), "my.dbc").messages
    assert dict(message.signals[0].choices or {}) == {21: "Forward; bad", 12: "MotorOff"}
    assert message.comment == read


def test_an_attribute_with_a_text_that_its_enumeration_lacks_is_refused() -> None:
    text = 'BA_DEF_ BO_ "GenMsgSendType" ENUM "Cyclic","Event";\nBA_ "GenMsgSendType" BO_ 256 "Sometimes";\n'
    with pytest.raises(UserError, match='"GenMsgSendType": "Sometimes" is none of'):
        parse_database((HEAD + STATE + text).encode(), "my.dbc")


@pytest.mark.parametrize(
    "table",
    [
        'VAL_TABLE_ States 21 "Forward" 12 "MotorOff" ;',
        'VAL_TABLE_ States\n21 "Forward"\n12 "MotorOff";',
    ],
)
def test_a_value_table_may_be_named_although_ns_lists_its_keyword(table: str) -> None:
    (plan,) = compiled(
        f"VAL_TABLE_ Empty ;\n{table}\n{STATE}VAL_ 256 OperatingState States ;\n"
    ).messages
    assert plan.signals[0].numbers == {21: 21, 12: 12}


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
    text = f'{HEAD}{STATE}CM_ SG_ 256 OperatingState "{entry.replace(chr(34), "")}";\n{entry}\n'
    database = parse_database(text.encode(), "my.dbc", warnings)
    (line,) = warnings
    assert line.startswith("my.dbc: ignored") and line.endswith(words)
    (signal,) = database.messages[0].signals
    assert signal.choices is None and signal.comment == entry.replace('"', "")


def test_many_entries_for_nothing_are_one_warning_and_a_mistake_keeps_its_line() -> None:
    warnings: list[str] = []
    text = HEAD + STATE + "".join(f'VAL_ {n} X 1 "x" ;\n' for n in range(1000, 1100))
    parse_database(text.encode(), "my.dbc", warnings)
    (line,) = warnings
    assert line.endswith("VAL_ 1005 X and 94 more")
    with pytest.raises(UserError, match=f"line {text.count(chr(10)) + 1}"):
        parse_database(f"{text}VAL_ x y z;\n".encode(), "my.dbc")


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
    factor, offset = conversion(VALUES[source].unit, text) or (
        Fraction(0),
        Fraction(0),
    )
    assert float(Fraction(value) * factor + offset) == pytest.approx(float(meant), rel=1e-11)


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
        (line,) = refused(
            f'{MESSAGE} SG_ X : 0|16@1+ (1,0) [0|0] "{text}" Other\n', bind={"X": source}
        )
        assert f"'{text}'" in line and f"Possible: {possible};" in line and "dbc.units" in line


def test_dbc_units_says_what_a_text_means_whatever_it_means_elsewhere() -> None:
    text = f'{MESSAGE} SG_ BatteryVoltage : 0|16@1+ (0.01,0) [0|0] "Zaehler" Other\n SG_ BecVoltage : 16|16@1+ (1,0) [0|0] "A" Other\n'
    (plan,) = compiled(text, units={"Zaehler": "mV", "A": "mV"}).messages
    assert [(s.unit, float(s.slope)) for s in plan.signals] == [("mV", 1000), ("mV", 1)]
    lines = refused(text, units={"Zaehler": "mV", "A": "mV", "Zahler": "V"})
    assert lines == [
        "dbc.units.Zahler: no signal of Gateway has this unit in my.dbc. Did you mean 'Zaehler'?"
    ]


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_degrees_and_micro_are_read_in_either_encoding_of_a_file(encoding: str) -> None:
    text = f'{HEAD}{MESSAGE} SG_ BecTemperature : 0|8@1- (1,0) [0|0] "°C" Other\n SG_ PwmInput : 8|16@1+ (1,0) [0|0] "µs" Other\n'
    database = parse_database(text.encode(encoding), "my.dbc")
    (plan,) = prepare(database, "my.dbc", [EscSettings()], DbcSettings())[1].messages
    assert [(float(s.slope), s.unit) for s in plan.signals] == [(1, "°C"), (1, "µs")]


# --- which messages, and signals bound to nothing ----------------------------------------------------------------------

ECU = (
    "".join(f'BO_ {n} {name}: 8 {node}\n SG_ {name}X : 0|8@1+ (1,0) [0|0] "" Other\n\n' for n, name, node in (
        (1, "Motor_11", "Gateway"), (2, "Motor_12", "Gateway"), (3, "Brake_1", "Gateway"), (4, "Motor_90", "Other"))
    )
    + 'BO_ 5 Motor_20: 8 Gateway\n SG_ BatteryVoltage : 0|16@1+ (0.01,0) [0|0] "V" Other\n'
    ' SG_ Torque : 16|16@1- (0.5,-509) [0|0] "Nm" Other\n'
    ' SG_ Warm : 32|4@1+ (1,0) [0|0] "" Other\n SG_ Gear : 36|4@1+ (1,0) [0|0] "" Other\n\n'
    'BO_ 6 Motor_21: 8 Gateway\n SG_ Ratio : 0|32@1- (1,0) [0|0] "" Other\n SG_ Cool : 39|8@0- (1,0) [0|0] "" Other\n\n'
    'BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 0;\nBA_DEF_DEF_ "GenSigStartValue" 3;\n'
    'BA_ "GenSigStartValue" SG_ 5 Torque -7;\nBA_ "GenSigStartValue" SG_ 6 Ratio 1.5;\nBA_ "GenSigStartValue" SG_ 6 Cool -2;\n'
    'VAL_ 5 Warm 15 "SNA" 0 "Cold" ;\nSIG_VALTYPE_ 6 Ratio : 1;\n'
)  # fmt: skip


@pytest.mark.parametrize(
    ("patterns", "chosen"),
    [
        (["Motor_1*"], ["Motor_11", "Motor_12"]),
        (["Brake_1", "Motor_?1"], ["Motor_11", "Brake_1", "Motor_21"]),
        ([], ["Motor_11", "Motor_12", "Brake_1", "Motor_20", "Motor_21"]),
    ],
)
def test_messages_are_chosen_by_patterns_of_their_names(
    patterns: list[str], chosen: list[str]
) -> None:
    layout = compiled(ECU, node="Gateway", messages=patterns, unbound="start_value")
    assert [plan.name for plan in layout.messages] == chosen


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("Motr_11", "Did you mean Motor_11?"),
        ("Motor_9*", "Motor_90 is sent by Other."),
        ("qqq*", "in my.dbc."),
    ],
)
def test_a_pattern_that_names_no_message_of_ours_is_refused(pattern: str, words: str) -> None:
    (line,) = refused(ECU, node="Gateway", messages=["Motor_11", pattern], unbound="start_value")
    assert line.startswith(f"dbc.messages: {pattern!r}") and line.endswith(words)


def test_only_what_is_chosen_has_to_be_right_and_many_unbound_signals_come_with_advice() -> None:
    lines = refused(ECU, node="Gateway")
    assert (
        len(lines) == 9
        and "8 signals of Gateway" in lines[-1]
        and "dbc.messages" in lines[-1]
        and "start_value" in lines[-1]
    )
    (line,) = refused(ECU, node="Gateway", messages=["Motor_11"])
    assert "Motor_11.Motor_11X: no such source" in line


def test_a_signal_bound_to_nothing_holds_its_start_value_as_cantools_reads_it() -> None:
    layout = compiled(
        ECU, node="Gateway", messages=["Motor_2?"], unbound="start_value", bind={"Gear": 5}
    )
    gateway = Gateway([EscSettings("esc1", 7)], layout, 0)
    gateway.receive_bytes(
        0, encode(LiveData(battery_voltage=4442), WireLayout.V4), 50 * MS, 50 * MS
    )
    database = parse_database((HEAD + ECU).encode(), "my.dbc")
    read: dict[str, Any] = {}
    for plan in layout.messages:
        bits = compile_pack(plan)(gateway.escs, gateway.status, 50 * MS, 0, 0)
        data = bits.to_bytes(8, "little")
        read |= dict(
            database.get_message_by_frame_id(plan.can_id).decode_simple(data, decode_choices=False)
        )
    assert read == {
        "BatteryVoltage": 44.42,
        "Torque": -512.5,
        "Warm": 15,
        "Gear": 5,
        "Ratio": 1.5,
        "Cool": -2,
    }
    unbound = [signal.name for plan in layout.messages for signal in plan.signals if signal.unbound]
    assert unbound == ["Torque", "Warm", "Ratio", "Cool"]
    said = "\n".join(check.unbound(layout))
    assert (
        "Motor_20: Torque = -512.5 Nm, Warm = 15" in said
        and "Motor_21: Ratio = 1.5, Cool = -2" in said
    )
    assert [line for line in layout.warnings if "sent once" in line] == [
        "my.dbc: sent once at the start, without a cycle and a value that changes: Motor_21"
    ]


@pytest.mark.parametrize("value", ["300", "-1", "0.5"])
def test_a_start_value_that_the_signal_cannot_hold_is_refused(value: str) -> None:
    text = ECU + f'BA_ "GenSigStartValue" SG_ 1 Motor_11X {value};\n'
    (line,) = refused(text, node="Gateway", messages=["Motor_11"], unbound="start_value")
    assert "Motor_11.Motor_11X" in line and f"GenSigStartValue {value}" in line


@pytest.mark.parametrize(
    ("place", "fits", "beyond"),
    [
        ("0|8@1+", (0, 255), (-1, 256)),
        ("0|8@1-", (-128, 127), (-129, 128)),
        ("0|1@1-", (-1, 0), (-2, 1)),
        ("7|12@0-", (-2048, 2047), (-2049, 2048)),
    ],
)
def test_a_start_value_may_be_every_number_that_the_signal_holds(
    place: str, fits: tuple[int, int], beyond: tuple[int, int]
) -> None:
    text = f'{MESSAGE} SG_ Foo : {place} (1,0) [0|0] "" Other\nBA_DEF_ SG_ "GenSigStartValue" INT 0 0;\n'
    for value in fits:
        own = f'BA_ "GenSigStartValue" SG_ 256 Foo {value};\n'
        (plan,) = compiled(text + own, unbound="start_value").messages
        gateway = Gateway([EscSettings("esc1", 7)], Layout("", "", ()), 0)
        data = compile_pack(plan)(gateway.escs, gateway.status, 0, 0, 0).to_bytes(8, "little")
        theirs = parse_database((HEAD + text).encode(), "my.dbc").messages[0]
        assert theirs.decode_simple(data) == {"Foo": value}
    for value in beyond:
        own = f'BA_ "GenSigStartValue" SG_ 256 Foo {value};\n'
        assert len(refused(text + own, unbound="start_value")) == 1


def test_a_wrong_binding_is_refused_whatever_becomes_of_signals_without_one() -> None:
    (line,) = refused(
        ECU,
        node="Gateway",
        messages=["Motor_11"],
        unbound="start_value",
        bind={"Motor_11X": "batery_voltage"},
    )
    assert "bound by dbc.bind to 'batery_voltage'" in line and "battery_voltage" in line


# --- send types ---------------------------------------------------------------------------------------------------------

SEND_TYPES = {
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
    [(meant, text) for meant, texts in SEND_TYPES.items() for text in texts.split()],
)
def test_a_send_type_is_known_by_its_names_in_use(meant: str, text: str) -> None:
    layout = compiled(all_sent(text))
    assert layout.messages[0].send_type == (NAMES[meant] if meant else SendType.CYCLIC)
    assert ("sent all the time" in "".join(layout.warnings)) == (
        "active" in text.lower() or text == "EnabledPeriodic"
    )
    if not meant:
        assert compiled(all_sent(text, 0)).messages[0].send_type == SendType.EVENT


@pytest.mark.parametrize("text", ["No", "Wrong", "OnRequest", "cyclically"])
def test_another_send_type_is_refused_unless_dbc_send_type_says_what_it_means(text: str) -> None:
    (line,) = refused(all_sent(text))
    assert f"GenMsgSendType {text!r} is not known" in line and f"dbc.send_type.{text!r}" in line
    for name, meaning in ((text, "CyclicAndEvent"), ("OnChange", "Event")):
        (plan,) = compiled(all_sent(name), send_types={name: meaning}).messages
        assert plan.send_type == NAMES[meaning]
    assert refused(all_sent("Event"), send_types={"Evnt": "Cyclic"}) == [
        "dbc.send_type.Evnt: no message of Gateway has this GenMsgSendType in my.dbc. Did you mean 'Event'?"
    ]


# --- counters and checksums ---------------------------------------------------------------------------------------------


def role(name: str, length: int = 8, **settings: Any) -> Role:
    text = f'{MESSAGE} SG_ {name} : 0|{length}@1+ (1,0) [0|0] "" Other\n SG_ Beside : 8|4@1+ (1,0) [0|0] "" Other\n'
    (plan,) = compiled(text, **{"bind": {"Beside": 0}} | settings).messages
    return plan.signals[0].role


@pytest.mark.parametrize(
    "name",
    [
        "MsgCntr", "AliveCnt", "COUNTER", "Counter", "CTR", "Motor_11_BZ", "SQC", "Gear_SQC", "XMsgCnt",
        "LWI_Botschaftszaehler", "AliveCtr",
    ],
)  # fmt: skip
def test_a_counter_of_frames_is_known_by_its_name(name: str) -> None:
    assert role(name) is Role.ALIVE
    assert role(name, bind={"Beside": 0, name: 1}) is Role.CONSTANT


@pytest.mark.parametrize(
    "name", ["ErrorCounter", "AliveCnt2", "FaultCnt", "COUNTER_PEDAL", "Counter1", "Alive_1"]
)
def test_what_may_count_something_else_is_refused_with_the_way_to_say_that_it_counts_frames(
    name: str,
) -> None:
    (line,) = refused(f'{MESSAGE} SG_ {name} : 0|8@1+ (1,0) [0|0] "" Other\n')
    assert "no such source" in line and 'bind = "alive"' in line
    assert role(name, bind={"Beside": 0, name: "alive"}) is Role.ALIVE


@pytest.mark.parametrize("name", ["ABZ", "Jazz", "Brebz", "Kompass", "Physics", "Gas_CSX"])
def test_a_word_that_only_ends_alike_is_neither(name: str) -> None:
    assert protection(name) is None


@pytest.mark.parametrize(
    "crc", ["CHKSM", "CRC8", "Checksum", "Motor_11_CRC", "Chksum", "EPS_CKS", "Mdps_CS"]
)
@pytest.mark.parametrize("counter", ["COUNTER", "Motor_11_BZ", "AliveCnt", "Nothing"])
def test_a_checksum_of_unknown_making_is_refused_until_somebody_says_what_it_is(
    crc: str, counter: str
) -> None:
    text = f'{MESSAGE} SG_ {crc} : 0|8@1+ (1,0) [0|0] "" Other\n SG_ {counter} : 8|4@1+ (1,0) [0|0] "" Other\n'
    for settings in ({}, {"unbound": "start_value"}):
        (line,) = refused(text, bind={"Nothing": 0} if counter == "Nothing" else {}, **settings)
        assert (
            f"Power.{crc}: " in line
            and "dbc.e2e_data_ids.Power = 0x100" in line
            and "dbc.messages" in line
        )
    bind: dict[str, str | float] = {counter: "alive"}
    for said in ({"data_ids": {"Power": 7}, "bind": bind}, {"bind": {crc: "crc"} | bind}):
        layout = compiled(text, **said)
        assert [signal.role for signal in layout.messages[0].signals] == [Role.CRC, Role.ALIVE]
        assert not layout.warnings[:-1]
    assert compiled(text, bind=bind | {crc: 0}).messages[0].signals[0].role is Role.CONSTANT


def test_what_0_5_0_sent_as_e2e_profile_1_by_its_names_goes_on_with_a_warning() -> None:
    text = f'{MESSAGE} SG_ Crc : 0|8@1+ (1,0) [0|0] "" Other\n SG_ Alive : 8|4@1+ (1,0) [0|0] "" Other\n'
    assert any(
        "AUTOSAR E2E profile 1" in line and "= 0x100" in line for line in compiled(text).warnings
    )
    assert not any("E2E" in line for line in compiled(text, data_ids={"Power": 0x100}).warnings)
    other = compiled(
        text.replace("Alive", "MsgNo"), bind={"MsgNo": "alive"}
    )  # a counter by its binding is one by its name
    assert [signal.role for signal in other.messages[0].signals] == [Role.CRC, Role.ALIVE]


# --- flags without telemetry --------------------------------------------------------------------------------------------

FLAG = f'{MESSAGE} SG_ Undervoltage : 0|1@1+ (1,0) [0|1] "" Other\n'
START = 'BA_DEF_ SG_ "GenSigStartValue" INT 0 1;\nBA_DEF_DEF_ "GenSigStartValue" 1;\n'


@pytest.mark.parametrize(
    ("text", "on_loss", "raw"),
    [
        (FLAG, None, 0),
        (FLAG, 0, 0),
        (FLAG, 1, 1),
        (FLAG + START, None, 0),  # a default says nothing of this flag
        (FLAG + START + 'BA_ "GenSigStartValue" SG_ 256 Undervoltage 1;\n', None, 1),
        (FLAG + START + 'BA_ "GenSigStartValue" SG_ 256 Undervoltage 2;\n', None, 0),
        (FLAG + START + 'BA_ "GenSigStartValue" SG_ 256 Undervoltage 1;\n', 0, 0),
        (FLAG + START + 'BA_ "GenSigStartValue" SG_ 256 Undervoltage 0;\n', 1, 1),
        (FLAG + 'VAL_ 256 Undervoltage 1 "NotAvailable" ;\n', None, 1),
        (FLAG + 'VAL_ 256 Undervoltage 1 "NotAvailable" ;\n', 0, 1),
        (FLAG + 'VAL_ 256 Undervoltage 0 "Ok" 1 "Error" ;\n', None, 0),
        (FLAG.replace("(1,0)", "(-1,1)"), None, 1),  # inverted
        (FLAG.replace("(1,0)", "(-1,1)"), 1, 0),
        (FLAG.replace("@1+ (1,0)", "@1- (-1,0)"), None, 0),
        (FLAG.replace("0|1@1+", "0|2@1+"), None, 3),  # two bits have room for a code
    ],
)
def test_a_flag_without_a_code_is_0_without_telemetry_or_what_is_asked_for(
    text: str, on_loss: int | None, raw: int
) -> None:
    (plan,) = compiled(text, flags_on_loss=on_loss).messages
    pack, gateway = compile_pack(plan), Gateway([EscSettings("esc1", 7)], Layout("", "", ()), 0)
    assert pack(gateway.escs, gateway.status, 0, 0, 0) == raw
    for word in (0, 1):
        gateway.receive_bytes(
            0, encode(LiveData(operating_errors=word), WireLayout.V4), 50 * MS, 50 * MS
        )
        value = (word - plan.signals[0].offset) / plan.signals[0].factor
        assert pack(gateway.escs, gateway.status, 50 * MS, 0, 0) == value % (
            1 << plan.signals[0].length
        )


PERCENT = ' SG_ Throttle : 32|32@1- (1,0) [0|100] "%" Other\nSIG_VALTYPE_ 256 Throttle : 1;\n'
STATES = (
    ' SG_ OperatingState : 8|8@1+ (1,0) [0|0] "" Other\nVAL_ 256 OperatingState 7 "MotorOff" ;\n'
)


def test_a_bit_that_cannot_hold_both_values_of_a_flag_is_refused() -> None:
    (line,) = refused(FLAG.replace("@1+", "@1-"))
    assert "both values of a flag" in line and "unsigned" in line


@pytest.mark.parametrize(
    ("beside", "reporter"),
    [
        ("", None),
        (' SG_ BatteryVoltage : 8|16@1+ (0.01,0) [0|0] "V" Other\n', None),
        (' SG_ BatteryVoltage : 8|16@1+ (0.01,0) [0|100] "V" Other\n', "BatteryVoltage"),
        (' SG_ LinkState : 8|8@1+ (1,0) [0|0] "" Other\n', "LinkState"),
        # of the information, which outlives the link
        (
            ' SG_ Device : 8|8@1+ (1,0) [0|5] "" Other\n',
            None,
        ),
        # not available on a JIVEPro at any time
        (
            ' SG_ BecCurrent : 8|16@1+ (0.01,0) [0|100] "A" Other\n',
            None,
        ),
        (
            ' SG_ Throttle : 32|32@1- (1,0) [0|0] "%" Other\nSIG_VALTYPE_ 256 Throttle : 1;\n',
            "Throttle",
        ),
        (' SG_ MessageAlive : 8|8@1+ (1,0) [0|0] "" Other\n', None),
        (PERCENT + 'VAL_ 256 Throttle 101 "NotAvailable" ;\n', "Throttle"),
        (PERCENT + 'VAL_ 256 Throttle -1 "NotAvailable" ;\n', "Throttle"),
        # codes amid the values
        (PERCENT + 'VAL_ 256 Throttle 100 "NotAvailable" ;\n', None),
        (PERCENT + 'VAL_ 256 Throttle 0 "NotAvailable" ;\n', None),
        (STATES, "OperatingState"),
        (
            STATES
            + 'BA_DEF_ SG_ "GenSigStartValue" INT 0 0;\nBA_ "GenSigStartValue" SG_ 256 OperatingState 7;\n',
            None,
        ),
    ],
)
def test_check_names_the_signal_that_reports_the_loss_and_warns_where_there_is_none(
    beside: str, reporter: str | None
) -> None:
    layout = compiled(FLAG + beside)
    (row,) = [line for line in check.table(layout, ["esc1"]) if "Undervoltage" in line]
    assert ("reports the loss" in row) == (reporter is not None)
    assert reporter is None or f"{reporter} reports the loss" in row
    warned = unreported(layout, silent=False)
    assert [
        line for line in warned if 'on_loss = "silent"' in line and "Undervoltage" in line
    ] == warned
    assert len(warned) == (reporter is None)
    assert not unreported(layout, silent=True)


def test_a_message_that_goes_on_although_on_loss_is_silent_is_warned_of_without_that_advice() -> (
    None
):
    layout = compiled(f'{FLAG} SG_ CrcErrors : 8|8@1+ (1,0) [0|0] "" Other\n')
    for silent in (False, True):
        (line,) = unreported(layout, silent)
        assert "on_loss" not in line and "link_state" in line


def test_of_two_escs_each_flag_needs_a_signal_of_its_own_esc() -> None:
    text = MESSAGE + "".join(
        f' SG_ {n}Undervoltage : {at}|1@1+ (1,0) [0|1] "" Other\n'
        for at, n in enumerate(("Left", "Right"))
    )
    layout = compiled(
        f'{text} SG_ LeftLinkState : 8|8@1+ (1,0) [0|0] "" Other\n', names=("left", "right")
    )
    (line,) = unreported(layout, silent=False)
    assert "RightUndervoltage" in line and "LeftUndervoltage" not in line


def test_a_capture_holds_how_a_dbc_is_used_and_one_of_0_5_0_has_less() -> None:
    keys = {
        "units": {"x": "V"},
        "send_type": {"y": "Event"},
        "messages": ["Motor_*"],
        "unbound": "start_value",
        "flags_on_loss": 1,
    }
    config = parse(
        {
            "dbc": {"bind": {"A.B": 1}, "e2e_data_ids": {"M": 7}, "base_id": 5} | keys,
            "esc": [{"port": "-"}],
        },
        "a.toml",
    )
    setup = CaptureSetup(
        tuple(config.escs), ("-",), ("my.dbc", b""), config.dbc_settings, False, False, None
    )
    header = json.loads(json.dumps(setup.header()))
    assert CaptureSetup.of(header).dbc_settings == config.dbc_settings
    for later in ("units", "send_types", "messages", "unbound", "flags_on_loss"):
        del header["dbc"][later]
    old = CaptureSetup.of(header).dbc_settings
    assert old == DbcSettings(bind={"A.B": 1}, data_ids={"M": 7}, base_id=5)
