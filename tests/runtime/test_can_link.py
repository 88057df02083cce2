"""The CAN interface in the loop: bus-off and recovery, outages, a stalled bus.

Time is passed in. The port and the kernel are scripted.
"""

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from wire_world import CAN_FD, Bus, World

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.can import can_controller, can_opener
from kontronik_can_gw.runtime.can.can_link import CanLink
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.can.socketcan_port import socketcan_error
from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS, NEVER, SECOND

pytestmark = pytest.mark.promise("unstoppable")


@pytest.fixture(autouse=True)
def locks_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each test its own locks.

    Otherwise a test of this file that runs in another process at the same time would be another
    gateway with the same node. Root has another folder than an ordinary user.
    """
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(folders, "RUN", folder)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))


ACTIVE = LinkFacts(
    True,
    True,
    "can",
    CanState.ERROR_ACTIVE,
    500_000,
    100,
    (0, 0),
)
OFF = ACTIVE._replace(state=CanState.BUS_OFF)
BOOT_UP = (0x701, b"\0")


class Port(Bus):
    """A SocketCAN port. It cannot be opened while ``there`` is False."""

    there = True

    def __init__(self, _config: object) -> None:
        if not Port.there:
            raise RunError("CAN interface can0: there is none.")
        super().__init__(World())
        self.state = CanState.UNKNOWN


class Kernel:
    """The messages of rtnetlink: ``facts`` answers a request, ``news`` arrives unasked."""

    def __init__(self) -> None:
        self.facts: LinkFacts | None = None
        self.news: list[LinkFacts] = []
        self.asked = 0
        self._waiting: list[LinkFacts] = []

    def fileno(self) -> int:
        return CAN_FD + 1

    def ask(self) -> None:
        self.asked += 1
        if self.facts is not None:
            self._waiting.append(self.facts)

    def take(self) -> list[LinkFacts]:
        reports = [*self.news, *self._waiting]
        self._waiting = []
        self.news = []
        return reports

    def close(self) -> None:
        pass


class Bench:
    port_blocks = False
    """True if the interface takes frames that do not leave it, each time it is opened."""

    def __init__(
        self,
        kernel: Kernel,
        self_start: bool = True,
        has_node: bool = True,
        dbc: Mapping[str, object] | None = None,
        nodes: int = 1,
        **can: object,
    ) -> None:
        tables = {
            "canopen": {"enabled": has_node, "self_start": self_start, "store": "/nowhere"},
            "esc": [{"port": f"p{number}"} for number in range(nodes)],
            "can": can,
            "dbc": dbc or {},
        }
        loaded = assemble(parse(tables, "test"))
        self.gateway = Gateway(loaded.core_settings, 0, outputs=loaded.outputs)
        self.kernel = kernel
        self.now = 0
        self.clock = 0
        self.world = World()
        self.can = CanLink(
            loaded.config.can,
            self.gateway,
            self.world.poller,
            FaultLog(),
            esc_at=lambda _path: None,
            clock=lambda: self.clock,
        )

    @property
    def port(self) -> Port:
        assert isinstance(self.can.port, Port)
        return self.can.port

    def start(self) -> None:
        self.can.open(self.now, wait=True)
        self.gateway.start(self.now, self.can.is_open)
        self.can.transmit(self.now)

    def begin(self) -> None:
        """Open the interface, and discard the first frames."""
        self.kernel.facts = ACTIVE
        self.start()
        self.turn(300)
        self.take()

    def turn(self, ms: int = 1) -> None:
        """Do the work of the loop in steps of a millisecond.

        A deadline that stays in the past would make the loop spin.
        """
        for _ in range(ms):
            self.now += MS
            self.clock = self.now
            if self.can.port is not None:
                self.port.let_pass(MS)
            self.can.hear(self.now)
            self.can.reopen(self.now)
            if self.port_blocks and self.can.port is not None and not self.port.frame_ns:
                self.port.frame_ns = MS // 4
                self.port.block()
            if self.now >= self.can.controller.due:
                self.can.ask(self.now)
            self.can.look(self.now)
            self.gateway.advance(self.now)
            self.can.follow_ids()
            self.can.transmit(self.now)
            assert self.can.due > self.now or self.can.port is None

    def error_frame(self, state: CanState) -> None:
        self.port.note_state(state)
        self.can._follow_reception(self.now)

    def goes_off(self) -> None:
        """Put the controller in bus-off: it sends the error frame, and rtnetlink reports it."""
        self.kernel.facts = OFF._replace(running=False)
        self.error_frame(CanState.BUS_OFF)

    def changes(self, facts: LinkFacts, there: bool = True) -> None:
        """Change the interface. rtnetlink reports it."""
        self.kernel.facts = facts
        self.kernel.news = [facts]
        Port.there = there

    def take(self) -> list[tuple[int, bytes]]:
        return self.port.take()


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    made = Kernel()
    monkeypatch.setattr(can_opener, "open_can", Port)
    monkeypatch.setattr(can_controller, "link_monitor", lambda _name: made)
    monkeypatch.setattr(Port, "there", True)
    return made


@pytest.fixture
def bench(kernel: Kernel) -> Iterator["Bench"]:
    made = Bench(kernel)
    yield made
    made.can.close()


def boot_ups_and_emergencies(frames: list[tuple[int, bytes]]) -> list[str]:
    """Return the boot-ups as "boot-up" and the emergencies as their code in hex."""
    names = []
    for frame in frames:
        can_id, data = frame
        if frame == BOOT_UP:
            names.append("boot-up")
        elif can_id == 0x081:
            names.append(data[1::-1].hex())
    return names


@pytest.mark.promise("bus-off")
@pytest.mark.parametrize("late_ms", [0, 1, 40, 300])
def test_node_boots_and_sends_8140h_when_the_queue_runs_after_a_restart(
    bench: Bench,
    kernel: Kernel,
    late_ms: int,
) -> None:
    """The kernel first sends the error frame "restarted", then starts the queue.

    rtnetlink reports the start of the queue. Frames that are sent before it are lost.
    """
    bench.begin()
    bench.goes_off()
    bench.turn(200)
    assert bench.take() == [], "nothing is handed to a controller that is off"
    assert bench.gateway.status.bus_off_count == 1
    assert bench.gateway.status.can_state is CanState.BUS_OFF
    bench.error_frame(CanState.ERROR_ACTIVE)
    if late_ms:
        bench.turn(late_ms)
        assert bench.take() == []
    bench.changes(ACTIVE)
    bench.turn(2)
    assert boot_ups_and_emergencies(bench.take()) == ["boot-up", "8140", "0000"]
    bench.turn(3000)
    assert boot_ups_and_emergencies(bench.take()) == []
    assert bench.gateway.status.bus_off_count == 1


def test_driver_that_reports_bus_off_late_causes_one_boot_up(
    bench: Bench,
    kernel: Kernel,
) -> None:
    bench.begin()
    bench.goes_off()
    bench.turn(50)
    bench.error_frame(CanState.ERROR_ACTIVE)
    kernel.facts = OFF  # the controller runs, but its driver has not noticed
    bench.turn(300)
    kernel.facts = ACTIVE
    bench.turn(2000)
    assert boot_ups_and_emergencies(bench.take()) == ["boot-up", "8140", "0000"]


def test_controller_without_restart_is_reported_once_with_the_remedy(
    bench: Bench,
    kernel: Kernel,
    caplog: pytest.LogCaptureFixture,
) -> None:
    kernel.facts = ACTIVE._replace(restart_ms=0)
    bench.start()
    bench.turn(10)
    bench.port.answer = Sent.BUSY
    bench.turn(300)
    kernel.facts = kernel.facts._replace(state=CanState.BUS_OFF, running=False)
    bench.turn(5000)
    assert 40 < kernel.asked < 70, "ten times a second"
    assert sum("restart-ms is 0" in line for line in caplog.messages) == 1


def test_old_report_of_a_link_does_not_close_a_new_port(bench: Bench, kernel: Kernel) -> None:
    bench.begin()
    bench.changes(LinkFacts(exists=False), there=False)
    bench.turn(100)
    assert not bench.can.is_open
    bench.changes(ACTIVE)
    bench.now += SECOND
    kernel.news = [LinkFacts(exists=False)]
    bench.can.reopen(bench.now)  # after its own pause, before it has read the kernel's report
    port = bench.can.port
    assert port is not None
    bench.turn(100)
    assert bench.can.port is port


def test_own_frames_returned_after_an_outage_are_no_conflict(bench: Bench) -> None:
    bench.kernel.facts = ACTIVE
    bench.start()
    bench.gateway.receive_frame(CanFrame(0x701, b"\5"), bench.now, bench.now)
    assert bench.gateway.status.id_conflicts == 0
    bench.turn(300)
    bench.gateway.receive_frame(CanFrame(0x701, b"\5"), bench.now, bench.now)
    assert bench.gateway.status.id_conflicts == 1


def test_outage_is_logged_with_the_remedy_and_when_it_ends(
    bench: Bench,
    kernel: Kernel,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    bench.begin()
    caplog.clear()
    bench.changes(LinkFacts(exists=True, up=False))

    def is_down(_config: object) -> Port:
        raise socketcan_error(bench.can.config, 100)

    with monkeypatch.context() as patch:
        patch.setattr(can_opener, "open_can", is_down)
        bench.turn(5000)
    assert not bench.can.is_open
    assert bench.gateway.status.can_state == CanState.DOWN
    bench.changes(ACTIVE)
    bench.turn(100)
    down, back = caplog.messages
    assert down.startswith("CAN interface can0: is down. Start it: sudo ip link set can0 up")
    assert back.startswith("CAN can0: frames are sent again, after 5.0 s")


@pytest.mark.promise("late-frames")
def test_bus_that_was_stalled_gets_no_backlog(
    bench: Bench,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    bench.kernel.facts = ACTIVE
    bench.start()
    bench.gateway.receive_bytes(
        0,
        encode(LiveData(battery_voltage=2400), WireLayout.V4),
        bench.now,
        bench.now,
    )
    bench.turn(100)
    bench.take()
    bench.port.answer = Sent.BUSY
    bench.turn(5000)
    assert len(bench.can.transmitter.queue) < 50
    assert bench.gateway.status.dropped_frames == 2, "heartbeats before the outage was noticed"
    bench.port.answer = Sent.OK
    bench.turn(50)
    sent = bench.take()
    assert [data for can_id, data in sent if can_id == 0x701] in ([], [b"\5"])
    assert boot_ups_and_emergencies(sent) == ["7510"], "the loss of telemetry is reported again"
    said = [message for message in caplog.messages if "no frame can be sent" in message]
    reason = "No other node acknowledges, or the bus is full. Trying again."
    assert said == [f"CAN can0: no frame can be sent. {reason}"]
    assert "CAN can0: frames are sent again, after 4.0 s" in caplog.messages


def test_saturated_bus_is_not_taken_for_a_dead_adapter(
    bench: Bench,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The adapter does not report which of the two it is, but still takes a frame now and then."""
    monkeypatch.setattr(Port, "is_socket", False)
    bench.start()
    port = bench.port
    before = bench.can.port
    for n in range(3000):
        port.answer = Sent.OK if n % 3 else Sent.BUSY
        data = bytes((n & 255,))
        for can_id in range(10):
            bench.can.transmitter.queue.put_all([CanFrame(0x100 + can_id, data)])
        bench.turn()
    assert bench.can.port is before
    port.answer = Sent.BUSY
    bench.can.transmitter.queue.put_all([CanFrame(0x100, b"")])
    bench.turn(2000)
    assert bench.can.port is not before


