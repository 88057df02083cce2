"""Mistakes of people in a DBC or its binding: one clear line each, all at once, never a traceback."""

import random
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout, load_database
from kontronik_can_gw.dbc_output.prepare import check_load, prepare
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.telemetry import EscSettings

SHIPPED = Path(__file__).parents[2] / "dbc" / "kontronik_esc.dbc"
VOLTAGE = Sig("BatteryVoltage", 0, 16, factor="0.01", unit="V")
CURRENT = Sig("BatteryCurrent", 16, 16, signed=True, factor="0.1", unit="A")


def load(
    folder: Path,
    text: str,
    settings: DbcSettings | None = None,
    names: Sequence[str] = ("esc1",),
    fd: bool = False,
    taken: Mapping[int, str] | None = None,
) -> Layout:
    file = folder / "my_car.dbc"
    file.write_text(text)
    escs = [EscSettings(name) for name in names]
    return prepare(load_database(file), "my_car.dbc", escs, settings or DbcSettings(), fd, taken)[1]


def mistakes(
    folder: Path,
    text: str,
    settings: DbcSettings | None = None,
    names: Sequence[str] = ("esc1",),
    fd: bool = False,
    taken: Mapping[int, str] | None = None,
) -> list[str]:
    with pytest.raises(UserError) as caught:
        load(folder, text, settings, names, fd, taken)
    assert caught.value.exit_code == 2
    lines = list(caught.value.problems)
    assert lines
    assert all(line and "\n" not in line and len(line) < 500 for line in lines)
    return lines


def one(*signals: Sig, length: int = 8) -> str:
    return dbc_text([Msg("Power", 0x100, length, list(signals))])


def only(lines: list[str], *words: str) -> None:
    """There is one line and it says all this."""
    assert len(lines) == 1, lines
    for word in words:
        assert word in lines[0]


# --- one signal ---------------------------------------------------------------------------------------------------------


def test_an_unbound_signal_is_named_with_the_nearest_source_and_the_remedy(tmp_path: Path) -> None:
    lines = mistakes(tmp_path, one(Sig("BattVoltage", 0, 16, unit="V")))
    only(lines, "my_car.dbc: Power.BattVoltage: no such source", "battery_voltage", "[dbc.bind]")


def test_an_unbound_signal_with_an_esc_prefix_is_suggested_for_its_stem(tmp_path: Path) -> None:
    text = one(Sig("LeftBatteryVoltag", 0, 16, unit="V"), Sig("RightBatteryVoltage", 16, 16, unit="V"))
    only(mistakes(tmp_path, text, names=("left", "right")), "LeftBatteryVoltag: no such source", "battery_voltage")


def test_a_name_like_nothing_gets_no_suggestion(tmp_path: Path) -> None:
    (line,) = mistakes(tmp_path, one(Sig("Qqq", 0, 16)))
    assert "Did you mean" not in line


def test_a_binding_to_nothing_says_what_was_bound(tmp_path: Path) -> None:
    lines = mistakes(tmp_path, one(Sig("U", 0, 16)), DbcSettings({"U": "batery_voltage"}))
    only(lines, "my_car.dbc: Power.U", "'batery_voltage'", "battery_voltage")


@pytest.mark.parametrize("unit", ["A", "degC", "%", "furlong"])
def test_an_impossible_unit_is_refused_with_the_possible_ones(tmp_path: Path, unit: str) -> None:
    signal = Sig("BatteryVoltage", 0, 16, unit=unit)
    only(mistakes(tmp_path, one(signal)), "my_car.dbc: Power.BatteryVoltage", f"'{unit}'", "mV", "kV")


def test_a_unit_on_a_number_without_one_is_refused(tmp_path: Path) -> None:
    only(mistakes(tmp_path, one(Sig("CellCount", 0, 8, unit="V"))), "Power.CellCount", "'V'", "no unit")


def test_an_overlap_names_both_signals(tmp_path: Path) -> None:
    clash = Sig("BatteryCurrent", 15, 16, signed=True, unit="A")
    only(mistakes(tmp_path, one(VOLTAGE, clash)), "my_car.dbc: Power.", "BatteryVoltage", "BatteryCurrent", "overlap")


