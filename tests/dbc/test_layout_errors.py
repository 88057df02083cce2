"""Mistakes of people in a DBC or its binding: one clear line each, all at once, never a traceback."""

import random
import re
from pathlib import Path
from typing import Any

import pytest
from dbc_bench import compiled, refused
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.dbc.reader import load_database
from kontronik_can_gw.errors import UserError

VOLTAGE = Sig("BatteryVoltage", 0, 16, factor="0.01", unit="V")
CURRENT = Sig("BatteryCurrent", 16, 16, signed=True, factor="0.1", unit="A")


def one(*signals: Sig, length: int = 8) -> str:
    return dbc_text([Msg("Power", 0x100, length, list(signals))])


def only(lines: list[str], *words: str) -> None:
    """There is one line and it says all this."""
    assert len(lines) == 1, lines
    for word in words:
        assert word in lines[0]


# --- one message: its signals and what the one line says ------------------------------------------------------------------

PAGE, ALIVE, CRC = Sig("Page", 0, 8, mux="M"), Sig("AliveCounter", 24, 4), Sig("Crc8", 0, 8)


def volts(start: Any = 0, length: Any = 16, little: Any = True, **more: Any) -> Sig:
    return Sig("BatteryVoltage", start, length, little, **{"unit": "V"} | more)


def errors(**more: Any) -> Sig:
    return Sig("CrcErrors", 0, 16, **more)


def version(length: int = 8, **more: Any) -> Sig:
    return Sig("Version", 0, length, **more)


REFUSED: list[tuple[list[Sig], list[str]]] = [
    ([Sig("BattVoltage", 0, 16, unit="V")], ["my_car.dbc: Power.BattVoltage: no such source.", "battery_voltage", "[dbc.bind]"]),
    *(([volts(unit=u)], ["Power.BatteryVoltage", f"'{u}'", "mV", "kV"]) for u in ("A", "degC", "%", "furlong")),
    ([Sig("CellCount", 0, 8, unit="V")], ["Power.CellCount", "'V'", "no unit"]),
    ([VOLTAGE, Sig("BatteryCurrent", 15, 16, signed=True, unit="A")], ["Power.", "BatteryVoltage", "BatteryCurrent", "overlap"]),
    *(([volts(*place)], ["Power.BatteryVoltage", "outside", "8 bytes"]) for place in (
        (56,), (63,), (56, 16, False), (64,), (300, 16, False))),
    *(([volts(), Sig("BatteryCurrent", 0, n, signed=True, unit="A")], ["Power.BatteryCurrent", "outside"]) for n in (65, 80)),
    ([volts(factor="0")], ["Power.BatteryVoltage", "factor 0"]),
    *(([volts(**{k: v})], ["Power.BatteryVoltage", "finite"]) for k, v in (
        ("factor", "1e400"), ("offset", "-1e400"), ("maximum", "1e999"))),
    *(([volts(length=64, **more)], ["Power.BatteryVoltage", "too large"]) for more in (
        {"factor": "1e300"}, {"factor": "1e-300", "maximum": "1e300", "signed": True, "is_float": True})),
    ([volts(length=64, signed=True, is_float=True, texts={10**350: "SNA"})], ["Power.BatteryVoltage", "64-bit float"]),
    *(([errors(**more)], ["Power.CrcErrors", "counter", "factor 1"]) for more in (
        {"factor": "2"}, {"factor": "0.1"}, {"offset": "1"}, {"signed": True}, {"minimum": "5", "maximum": "100"},
        {"minimum": "-5", "maximum": "-1"})),
    ([Sig("Timing", 0, 4, unit="us", texts={255: "NotAvailable"})], ["Power.Timing", "255"]),
    ([Sig("Timing", 0, 8, unit="us", texts={-1: "NotAvailable"})], ["Power.Timing", "-1"]),
    ([Sig("Timing", 0, 8, True, True, unit="us", texts={128: "Error"})], ["Power.Timing", "128"]),
    ([Sig("OperatingState", 0, 8, texts={300: "MotorOff"})], ["Power.OperatingState", "300"]),
    ([volts(0, 32, signed=True, is_float=True, texts={1 << 200: "Error"})], ["Power.BatteryVoltage", "32-bit float"]),
    *(([Sig("AliveCounter", 0, n, **more)], ["Power.AliveCounter", "alive counter"]) for n, more in (
        (1, {}), (32, {"signed": True, "is_float": True}), (4, {"minimum": "3", "maximum": "9"}),
        (4, {"minimum": "-5", "maximum": "-1"}))),
    *(([Sig("Crc8", *place), ALIVE], ["Power.Crc8", "8 bits", "byte border"]) for place in (
        (4, 8), (0, 16), (0, 4), (3, 8, False))),
    ([CRC], ["Power", "Crc8", "exactly one alive counter"]),
    ([CRC, ALIVE, Sig("SecondAlive", 12, 4)], ["Power", "exactly one alive counter"]),
    ([CRC, ALIVE, Sig("Checksum", 16, 8)], ["Power", "several CRC", "Crc8", "Checksum"]),
    ([PAGE, Sig("Crc8", 8, 8, mux="m1"), ALIVE], ["Power.Crc8", "CRC", "every frame"]),
    ([PAGE, Sig("Crc8", 8, 8), Sig("AliveCounter", 16, 4, mux="m1")], ["Power.AliveCounter", "alive counter", "every frame"]),
    ([PAGE, volts(8, mux="m0"), Sig("BatteryCurrent", 16, 16, signed=True, mux="m0", unit="A")], ["Power.", "overlaps"]),
    ([PAGE, volts(8, mux="m0"), Sig("BatteryCurrent", 16, 16, signed=True, unit="A")], ["Power.", "overlaps"]),
    ([Sig("Page", 0, 4, mux="M"), volts(16, mux="m16")], ["Power.Page", "16"]),
    ([Sig("Page", 0, 4, signed=True, mux="M"), volts(16, mux="m8")], ["Power.Page", "8"]),
    ([], ["Power", "no signal"]),
    ([VOLTAGE, volts(16)], ["Power.BatteryVoltage", "two signals"]),
]  # fmt: skip


