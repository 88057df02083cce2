"""The recipe for another output: one class, one line in the gateway's tuple. It sends one invented frame a second for each ESC."""

from collections.abc import Sequence

from kontronik_can_gw.config.nodes import shipped_canopen
from kontronik_can_gw.esc.kontronik import LiveData, codec, encode
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings, EscTelemetry, Event
from kontronik_can_gw.esc.values import VALUES, steps
from kontronik_can_gw.frames import EXTENDED, CanFrame, id_block
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.output import NO_IDS, Output, Owner
from kontronik_can_gw.signals.plan import Layout

FIRST_ID, COMMAND_ID = 0x1234500, 0x12
ESCS = [EscSettings("left"), EscSettings("right")]


class Voltages(Output):
    """Each ESC's battery voltage in 10 mV, FFFFh: not available; a command by CAN changes the period."""

    def __init__(self, escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> None:
        super().__init__()
        self.receive_ids = frozenset({COMMAND_ID})
        self._escs, self._gateway = escs, gateway
        self._due, self._period = now + SECOND, SECOND

    def own_ids(self) -> dict[int, Owner]:
        return {FIRST_ID + n | EXTENDED: Owner(n, "voltage") for n in range(len(self._escs))}

    def next_deadline(self) -> int:
        return self._due

    def on_event(self, esc: int, events: int, now: int) -> None:
        if events & Event.LINK and not self._escs[esc].up:
            self._send(esc, now)

    def receive(self, frame: CanFrame, now: int, at: int) -> None:
        if frame.can_id == COMMAND_ID:
            self._period = frame.data[0] * SECOND

    def advance(self, now: int) -> None:
        if now >= self._due:
            self._due += self._period
            for esc in range(len(self._escs)):
                self._send(esc, now)

    def _send(self, esc: int, now: int) -> None:
        value = steps(VALUES["battery_voltage"], self._escs[esc], self._gateway, now)
        data = (0xFFFF if value is None else value).to_bytes(2, "little")
        self.frames.append(CanFrame(FIRST_ID + esc, data, extended=True))


def test_other_receive_ids_are_noticed_whatever_their_content_and_address() -> None:
    output = Output()
    for number in range(100):
        before, again = output.marks, output.marks
        assert before == again
        output.receive_ids = NO_IDS  # the memory of the old ones may be used again
        output.receive_ids = frozenset((number // 2,))
        assert output.marks != before


def test_an_output_of_its_own_goes_from_bytes_to_frames_and_back() -> None:
    gateway = Gateway(ESCS, Layout("", "", ()), 0, further=(Voltages,))
    gateway.start(0)
    found = []
    for now in range(0, 4 * SECOND, SECOND // 10):
        while gateway.next_deadline() < now:
            gateway.advance(gateway.next_deadline())
        if now < 2 * SECOND:
            wire = encode(LiveData(battery_voltage=2400), codec.Layout.V4)
            gateway.receive_bytes(1, wire, now, now)
        gateway.advance(now)
        found += [(now, f.can_id - FIRST_ID, f.data.hex()) for f in gateway.take_frames(now)]
        if now == 2 * SECOND:
            gateway.receive_frame(CanFrame(COMMAND_ID, b"\x09"), now, now)
    assert [each for each in found if each[1] == 1] == [
        (SECOND, 1, "6009"),
        (2 * SECOND, 1, "6009"),
        (2 * SECOND + 2 * SECOND // 10, 1, "ffff"),  # lost: 250 ms after the last
        (3 * SECOND, 1, "ffff"),
    ]
    assert [each for each in found if each[1] == 0] == [(s * SECOND, 0, "ffff") for s in (1, 2, 3)]


class Saving(Output):
    """It has something to store."""

    def __init__(self, escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> None:
        super().__init__()
        self.saves.append((0, b"parameters"))
        self.answers: list[tuple[int, str | None]] = []

    def saved(self, esc: int, error: str | None, now: int) -> None:
        self.answers.append((esc, error))


def test_what_one_output_stores_is_answered_to_it_alone() -> None:
    made: list[Saving] = []

    def make(escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> Saving:
        made.append(Saving(escs, gateway, now))
        return made[-1]

    gateway = Gateway(ESCS, Layout("", "", ()), 0, canopen=shipped_canopen([1, 2]), further=(make,))
    assert gateway.take_saves() == [(0, b"parameters")]
    gateway.saved(0, "disk full", 1)
    assert made[0].answers == [(0, "disk full")]


def test_another_device_with_its_ids_is_noticed() -> None:
    gateway = Gateway(ESCS, Layout("", "", ()), 0, further=(Voltages,))
    assert gateway.receive_ids == {COMMAND_ID, FIRST_ID | EXTENDED, FIRST_ID + 1 | EXTENDED}
    gateway.receive_frame(CanFrame(FIRST_ID + 1, b"\0\0", extended=True), SECOND, SECOND)
    assert [(each.whose, each.node) for each in gateway.conflicts.take()] == [("voltage", 1)]


class Blocks(Output):
    """Whatever ends with 2Ah is its own."""

    def __init__(self, escs: Sequence[EscTelemetry], gateway: GatewayStatus, now: int) -> None:
        super().__init__()
        self.collisions: list[tuple[int, bool]] = []

    def own_ids(self) -> dict[int, Owner]:
        return {id_block(0x2A, 0x7F): Owner(1, "all of 2Ah")}

    def collision(self, esc: int, present: bool, now: int) -> None:
        self.collisions.append((esc, present))


def test_a_block_of_ids_is_one_conflict_and_only_its_owner_hears_of_it() -> None:
    gateway = Gateway(ESCS, Layout("", "", ()), 0, further=(Blocks, Blocks, Voltages))
    first, last = gateway.outputs[:2]  # both own it: the later one has it
    assert isinstance(first, Blocks)
    assert isinstance(last, Blocks)
    for can_id in (0x2A, 0x123402A, 0x1FFFFFAA):
        gateway.receive_frame(CanFrame(can_id, b"", extended=True), SECOND, SECOND)
    gateway.receive_frame(CanFrame(0x2B, b"", extended=True), SECOND, SECOND)
    gateway.receive_frame(CanFrame(0x2A, b""), SECOND, SECOND)
    (conflict,) = gateway.conflicts.take()
    assert (conflict.ids, conflict.count) == ("29-bit ids with 2Ah in their bits 7Fh", 3)
    gateway.advance(12 * SECOND)
    assert (first.collisions, last.collisions) == ([], [(1, True), (1, False)])
    gateway.receive_frame(CanFrame(FIRST_ID, b"", extended=True), SECOND, SECOND)
    assert [each.ids for each in gateway.conflicts.take()][1:] == ["29-bit id 1234500h"]
