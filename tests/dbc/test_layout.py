"""Notes and bus load of a compiled layout, and files that are right although they look wrong.

Mistakes and their lines are in tests/golden/commands/refused_dbc.txt, random mistakes in
tests/native/fuzz_dbc.py.
"""

import re
from typing import Any

import pytest
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.dbc.prepare import check_load
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.signals.plan import MessageLayout

pytestmark = pytest.mark.promise("packing")

PAGE = Sig("Page", 0, 8, mux="M")
VOLTAGE = Sig("BatteryVoltage", 0, 16, factor="0.01", unit="V")


def one(*signals: Sig) -> str:
    return dbc_text([Msg("Power", 0x100, 8, list(signals))])


def test_pages_may_share_bits_and_have_a_crc_beside_them() -> None:
    voltage = Sig("BatteryVoltage", 8, 16, unit="V", mux="m0")
    current = Sig("BatteryCurrent", 16, 16, signed=True, mux="m1", unit="A")
    layout = compiled(one(PAGE, voltage, current))
    assert layout.messages[0].pages == (0, 1)
    crc = Sig("Crc8", 8, 8)
    alive = Sig("AliveCounter", 16, 4)
    timing = Sig("Timing", 24, 8, unit="us", mux="m1")
    assert compiled(one(PAGE, crc, alive, timing)).messages
    short_page = Sig("Page", 0, 5, mux="M")
    wide = Sig("BatteryVoltage", 16, 16, unit="V", mux="m16")
    layout = compiled(one(short_page, wide))
    assert layout.messages[0].pages == (16,)


def test_ids_of_11_and_29_bits_may_be_equal_and_other_senders_do_not_matter() -> None:
    foo = [Sig("Foo", 0, 8)]
    messages = [
        Msg("Brake", 0x123, 8, foo, sender="Other"),
        Msg("Wheel", 0x123, 8, foo, sender="Other"),
        Msg("Power", 0x124, 8, [VOLTAGE]),
        Msg("Flow", 0x124, 8, [VOLTAGE], extended=True),
    ]
    both = compiled(dbc_text(messages), node="Gateway").messages
    assert [message.extended for message in both] == [False, True]


def test_start_value_that_is_not_a_number_is_ignored() -> None:
    more = 'BA_ "GenSigStartValue" SG_ 256 BatteryVoltage 1;'
    text = dbc_text([Msg("Power", 0x100, 8, [VOLTAGE])], more)
    text = re.sub(r'(?m)^(BA_DEF_ SG_ "GenSigStartValue").*', r'\1 ENUM "a","b";', text)
    text = text.replace('BA_DEF_DEF_ "GenSigStartValue" 0', 'BA_DEF_DEF_ "GenSigStartValue" "a"')
    assert compiled(text).messages[0].signals[0].not_available == 65535


# --- values that a signal cannot hold

CODES = {255: "NotAvailable", 254: "Error"}
NO_NAMES = "the value table has none of its names, so the ESC's number is sent"


def volts(length: int, factor: str, **more: Any) -> Sig:
    return Sig("BatteryVoltage", 0, length, factor=factor, **({"unit": "V"} | more))


@pytest.mark.parametrize(
    ("signal", "expected"),
    [
        (volts(16, "0.01"), ["not available is sent as 655.35"]),
        (volts(17, "0.01"), ["not available is sent as 1310.71"]),
        (volts(16, "0.01", texts={65535: "NotAvailable", 65534: "Error"}), []),
        (volts(32, "1", signed=True, is_float=True), []),
        (Sig("CrcErrors", 0, 8, texts=CODES), ["restarts at 0 after 253"]),
        (Sig("CrcErrors", 0, 8, maximum="99"), ["restarts at 0 after 99"]),
        (Sig("OperatingState", 0, 8), [NO_NAMES, "not available is sent as 255"]),
        (Sig("OperatingState", 0, 8, texts={1: "Asleep"} | CODES), [NO_NAMES]),
        (Sig("LinkState", 0, 8,
             texts={9: "Ok", 8: "LOST", 7: "Searching", 6: "never_seen"} | CODES),
         ["sent as Error, because missing in the value table: Degraded, PortError"]),
        (Sig("Undervoltage", 0, 1), ["not available is sent as 0"]),
        # a source without names leaves a value table alone
        (Sig("CellCount", 0, 8, texts={0: "unknown", 6: "six"} | CODES), []),
    ],
    ids=lambda value: value.line if isinstance(value, Sig) else "",
)  # fmt: skip
def test_values_that_a_signal_cannot_hold_are_noted(signal: Sig, expected: list[str]) -> None:
    layout = compiled(one(signal))
    assert list(layout.messages[0].signals[0].notes) == expected