@pytest.mark.parametrize(("signals", "words"), REFUSED)
def test_a_mistake_of_a_signal_is_one_line_with_its_place(
    signals: list[Sig], words: list[str]
) -> None:
    only(refused(one(*signals)), "my_car.dbc: ", *words)


def test_what_lies_near_a_mistake_is_none() -> None:
    current = Sig("BatteryCurrent", 16, 16, signed=True, mux="m1", unit="A")
    assert compiled(one(PAGE, volts(8, mux="m0"), current)).messages[0].pages == (0, 1)
    crc, alive = Sig("Crc8", 8, 8), Sig("AliveCounter", 16, 4)
    assert compiled(one(PAGE, crc, alive, Sig("Timing", 24, 8, unit="us", mux="m1"))).messages
    wide = compiled(one(Sig("Page", 0, 5, mux="M"), volts(16, mux="m16")))
    assert wide.messages[0].pages == (16,)


@pytest.mark.parametrize(
    ("signal", "constant"),
    [
        (version(), 256), (version(), -1), (version(), 1.5), (version(signed=True), 128), (version(signed=True), -129),
        (version(factor="0.5"), 0.25), (version(factor="2"), 3), (version(), float("nan")), (version(), float("inf")),
        (version(32, signed=True, is_float=True), 1e39), (version(32, signed=True, is_float=True), float("inf")),
    ],
)  # fmt: skip
def test_a_constant_that_cannot_be_sent_exactly_is_refused(signal: Sig, constant: float) -> None:
    lines = refused(one(signal), bind={"Version": constant})
    only(lines, "my_car.dbc: Power.Version", f"constant {constant}")


def test_suggestions_go_without_prefix_and_without_likeness_there_is_none() -> None:
    text = one(Sig("LeftBatteryVoltag", 0, 16, unit="V"), Sig("RightBatteryVoltage", 16, 16))
    lines = refused(text, ("left", "right"))
    only(lines, "LeftBatteryVoltag: no such source", "battery_voltage")
    (line,) = refused(one(Sig("TestOvervoltag", 0, 1)))
    assert "Did you mean test_overvoltage or " in line and line.partition("?")[0].count(" or ") == 2
    (line,) = refused(one(Sig("Qqq", 0, 16)))
    assert "Did you mean" not in line
    lines = refused(one(Sig("U", 0, 16)), bind={"U": "batery_voltage"})
    only(lines, "my_car.dbc: Power.U", "'batery_voltage'", "Did you mean battery_voltage")


def test_a_16_bit_float_and_two_levels_of_multiplexing_are_refused() -> None:
    text = one(volts(signed=True, is_float=True)).replace("Voltage : 2;", "Voltage : 1;")
    only(refused(text), "my_car.dbc: Power.BatteryVoltage", "16 bits", "32 and 64")
    text = one(PAGE, Sig("Under", 8, 8, mux="m0M"), volts(16, mux="m1"))
    text += "SG_MUL_VAL_ 256 Under Page 0-0;\nSG_MUL_VAL_ 256 BatteryVoltage Under 1-1;\n"
    only(refused(text), "my_car.dbc: Power", "more than one level")


# --- messages, ids, lengths, nodes ----------------------------------------------------------------------------------------


