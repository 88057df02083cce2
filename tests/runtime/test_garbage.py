"""The hot path makes no garbage in circles: with the collector off, thousands of frames leave nothing that only it could find."""

import gc
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from capture_bench import Bench, made
from statistics_bench import moment_of

from kontronik_can_gw.config.keys import CanConfig, RecordConfig
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import MS
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.runtime.recorder import Recorder
from kontronik_can_gw.runtime.snapshot import snapshot

EVERYTHING = made(2, canopen=True, dronecan={"node_id": 40, "enabled": True})
"""Two ESCs, with messages, CANopen nodes and one of DroneCAN."""


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


def test_frames_recording_and_statistics_leave_no_garbage(tmp_path: Path) -> None:
    """Live and info frames, damaged ones, an unplugged port, a bus in trouble, a master."""
    recorder = Recorder(tmp_path, RecordConfig())
    recorder.start()
    assert recorder._worker.stop(60)
    bench = Bench(*EVERYTHING)
    run = bench.running(7)
    run(2)  # the nodes boot, and what is made once is made
    before, written, begun = None, 0, len(bench.sent)
    with collector_off():
        for _ in range(40):
            entries = len(bench.entries)
            now = run(0.5)
            for entry in bench.entries[entries:]:
                recorder.put(*entry)
            recorder.note(bench.gateway, now)
            recorder.reports(now)
            moment = moment_of(bench.gateway, now)
            written += len(snapshot(moment, before))
            before = moment
        recorder._work([])  # what the thread does each half second; it has ended
        assert garbage() == []
    recorder.close()
    assert len(bench.sent) - begun > 3000
    assert sum(pdos for _, _, pdos in bench.gateway.node_states()) > 1000
    assert recorder.facts.bytes > 50_000
    assert written > 50_000


def test_the_loop_leaves_no_garbage() -> None:
    """With its selector, ports, conditions and the CAN side; python-can's virtual interface in place of a socket."""
    setup, layout = EVERYTHING
    further = [each.make for each in setup.outputs]
    gateway = Gateway(setup.escs, layout, 0, False, setup.canopen, further)
    wires = [encode(LiveData(battery_voltage=n, operating_errors=n % 3), Layout.V4) for n in range(50)]  # fmt: skip
    clock = [0]
    with ExitStack() as ends:
        escs = [ends.enter_context(PtyEsc()) for _ in setup.escs]
        paths, can = [esc.path for esc in escs], CanConfig("virtual", "garbage")
        loop = Loop(gateway, paths, can, clock=lambda: clock[0])
        loop.open()
        loop.begin()
        try:
            with collector_off():
                for turn in range(600):
                    for esc in escs:
                        esc.write(wires[turn % 50] if turn % 90 else b"???")
                    clock[0] += 10 * MS if turn % 200 else 300 * MS
                    loop.turn()
                assert garbage() == []
        finally:
            loop.end()
    assert all(esc.counters.live > 400 for esc in gateway.escs)