def test_bus_off_and_lost_frames_are_counted_once(bench: Bench) -> None:
    bench.begin()
    bench.port.bus_off_count = 2
    bench.port.overruns = 1
    for _ in range(2):
        bench.can.serve(bench.now)
    bench.turn(200)
    assert bench.gateway.status.bus_off_count == 2
    assert boot_ups_and_emergencies(bench.take()) == ["8110", "0000"]
    bench.turn(1000)  # an overrun is reported at most once a second
    bench.port.overruns = 1
    for _ in range(3000):  # frames are received all the time
        bench.can.serve(bench.now)
        bench.turn()
    assert boot_ups_and_emergencies(bench.take()) == ["8110", "0000"]


def test_changed_receive_ids_are_set_on_the_open_port(bench: Bench) -> None:
    bench.start()
    bench.turn(10)
    assert 0x601 in bench.port._ids
    assert 0x705 not in bench.port._ids
    watch_node_5 = bytes.fromhex("23 16 10 01 2c 01 05 00")
    bench.gateway.receive_frame(CanFrame(0x601, watch_node_5), bench.now, bench.now)
    bench.turn(1)
    assert {0x601, 0x705} <= bench.port._ids


@pytest.mark.promise("interface-reopens")
def test_adapter_that_fails_while_it_is_read_is_opened_again(bench: Bench) -> None:
    bench.start()
    bench.turn(100)
    before = bench.port
    before.is_gone = True
    bench.can.serve(bench.now)
    assert not bench.can.is_open
    bench.turn(600)
    assert bench.port is not before
    assert bench.port._ids == before._ids
    assert boot_ups_and_emergencies(bench.take()) == ["boot-up"]