# --- bus load ---

CYCLIC, EVENT, ON_CHANGE, CYCLIC_AND_EVENT, CYCLIC_AND_ON_CHANGE = range(5)
NO_FD = 0
FD = 14


def layout_of(
    message: Msg,
    kind: int = CYCLIC,
    cycle: int = 10,
    delay: int = 0,
    frame_format: int = NO_FD,
) -> MessageLayout:
    if frame_format:
        frame_format += message.extended
    more = f"""BA_DEF_ BO_ "VFrameFormat" INT 0 15;
BA_DEF_DEF_ "VFrameFormat" 0;
BA_ "VFrameFormat" BO_ {message.dbc_id} {frame_format};
BA_ "GenMsgSendType" BO_ {message.dbc_id} {kind};
BA_ "GenMsgCycleTime" BO_ {message.dbc_id} {cycle};
BA_ "GenMsgDelayTime" BO_ {message.dbc_id} {delay};"""
    return compiled(dbc_text([message], more), ("left", "right"))


def message_of(*names: str, length: int = 8, extended: bool = False) -> Msg:
    signals = [Sig(name, 16 * place, 16) for place, name in enumerate(names)]
    return Msg("EscPower", 0x100, length, signals, extended)


@pytest.mark.parametrize(
    ("length", "extended", "frame_format", "nominal", "at_data_rate"),
    [
        # ISO 11898-1: the bits from SOF to the CRC, with a stuff bit after each 4 bits except the
        # first. Then the delimiters, ACK, EOF and the intermission of 3 bits.
        (8, False, NO_FD, 111 + 24, 0),
        (8, True, NO_FD, 131 + 29, 0),
        (2, False, NO_FD, 63 + 12, 0),
        # CAN FD: arbitration and the end are sent at the nominal rate. ESI, DLC, data, stuff count
        # and CRC (17 or 21 bits) are sent at the data rate.
        (8, False, FD, 17 + 4 + 13, 69 + 17 + 28),
        (8, True, FD, 36 + 9 + 13, 69 + 17 + 28),
        (16, False, FD, 17 + 4 + 13, 133 + 33 + 28),
        (20, False, FD, 17 + 4 + 13, 165 + 41 + 33),
        (64, True, FD, 36 + 9 + 13, 517 + 129 + 33),
    ],
)
def test_frame_is_counted_with_its_bits_and_the_most_stuff_bits(
    length: int,
    extended: bool,
    frame_format: int,
    nominal: int,
    at_data_rate: int,
) -> None:
    message = message_of("LeftBatteryVoltage", length=length, extended=extended)
    layout = layout_of(message, frame_format=frame_format)
    load = 100 * (nominal / 500_000 + at_data_rate / 4_000_000)
    assert layout.bus_load(500_000, 4_000_000) == pytest.approx(load, rel=1e-12)