def test_an_overlap_within_a_page_is_found_and_one_of_two_pages_is_none(tmp_path: Path) -> None:
    page = Sig("Page", 0, 8, mux="M")
    voltage = Sig("BatteryVoltage", 8, 16, mux="m0", unit="V")
    current = Sig("BatteryCurrent", 16, 16, signed=True, mux="m1", unit="A")
    assert load(tmp_path, one(page, voltage, current)).messages[0].pages == (0, 1)
    current.mux = "m0"
    only(mistakes(tmp_path, one(page, voltage, current)), "Power.", "overlaps")
    current.mux = ""
    only(mistakes(tmp_path, one(page, voltage, current)), "Power.", "overlaps")


@pytest.mark.parametrize(("start", "little"), [(56, True), (63, True), (56, False), (64, True), (300, False)])
def test_a_signal_outside_its_message_is_named(tmp_path: Path, start: int, little: bool) -> None:
    text = one(Sig("BatteryVoltage", start, 16, little, unit="V"))
    only(mistakes(tmp_path, text), "my_car.dbc: Power.BatteryVoltage", "outside", "8 bytes")


def test_a_16_bit_float_is_refused(tmp_path: Path) -> None:
    text = one(Sig("BatteryVoltage", 0, 16, signed=True, is_float=True, unit="V"))
    text = text.replace("BatteryVoltage : 2;", "BatteryVoltage : 1;")
    only(mistakes(tmp_path, text), "my_car.dbc: Power.BatteryVoltage", "16 bits", "32 and 64")


def test_factor_zero_is_refused(tmp_path: Path) -> None:
    only(
        mistakes(tmp_path, one(Sig("BatteryVoltage", 0, 16, factor="0", unit="V"))), "Power.BatteryVoltage", "factor 0"
    )


@pytest.mark.parametrize(
    "signal",
    [
        Sig("BatteryVoltage", 0, 16, factor="1e400", unit="V"),
        Sig("BatteryVoltage", 0, 16, offset="-1e400", unit="V"),
        Sig("BatteryVoltage", 0, 16, maximum="1e999", unit="V"),
    ],
)
def test_numbers_beyond_all_bounds_are_refused(tmp_path: Path, signal: Sig) -> None:
    only(mistakes(tmp_path, one(signal)), "my_car.dbc: Power.BatteryVoltage", "finite")


@pytest.mark.parametrize(
    "signal",
    [
        Sig("CrcErrors", 0, 16, factor="2"),
        Sig("CrcErrors", 0, 16, factor="0.1"),
        Sig("CrcErrors", 0, 16, offset="1"),
        Sig("CrcErrors", 0, 16, signed=True),
        Sig("CrcErrors", 0, 16, minimum="5", maximum="100"),
        Sig("CrcErrors", 0, 16, minimum="-5", maximum="-1"),
    ],
)
def test_a_counter_that_cannot_roll_over_rightly_is_refused(tmp_path: Path, signal: Sig) -> None:
    only(mistakes(tmp_path, one(signal)), "my_car.dbc: Power.CrcErrors", "counter", "factor 1")


@pytest.mark.parametrize(
    ("signal", "code"),
    [
        (Sig("Timing", 0, 4, unit="us", texts={255: "NotAvailable"}), "255"),
        (Sig("Timing", 0, 8, unit="us", texts={-1: "NotAvailable"}), "-1"),
        (Sig("Timing", 0, 8, True, True, unit="us", texts={128: "Error"}), "128"),
        (Sig("OperatingState", 0, 8, texts={300: "MotorOff"}), "300"),
    ],
)
def test_a_value_table_that_does_not_fit_its_signal_is_refused(tmp_path: Path, signal: Sig, code: str) -> None:
    only(mistakes(tmp_path, one(signal)), f"my_car.dbc: Power.{signal.name}", code)


