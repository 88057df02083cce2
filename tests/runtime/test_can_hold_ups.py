"""What waits on the CAN side of a process that was held up: commands are obeyed, answers sent, measurements made anew."""

from collections.abc import Iterable, Iterator

import pytest
from wire_world import World, loop_in, run

from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import GatewayState
from kontronik_can_gw.node_state import NmtState
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.transmit_queue import Sent

HELD_UP_NS = 400 * MS
REQUEST, ANSWER, EMCY, HEARTBEAT, TPDO = 0x601, 0x581, 0x081, 0x701, 0x181
SPEED = 0x688
ZEROS = "00 00 00 00"
WATCH = ("23 16 10 01 2c 01 05 00", "2f 29 10 01 01 00 00 00", "2b 00 21 04 60 ea 00 00")
"""Node 5: 300 ms; its loss changes no state; and telemetry is not lost for 60 s."""


class Bench:
    """A gateway with a CANopen node 1 that runs, and telemetry of 100 Hz."""

    def __init__(self, patch: pytest.MonkeyPatch, opening_ns: int = 0) -> None:
        self.world = World()
        self.world.opening_ns = opening_ns
        canopen = {"enabled": True, "self_start": True, "store": "/nowhere"}
        loaded = assemble(parse({"canopen": canopen, "esc": [{"port": "p"}]}, "test"))
        self.layout = loaded.layout
        self.loop: Loop = loop_in(self.world, patch, loaded.escs, loaded.layout, loaded.canopen)
        self.wire = self.world.wires[0]
        self.loop.open()
        self.loop.begin()
        self.speed_until(SECOND)

    def speed_until(self, ns: int) -> None:
        self.wire.stream(self.world.now, self.world.now + ns, 10 * MS)
        self.run(ns)

    def run(self, ns: int) -> None:
        run(self.loop, self.world, self.world.now + ns)

    def ask(self, request: str) -> str:
        """An SDO request and its answer."""
        self.take()
        self.world.bus.came(REQUEST, bytes.fromhex(request))
        self.run(20 * MS)
        (answer,) = [data for can_id, data in self.take() if can_id == ANSWER]
        return answer.hex(" ")

    def write(self, *requests: str) -> None:
        for request in requests:
            assert self.ask(request).startswith("60"), request

    def hold_up(self, ns: int = HELD_UP_NS) -> None:
        self.take()
        self.world.now += ns
        self.run(20 * MS)

    def take(self) -> list[tuple[int, bytes]]:
        return self.world.bus.take()

    @property
    def state(self) -> NmtState:
        state: NmtState = self.loop.gateway.node_states()[0][1]
        return state


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    made = Bench(monkeypatch)
    assert made.loop.gateway.status.state is GatewayState.RUNNING
    yield made
    made.loop.close()


def of(frames: list[tuple[int, bytes]], *ids: int) -> list[tuple[int, str]]:
    return [(can_id, data.hex(" ")) for can_id, data in frames if can_id in ids]


@pytest.mark.parametrize(
    ("can_id", "request_hex", "answer_id", "answer", "state"),
    [
        (0x000, "02 01", 0, "", NmtState.STOPPED),
        (0x000, "80 00", 0, "", NmtState.PRE_OPERATIONAL),
        (0x000, "81 01", HEARTBEAT, "00", NmtState.OPERATIONAL),
        (0x000, "82 01", HEARTBEAT, "00", NmtState.OPERATIONAL),
        (REQUEST, f"40 00 10 00 {ZEROS}", ANSWER, f"43 00 10 00 {ZEROS}", NmtState.OPERATIONAL),
        (REQUEST, f"40 99 99 00 {ZEROS}", ANSWER, "80 99 99 00 00 00 02 06", NmtState.OPERATIONAL),
        (0x7E5, f"04 01 00 00 {ZEROS}", 0x7E4, f"5e 01 00 00 {ZEROS}", NmtState.OPERATIONAL),
    ],
)
def test_a_command_that_waited_is_obeyed_and_answered_once(
    bench: Bench, can_id: int, request_hex: str, answer_id: int, answer: str, state: NmtState
) -> None:
    bus, now = bench.world.bus, bench.world.now
    bus.came(can_id, bytes.fromhex(request_hex), now + MS)
    if can_id == 0x7E5:
        bus.came(can_id, bytes.fromhex(f"5e 00 00 00 {ZEROS}"), now + 2 * MS)
    bench.hold_up()
    expected = [(answer_id, answer)] if answer else []
    assert of(bench.take(), HEARTBEAT, ANSWER, 0x7E4) == expected
    assert bench.state is state


def test_an_interface_that_opens_slowly_is_no_hold_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = Bench(monkeypatch, opening_ns=HELD_UP_NS)
    world = made.world
    assert of(made.take(), HEARTBEAT)[0] == (HEARTBEAT, "00")
    made.loop.can._lost(Sent.GONE, world.now)
    made.run(2 * SECOND)
    assert of(made.take(), HEARTBEAT)[0] == (HEARTBEAT, "00"), "the node boots again"
    assert "suspended" not in "".join(made.loop.conditions.recent)
    made.loop.close()


