"""Captures of a gateway on a real vcan, and their replay: what comes out is what was on the bus."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import can
import cantools.database
import pytest
from vcan_tools import (
    Candump,
    GatewayProcess,
    bench,
    canopen_table,
    configuration,
    ip,
    program,
    wait_for,
)

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.esc.kontronik.simulator import Dropout, EscOptions, Faults

Start = Callable[..., GatewayProcess]
pytestmark = pytest.mark.extended

NOISY = EscOptions(
    faults=Faults(noise=0.5, lost_bytes=0.002, dropout=Dropout(700_000_000, 3_000_000_000))
)


def shipped_message(name: str) -> cantools.database.can.Message:
    database = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
    assert isinstance(database, cantools.database.can.Database)
    return database.get_message_by_name(name)


def frames_of(dump: Candump) -> list[tuple[int, bytes]]:
    return [(frame.can_id, frame.data) for frame in dump.frames]


def by_id(frames: Sequence[tuple[Any, ...]]) -> dict[int, list[bytes]]:
    """The data of each id's frames, in order."""
    found: dict[int, list[bytes]] = {}
    for can_id, data, *_ in frames:
        found.setdefault(can_id, []).append(data)
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
        with bench(NOISY, EscOptions()) as run:
            tables = canopen_table(tmp_path / "store", more="self_start = true")
            with Candump(vcan) as live:
                toml = configuration(vcan, [port.path for port in run.ports], tables, esc="")
                gateway = start_gateway(toml, "--record", str(folder))
                gateway.wait_for_line("esc2: /dev/pts")
                run.start()
                wait_for(lambda: len(run.live(0)) > 300, "telemetry")
                assert gateway.end() == 0
        on_bus = frames_of(live)
        assert len(on_bus) > 500
        # through the core, as a log
        log = tmp_path / "again.log"
        done = program("convert", folder, log)
        assert done.returncode == 0, done.stderr
        with can.LogReader(log) as reader:
            logged = [(m.arbitration_id, bytes(m.data)) for m in reader]
        # what waited while the process was held up was not sent; a replay is not held up
        was, is_now = by_id(on_bus), by_id(logged)
        assert was == is_now or "suspended" in gateway.log
        assert all(is_part(data, is_now[can_id]) for can_id, data in was.items())
        # on another bus, in real time times three
        for marked in (False, True):
            with Candump(second_vcan) as replayed:
                words = f"--on can --channel {second_vcan} --speed 3".split()
                done = program("replay", folder, *words, *([] if marked else ["--unmarked"]))
                assert done.returncode == 0, done.stderr
                assert f"{len(logged)} frames to {second_vcan}" in done.stderr
                wait_for(lambda r=replayed: len(r.frames) >= len(logged), "all frames")  # type: ignore[misc]
            if not marked:
                assert by_id(frames_of(replayed)) == by_id(logged)
                continue
            state = shipped_message("GatewayStatus")
            shown, were = by_id(frames_of(replayed)), by_id(logged)
            assert shown.keys() == were.keys()
            differing = {can_id for can_id in were if shown[can_id] != were[can_id]}
            # TPDO 4 has the link status, in which bit 6 says replay
            assert differing == {state.frame_id, 0x481, 0x482}
            states = [
                str(state.decode_simple(data)["GatewayState"])
                for can_id, data in frames_of(replayed)
                if can_id == state.frame_id
            ]
            assert set(states[:-1]) == {"Replay"}
    finally:
        ip("link", "del", second_vcan)