# --- constants, alive counter, CRC --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("signal", "constant"),
    [
        (Sig("Version", 0, 8), 256),
        (Sig("Version", 0, 8), -1),
        (Sig("Version", 0, 8), 1.5),
        (Sig("Version", 0, 8, signed=True), 128),
        (Sig("Version", 0, 8, signed=True), -129),
        (Sig("Version", 0, 8, factor="0.5"), 0.25),
        (Sig("Version", 0, 8, factor="2"), 3),
        (Sig("Version", 0, 8), float("nan")),
        (Sig("Version", 0, 8), float("inf")),
        (Sig("Version", 0, 32, signed=True, is_float=True), 1e39),
        (Sig("Version", 0, 32, signed=True, is_float=True), float("inf")),
    ],
)
def test_a_constant_that_cannot_be_sent_exactly_is_refused(tmp_path: Path, signal: Sig, constant: float) -> None:
    lines = mistakes(tmp_path, one(signal), DbcSettings({"Version": constant}))
    only(lines, "my_car.dbc: Power.Version", f"constant {constant}")


@pytest.mark.parametrize(
    "signal",
    [
        Sig("AliveCounter", 0, 1),
        Sig("AliveCounter", 0, 32, signed=True, is_float=True),
        Sig("AliveCounter", 0, 4, minimum="3", maximum="9"),
        Sig("AliveCounter", 0, 4, minimum="-5", maximum="-1"),
    ],
)
def test_an_alive_counter_that_cannot_count_from_0_is_refused(tmp_path: Path, signal: Sig) -> None:
    only(mistakes(tmp_path, one(signal)), "my_car.dbc: Power.AliveCounter", "alive counter")


@pytest.mark.parametrize("signal", [Sig("Crc8", 4, 8), Sig("Crc8", 0, 16), Sig("Crc8", 0, 4), Sig("Crc8", 3, 8, False)])
def test_a_crc_that_is_no_byte_is_refused(tmp_path: Path, signal: Sig) -> None:
    lines = mistakes(tmp_path, one(signal, Sig("AliveCounter", 24, 4)))
    only(lines, "my_car.dbc: Power.Crc8", "8 bits", "byte border")


def test_a_crc_without_alive_counter_and_several_of_either_are_refused(tmp_path: Path) -> None:
    crc, alive = Sig("Crc8", 0, 8), Sig("AliveCounter", 8, 4)
    only(mistakes(tmp_path, one(crc)), "Power", "Crc8", "exactly one alive counter")
    lines = mistakes(tmp_path, one(crc, alive, Sig("SecondAlive", 12, 4)))
    only(lines, "Power", "exactly one alive counter")
    only(mistakes(tmp_path, one(crc, alive, Sig("Checksum", 16, 8))), "Power", "several CRC", "Crc8", "Checksum")


def test_an_alive_counter_or_a_crc_on_one_page_only_is_refused(tmp_path: Path) -> None:
    page, crc, alive = Sig("Page", 0, 8, mux="M"), Sig("Crc8", 8, 8), Sig("AliveCounter", 16, 4)
    value = Sig("Timing", 24, 8, unit="us", mux="m1")
    assert load(tmp_path, one(page, crc, alive, value)).messages
    crc.mux = "m1"
    only(mistakes(tmp_path, one(page, crc, alive, value)), "Power.Crc8", "CRC", "every frame")
    crc.mux, alive.mux = "", "m1"
    only(mistakes(tmp_path, one(page, crc, alive, value)), "Power.AliveCounter", "alive counter", "every frame")


# --- messages and ids ---------------------------------------------------------------------------------------------------


def test_two_messages_with_one_id_are_named(tmp_path: Path) -> None:
    text = dbc_text([Msg("Power", 0x123, 8, [VOLTAGE]), Msg("Flow", 0x123, 8, [CURRENT])])
    only(mistakes(tmp_path, text), "my_car.dbc", "Flow", "123h", "Power")


def test_an_id_of_ours_that_another_node_uses_too_is_named(tmp_path: Path) -> None:
    theirs = Msg("Brake", 0x123, 8, [Sig("Foo", 0, 8)], sender="Other")
    text = dbc_text([theirs, Msg("Power", 0x123, 8, [VOLTAGE])])
    only(mistakes(tmp_path, text, DbcSettings(node="Gateway")), "Power", "123h", "Brake")


def test_one_id_twice_among_messages_of_others_is_none_of_our_business(tmp_path: Path) -> None:
    theirs = [Msg(name, 0x123, 8, [Sig("Foo", 0, 8)], sender="Other") for name in ("Brake", "Wheel")]
    text = dbc_text([*theirs, Msg("Power", 0x124, 8, [VOLTAGE])])
    assert len(load(tmp_path, text, DbcSettings(node="Gateway")).messages) == 1


