"""Frames that no further event brings, frames that are not classic ones of 11 bits, frames after a change of settings."""

from collections.abc import Sequence

import cantools.database
import pytest
from cantools.database.can import Database
from dialogue import QUIET, Bench

from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.protocol import Layout as WireLayout
from kontronik_can_gw.protocol import LiveData, encode
from kontronik_can_gw.telemetry import MS, SECOND, EscSettings

HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: Gateway\n'
SEND_TYPES = '"cyclic","event","onChange","cyclicAndEvent","cyclicAndOnChange"'
CYCLIC, EVENT, ON_CHANGE, CYCLIC_AND_EVENT, CYCLIC_AND_ON_CHANGE = range(5)
PAGED = (
    "BO_ 256 EscPaged: 8 Gateway\n"
    ' SG_ Page M : 0|{length}@1{sign} (1,0) [0|0] "" Logger\n'
    ' SG_ BatteryVoltage m1 : 8|16@1+ (0.01,0) [0|0] "V" Logger\n'
    ' SG_ Throttle m{second} : 8|8@1- (1,0) [0|0] "%" Logger\n'
    ' SG_ BecTemperature m7 : 8|8@1- (1,0) [0|0] "degC" Logger\n'
)
NOTHING = {1: 0xFFFF, 5: 0x80, 7: 0x80}


def layout(messages: str, kind: int, cycle: int = 0, delay: int = 0, fd: bool = False, more: str = "") -> Layout:
    attributes = (
        f'BA_DEF_ BO_ "GenMsgSendType" ENUM {SEND_TYPES};\nBA_DEF_ BO_ "GenMsgCycleTime" INT 0 60000;\n'
        'BA_DEF_ BO_ "GenMsgDelayTime" INT 0 60000;\nBA_DEF_ BO_ "VFrameFormat" INT 0 15;\n'
        'BA_DEF_DEF_ "GenMsgSendType" "cyclic";\nBA_DEF_DEF_ "GenMsgCycleTime" 0;\n'
        'BA_DEF_DEF_ "GenMsgDelayTime" 0;\nBA_DEF_DEF_ "VFrameFormat" 0;\n'
    )
    number = messages.split()[1]
    values = (("GenMsgSendType", kind), ("GenMsgCycleTime", cycle), ("GenMsgDelayTime", delay))
    given = "".join(f'BA_ "{name}" BO_ {number} {value};\n' for name, value in values)
    text = f"{HEAD}{messages}{attributes}{given}{more}".replace("Logger", "Vector__XXX")
    database = cantools.database.load_string(text, "dbc")
    assert isinstance(database, Database)
    return prepare(database, "my.dbc", [EscSettings("esc1")], DbcSettings(), fd)[1]


def sent_until(gateway: Gateway, when: int) -> list[CanFrame]:
    """As a perfect runtime does: awake at each deadline."""
    found = gateway.take_frames()
    while (deadline := gateway.next_deadline()) <= when:
        gateway.advance(deadline)
        found += gateway.take_frames()
    return found


def live(gateway: Gateway, now: int, *values: int) -> list[CanFrame]:
    data = LiveData(battery_voltage=values[0], throttle=values[1], bec_temperature=values[2])
    gateway.receive_bytes(0, encode(data, WireLayout.V4), now, now)
    return gateway.take_frames()


@pytest.mark.parametrize("kind", [EVENT, ON_CHANGE])
@pytest.mark.parametrize("delay", [0, 30])
def test_after_a_loss_each_page_says_by_itself_that_its_value_is_gone(kind: int, delay: int) -> None:
    gateway = Gateway([EscSettings("esc1")], layout(PAGED.format(length=8, sign="+", second=5), kind, delay=delay), 0)
    gateway.start(0)
    now = SECOND
    sent_until(gateway, now)
    for number in range(12):
        live(gateway, now := now + 10 * MS, 2400 + number, number, number)
    sent_until(gateway, now + 249 * MS)
    frames = sent_until(gateway, now + SECOND)
    assert {frame.data[0] for frame in frames} == set(NOTHING)
    last = {frame.data[0]: frame for frame in frames}
    for page, value in NOTHING.items():
        assert int.from_bytes(last[page].data[1:3], "little") == value


def test_at_the_start_each_page_is_sent_without_an_event() -> None:
    gateway = Gateway([EscSettings("esc1")], layout(PAGED.format(length=8, sign="+", second=5), EVENT), 0)
    gateway.start(0)
    assert [frame.data[0] for frame in sent_until(gateway, 900 * MS)] == [1, 5, 7]