def drone(kernel: Kernel, node_id: int = 42) -> Bench:
    """Return a bench whose only output is DroneCAN."""
    made = Bench.__new__(Bench)
    table = {"enabled": True, "node_id": node_id}
    tables = {"dbc": {"enabled": False}, "dronecan": table, "esc": [{"port": "p"}]}
    loaded = assemble(parse(tables, "test"))
    made.gateway = Gateway(loaded.core_settings, 0, outputs=loaded.outputs)
    made.kernel = kernel
    made.now = 0
    made.clock = 0
    made.can = CanLink(
        loaded.config.can,
        made.gateway,
        World().poller,
        FaultLog(),
        esc_at=lambda _path: None,
        clock=lambda: made.clock,
    )
    return made


@pytest.mark.promise("bus-off")
@pytest.mark.parametrize("is_drone", [False, True])
@pytest.mark.parametrize(
    "facts",
    [
        pytest.param(OFF._replace(running=False), id="controller"),
        pytest.param(ACTIVE._replace(state=None), id="virtual interface"),
        pytest.param(None, id="no rtnetlink"),
    ],
)
def test_no_frame_is_sent_in_bus_off(
    kernel: Kernel,
    facts: LinkFacts | None,
    is_drone: bool,
) -> None:
    made = drone(kernel) if is_drone else Bench(kernel)
    before = None
    after = None
    if facts is not None:
        state = facts.state and ACTIVE.state
        before = facts._replace(state=state)
        after = ACTIVE._replace(state=state)
    kernel.facts = before
    made.start()
    made.turn(1500)
    assert made.take() != []
    kernel.facts = facts
    made.error_frame(CanState.BUS_OFF)
    made.turn(950)
    made.gateway.receive_bytes(0, encode(LiveData(1, 2442), WireLayout.V4), made.now, made.now)
    made.turn(10)
    assert made.take() == []
    kernel.facts = after
    made.error_frame(CanState.ERROR_ACTIVE)
    made.turn(1500)
    assert made.take() != []
    made.can.close()