def file_of(*messages: tuple[Any, ...]) -> str:
    """Messages of (name, id, signal, sender, 29 bits)."""
    filled = [(*m, *("Gateway", False)[len(m) - 3 :]) for m in messages]
    return dbc_text(Msg(name, n, 8, [signal], ext, by) for name, n, signal, by, ext in filled)


FOO = Sig("Foo", 0, 8)
THEIRS = ("Brake", 0x123, FOO, "Other")
POWER, FLOW = ("Power", 0x123, VOLTAGE), ("Flow", 0x123, CURRENT)


def test_ids_and_names_are_each_of_one_message() -> None:
    only(refused(file_of(POWER, FLOW)), "my_car.dbc", "Flow", "123h", "Power")
    only(refused(file_of(THEIRS, POWER), node="Gateway"), "Power", "123h", "Brake")
    twice = refused(file_of(POWER, ("Power", 0x124, CURRENT)))
    only(twice, "my_car.dbc", "Power", "two messages have this name")
    assert any("123h" in line for line in refused(file_of(POWER, ("Power", 0x123, CURRENT))))
    # among messages of others it is none of our business, and 11 and 29 bits do not meet
    text = file_of(THEIRS, ("Wheel", 0x123, FOO, "Other"), ("Power", 0x124, VOLTAGE))
    assert len(compiled(text, node="Gateway").messages) == 1
    both = compiled(file_of(POWER, (*FLOW, "Gateway", True))).messages
    assert [message.extended for message in both] == [False, True]


def test_an_id_that_is_taken_by_canopen_is_named_with_its_user() -> None:
    text = file_of(("Power", 0x181, VOLTAGE), ("Flow", 0x181, CURRENT, "Gateway", True))
    lines = refused(text, taken={0x181: "TPDO1 of node 1"})
    only(lines, "my_car.dbc: Power", "181h", "TPDO1 of node 1", "680h")


def test_can_fd_is_refused_unless_allowed_and_some_lengths_are_none() -> None:
    text = one(VOLTAGE, length=12)
    only(refused(text, fd=False), "my_car.dbc: Power", "CAN FD", "12 bytes", "can.fd")
    assert compiled(text).messages[0].fd
    for length in (9, 11, 13, 63, 65, 100, 1000):
        only(refused(one(VOLTAGE, length=length)), "my_car.dbc: Power", f"{length} bytes")


def test_the_node_is_the_only_one_that_sends_ours_or_the_one_that_is_named() -> None:
    text = file_of(("Power", 1, VOLTAGE), ("Brake", 2, FOO, "Other"))
    for node in ("Motor", "Logger"):
        only(refused(text, node=node), "my_car.dbc", f"'{node}'", "Gateway, Other", "dbc.node")
    only(refused(text), "my_car.dbc", "several nodes", "Gateway, Other", "dbc.node")
    assert compiled(text.replace("Gateway", "KontronikGateway")).node == "KontronikGateway"
    silent = one(VOLTAGE).replace("8 Gateway", "8 Vector__XXX")
    only(refused(silent), "my_car.dbc", "no message has a transmitter")


# --- timing -------------------------------------------------------------------------------------------------------------


def timed(more: str) -> str:
    return dbc_text([Msg("Power", 0x100, 8, [VOLTAGE])], more)


def test_send_types_are_known_and_a_cycle_has_a_time() -> None:
    lines = refused(timed('BA_ "GenMsgSendType" BO_ 256 6;'))
    only(lines, "my_car.dbc: Power", "GenMsgSendType 'Wrong'", "CyclicAndOnChange")
    for number in (0, 3, 4):
        text = timed(f'BA_ "GenMsgSendType" BO_ 256 {number};')
        only(refused(text), "Power", "GenMsgCycleTime is 0")


@pytest.mark.parametrize("attribute", ["GenMsgCycleTime", "GenMsgDelayTime"])
def test_an_invalid_time_is_refused(attribute: str) -> None:
    for value in ("soon", "inf", "nan", "-1"):
        text = timed(f'BA_ "{attribute}" BO_ 256 "{value}";')
        text = text.replace(f'"{attribute}" INT 0 65535', f'"{attribute}" STRING ')
        text = text.replace(f'BA_DEF_DEF_ "{attribute}" 0', f'BA_DEF_DEF_ "{attribute}" ""')
        assert len(refused(text)) == 1


def test_a_start_value_that_is_no_number_does_no_harm() -> None:
    text = timed('BA_ "GenSigStartValue" SG_ 256 BatteryVoltage 1;')
    text = re.sub(r'(?m)^(BA_DEF_ SG_ "GenSigStartValue").*', r'\1 ENUM "a","b";', text)
    text = text.replace('BA_DEF_DEF_ "GenSigStartValue" 0', 'BA_DEF_DEF_ "GenSigStartValue" "a"')
    assert compiled(text).messages[0].signals[0].not_available == 65535


