"""The hot path makes no garbage in circles: with the collector off, thousands of frames leave nothing that only it could find."""

import gc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from kontronik_can_gw.config.assemble import Loaded, assemble
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway, MakeOutput
from kontronik_can_gw.gateway_status import CanState
from kontronik_can_gw.runtime.facts import CanFacts, PortFacts, ProgramFacts, gateway_facts
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.runtime.process import ProcessFacts
from kontronik_can_gw.runtime.recorded_gateway import RecordedGateway
from kontronik_can_gw.runtime.recorder import Recorder, RecordSettings
from kontronik_can_gw.runtime.snapshot import Moment, snapshot

FRAMES = 3000
START = range(1, 100)
"""Turns in which the nodes boot and what is made once is made."""
STEADY = range(100, 100 + FRAMES)
LIVE = [
    encode(
        LiveData(electrical_speed=n * 100, battery_voltage=2000 + n, operating_errors=n % 3),
        Layout.V4,
    )
    for n in range(50)
]
INFO = encode(InfoData(device_and_variant=1 << 10, firmware_word=0x0203), Layout.V4)


def garbage() -> list[str]:
    """What only the collector finds now, each by its type and text."""
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        gc.collect()
        return [f"{type(each).__name__}: {str(each)[:80]}" for each in gc.garbage]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()


@contextmanager
def collector_off() -> Iterator[None]:
    """Nothing is collected inside, and what was left over before is away."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def loaded(folder: Path) -> Loaded:
    """Two ESCs, with messages, CANopen nodes and one of DroneCAN."""
    canopen = {"enabled": True, "store": str(folder / "store"), "self_start": True}
    escs = [{"port": "a"}, {"port": "b"}]
    can = {"bitrate": 1_000_000}
    return assemble(
        parse(
            {
                "esc": escs,
                "can": can,
                "canopen": canopen,
                "dronecan": {"node_id": 40, "enabled": True},
            },
            "test",
        )
    )


def further(setup: Loaded) -> list[MakeOutput]:
    return [each.make for each in setup.outputs]


def drive(gateway: Gateway, turns: range, each_turn: Callable[[int, int], object]) -> int:
    """Live and info frames, damaged ones, silence, an unplugged port, a bus in trouble, a master; the CAN frames that came of it."""
    sent = 0
    for turn in turns:
        now = turn * 10 * MS + turn // 501 * SECOND
        esc, wire = turn % 2, LIVE[turn % 50]
        if turn % 100 < 2:
            wire = INFO + wire
        if turn % 97 == 0:
            wire = wire[:9] + b"?" + wire[10:]
        gateway.receive_bytes(esc, wire, now, now)
        if turn % 700 == 0:
            gateway.port(esc, False, now)
            gateway.port(esc, True, now)
        if turn % 300 == 0:
            gateway.set_can_state(CanState.BUS_OFF if turn % 600 else CanState.ERROR_ACTIVE, now)
        if turn % 50 == 0:
            for request in ("4018100100000000", "4008100000000000", "4000400000000000"):
                gateway.receive_frame(CanFrame(0x601 + esc, bytes.fromhex(request)), now, now)
            gateway.receive_frame(CanFrame(0x000, bytes([1, 0])), now, now)
        gateway.advance(now)
        gateway.take_link_changes()
        gateway.conflicts.take()
        gateway.take_saves()
        sent += len(gateway.take_frames(now))
        each_turn(turn, now)
    return sent


def test_a_circle_would_be_found() -> None:
    class Circle:
        def __init__(self) -> None:
            self.me = self

    with collector_off():
        Circle()
        assert any("Circle object" in found for found in garbage())


def test_frames_recording_and_statistics_leave_no_garbage(tmp_path: Path) -> None:
    setup = loaded(tmp_path)
    recorder = Recorder(RecordSettings(tmp_path / "captures"))
    gateway = RecordedGateway(
        recorder.put, setup.escs, setup.layout, 0, False, setup.canopen, further(setup)
    )
    recorder.start()
    assert recorder._worker.stop(60)

    ports = [PortFacts(esc.name, "/dev/ttyUSB0", True) for esc in setup.escs]
    facts = {"wall": 0.0, "program": ProgramFacts("x"), "process": ProcessFacts(), "ports": ports}
    can = CanFacts("socketcan", "can0", 500_000, True)
    before: list[Moment] = []
    written = 0

    def each_turn(turn: int, now: int) -> None:
        nonlocal written
        if turn % 10 == 0:
            recorder.note(gateway, now)
            recorder.reports(now)
        if turn % 20 == 0:
            moment = Moment(gateway_facts(gateway), now=now, can=can, **facts)  # type: ignore[arg-type]
            written += len(snapshot(moment, before[-1] if before else None))
            before[:] = [moment]

    try:
        gateway.start(0)
        drive(gateway, START, each_turn)
        with collector_off():
            sent = drive(gateway, STEADY, each_turn)
            recorder._work([])  # what the thread does each half second; it has ended
            assert garbage() == []
    finally:
        recorder.close()
    assert sent > FRAMES
    assert sum(pdos for _, _, pdos in gateway.node_states()) > FRAMES
    assert recorder.facts.bytes >= 10 * FRAMES
    assert written > 100_000


def test_the_loop_leaves_no_garbage(tmp_path: Path) -> None:
    """With its selector, ports, conditions and the CAN side; python-can's virtual interface in place of a socket."""
    setup = loaded(tmp_path)
    gateway = Gateway(setup.escs, setup.layout, 0, False, setup.canopen, further(setup))
    clock = [0]
    with ExitStack() as ends:
        escs = [ends.enter_context(PtyEsc()) for _ in setup.escs]
        loop = Loop(
            gateway,
            [esc.path for esc in escs],
            CanConfig("virtual", "garbage"),
            clock=lambda: clock[0],
        )
        loop.open()
        loop.begin()
        try:
            with collector_off():
                for turn in range(600):
                    for esc in escs:
                        esc.write(LIVE[turn % 50] if turn % 90 else b"???")
                    clock[0] += 10 * MS if turn % 200 else 300 * MS
                    loop.turn()
                assert garbage() == []
        finally:
            loop.end()
    assert all(esc.counters.live > 400 for esc in gateway.escs)
