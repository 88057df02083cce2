"""The computed bus load: bits of a frame, frames a second, and what is said of a bus that is full."""

import pytest
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.dbc.prepare import check_load
from kontronik_can_gw.signals.plan import Layout

CYCLIC, EVENT, ON_CHANGE, CYCLIC_AND_EVENT, CYCLIC_AND_ON_CHANGE = range(5)
NO_FD, FD = 0, 14


def layout_of(
    message: Msg, kind: int = CYCLIC, cycle: int = 10, delay: int = 0, frame_format: int = NO_FD
) -> Layout:
    more = f"""BA_DEF_ BO_ "VFrameFormat" INT 0 15;
BA_DEF_DEF_ "VFrameFormat" 0;
BA_ "VFrameFormat" BO_ {message.dbc_id} {frame_format + message.extended if frame_format else 0};
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
        # ISO 11898-1: SOF to the CRC with a stuff bit after each 4 bits but the first, then delimiters, ACK, EOF and 3 bits of pause
        (8, False, NO_FD, 111 + 24, 0),
        (8, True, NO_FD, 131 + 29, 0),
        (2, False, NO_FD, 63 + 12, 0),
        # CAN FD: arbitration and the end at the nominal rate; ESI, DLC, data, stuff count and CRC (17 or 21 bits) at the other
        (8, False, FD, 17 + 4 + 13, 69 + 17 + 28),
        (8, True, FD, 36 + 9 + 13, 69 + 17 + 28),
        (16, False, FD, 17 + 4 + 13, 133 + 33 + 28),
        (20, False, FD, 17 + 4 + 13, 165 + 41 + 33),
        (64, True, FD, 36 + 9 + 13, 517 + 129 + 33),
    ],
)
def test_a_frame_takes_its_bits_and_the_most_stuffing_that_is_possible(
    length: int, extended: bool, frame_format: int, nominal: int, at_data_rate: int
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
def test_a_message_is_counted_with_what_a_uart_at_100_hz_brings(
    names: tuple[str, ...], kind: int, cycle: int, delay: int, frames_a_second: float
) -> None:
    layout = layout_of(message_of(*names), kind, cycle, delay)
    assert layout.bus_load(1_000_000) == pytest.approx(frames_a_second * 135e-6, rel=1e-12)


def test_the_bits_of_canopen_nodes_count_too() -> None:
    layout = layout_of(message_of("LeftBatteryVoltage"))
    assert check_load(layout, 36_000, further={"the CANopen nodes": 4_500}) is None
    warning = str(check_load(layout, 36_000, further={"the CANopen nodes": 8_100}))
    assert warning.startswith(
        "my_car.dbc: the messages and the CANopen nodes need 60% of 36 kbit/s"
    )
    assert "CANopen" not in str(check_load(layout, 18_000))
    alone = str(check_load(Layout("", "", ()), 1_000_000, further={"the CANopen nodes": 600_000}))
    assert alone.startswith("the CANopen nodes need 60% of 1000 kbit/s")
