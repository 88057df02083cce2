"""The judge of the fault programme finds what is wrong: it would be of no use if it called everything right."""

from collections.abc import Iterator
from itertools import pairwise

import benches
import pytest
from bus_watch import MS, SECOND, Judge
from encoding import Identity, live, live_values, mix
from feeder import CURRENT, SPEED, FedEsc
from signals import Message, Table

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.fields import LiveData, rows

START = 100 * SECOND
PERIOD = 20 * MS
SPEED_ID, CURRENT_ID, LINK_ID = 0x688, 0x690, 0x6B0


@pytest.fixture(scope="module")
def table() -> Table:
    return benches.table(2, True)


@pytest.fixture
def escs() -> list[FedEsc]:
    """Two ESCs that have sent fifty frames each, 20 ms apart."""
    made = [FedEsc(lambda _: True, Identity(1)), FedEsc(lambda _: True, Identity(2, Layout.LEGACY))]
    for esc in made:
        for n in range(50):
            esc.sent.append(START + n * PERIOD)
            esc.whole.append(1)
            esc.seen.append(0)
    return made


@pytest.fixture
def judge(table: Table, escs: list[FedEsc]) -> Judge:
    return Judge(table, escs)


def frame(message: Message, values: dict[str, float], flags: int = 0) -> bytes:
    """A frame as the gateway sends it, made from the DBC alone."""
    bits = (flags & message.flags[1]) << message.flags[0]
    for place in message.places:
        bits |= (round(values[place.name] / place.scale) & place.mask) << place.start
    return bits.to_bytes(8, "little")


def of_live(judge: Judge, can_id: int, n: int, esc: int = 0) -> bytes:
    data = judge.escs[esc].live(n)
    cells = judge.escs[esc].identity.cells
    return frame(judge.table[can_id], live_values(data, cells), data.operating_errors)


def settled(judge: Judge) -> list[str]:
    judge.settle(lambda _begin, _end: 0)
    return [wrong.why for wrong in judge.wrong]


def times() -> Iterator[int]:
    return iter(range(START, START + 50 * PERIOD, PERIOD))


def test_right_and_fresh_values_are_right_and_noted(judge: Judge) -> None:
    for n, at in enumerate(times()):
        judge.take(SPEED_ID, of_live(judge, SPEED_ID, n), at + MS)
        judge.take(CURRENT_ID, of_live(judge, CURRENT_ID, n), at + MS)
    assert settled(judge) == []
    assert all(seen == SPEED | CURRENT for seen in judge.escs[0].seen)
    assert judge.values == 100
    assert judge.first_fresh(0, START + 10 * PERIOD + 2 * MS) == (START + 11 * PERIOD + MS, 11)


def test_values_marked_as_not_available_are_never_wrong(judge: Judge) -> None:
    codes = {place.name: place.not_available or 0 for place in judge.table[SPEED_ID].places}
    bits = sum(
        (codes[place.name] & place.mask) << place.start for place in judge.table[SPEED_ID].places
    )
    judge.take(SPEED_ID, bits.to_bytes(8, "little"), START + 5 * SECOND)
    assert settled(judge) == []
    assert judge.marked == 1


def test_an_old_value_is_excused_by_a_standstill_of_the_whole_machine_only(judge: Judge) -> None:
    judge.take(SPEED_ID, of_live(judge, SPEED_ID, 10), START + 10 * PERIOD + 400 * MS)
    judge.settle(lambda begin, end: 200 * MS if begin < START + 20 * PERIOD < end else 0)
    assert (judge.wrong_count, judge.late_count) == (0, 1)


def test_a_value_that_was_never_sent_is_wrong_whatever_stood_still(judge: Judge) -> None:
    data = bytearray(of_live(judge, SPEED_ID, 10))
    data[0] ^= 1
    judge.take(SPEED_ID, bytes(data), START + 10 * PERIOD + MS)
    judge.settle(lambda _begin, _end: 100 * SECOND)
    assert (judge.wrong_count, judge.old_count) == (1, 0)
    assert "never sent" in judge.wrong[0].why