@pytest.mark.parametrize("told_by", ["state of no controller", "nothing", "no rtnetlink"])
def test_forged_bus_off_on_a_virtual_bus_ends_after_a_second(
    kernel: Kernel,
    monkeypatch: pytest.MonkeyPatch,
    told_by: str,
) -> None:
    if told_by == "no rtnetlink":  # as with the buses of python-can
        monkeypatch.setattr(can_controller, "link_monitor", lambda _name: None)
    made = Bench(kernel)
    kernel.facts = ACTIVE._replace(state=None) if told_by == "state of no controller" else None
    made.start()
    made.turn(1500)
    made.take()
    made.error_frame(CanState.BUS_OFF)
    made.turn(950)
    assert made.take() == []
    made.turn(300)
    assert boot_ups_and_emergencies(made.take())[0] == "boot-up"
    assert made.gateway.status.can_state is CanState.ERROR_ACTIVE
    made.turn(3000)
    assert (made.can.controller.due == NEVER) == (told_by == "no rtnetlink"), "nothing to ask"
    made.can.close()


def test_gateway_without_nodes_receives_the_same_ids_after_an_outage(kernel: Kernel) -> None:
    """After the outage, other devices that send its messages are still noticed."""
    bench = Bench(kernel, has_node=False)
    bench.begin()
    before = bench.port
    assert before._ids
    bench.changes(LinkFacts(exists=False), there=False)
    bench.turn(100)
    assert not bench.can.is_open
    bench.changes(ACTIVE)
    bench.turn(1000)
    assert bench.port is not before
    assert bench.port._ids == before._ids
    bench.can.close()


