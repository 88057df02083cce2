"""No value from before an outage of the bus, and a first frame without measurements after it."""

import random
from collections.abc import Iterable, Sequence

import pytest
import wire_world
from dbc_bench import compiled
from dialogue import shipped_eds
from packer_oracle import Msg, Sig, dbc_text
from wire_world import NOT_AVAILABLE, TIMES, World, layout_of, loop_in, run, speed_and_age

from kontronik_can_gw.canopen.node_settings import NodeSettings
from kontronik_can_gw.canopen.setup import CanopenSetup
from kontronik_can_gw.canopen.storage import Stored
from kontronik_can_gw.capture.format import Entry, EntryKind
from kontronik_can_gw.capture.recorded_gateway import RecordedGateway, state_of
from kontronik_can_gw.config.output_keys import DronecanConfig
from kontronik_can_gw.core.output_setup import OutputMaker
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.desk.recordings.replay import Replay, TimedFrame
from kontronik_can_gw.dronecan.nodes import Given
from kontronik_can_gw.dronecan.setup import DronecanSetup
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.native import load
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("after-outage")

ESCS = (EscSettings("esc1"),)
TIMEOUT = ESCS[0].timeout_ns
FRAME_NS = MS // 4
HELD = 6
"""Number of frames that the kernel holds."""
STATUS = 0x300
NO_MESSAGES = MessageLayout("", "", ())
in_both_cores = pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)


def with_status() -> MessageLayout:
    """Return the layout of ``layout_of`` and a message of the gateway's own state."""
    status = Msg("GatewayStatus", STATUS, 8, [Sig("GatewayState", 0, 8), Sig("Uptime", 32, 32)])
    return compiled(dbc_text([Msg("M0", 0x100, 8, speed_and_age()), status], TIMES), ["esc1"])


def nodes() -> CanopenSetup:
    return CanopenSetup(shipped_eds(), (NodeSettings(1, self_start=True),), (Stored(),), ESCS)


def drone() -> DronecanSetup:
    return DronecanSetup(Given(DronecanConfig(node_id=42), b"", (1, 2), 3), ESCS)


class Recorded:
    """A recorded loop with an ESC that sends every 10 ms, and a bus with a frame each 0.25 ms."""

    def __init__(
        self,
        patch: pytest.MonkeyPatch,
        layout: MessageLayout,
        outputs: Sequence[OutputMaker] = (),
        is_unplugged: bool = False,
    ) -> None:
        self.entries: list[Entry] = []
        self.layout = layout
        self.outputs = outputs
        self.world = World()
        self.bus = self.world.bus
        self.bus.frame_ns = FRAME_NS
        if is_unplugged:
            self.bus.count = 0  # since the interface was made
            self.bus.block()
        self.begun = self.world.now
        self._patch = patch
        patch.setattr(wire_world, "Gateway", self._gateway)
        self.loop: Loop = loop_in(self.world, patch, ESCS, layout, outputs=outputs)
        self.loop.open()
        self.loop.begin()

    def _gateway(self, *args: object, **more: object) -> RecordedGateway:
        return RecordedGateway(self._put, *args, **more)

    def _put(
        self, now: int, kind: int, esc: int, data: bytes, flags: int, came: int | None = None
    ) -> None:
        self.entries.append(Entry(now, EntryKind(kind), esc, data, flags, came))

    def run(self, ns: int) -> None:
        """Run for a time in which the ESC sends a frame each 10 ms."""
        now = self.world.now
        self.world.wires[0].stream(now, now + ns - 5 * MS, 10 * MS)
        run(self.loop, self.world, now + ns)

    def replayed(self) -> list[TimedFrame]:
        """Return the frames of a replay by the core in Python."""
        self._patch.setattr(load, "library", lambda: (None, ""))
        gateway = Gateway(CoreSettings(ESCS, self.layout), self.begun, outputs=self.outputs)
        replay = Replay(gateway)
        frames = list(replay.follow(self.entries))
        assert replay.rejected == 0
        return frames


