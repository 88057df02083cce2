"""The judge of the fault programme detects wrong values, and accepts right ones."""

from itertools import pairwise

import beds
import pytest
from bus_watch import MS, SECOND, Judge
from feeder import CURRENT, SPEED, FedEsc, Identity, live, mix

from kontronik_can_gw.esc.kontronik.codec import WireLayout

pytestmark = pytest.mark.promise("sharp-tests")

START = 100 * SECOND
PERIOD = 20 * MS
SPEED_ID = 0x688
CURRENT_ID = 0x690
LINK_ID = 0x6B0


@pytest.fixture
def judge() -> Judge:
    """Return a judge with two ESCs that have sent fifty frames each, 20 ms apart."""
    escs = [FedEsc(Identity(1)), FedEsc(Identity(2, WireLayout.LEGACY))]
    for esc in escs:
        for n in range(50):
            esc.note(START + n * PERIOD)
            esc.whole[n] = 1
    return Judge(beds.table(("--esc", "2"), True, 2), escs)


def frame(
    judge: Judge,
    can_id: int,
    n: int,
    esc: int = 0,
) -> bytes:
    """Return a frame as the gateway sends it, computed from the DBC alone."""
    values = judge.escs[esc].values(n)
    message = judge.table[can_id]
    bits = (int(values["flags"]) & message.flags[1]) << message.flags[0]
    for place in message.places:
        bits |= (round(values[place.name] / place.scale) & place.mask) << place.start
    return bits.to_bytes(8, "little")


def wrong(judge: Judge) -> str:
    return "; ".join(each.what for each in judge.wrong)


def test_right_and_fresh_values_are_accepted_and_recorded(judge: Judge) -> None:
    for n in range(50):
        for can_id in (SPEED_ID, CURRENT_ID):
            judge.take(can_id, frame(judge, can_id, n), START + n * PERIOD + MS)
    assert wrong(judge) == ""
    assert all(seen == SPEED | CURRENT for seen in judge.escs[0].seen)
    assert judge.values == 100
    assert judge.by_more == 0
    assert judge.first_fresh(0, START + 10 * PERIOD + 2 * MS) == (START + 11 * PERIOD + MS, 11)


def test_values_marked_as_not_available_are_never_wrong(judge: Judge) -> None:
    bits = sum(
        ((place.not_available or 0) & place.mask) << place.start
        for place in judge.table[SPEED_ID].places
    )
    judge.take(SPEED_ID, bits.to_bytes(8, "little"), START + 5 * SECOND)
    assert wrong(judge) == ""
    assert judge.marked == 1


def test_values_delayed_by_a_slow_bus_are_right_and_counted(judge: Judge) -> None:
    judge.more_ns = SECOND
    judge.take(SPEED_ID, frame(judge, SPEED_ID, 10), START + 10 * PERIOD + 400 * MS)
    judge.take(SPEED_ID, frame(judge, SPEED_ID, 11), START + 11 * PERIOD + 300 * MS)
    assert wrong(judge) == ""
    assert judge.values == 2
    assert judge.by_more == 1


@pytest.mark.parametrize(
    ("given", "late", "why"),
    [
        ([10], 400 * MS, "old: frame 10, sent 0.400 s before"),
        ([11, 10], MS, "values of frame 10 after those of frame 11"),
        ([(10, 11)], MS, "never sent"),
        ([-10], MS, "never sent"),
    ],
)
def test_wrong_value_is_reported_with_its_reason(
    judge: Judge,
    given: list[int | tuple[int, int]],
    late: int,
    why: str,
) -> None:
    """A number is a frame of the first ESC, a negative one has values of the other ESC.

    A pair is a frame combined from two.
    """
    for each in given:
        if isinstance(each, tuple):
            one, other = (frame(judge, SPEED_ID, n) for n in each)
            n = each[1]
            data = one[:3] + other[3:]
        else:
            n = abs(each)
            data = frame(judge, SPEED_ID, n, int(each < 0))
        newest = max(n, 11) if len(given) > 1 else n
        judge.take(SPEED_ID, data, START + newest * PERIOD + late)
    assert why in wrong(judge)
    assert judge.wrong_count == 1


def test_data_age_that_is_too_low_is_wrong(judge: Judge) -> None:
    place = next(place for place in judge.table[LINK_ID].places if place.name == "data_age")
    late = START + 49 * PERIOD + SECOND
    judge.take(LINK_ID, (1000 << place.start).to_bytes(8, "little"), late)
    assert wrong(judge) == ""
    judge.take(LINK_ID, (100 << place.start).to_bytes(8, "little"), late)
    assert wrong(judge) == "Esc1Link: an age of 100 ms; the newest is 1000 ms old"
    judge.more_ns = SECOND
    judge.take(LINK_ID, (100 << place.start).to_bytes(8, "little"), late)
    assert judge.wrong_count == 1
    assert judge.by_more == 1


def test_every_value_message_of_the_shipped_layouts_is_judged(judge: Judge) -> None:
    followed = {message.stem for message in judge.table.values() if message.kind != "other"}
    assert followed >= {"Status", "Speed", "Current", "Shaft", "Bec", "Energy"}
    assert followed >= {"Info", "ExtremesA", "ExtremesB", "ExtremesC"}
    assert followed >= {"Tpdo1", "Tpdo2", "Tpdo3", "Tpdo4"}


def test_frames_of_an_esc_differ_in_every_message_within_the_time_out() -> None:
    for a, b in pairwise(live(Identity(1), n) for n in range(400)):
        assert a.electrical_speed != b.electrical_speed
        assert (a.power_stage_temperature, a.timing) != (b.power_stage_temperature, b.timing)
    assert len({mix(n, 8) for n in range(100_000)}) > 99_990


def test_boot_ups_and_emergencies_are_recorded(judge: Judge) -> None:
    judge.take(0x702, b"\0", 5)
    judge.take(0x702, b"\x05", 6)
    judge.take(0x82, b"\x40\x81\x11\xff\0\0\0\0", 7)
    assert judge.boot_ups == [(5, 2)]
    assert judge.emergencies == [(7, 2, 0x8140)]