def test_the_same_number_with_11_and_29_bits_is_no_clash(tmp_path: Path) -> None:
    text = dbc_text([Msg("Power", 0x123, 8, [VOLTAGE]), Msg("Flow", 0x123, 8, [CURRENT], extended=True)])
    assert [m.extended for m in load(tmp_path, text).messages] == [False, True]


def test_a_message_that_stands_twice_in_the_file_is_found(tmp_path: Path) -> None:
    text = dbc_text([Msg("Power", 0x123, 8, [VOLTAGE]), Msg("Power", 0x123, 8, [CURRENT])])
    lines = mistakes(tmp_path, text)
    assert any("123h" in line for line in lines)
    text = dbc_text([Msg("Power", 0x123, 8, [VOLTAGE]), Msg("Power", 0x124, 8, [CURRENT])])
    only(mistakes(tmp_path, text), "my_car.dbc", "Power", "two messages have this name")


def test_a_signal_that_stands_twice_in_a_message_is_found(tmp_path: Path) -> None:
    again = Sig("BatteryVoltage", 16, 16, factor="0.01", unit="V")
    only(mistakes(tmp_path, one(VOLTAGE, again)), "my_car.dbc", "Power.BatteryVoltage", "two signals")


def test_an_id_that_is_taken_by_canopen_is_named_with_its_user(tmp_path: Path) -> None:
    text = dbc_text([Msg("Power", 0x181, 8, [VOLTAGE]), Msg("Flow", 0x181, 8, [CURRENT], extended=True)])
    lines = mistakes(tmp_path, text, taken={0x181: "TPDO1 of node 1"})
    only(lines, "my_car.dbc: Power", "181h", "TPDO1 of node 1", "680h")


def test_can_fd_is_refused_unless_allowed(tmp_path: Path) -> None:
    text = one(VOLTAGE, length=12)
    only(mistakes(tmp_path, text), "my_car.dbc: Power", "CAN FD", "12 bytes", "can.fd")
    assert load(tmp_path, text, fd=True).messages[0].fd


@pytest.mark.parametrize("length", [9, 11, 13, 63, 65, 100, 1000])
def test_a_length_that_no_frame_has_is_refused(tmp_path: Path, length: int) -> None:
    only(mistakes(tmp_path, one(VOLTAGE, length=length), fd=True), "my_car.dbc: Power", f"{length} bytes")


def test_a_message_of_ours_without_signals_is_refused(tmp_path: Path) -> None:
    only(mistakes(tmp_path, one()), "my_car.dbc: Power", "no signal")


def test_two_levels_of_multiplexing_are_refused(tmp_path: Path) -> None:
    signals = [
        Sig("Page", 0, 8, mux="M"),
        Sig("Under", 8, 8, mux="m0M"),
        Sig("BatteryVoltage", 16, 16, mux="m1", unit="V"),
    ]
    text = one(*signals) + "SG_MUL_VAL_ 256 Under Page 0-0;\nSG_MUL_VAL_ 256 BatteryVoltage Under 1-1;\n"
    only(mistakes(tmp_path, text), "my_car.dbc: Power", "more than one level")


def test_a_multiplexer_too_narrow_for_its_pages_is_refused(tmp_path: Path) -> None:
    voltage = Sig("BatteryVoltage", 16, 16, mux="m16", unit="V")
    only(mistakes(tmp_path, one(Sig("Page", 0, 4, mux="M"), voltage)), "my_car.dbc: Power.Page", "16")
    assert load(tmp_path, one(Sig("Page", 0, 5, mux="M"), voltage)).messages[0].pages == (16,)


# --- timing -------------------------------------------------------------------------------------------------------------


def timed(more: str) -> str:
    return dbc_text([Msg("Power", 0x100, 8, [VOLTAGE])], more)


def test_an_unknown_send_type_is_named_with_the_known_ones(tmp_path: Path) -> None:
    lines = mistakes(tmp_path, timed('BA_ "GenMsgSendType" BO_ 256 6;'))
    only(lines, "my_car.dbc: Power", "GenMsgSendType 'Wrong'", "CyclicAndOnChange")


