"""Memory does not grow with the received frames.

The test counts allocations, so it does not depend on the speed of the machine.
"""

import gc
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import wire_world
from capture_bench import made
from wire_world import World, loop_in, run

from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
from kontronik_can_gw.config.keys import RecordConfig
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.runtime.files.recorder import Recorder
from kontronik_can_gw.runtime.housekeeping import COLLECT_NS
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("memory")

LIVE_EACH = 40 * MS
EVENTS_A_SECOND = 2 * (SECOND // LIVE_EACH + 1)
"""Live and info frames of two ESCs in a second."""
ONCE = 60
"""Blocks that may be allocated once at any time, for a number above 256 or a list that grows."""


class Everything:
    """A recorded gateway with two ESCs, CANopen nodes and DroneCAN, in a World without a clock."""

    def __init__(self, patch: pytest.MonkeyPatch, folder: Path) -> None:
        setup, layout = made(2, True, dronecan={"enabled": True, "node_id": 42})
        self.world = world = World(2)
        self.recorder = Recorder(folder, RecordConfig(), clock=world.clock)
        patch.setattr(wire_world, "Gateway", partial(RecordedGateway, self.recorder.put))
        self.loop = loop_in(world, patch, setup.escs, layout, outputs=setup.outputs)
        self.loop._housekeeping._recorder = self.recorder
        self.loop.open()
        self.loop.begin()
        self.count = 0

    def pass_second(self) -> None:
        """Let a second pass, in which values and an error bit change.

        The World's own records are discarded.
        """
        world = self.world
        begin = self.world.now
        for wire in world.wires:
            del wire.arrivals[: wire._read], wire._bytes[: wire._read]
            wire._read = 0
            wire.looks.clear()
            for at in range(begin, begin + SECOND, LIVE_EACH):
                self.count += 1
                errors = (self.count // 37 % 2) << 20
                live = LiveData(electrical_speed=self.count % 90_000, operating_errors=errors)
                self._put(wire, encode(live, WireLayout.V4), at)
            self._put(wire, encode(InfoData(), WireLayout.V4), begin + SECOND - 5 * MS)
        world.bus.sent.clear()
        del world.looks[:-2]
        run(self.loop, world, begin + SECOND)
        self.recorder._work([])  # the work of the recorder's thread

    def _put(self, wire: wire_world.Wire, data: bytes, at: int) -> None:
        wire.put(data, [at + (n + 1) * wire_world.NS_PER_BYTE for n in range(len(data))])


@pytest.fixture
def settled() -> Iterator[None]:
    """Switch off automatic full collections, as the program does at its start."""
    gc.collect()
    gc.freeze()
    before = gc.get_threshold()
    gc.set_threshold(before[0], before[1], (1 << 31) - 1)
    yield
    gc.set_threshold(*before)
    gc.unfreeze()


@pytest.mark.parametrize("core_language", ["C", "Python"], indirect=True)
def test_thousand_events_leave_no_allocation(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    settled: None,
    core_language: str,
) -> None:
    """Blocks are counted at the full collections of two minutes in succession."""
    del settled, core_language
    it = Everything(monkeypatch, tmp_path)
    collected: list[int] = []
    collect = gc.collect

    def counted() -> int:
        found = collect()
        collected.append(sys.getallocatedblocks())
        return found

    monkeypatch.setattr(gc, "collect", counted)
    for _ in range(3 * COLLECT_NS // SECOND + 3):
        it.pass_second()
    sent = it.loop.gateway.status.sent_frames
    it.loop.close()
    assert sent > 10_000
    assert len(collected) == 3, "one a minute"
    thousands = COLLECT_NS // SECOND * EVENTS_A_SECOND // 1000
    assert thousands >= 3
    growth = collected[2] - collected[1]
    assert growth < ONCE, f"{growth} blocks in {thousands} 000 events"