def age_of(world: World, at: int, frame: CanFrame) -> int | None:
    """Return the age in ns of a frame's value when it arrived. None if it has no value."""
    number = int.from_bytes(frame.data[:4], "little")
    if frame.can_id != 0x100 or number == NOT_AVAILABLE:
        return None
    return at - world.wires[0].frames[number - 1]


def on_the_wire(frames: Iterable[tuple[int, CanFrame]]) -> list[tuple[int, bytes]]:
    return [(frame.can_id, frame.data) for _, frame in frames]


@in_both_cores
@pytest.mark.parametrize("has_nodes", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_after_a_blocked_bus_only_the_frames_in_the_kernel_are_late(
    seed: int, has_nodes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    chance = random.Random(seed)
    it = Recorded(monkeypatch, with_status(), [nodes()] if has_nodes else [])
    spans = []
    for _ in range(2):
        it.run(chance.randrange(300, 900) * MS)
        it.bus.block()
        blocked = it.world.now
        number = len(it.entries)
        begin = len(it.bus.arrived)
        it.run(round(10 ** chance.uniform(-0.5, 0.5) * SECOND))
        assert len(it.bus.arrived) == begin
        it.bus.free()
        it.run(SECOND // 2)
        it.bus.frames_left()
        after = it.bus.arrived[begin:]
        ages = [age_of(it.world, *each) for each in after]
        late = [n for n, age in enumerate(ages) if age is not None and age > TIMEOUT]
        assert all(n < HELD for n in late), "these were in the kernel"
        assert any(age is not None for age in ages[HELD:]), "values are sent again"
        entries = it.entries[number:]
        held = next(each.time_ns for each in entries if each.kind == EntryKind.HOLD)
        assert held <= blocked + 1.1 * TIMEOUT
        handed = [each for each in it.bus.sent if each[0] >= held]
        assert handed[0][1].can_id == STATUS
        left = next(at for at, frame in after if frame is handed[0][1])
        assert all(at >= left for at, frame in handed[1:] if frame.can_id != STATUS)
        end = it.world.now
        spans.append((held, end, on_the_wire(each for each in handed if each[0] < end)))
    it.loop.end()
    replayed = [(each.time_ns, each.frame) for each in it.replayed()]
    for held, end, sent in spans:
        in_replay = iter(on_the_wire(each for each in replayed if held <= each[0] < end))
        assert all(frame in in_replay for frame in sent), "in this order; a full bus replaces some"


@in_both_cores
def test_nothing_is_handed_over_while_no_frame_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message is sent so rarely that the kernel does not refuse a frame for a long time."""
    rare = TIMES.replace("20", "100").replace("CyclicAndEvent", "Cyclic")
    layout = compiled(dbc_text([Msg("M0", 0x100, 8, speed_and_age())], rare), ["esc1"])
    it = Recorded(monkeypatch, layout)
    it.run(SECOND)
    it.bus.block()
    blocked = it.world.now
    it.run(5 * SECOND)
    values = [at for at, frame in it.bus.sent if age_of(it.world, at, frame) is not None]
    assert blocked <= values[-1] <= blocked + TIMEOUT // 2
    assert it.loop.can.gate.is_stalled
    it.bus.free()
    it.run(SECOND)
    assert not it.loop.can.gate.is_stalled


@pytest.mark.parametrize(
    ("layout", "outputs", "first"),
    [
        (with_status(), [nodes()], (STATUS, None)),
        (layout_of(ESCS), [nodes()], (0x100, b"\xff\xff\xff\xff\xff\xff\0\0")),
        (NO_MESSAGES, [nodes()], (0x701, b"\x05")),
        (NO_MESSAGES, [drone()], (0x1F01552A, None)),
    ],
)
def test_first_frame_carries_no_measurement(
    layout: MessageLayout,
    outputs: list[OutputMaker],
    first: tuple[int, bytes | None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    it = Recorded(monkeypatch, layout, outputs)
    it.run(SECOND)
    begin = len(it.bus.sent)
    it.loop.can.gate.bus_off(False, it.world.now)
    it.loop.can.transmitter.work(it.world.now)
    it.loop.can.gate.left_bus_off(
        it.bus.frames_left(), is_running=True, is_reported=False, now=it.world.now
    )
    it.run(SECOND)
    frame = it.bus.sent[begin][1]
    assert frame.can_id == first[0]
    assert first[1] in (None, frame.data)
    left = it.bus.sent[begin][0] + FRAME_NS
    assert it.bus.sent[begin + 1][0] >= left, "the others follow when it has left"


@in_both_cores
def test_blocked_interface_that_is_restarted_sends_no_old_value(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The restart discards the frames in the kernel and in the controller."""
    it = Recorded(monkeypatch, with_status(), [nodes()])
    it.run(SECOND)
    it.bus.block()
    it.run(SECOND)
    begin = len(it.bus.arrived)
    for _ in range(3):
        it.bus.discard_waiting()
        it.bus.answer = Sent.DOWN
        it.run(50 * MS)
        it.bus.answer = Sent.OK
        it.run(2 * SECOND)
    it.bus.free()
    it.run(SECOND)
    it.bus.frames_left()
    after = it.bus.arrived[begin:]
    ages = [age for each in after if (age := age_of(it.world, *each)) is not None]
    assert ages
    assert max(ages) < TIMEOUT
    assert after[0][1].can_id == STATUS
    assert [frame.can_id for _, frame in after].count(0x701) >= 1


@in_both_cores
@pytest.mark.promise("restarts")
def test_interface_that_has_sent_nothing_yet_is_restarted_and_sends_no_old_value(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The bus is unplugged from the start. The interface's count of sent frames is 0."""
    it = Recorded(monkeypatch, with_status(), [nodes()], is_unplugged=True)
    asked: list[int] = []
    it.loop.can.gate.restart.after_ns = it.loop.can.gate.restart.pause_ns = SECOND // 2
    it.loop.can.transmitter.ask_restart = lambda _channel: asked.append(it.world.now)
    for number in range(1, 4):
        it.run(number * SECOND)
        assert len(asked) == number, "no frame leaves"
        it.bus.discard_waiting()
        it.loop.can._follow(LinkFacts(exists=True, up=False), it.world.now)
    it.run(100 * MS)
    it.bus.free()
    it.run(SECOND)
    it.bus.frames_left()
    ages = [age for each in it.bus.arrived if (age := age_of(it.world, *each)) is not None]
    assert ages
    assert max(ages) < TIMEOUT
    assert it.bus.arrived[0][1].can_id == STATUS


def test_recording_that_begins_in_an_outage_holds_frames_in_its_replay() -> None:
    settings = CoreSettings(ESCS, layout_of(ESCS))
    gateway = RecordedGateway(lambda *_: None, settings, 0)
    gateway.start(0)
    gateway.hold(0)
    replayed = Gateway(settings, 0)
    Replay(replayed, state_of(gateway))
    assert replayed.is_held


@in_both_cores
@pytest.mark.parametrize("phase_ms", [0, 7, 13, 17, 22])
def test_bus_that_is_blocked_after_bus_off_gets_no_measurement(
    phase_ms: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that left just before the bus-off are not taken for the first frame."""
    it = Recorded(monkeypatch, with_status())
    it.run(SECOND + phase_ms * MS)
    it.bus.discard_waiting()
    it.bus.block()
    it.bus.state = CanState.BUS_OFF
    it.bus.came(0x7FF)
    it.run(300 * MS)
    begin = len(it.bus.sent)
    it.bus.state = CanState.ERROR_ACTIVE
    it.bus.came(0x7FF)
    it.run(1500 * MS)
    handed_over = it.bus.sent[begin:]
    assert handed_over
    assert not [each for each in handed_over if age_of(it.world, *each) is not None]