def test_syncs_that_waited_are_counted_and_not_answered(bench: Bench) -> None:
    bench.write(
        "23 00 18 01 81 01 00 c0",  # 1800h:1: off
        "2f 00 18 02 02 00 00 00",  # each second SYNC
        "23 00 18 01 81 01 00 40",
    )
    sync = 0x80
    for n in range(3):
        bench.world.bus.came(sync, b"", bench.world.now + (10 + 100 * n) * MS)
    bench.wire.stream(bench.world.now, bench.world.now + SECOND, 10 * MS)
    bench.hold_up()
    assert of(bench.take(), TPDO) == []
    bench.world.bus.came(sync)
    bench.run(10 * MS)
    assert len(of(bench.take(), TPDO)) == 1, (
        "the fourth is an even one: those that waited were counted"
    )
    for expected in (0, 1):
        bench.world.bus.came(sync)
        bench.run(10 * MS)
        assert len(of(bench.take(), TPDO)) == expected


@pytest.mark.parametrize(
    ("came_ms", "codes"),
    [
        (range(50, 2000, 50), []),  # all the time, as the kernel knows
        ([100, *range(700, 2000, 50)], ["3081", "0000"]),  # it stayed away for 600 ms
        ([100, 200, 300], ["3081"]),
        ([], ["3081"]),
    ],
)
def test_heartbeats_count_when_they_came(
    bench: Bench, came_ms: Iterable[int], codes: list[str]
) -> None:
    """Held up for the first second. Beside them comes more than one call reads."""
    bench.write(*WATCH)
    bench.world.bus.came(0x705, b"\x05")
    bench.run(10 * MS)
    others = [(n, REQUEST, bytes((0x80, 0, 0, 0, 0, 0, 0, 0))) for n in range(900)]
    start = bench.world.now
    for ms, can_id, data in sorted([*others, *((ms, 0x705, b"\x05") for ms in came_ms)]):
        bench.world.bus.came(can_id, data, start + ms * MS)
    bench.hold_up(SECOND)
    bench.run(900 * MS)
    emergencies = [data for can_id, data in bench.take() if can_id == EMCY]
    assert [data[:2].hex() for data in emergencies] == codes


def test_what_waits_to_be_sent_answers_stay_and_measurements_are_made_anew(bench: Bench) -> None:
    bus = bench.world.bus
    bench.write(*WATCH)  # nothing is sent because telemetry is lost
    bus.answer = Sent.BUSY
    for n in range(5):
        bus.came(REQUEST, bytes((0x40, n, 0x99, 0, 0, 0, 0, 0)))
    bench.speed_until(50 * MS)
    old = len(bench.wire.frames)
    assert len(bench.loop.can.transmitter.queue) > 5
    bench.loop.can.transmitter.queue.put_all([CanFrame(0x123, b"old")])
    bus.take()
    bus.answer = Sent.OK
    bench.world.now += HELD_UP_NS
    bench.wire.send(bench.world.now - 10 * MS)
    bench.loop.turn()
    sent = bench.take()
    assert [data[1] for can_id, data in sent if can_id == ANSWER] == list(range(5))
    speeds = {int.from_bytes(data[:3], "little") for can_id, data in sent if can_id == SPEED}
    assert speeds == {old + 1}
    dbc = {message.can_id for message in bench.layout.messages if message.cycle_ns <= HELD_UP_NS}
    assert dbc <= {can_id for can_id, _ in sent}, "what was dropped is made anew at once"
    assert 0x123 not in {can_id for can_id, _ in sent}, "what nothing replaces is dropped too"


def test_within_a_turn_the_rest_is_late_but_answers_are_not_lost(
    bench: Bench,
) -> None:
    world = bench.world
    seen: list[object] = []

    def stop_once(frame: object) -> None:
        if not seen:
            world.now += 10 * SECOND
        seen.append(frame)

    for n in range(5):
        world.bus.came(REQUEST, bytes((0x40, n, 0x99, 0, 0, 0, 0, 0)))
    bench.wire.send(world.now - 5 * MS)
    number = len(bench.wire.frames)
    bench.take()
    world.bus.on_send = stop_once
    bench.run(20 * MS)
    bench.run(20 * MS)
    sent = [(at, frame.can_id, frame.data) for at, frame in world.bus.sent]
    late = [(can_id, data) for at, can_id, data in sent if at > world.now - SECOND]
    assert [data[1] for _, can_id, data in sent if can_id == ANSWER] == list(range(5))
    assert [
        can_id
        for can_id, data in late
        if int.from_bytes(data[:3], "little") == number and can_id == SPEED
    ] == []
    assert any(can_id == SPEED for can_id, _ in late), "and told that there is nothing"