@pytest.mark.parametrize(
    ("names", "kind", "cycle", "delay", "frames_a_second"),
    [
        (("LeftBatteryVoltage",), CYCLIC, 10, 0, 100),
        (("LeftBatteryVoltage",), CYCLIC, 10, 40, 25),
        (("LeftBatteryVoltage",), EVENT, 0, 0, 100),
        (("LeftBatteryVoltage", "RightBatteryVoltage"), EVENT, 0, 0, 200),
        (("LeftBatteryVoltage", "RightBatteryVoltage"), EVENT, 0, 8, 125),
        (("LeftBatteryVoltage", "LeftCellCount"), EVENT, 0, 0, 100),
        (("LeftCellCount",), EVENT, 0, 0, 1),
        (("LeftCellCount", "RightCellCount"), EVENT, 0, 0, 2),
        (("LeftCellCount", "RightCellCount"), EVENT, 0, 800, 1.25),
        (("EscsOk",), EVENT, 0, 0, 1),
        (("LeftBatteryVoltage",), CYCLIC_AND_EVENT, 20, 0, 150),
        (("LeftBatteryVoltage",), CYCLIC_AND_ON_CHANGE, 20, 0, 50),
        (("LeftBatteryVoltage",), ON_CHANGE, 0, 0, 0),
    ],
)  # fmt: skip
def test_message_is_counted_as_if_each_esc_sent_at_100_hz(
    names: tuple[str, ...],
    kind: int,
    cycle: int,
    delay: int,
    frames_a_second: float,
) -> None:
    layout = layout_of(message_of(*names), kind, cycle, delay)
    assert layout.bus_load(1_000_000) == pytest.approx(frames_a_second * 135e-6, rel=1e-12)


@pytest.mark.parametrize(
    ("names", "kind", "cycle", "delay", "frames_a_second"),
    [
        (("LeftBatteryVoltage",), ON_CHANGE, 0, 0, 100),
        (("LeftBatteryVoltage", "RightBatteryVoltage"), ON_CHANGE, 0, 0, 200),
        (("LeftBatteryVoltage",), ON_CHANGE, 0, 40, 25),
        (("LeftCellCount",), ON_CHANGE, 0, 0, 1),
        (("LeftBatteryVoltage",), CYCLIC_AND_ON_CHANGE, 20, 0, 150),
        (("LeftBatteryVoltage",), CYCLIC_AND_EVENT, 20, 0, 150),
        (("LeftBatteryVoltage",), CYCLIC, 10, 0, 100),
    ],
)  # fmt: skip
def test_worst_load_counts_each_change(
    names: tuple[str, ...],
    kind: int,
    cycle: int,
    delay: int,
    frames_a_second: float,
) -> None:
    layout = layout_of(message_of(*names), kind, cycle, delay)
    worst = layout.bus_load(1_000_000, is_worst=True)
    assert worst == pytest.approx(frames_a_second * 135e-6, rel=1e-12)


@pytest.mark.promise("overload")
def test_worst_load_causes_a_warning_and_the_usual_load_a_refusal() -> None:
    message = message_of("LeftBatteryVoltage")
    layout = layout_of(message, CYCLIC_AND_ON_CHANGE, 20)
    assert check_load(layout, 50 * 3 * 135 * 2) is None
    warning = str(check_load(layout, 50 * 2 * 135))
    words = "need 50% of 13 kbit/s, and up to 150% while all values sent on change keep changing"
    assert words in warning
    with pytest.raises(UserError, match="need 101%"):
        check_load(layout, 50 * 135 * 100 // 101)
    empty = MessageLayout("", "", ())
    further = {"the CANopen nodes": 1_000.0}
    worst = {"the CANopen nodes": 6_000.0}
    assert check_load(empty, 10_000, further=further) is None
    loaded = check_load(empty, 10_000, 0, further, worst)
    assert "need 10% of 10 kbit/s, and up to 60% while" in str(loaded)


def test_bits_of_canopen_nodes_are_counted_too() -> None:
    layout = layout_of(message_of("LeftBatteryVoltage"))
    assert check_load(layout, 36_000, further={"the CANopen nodes": 4_500}) is None
    warning = str(check_load(layout, 36_000, further={"the CANopen nodes": 8_100}))
    words = "my_car.dbc: the messages and the CANopen nodes need 60% of 36 kbit/s"
    assert warning.startswith(words)
    assert "CANopen" not in str(check_load(layout, 18_000))
    empty = MessageLayout("", "", ())
    alone = str(check_load(empty, 1_000_000, further={"the CANopen nodes": 600_000}))
    assert alone.startswith("the CANopen nodes need 60% of 1000 kbit/s")