@pytest.mark.parametrize("number", [0, 3, 4])
def test_cyclic_without_a_time_is_refused(tmp_path: Path, number: int) -> None:
    only(mistakes(tmp_path, timed(f'BA_ "GenMsgSendType" BO_ 256 {number};')), "Power", "GenMsgCycleTime is 0")


@pytest.mark.parametrize("attribute", ["GenMsgCycleTime", "GenMsgDelayTime"])
@pytest.mark.parametrize("value", ['"soon"', '"inf"', '"nan"', '"-1"'])
def test_a_time_that_is_none_is_refused(tmp_path: Path, attribute: str, value: str) -> None:
    text = timed(f'BA_ "{attribute}" BO_ 256 {value};')
    text = text.replace(f'"{attribute}" INT 0 65535', f'"{attribute}" STRING ')
    text = text.replace(f'BA_DEF_DEF_ "{attribute}" 0', f'BA_DEF_DEF_ "{attribute}" ""')
    (line,) = mistakes(tmp_path, text)
    assert "my_car.dbc" in line


def test_a_start_value_that_is_no_number_does_no_harm(tmp_path: Path) -> None:
    text = timed('BA_ "GenSigStartValue" SG_ 256 BatteryVoltage 1;')
    text = re.sub(r'BA_DEF_ SG_ "GenSigStartValue".*', 'BA_DEF_ SG_ "GenSigStartValue" ENUM "a","b";', text)
    text = text.replace('BA_DEF_DEF_ "GenSigStartValue" 0', 'BA_DEF_DEF_ "GenSigStartValue" "a"')
    assert load(tmp_path, text).messages[0].signals[0].not_available == 65535


# --- bindings and nodes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("esc1",), ("left", "right")])
def test_keys_that_bind_nothing_are_named_with_the_nearest_signal(tmp_path: Path, names: tuple[str, ...]) -> None:
    bind: dict[str, str | float] = {
        "Power.BatteryVoltge": "battery_voltage", "Nope.Signal": 1, "BatteryVolt": "battery_voltage",
    }  # fmt: skip
    lines = mistakes(tmp_path, one(VOLTAGE), DbcSettings(bind), names)
    assert len(lines) == 3, lines
    for key in bind:
        assert any(f"dbc.bind.{key}" in line and "my_car.dbc" in line for line in lines)
    assert any("Did you mean" in line and "BatteryVoltage" in line for line in lines)


def test_a_binding_of_a_signal_of_another_node_is_unused(tmp_path: Path) -> None:
    text = dbc_text([Msg("Power", 1, 8, [VOLTAGE]), Msg("Brake", 2, 8, [Sig("Foo", 0, 8)], sender="Other")])
    for names in (("esc1",), ("left", "right")):
        only(mistakes(tmp_path, text, DbcSettings({"Foo": 1}, "Gateway"), names), "dbc.bind.Foo", "no such signal")


def test_a_name_bound_here_may_be_a_signal_of_another_node_too(tmp_path: Path) -> None:
    messages = [Msg("Power", 1, 8, [Sig("U", 0, 16, unit="V")]), Msg("Brake", 9, 8, [Sig("U", 0, 8)], sender="Other")]
    settings = DbcSettings({"U": "battery_voltage"}, "Gateway")
    for names in (("esc1",), ("left", "right")):
        assert len(load(tmp_path, dbc_text(messages), settings, names).messages) == len(names)


def test_a_data_id_for_no_message_is_named(tmp_path: Path) -> None:
    lines = mistakes(tmp_path, one(VOLTAGE), DbcSettings(data_ids={"Powr": 7}))
    only(lines, "dbc.e2e_data_ids.Powr", "no such message", "my_car.dbc")


def test_a_signal_that_does_not_say_of_which_esc_is_refused(tmp_path: Path) -> None:
    text = one(Sig("LeftBatteryVoltage", 0, 16, unit="V"), Sig("U", 16, 16, unit="V"))
    lines = mistakes(tmp_path, text, DbcSettings({"U": "right.battery_voltag"}), ("left", "right"))
    only(lines, "Power.U", "right.battery_voltag", "battery_voltage")


