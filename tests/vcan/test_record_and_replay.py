"""Captures of a gateway on a real vcan, and their replay: what comes out is what was on the bus."""

import random
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import can
import pytest
from vcan_tools import (
    GatewayProcess,
    Recorded,
    canopen_table,
    configuration,
    feeding,
    ip,
    program,
    recording,
    wait_for,
)

Start = Callable[..., GatewayProcess]
pytestmark = pytest.mark.extended

chance = random.Random(1)


def noisy(wire: bytes) -> tuple[bytes, bool]:
    """A frame, now and then without its first byte and after noise."""
    if chance.random() < 0.9:
        return wire, True
    return chance.randbytes(9) + wire[1:], False


def by_id(frames: Iterable[Recorded]) -> dict[int, list[bytes]]:
    """The data of each id's frames, in order."""
    found: dict[int, list[bytes]] = {}
    for frame in frames:
        found.setdefault(frame.can_id, []).append(frame.data)
    return found


def is_part(some: Sequence[bytes], whole: Sequence[bytes]) -> bool:
    """Whether these are among the others in the same order."""
    others = iter(whole)
    return all(any(other == each for other in others) for each in some)


@pytest.fixture
def second_vcan(vcan: str) -> str:
    name = f"{vcan}b"
    ip("link", "add", name, "type", "vcan")
    ip("link", "set", name, "up")
    return name


def test_a_replay_is_what_was_on_the_bus_frame_by_frame(
    vcan: str, second_vcan: str, start_gateway: Start, tmp_path: Path
) -> None:
    folder = tmp_path / "captures"
    try:
        with feeding(tmp_path, 2) as ports:
            tables = canopen_table(tmp_path / "store", more="self_start = true")
            with recording(vcan) as live:
                toml = configuration(vcan, ports, tables, esc="")
                gateway = start_gateway(toml, "--record", str(folder))
                gateway.wait_for_line("esc2: /")
                ports[0].mangle = noisy
                ports[0].on = ports[1].on = True
                wait_for(lambda: len(ports[0].sent) > 150, "telemetry")
                ports[0].on = False
                wait_for(lambda: "telemetry lost" in gateway.log, "its loss")
                ports[0].on = True
                wait_for(lambda: len(ports[0].sent) > 300, "telemetry again")
                assert gateway.end() == 0
        assert len(live.recorded) > 500
        # through the core, as a log
        log = tmp_path / "again.log"
        done = program("convert", folder, log)
        assert done.returncode == 0, done.stderr
        with can.LogReader(log) as reader:
            logged = [Recorded(0, m.arbitration_id, bytes(m.data)) for m in reader]
        # what waited while the process was held up was not sent; a replay is not held up
        was, is_now = by_id(live.recorded), by_id(logged)
        assert was == is_now or "suspended" in gateway.log
        assert all(is_part(data, is_now[can_id]) for can_id, data in was.items())
        # on another bus, in real time times three
        with recording(second_vcan) as replayed:
            words = f"--on can --channel {second_vcan} --speed 3 --unmarked".split()
            done = program("replay", folder, *words)
            assert done.returncode == 0, done.stderr
            assert f"{len(logged)} frames to {second_vcan}" in done.stderr
        assert by_id(replayed.recorded) == is_now
    finally:
        ip("link", "del", second_vcan)