@pytest.mark.parametrize(
    ("length", "sign", "second", "fits"),
    [
        (3, "+", 6, True),
        (4, "-", 6, True),
        (4, "+", 15, True),
        (4, "-", 8, False),
        (4, "-", 15, False),
        (3, "-", 6, False),
    ],
)
def test_a_multiplexer_that_cannot_hold_a_page_is_refused(length: int, sign: str, second: int, fits: bool) -> None:
    text = PAGED.format(length=length, sign=sign, second=second)
    if fits:
        assert layout(text, CYCLIC, 100).messages[0].pages == tuple(sorted({1, second, 7}))
        return
    with pytest.raises(UserError) as caught:
        layout(text, CYCLIC, 100)
    assert any("Page" in line and f"{second}" in line for line in caught.value.problems)


WIDE = 'BO_ {number} EscWide: {size} Gateway\n SG_ BatteryVoltage : {at}|16@1+ (0.01,0) [0|0] "V" Logger\n'


@pytest.mark.parametrize(
    ("number", "size", "at", "fd", "more"),
    [
        (256, 8, 48, False, ""),
        (0x80000123, 8, 0, False, ""),
        (256, 3, 8, False, ""),
        (256, 64, 496, True, 'BA_ "VFrameFormat" BO_ 256 14;\n'),
        (256, 8, 0, True, 'BA_ "VFrameFormat" BO_ 256 14;\n'),
        (0x80000123, 12, 80, True, 'BA_ "VFrameFormat" BO_ 2147483939 15;\n'),
    ],
)
@pytest.mark.parametrize(("kind", "cycle"), [(EVENT, 0), (CYCLIC_AND_EVENT, 10_000)])
def test_a_live_frame_is_followed_by_a_frame_of_the_right_kind(
    kind: int, cycle: int, number: int, size: int, at: int, fd: bool, more: str
) -> None:
    text = WIDE.format(number=number, size=size, at=at)
    gateway = Gateway([EscSettings("esc1")], layout(text, kind, cycle, fd=fd, more=more), 0)
    gateway.start(0)
    now = SECOND
    sent_until(gateway, now)
    live(gateway, now, 0, 0, 0)
    for volts in (1, 2400, 0xFFF0):
        frames: Sequence[CanFrame] = live(gateway, now := now + 10 * MS, volts, 0, 0)
        [frame] = frames
        assert (frame.can_id, frame.extended, frame.fd) == (number & 0x1FFFFFFF, number >= 1 << 31, fd)
        assert len(frame.data) == size
        assert int.from_bytes(frame.data, "little") == volts << at


def test_a_cycle_that_the_minimum_distance_puts_off_is_not_lost() -> None:
    text = WIDE.format(number=256, size=8, at=0)
    gateway = Gateway([EscSettings("esc1")], layout(text, CYCLIC_AND_ON_CHANGE, 100, 30), 0)
    gateway.start(0)
    live(gateway, 990 * MS, 2400, 0, 0)
    sent_until(gateway, 1080 * MS)
    assert len(live(gateway, 1090 * MS, 2401, 0, 0)) == 1
    found = {ms: len(sent_until(gateway, ms * MS)) for ms in (1100, 1119, 1120, 1199, 1200)}
    assert found == {1100: 0, 1119: 0, 1120: 1, 1199: 0, 1200: 1}


SPEED = (
    "BO_ 256 EscSpeed: 8 Gateway\n"
    ' SG_ MotorSpeed : 0|16@1+ (1,0) [0|0] "1/min" Logger\n'
    ' SG_ BatteryVoltage : 16|16@1+ (0.01,0) [0|0] "V" Logger\n'
    ' SG_ OutputSpeed : 32|32@1+ (0.5,0) [0|0] "1/min" Logger\n'
)


@pytest.mark.parametrize(("kind", "cycle"), [(EVENT, 0), (CYCLIC, 10), (CYCLIC_AND_EVENT, 10)])
def test_pole_pairs_and_gear_from_a_master_hold_for_messages_from_the_next_frame_on(kind: int, cycle: int) -> None:
    bench = Bench(changes=QUIET, layout=layout(SPEED, kind, cycle))
    bench.wait(1000)
    for writes, motor, output in (
        ((), 21_000, 42_000),
        (("2F 00 21 01 07 00 00 00",), 3_000, 6_000),
        (("23 00 21 02 05 00 00 00", "23 00 21 03 02 00 00 00"), 3_000, 2_400),
    ):
        for request in writes:
            bench.put(0x601, request)
        assert [frame.data[0] for frame in bench.take() if frame.can_id == 0x581] == [0x60] * len(writes)
        bench.uart(encode(LiveData(electrical_speed=21_000, battery_voltage=2442), WireLayout.V4))
        bench.wait(10)
        data = [frame.data for frame in bench.take() if frame.can_id == 0x100][-1]
        values = (data[0:2], data[2:4], data[4:8])
        assert tuple(int.from_bytes(value, "little") for value in values) == (motor, 2442, output)