def test_one_signal_without_an_esc_among_those_of_named_escs_is_said_to_be_the_mistake(tmp_path: Path) -> None:
    left, right = Sig("LeftBatteryVoltage", 0, 16, unit="V"), Sig("RightBatteryVoltage", 16, 16, unit="V")
    text = one(left, right, Sig("BatteryCurrent", 32, 16, signed=True, unit="A"))
    lines = mistakes(tmp_path, text, names=("left", "right"))
    only(lines, "Power.BatteryCurrent", "of which ESC", "left.battery_current", "right.battery_current")


def test_a_node_that_is_not_there_is_refused_with_those_that_are(tmp_path: Path) -> None:
    text = dbc_text([Msg("Power", 1, 8, [VOLTAGE]), Msg("Brake", 2, 8, [Sig("Foo", 0, 8)], sender="Other")])
    only(mistakes(tmp_path, text, DbcSettings(node="Motor")), "my_car.dbc", "'Motor'", "Gateway, Other", "dbc.node")
    only(mistakes(tmp_path, text, DbcSettings(node="Logger")), "my_car.dbc", "'Logger'", "Gateway, Other")


def test_several_nodes_must_be_chosen_from(tmp_path: Path) -> None:
    text = dbc_text([Msg("Power", 1, 8, [VOLTAGE]), Msg("Brake", 2, 8, [Sig("Foo", 0, 8)], sender="Other")])
    only(mistakes(tmp_path, text), "my_car.dbc", "several nodes", "Gateway, Other", "dbc.node")
    assert load(tmp_path, text.replace("Gateway", "KontronikGateway")).node == "KontronikGateway"


def test_a_dbc_in_which_nobody_sends_has_no_message_of_ours(tmp_path: Path) -> None:
    text = one(VOLTAGE).replace("8 Gateway", "8 Vector__XXX")
    only(mistakes(tmp_path, text), "my_car.dbc", "no message has a transmitter")


def test_a_bus_that_is_too_full_is_refused(tmp_path: Path) -> None:
    more = 'BA_ "GenMsgSendType" BO_ 256 0;\nBA_ "GenMsgCycleTime" BO_ 256 1;'
    layout = load(tmp_path, timed(more))
    assert check_load(layout, 1_000_000) is None
    warning = check_load(layout, 200_000)
    assert warning is not None and "my_car.dbc" in warning and "%" in warning
    with pytest.raises(UserError, match=r"my_car.dbc.*GenMsgCycleTime"):
        check_load(layout, 125_000)


# --- all at once --------------------------------------------------------------------------------------------------------


def test_all_mistakes_come_at_once_each_naming_its_place(tmp_path: Path) -> None:
    messages = [
        Msg("Power", 0x10, 8, [Sig("BattVolt", 0, 16, unit="V"), Sig("BatteryCurrent", 8, 16, unit="V")]),
        Msg("Heat", 0x10, 8, [Sig("BecTemperature", 60, 8, unit="degC"), Sig("CrcErrors", 0, 8, factor="2")]),
        Msg("Wide", 0x11, 16, [VOLTAGE]),
    ]
    lines = mistakes(
        tmp_path,
        dbc_text(messages, 'BA_ "GenMsgSendType" BO_ 17 6;'),
        DbcSettings({"Nope": 1}, data_ids={"None": 1}),
        taken={0x11: "SYNC"},
    )
    for words in (
        ("Power.BattVolt", "no such source"),
        ("Power.BatteryCurrent", "cannot be converted"),
        ("Power.", "overlaps"),
        ("Heat.BecTemperature", "outside"),
        ("Heat.CrcErrors", "counter"),
        ("Heat", "10h"),
        ("Wide", "CAN FD"),
        ("Wide", "GenMsgSendType"),
        ("Wide", "11h", "SYNC"),
        ("dbc.bind.Nope",),
        ("dbc.e2e_data_ids.None",),
    ):
        assert any(all(word in line for word in words) for line in lines), (words, lines)
    assert len(lines) == 11
    assert all("my_car.dbc" in line for line in lines)