# --- bindings -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("esc1",), ("left", "right")])
def test_keys_that_bind_nothing_are_named_with_the_nearest_signal(names: tuple[str, ...]) -> None:
    keys = ("Power.BatteryVoltge", "Nope.Signal", "BatteryVolt")
    lines = refused(one(VOLTAGE), names, bind=dict.fromkeys(keys, 1))
    assert {line.partition(": ")[0] for line in lines} == {f"dbc.bind.{key}" for key in keys}
    assert any("Did you mean" in line and "BatteryVoltage" in line for line in lines)
    # a signal of another node is no signal of ours; one of ours may have the name of theirs
    text = file_of(("Power", 1, VOLTAGE), ("Brake", 9, FOO, "Other"))
    only(refused(text, names, bind={"Foo": 1}, node="Gateway"), "dbc.bind.Foo", "no such signal")
    text = file_of(("Power", 1, Sig("U", 0, 16, unit="V")), ("Brake", 9, Sig("U", 0, 8), "Other"))
    layout = compiled(text, names, bind={"U": "battery_voltage"}, node="Gateway")
    assert len(layout.messages) == len(names)


def test_a_signal_that_does_not_say_of_which_esc_is_refused() -> None:
    pair = ("left", "right")
    left, right = (
        Sig(f"{name}BatteryVoltage", at, 16, unit="V") for name, at in (("Left", 0), ("Right", 16))
    )
    lines = refused(one(left, Sig("U", 16, 16, unit="V")), pair, bind={"U": "right.battery_voltag"})
    only(lines, "Power.U", "right.battery_voltag", "battery_voltage")
    lines = refused(one(left, right, Sig("BatteryCurrent", 32, 16, signed=True, unit="A")), pair)
    only(
        lines,
        "Power.BatteryCurrent",
        "of which ESC",
        "left.battery_current or right.battery_current",
    )


# --- all at once --------------------------------------------------------------------------------------------------------


def test_all_mistakes_come_at_once_each_naming_its_place() -> None:
    power = [Sig("BattVolt", 0, 16, unit="V"), Sig("BatteryCurrent", 8, 16, unit="V")]
    heat = [Sig("BecTemperature", 60, 8, unit="degC"), Sig("CrcErrors", 0, 8, factor="2")]
    messages = [
        Msg("Power", 0x10, 8, power),
        Msg("Heat", 0x10, 8, heat),
        Msg("Wide", 0x11, 16, [VOLTAGE]),
    ]
    lines = refused(
        dbc_text(messages, 'BA_ "GenMsgSendType" BO_ 17 6;'),
        fd=False,
        taken={0x11: "SYNC"},
        bind={"Nope": 1},
        data_ids={"None": 1},
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


# --- files that are no DBC ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "my_car.dbc"),
        (b"[can]\nchannel = 'can0'\n", "my_car.dbc"),
        (b"\xff\xfe\xfa\xfb\x80\x81", "my_car.dbc"),
        ('VERSION ""'.encode("utf-16"), "binary"),
        (b'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A\n', "no message"),
    ],
)
def test_a_file_that_is_no_dbc_is_said_to_be_none(
    tmp_path: Path, content: bytes, words: str
) -> None:
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


# --- broken versions of the shipped file -------------------------------------------------------------------------------

WORDS = (
    "-1", "0", "1e400", "2147483649", "M", "m0", "|", "@0-", '"', ";", "BO_", "VAL_", "nan", "", "\\", "\x80", "9" * 30)  # fmt: skip


def broken(rng: random.Random, text: str) -> str:
    """The text with some lines or words changed, lost or doubled."""
    lines = text.split("\n")
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        at = rng.choice([n for n, line in enumerate(lines) if line])
        kind = rng.randrange(5)
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines.insert(rng.randrange(len(lines)), lines[at])
        elif kind == 2:
            other = rng.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
        else:
            words = re.split(r"([ :|@,()\[\]])", lines[at])
            words[rng.randrange(len(words))] = rng.choice(WORDS)
            lines[at] = "".join(words)
    return "\n".join(lines)


def test_a_broken_version_of_the_shipped_file_works_or_is_refused_in_words() -> None:
    text = shipped("dbc/kontronik_esc.dbc").read_text()
    refusals = 0
    for seed in range(40):
        rng = random.Random(seed)
        mutated = broken(rng, text)
        names = rng.choice((("esc1",), ("left", "right")))
        try:
            compiled(mutated, names, node="KontronikGateway")
        except UserError:
            refusals += 1
            refused(mutated, names, node="KontronikGateway")
    assert 8 < refusals < 36
