"""Captures of a gateway on a real vcan, and their replay: what comes out is what was on the bus."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import can
import cantools.database
import pytest
from vcan_tools import (
    GatewayProcess,
    Recorded,
    bench,
    canopen_table,
    configuration,
    ip,
    program,
    recording,
    wait_for,
)

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.esc.kontronik.simulator import Dropout, EscOptions, Faults

Start = Callable[..., GatewayProcess]
pytestmark = pytest.mark.extended

NOISY = EscOptions(
    faults=Faults(noise=0.5, lost_bytes=0.002, dropout=Dropout(700_000_000, 3_000_000_000))
)


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
        with bench(NOISY, EscOptions()) as run:
            tables = canopen_table(tmp_path / "store", more="self_start = true")
            with recording(vcan) as live:
                toml = configuration(vcan, [port.path for port in run.ports], tables, esc="")
                gateway = start_gateway(toml, "--record", str(folder))
                gateway.wait_for_line("esc2: /dev/pts")
                run.start()
                wait_for(lambda: len(run.live(0)) > 300, "telemetry")
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
        database: Any = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
        status = database.get_message_by_name("GatewayStatus")
        # on another bus, in real time times three
        for marked in ([], ["--unmarked"]):
            with recording(second_vcan) as replayed:
                words = f"--on can --channel {second_vcan} --speed 3".split()
                done = program("replay", folder, *words, *marked)
                assert done.returncode == 0, done.stderr
                assert f"{len(logged)} frames to {second_vcan}" in done.stderr
            shown = by_id(replayed.recorded)
            # TPDO 4 has the link status, in which bit 6 says replay
            says_so = set() if marked else {status.frame_id, 0x481, 0x482}
            assert shown.keys() == is_now.keys()
            assert {each for each in shown if shown[each] != is_now[each]} == says_so
            states = [status.decode_simple(data) for data in shown[status.frame_id]]
            is_replay = {str(state["GatewayState"]) == "Replay" for state in states[:-1]}
            assert is_replay == {not marked}
    finally:
        ip("link", "del", second_vcan)