# --- files that are no DBC ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "my_car.dbc"),
        (b"\n\n", "my_car.dbc"),
        (b"hello\n", "my_car.dbc"),
        (b"[can]\nchannel = 'can0'\n", "my_car.dbc"),
        (b"<?xml version='1.0'?><NetworkDefinition/>", "my_car.dbc"),
        (b'{"messages": []}', "my_car.dbc"),
        (b"\x7fELF\x02\x01\x01\x00\x00\x00", "binary"),
        (b"\xff\xfe\xfa\xfb\x80\x81", "my_car.dbc"),
        ('VERSION ""'.encode("utf-16"), "binary"),
        (b'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A\n', "no message"),
        (b"KODL" * 20, "my_car.dbc"),
    ],
)
def test_a_file_that_is_no_dbc_is_said_to_be_none(tmp_path: Path, content: bytes, words: str) -> None:
    file = tmp_path / "my_car.dbc"
    file.write_bytes(content)
    with pytest.raises(UserError) as caught:
        load_database(file)
    only(list(caught.value.problems), str(file), words)
    assert "\n" not in caught.value.problems[0]


def test_a_missing_file_and_a_directory_cannot_be_read(tmp_path: Path) -> None:
    for path, reason in ((tmp_path / "none.dbc", "No such file"), (tmp_path, "directory")):
        with pytest.raises(UserError) as caught:
            load_database(path)
        only(list(caught.value.problems), str(path), "cannot be read", reason)


def test_a_dbc_in_an_old_windows_encoding_is_read(tmp_path: Path) -> None:
    file = tmp_path / "old.dbc"
    file.write_bytes(one(Sig("BecTemperature", 0, 8, signed=True, unit="°C")).encode("cp1252"))
    assert load_database(file).messages[0].signals[0].unit == "°C"


# --- 200 broken versions of the shipped file ----------------------------------------------------------------------------

WORDS = (
    "-1", "0", "1e400", "64", "65535", "M", "m0", "|", "@0-", '"', ";", "BO_", "SG_", "VAL_", "nan", "", "\\",
    "9" * 30,
)  # fmt: skip


def broken(rng: random.Random, text: str) -> str:
    """The text with some lines, words, characters or numbers changed, lost or doubled."""
    lines = text.split("\n")
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        at = rng.choice([n for n, line in enumerate(lines) if line])
        match rng.randrange(7):
            case 0:
                del lines[at]
            case 1:
                lines.insert(rng.randrange(len(lines)), lines[at])
            case 2:
                words = re.split(r"([ :|@,()\[\]])", lines[at])
                words[rng.randrange(len(words))] = rng.choice(WORDS)
                lines[at] = "".join(words)
            case 3:
                numbers = list(re.finditer(r"-?\d+(\.\d+)?", lines[at]))
                if numbers:
                    number = rng.choice(numbers)
                    new = rng.choice(("0", "1", "-1", "7", "63", "64", "255", "2147483649", "0.5", "1e400", "1e-400"))
                    lines[at] = lines[at][: number.start()] + new + lines[at][number.end() :]
            case 4:
                place = rng.randrange(len(lines[at]))
                lines[at] = lines[at][:place] + chr(rng.randrange(1, 256)) + lines[at][place + 1 :]
            case 5:
                other = rng.randrange(len(lines))
                lines[at], lines[other] = lines[other], lines[at]
            case _:
                lines = lines[: rng.randrange(len(lines))] if rng.random() < 0.2 else lines
        if not any(lines):
            break
    return "\n".join(lines)


@pytest.mark.parametrize("batch", range(10))
def test_a_broken_version_of_the_shipped_file_works_or_is_refused_in_words(tmp_path: Path, batch: int) -> None:
    text = SHIPPED.read_text()
    refusals: list[tuple[str, ...]] = []
    for seed in range(batch * 20, batch * 20 + 20):
        rng = random.Random(seed)
        mutated = broken(rng, text)
        names = rng.choice((("esc1",), ("left", "right")))
        try:
            load(tmp_path, mutated, DbcSettings(node="KontronikGateway"), names)
        except UserError as error:
            refusals.append(error.problems)
    assert all(problems for problems in refusals)
    assert all("\n" not in line and "my_car.dbc" in line for problems in refusals for line in problems), refusals
    assert 2 < len(refusals) < 20
