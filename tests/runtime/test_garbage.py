"""The hot path creates no reference cycles.

With the collector off, thousands of frames leave no garbage that only the collector could find.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from capture_bench import Bench, made
from statistics_bench import moment_of
from wire_world import World, loop_in, run

from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.runtime.files.recorder import Recorder
from kontronik_can_gw.runtime.status.snapshot import snapshot
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("memory")

EVERYTHING = made(2, canopen=True, dronecan={"node_id": 40, "enabled": True})
"""Setup and layout of two ESCs with messages, CANopen nodes and a DroneCAN node."""


def garbage() -> list[str]:
    """Return the objects that only the collector finds, each by its type and text."""
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        gc.collect()
        return [f"{type(each).__name__}: {str(each)[:80]}" for each in gc.garbage]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()


@contextmanager
def collector_off() -> Iterator[None]:
    """Collect the garbage so far, then switch the collector off within the block."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def test_frames_recording_and_statistics_leave_no_garbage(tmp_path: Path) -> None:
    """Live, info and damaged frames, an unplugged port, a faulty bus and a master occur."""
    recorder = Recorder(tmp_path, RecordConfig())
    recorder.start()
    assert recorder._worker.stop(60)
    bench = Bench(*EVERYTHING)
    running = bench.running(7)
    running(2)  # the nodes boot, and objects that are created once are created
    before = None
    written = 0
    begun = len(bench.sent)
    with collector_off():
        for _ in range(40):
            entries = len(bench.entries)
            now = running(0.5)
            for entry in bench.entries[entries:]:
                recorder.put(*entry)
            recorder.note(bench.gateway, now)
            recorder.reports(now)
            moment = moment_of(bench.gateway, now)
            written += len(snapshot(moment, before))
            before = moment
        recorder._work([])  # the thread would do this each half second, but it has ended
        assert garbage() == []
    recorder.close()
    assert len(bench.sent) - begun > 3000
    assert sum(pdos for _, _, pdos in bench.gateway.node_states()) > 1000
    assert recorder.facts.bytes > 50_000
    assert written > 50_000


def test_loop_leaves_no_garbage(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop has ports, conditions and a CAN side. Lines stop and resume, and it is held up."""
    setup, layout = EVERYTHING
    world = World(2)
    loop = loop_in(world, monkeypatch, setup.escs, layout, outputs=setup.outputs)
    loop.open()
    loop.begin()
    for second in range(0, 8, 2):
        for wire in world.wires:
            begin = world.now + second * SECOND
            wire.stream(begin, begin + SECOND, 10 * MS)
            wire.put(b"???", [begin + SECOND] * 3)
    run(loop, world, world.now + SECOND)
    with collector_off():
        for _ in range(3):
            run(loop, world, world.now + 2 * SECOND)
            world.now += 300 * MS
        assert garbage() == []
    loop.end()
    assert all(esc.counters.live > 300 for esc in loop.gateway.escs)