@pytest.mark.parametrize(
    ("given", "late", "why"),
    [
        ([10], 400 * MS, "old: frame 10, sent 0.400 s before"),
        ([11, 10], MS, "values of frame 10 after those of frame 11"),
        ([(10, 11)], MS, "never sent"),
        ([-10], MS, "of another ESC: frame 10 of esc2"),
    ],
)
def test_what_is_wrong_is_named(
    judge: Judge, given: list[int | tuple[int, int]], late: int, why: str
) -> None:
    """Frames of the first ESC; negative: of the second one; a pair: put together from two."""
    for each in given:
        if isinstance(each, tuple):
            one, other = (of_live(judge, SPEED_ID, n) for n in each)
            n, data = each[1], one[:3] + other[3:]
        else:
            n, esc = abs(each), int(each < 0)
            data = of_live(judge, SPEED_ID + esc, n, esc)
        judge.take(SPEED_ID, data, START + max(n, 11 if len(given) > 1 else 0) * PERIOD + late)
    (said,) = settled(judge)
    assert why in said
    assert (judge.wrong_count, judge.old_count) == (1, int(why.startswith("old")))


def test_an_age_that_is_told_too_young_is_wrong(judge: Judge) -> None:
    message = judge.table[LINK_ID]
    place = next(place for place in message.places if place.name == "data_age")
    late = START + 49 * PERIOD + SECOND
    judge.take(LINK_ID, (1000 << place.start).to_bytes(8, "little"), late)
    assert settled(judge) == []
    judge.take(LINK_ID, (100 << place.start).to_bytes(8, "little"), late)
    assert settled(judge) == ["an age of 100 ms; the newest is 1000 ms old"]


def test_boot_ups_and_emergencies_are_noted(judge: Judge) -> None:
    judge.take(0x702, b"\0", 5)
    judge.take(0x702, b"\x05", 6)
    judge.take(0x82, b"\x40\x81\x11\xff\0\0\0\0", 7)
    assert judge.boot_ups == [(5, 2)]
    assert [(each.node, each.code) for each in judge.emergencies] == [(2, 0x8140)]


def test_every_value_message_of_the_shipped_layouts_is_followed(table: Table) -> None:
    followed = {message.stem for message in table.values() if message.kind != "other"}
    assert followed >= {"Status", "Speed", "Current", "Shaft", "Bec", "Energy"}
    assert followed >= {"Info", "ExtremesA", "ExtremesB", "ExtremesC"}
    assert followed >= {"Tpdo1", "Tpdo2", "Tpdo3", "Tpdo4"}


def test_no_two_frames_of_an_esc_look_alike_in_any_message_within_the_time_out() -> None:
    one = Identity(1)
    for a, b in pairwise(range(400)):
        first, second = live(one, a), live(one, b)
        assert first.electrical_speed != second.electrical_speed
        assert (first.power_stage_temperature, first.timing) != (
            second.power_stage_temperature,
            second.timing,
        )
    assert len({mix(n, 8) for n in range(100_000)}) > 99_990


def test_all_values_are_inside_the_ranges_of_the_sheet() -> None:
    currents = dict.fromkeys(
        ("battery_current", "motor_current", "peak_current"), (-10_000, 10_000)
    )
    stated = {"battery_voltage": (0, 10_000), "throttle": (-100, 100), "output_opening": (0, 100)}
    for n in range(5000):
        for name, value in live(Identity(3, alarms=True), n)._asdict().items():
            row = rows(LiveData)[name]
            low, high = (stated | currents).get(name, row.type_range)
            assert low <= value <= high, name


def test_a_silence_begins_with_the_first_frame_that_is_not_shown(
    judge: Judge, escs: list[FedEsc]
) -> None:
    del escs[0].sent[20:]  # then the ESC itself is silent, until frame 20
    for n, at in list(enumerate(times()))[:20]:
        judge.take(SPEED_ID, of_live(judge, SPEED_ID, n), at + MS)
    shown = [(at, at + MS) for at in list(times())[:20]]
    assert judge.silences(0, START + 40 * PERIOD) == shown
    sent = START + 45 * PERIOD
    escs[0].sent.extend([sent, sent + PERIOD])
    assert judge.silences(0, sent + 2 * MS) == [*shown, (sent, sent + 2 * MS)]
    silence = sent, sent + PERIOD + 3 * MS
    judge.take(SPEED_ID, of_live(judge, SPEED_ID, 21), silence[1])
    assert judge.silences(0, silence[1] + SECOND) == [*shown, silence]