@pytest.mark.promise("one-device")
@pytest.mark.parametrize("wait", [False, True])
def test_port_of_an_esc_is_never_opened_as_a_can_interface(
    bench: Bench,
    wait: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is opened neither at the start nor later, when an adapter is back under another name."""
    opened: list[object] = []
    monkeypatch.setattr(can_opener, "open_can", opened.append)
    bench.can._opener._esc_at = lambda path: "left" if path == bench.can.config.channel else None
    if wait:
        bench.start()
        bench.turn(3000)
        assert not bench.can.is_open
    else:
        with pytest.raises(
            RunError, match="is the port of left, and nothing may be sent to an ESC"
        ):
            bench.can.open(bench.now, wait=False)
    assert opened == []


def test_node_boots_when_an_adapter_unplugged_in_bus_off_is_back(
    bench: Bench,
) -> None:
    """The bus-off ended with the old adapter, so it does not suppress the boot-up."""
    bench.begin()
    bench.goes_off()
    bench.turn(100)
    assert bench.can.controller.is_off
    bench.changes(LinkFacts(exists=False), there=False)
    bench.turn(100)
    assert not bench.can.is_open
    bench.changes(ACTIVE)
    bench.turn(10)
    assert bench.can.is_open
    assert BOOT_UP in bench.take()


def test_frames_discarded_in_an_outage_are_reported_to_the_recorder(
    bench: Bench,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise a replay would contain them."""
    bench.begin()
    told_at: list[int] = []
    hold = bench.gateway.hold

    def noted(now: int) -> None:
        told_at.append(now)
        hold(now)

    monkeypatch.setattr(bench.gateway, "hold", noted)
    bench.turn(100)
    assert told_at == []
    bench.changes(LinkFacts(exists=False), there=False)
    bench.turn(5000)
    assert len(told_at) == 1, "nodes make no frames in an outage"
    for _ in range(2):
        bench.gateway.receive_frame(CanFrame(0, b"\x81\x01"), bench.now, bench.now)
        bench.turn(10)
    assert len(told_at) == 3, "the boot-ups of a reset are discarded"
    bench.changes(ACTIVE)
    bench.turn(100)
    told_at.clear()
    bench.turn(100)
    assert told_at == []


def test_adapter_with_rare_failures_is_opened_after_the_shortest_pause(
    bench: Bench,
) -> None:
    """The adapter's return is not reported. Pauses grow only while no frame can be sent."""
    bench.start()
    for _ in range(5):
        bench.turn(500)
        failed = bench.port
        failed.is_gone = True
        bench.can.serve(bench.now)
        assert not bench.can.is_open
        assert CAN_FD not in bench.world.handlers
        bench.turn(110)
        assert bench.port is not failed


def test_received_frames_are_counted(bench: Bench) -> None:
    bench.start()
    bench.turn(10)
    before = bench.gateway.status.received_frames
    bench.port.came(0x601, bytes(8), at=0)
    bench.port.came(0x601, bytes(8), at=0)
    bench.can.serve(bench.now)
    assert bench.gateway.status.received_frames == before + 2
