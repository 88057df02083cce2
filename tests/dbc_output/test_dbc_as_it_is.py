"""A user's DBC as other tools write it: entries for nothing, units, send types, counters, checksums, flags, unbound signals."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import pytest

from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout, parse_database
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.dbc_output.units import conversion
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.sources import sources
from kontronik_can_gw.telemetry import EscSettings

HEAD = (
    'VERSION ""\nNS_ :\n\tNS_DESC_\n\tVAL_\n\tVAL_TABLE_\n\tBA_DEF_\n\tSIG_VALTYPE_\n\nBS_:\n\nBU_: Gateway Other\n\n'
)
MESSAGE = "BO_ 256 Power: 8 Gateway\n"
STATE = f'{MESSAGE} SG_ OperatingState : 0|8@1+ (1,0) [0|0] "" Other\n'


def compiled(text: str, names: Sequence[str] = ("esc1",), **settings: Any) -> Layout:
    database = parse_database((HEAD + text).encode(), "my.dbc")
    return prepare(database, "my.dbc", [EscSettings(name, 7) for name in names], DbcSettings(**settings), True)[1]


def refused(text: str, **settings: Any) -> list[str]:
    with pytest.raises(UserError) as caught:
        compiled(text, **settings)
    assert all(line.startswith(("my.dbc: ", "dbc.")) and "\n" not in line for line in caught.value.problems)
    return list(caught.value.problems)


# --- entries ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "table", ['VAL_TABLE_ States 21 "Forward" 12 "MotorOff" ;', 'VAL_TABLE_ States\n21 "Forward"\n12 "MotorOff";']
)
def test_a_value_table_may_be_named_although_ns_lists_its_keyword(table: str) -> None:
    (plan,) = compiled(f"VAL_TABLE_ Empty ;\n{table}\n{STATE}VAL_ 256 OperatingState States ;\n").messages
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
def test_an_entry_for_what_is_not_in_the_file_is_ignored_with_a_warning(entry: str, words: str) -> None:
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
def test_a_unit_is_known_however_it_is_spelled(source: str, value: str, meant: str, text: str) -> None:
    factor, offset = conversion(sources(EscSettings())[source].unit, text) or (Fraction(0), Fraction(0))
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
def test_a_unit_of_another_quantity_or_of_two_meanings_is_refused(source: str, texts: str, possible: str) -> None:
    for text in texts.split():
        (line,) = refused(f'{MESSAGE} SG_ X : 0|16@1+ (1,0) [0|0] "{text}" Other\n', bind={"X": source})
        assert f"'{text}'" in line and f"Possible: {possible};" in line and "dbc.units" in line


def test_dbc_units_says_what_a_text_means_whatever_it_means_elsewhere() -> None:
    text = f'{MESSAGE} SG_ BatteryVoltage : 0|16@1+ (0.01,0) [0|0] "Zaehler" Other\n SG_ BecVoltage : 16|16@1+ (1,0) [0|0] "A" Other\n'
    (plan,) = compiled(text, units={"Zaehler": "mV", "A": "mV"}).messages
    assert [(s.unit, s.slope) for s in plan.signals] == [("mV", 1000), ("mV", 1)]
    lines = refused(text, units={"Zaehler": "mV", "A": "mV", "Zahler": "V"})
    assert lines == ["dbc.units.Zahler: no signal of Gateway has this unit in my.dbc. Did you mean 'Zaehler'?"]


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_degrees_and_micro_are_read_in_either_encoding_of_a_file(encoding: str) -> None:
    text = f'{HEAD}{MESSAGE} SG_ BecTemperature : 0|8@1- (1,0) [0|0] "°C" Other\n SG_ PwmInput : 8|16@1+ (1,0) [0|0] "µs" Other\n'
    database = parse_database(text.encode(encoding), "my.dbc")
    (plan,) = prepare(database, "my.dbc", [EscSettings()], DbcSettings())[1].messages
    assert [(s.slope, s.unit) for s in plan.signals] == [(1, "°C"), (1, "µs")]
