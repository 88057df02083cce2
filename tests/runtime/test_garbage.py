"""The hot path makes no garbage in circles: with the collector off, thousands of frames leave nothing that only it could find."""

import gc
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from kontronik_can_gw.config.assemble import Loaded, assemble
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import MS
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.loop import Loop

LIVE = [
    encode(
        LiveData(electrical_speed=n * 100, battery_voltage=2000 + n, operating_errors=n % 3),
        Layout.V4,
    )
    for n in range(50)
]


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
    """Two ESCs, with messages and nodes."""
    canopen = {"enabled": True, "store": str(folder / "store"), "self_start": True}
    escs = [{"port": "a"}, {"port": "b"}]
    can = {"bitrate": 1_000_000}
    return assemble(parse({"esc": escs, "can": can, "canopen": canopen}, "test"))


def test_the_loop_leaves_no_garbage(tmp_path: Path) -> None:
    """With its selector, ports, conditions and the CAN side; python-can's virtual interface in place of a socket."""
    setup = loaded(tmp_path)
    gateway = Gateway(setup.escs, setup.layout, 0, False, setup.canopen)
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
