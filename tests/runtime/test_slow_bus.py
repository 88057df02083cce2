"""A slow bus: no value leaves late, all messages get their share, and the fault is reported."""

from itertools import pairwise

import pytest
from dbc_bench import compiled
from packer_oracle import Msg, dbc_text
from test_outages import TIMEOUT, Recorded, age_of, in_both_cores, nodes, on_the_wire, with_status
from wire_world import TIMES, run, speed_and_age

from kontronik_can_gw.capture.format import EntryKind
from kontronik_can_gw.core.output_setup import OutputMaker
from kontronik_can_gw.gateway.gate_table import State
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("slow-bus")

QUARTER = TIMEOUT // 4
in_all_rates = pytest.mark.parametrize("rate", [100, 40, 28, 20, 10, 5])


@in_both_cores
@in_all_rates
def test_no_value_that_leaves_a_slow_bus_is_old(rate: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """At full speed the gateway hands over 150 frames/s, one of them for each telemetry frame."""
    it = Recorded(monkeypatch, with_status())
    it.run(SECOND)
    frame_ns = SECOND // rate
    it.bus.frame_ns = frame_ns
    it.run(7 * frame_ns)  # the frames that were under way at the sudden slow-down may be late
    it.bus.frames_left()
    begin = len(it.bus.arrived)
    it.run(5 * SECOND)
    it.bus.frames_left()
    arrived = it.bus.arrived[begin:]
    ages = [age for each in arrived if (age := age_of(it.world, *each)) is not None]
    assert max(ages) <= TIMEOUT + QUARTER + frame_ns
    assert len(arrived) >= 0.95 * 5 * rate
    kinds = {EntryKind(entry.kind) for entry in it.entries}
    assert not kinds & {EntryKind.HOLD, EntryKind.FIRST_FRAME, EntryKind.RELEASE}
    if rate <= 40:
        assert it.loop.can.gate.is_slow
    it.bus.frame_ns = MS // 4
    it.run(5 * SECOND)
    assert not it.loop.can.gate.is_slow
    assert it.loop.can.gate.state is State.OPEN
    it.loop.end()
    if rate <= 40:
        limits = [entry.time_ns for entry in it.entries if entry.kind == EntryKind.LIMIT]
        begun, ended = limits[0], limits[-1]
        sent = on_the_wire(each for each in it.bus.sent if begun < each[0] < ended)
        replayed = [(each.time_ns, each.frame) for each in it.replayed()]
        assert sent == on_the_wire(each for each in replayed if begun < each[0] < ended)


@in_both_cores
def test_each_message_of_a_slow_bus_waits_for_two_departures_of_each_at_most(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    count = 8
    messages = [Msg(f"M{n}", 0x100 + n, 8, speed_and_age()) for n in range(count)]
    it = Recorded(monkeypatch, compiled(dbc_text(messages, TIMES), ["esc1"]), [nodes()])
    it.bus.frame_ns = 40 * MS
    it.run(2 * SECOND)
    it.bus.frames_left()
    begin = len(it.bus.arrived)
    for at in range(50):  # a master that asks all the time
        it.bus.came(0x601, bytes.fromhex("4000100000000000"), it.world.now + at * 100 * MS)
    it.run(5 * SECOND)
    it.bus.frames_left()
    ids = [frame.can_id for _, frame in it.bus.arrived[begin:]]
    pending = count + 1 + 4  # messages, answers and the PDOs of the node
    for message in {frame.can_id for _, frame in it.bus.sent if frame.can_id < 0x200}:
        places = [-1, *[place for place, can_id in enumerate(ids) if can_id == message], len(ids)]
        gaps = [after - before for before, after in pairwise(places)]
        assert max(gaps) <= 2 * pending, f"{message:X}"
    assert ids.count(0x581) >= 40


@in_both_cores
@pytest.mark.promise("slow-bus")
def test_slow_bus_is_reported_once_and_its_end_too(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "kontronik_can_gw")
    it = Recorded(monkeypatch, with_status(), [nodes()])
    it.run(SECOND)
    it.bus.frame_ns = 50 * MS
    it.run(10 * SECOND)
    it.bus.frame_ns = MS // 4
    it.run(4 * SECOND)
    lines = [line for line in caplog.messages if "CAN world" in line and "open" not in line]
    assert [line.split(":")[1].split(".")[0] for line in lines] == [
        " the bus is slow",
        " the bus takes all frames in time, after 12",
    ]
    boot_ups = [at for at, frame in it.bus.arrived if frame[:2] == (0x701, b"\0")]
    assert len(boot_ups) <= 1, "no node boots"


@in_both_cores
@pytest.mark.parametrize("rate", [28, 20, 10, 5])
@pytest.mark.parametrize("outputs", [[], [nodes()]], ids=["DBC", "with nodes"])
def test_no_value_is_too_old_if_it_is_old_when_it_is_handed_over(
    rate: int, outputs: list[OutputMaker], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With telemetry each 240 ms, values are up to 240 ms old when they are packed."""
    it = Recorded(monkeypatch, with_status(), outputs)
    it.run(SECOND)
    frame_ns = SECOND // rate
    it.bus.frame_ns = frame_ns
    it.run(8 * frame_ns)
    it.bus.frames_left()
    begin = len(it.bus.arrived)
    now = it.world.now
    it.world.wires[0].stream(now + 5 * MS, now + 20 * SECOND, 240 * MS)
    run(it.loop, it.world, now + 20 * SECOND)
    it.bus.frames_left()
    arrived = it.bus.arrived[begin:]
    ages = [age for each in arrived if (age := age_of(it.world, *each)) is not None]
    assert max(ages) <= TIMEOUT + QUARTER + frame_ns


@in_both_cores
@pytest.mark.parametrize("rate", [4, 3, 2])
def test_values_leave_a_bus_with_few_frames_a_second(
    rate: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame takes longer than the time after which a bus is blocked, but frames leave."""
    it = Recorded(monkeypatch, with_status(), [nodes()])
    it.run(SECOND)
    it.bus.frame_ns = SECOND // rate
    it.run(5 * SECOND)
    it.bus.frames_left()
    begin = len(it.bus.arrived)
    it.run(10 * SECOND)
    it.bus.frames_left()
    ages = [age for each in it.bus.arrived[begin:] if (age := age_of(it.world, *each)) is not None]
    assert len(ages) >= rate
    assert max(ages) <= TIMEOUT + QUARTER + SECOND // rate
    assert it.loop.can.gate.is_slow
