"""A gateway process with two CANopen nodes and the DBC, with the canopen library as master."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import canopen
import pytest
from feeder import Identity
from vcan_tools import EDS, LIMIT_S, canopen_table, chain, wait_for

from kontronik_can_gw.esc.kontronik.codec import WireLayout

pytestmark = pytest.mark.promise("nmt")

BOOT_UP = 0
STATES = {"OPERATIONAL": 5, "STOPPED": 4, "PRE-OPERATIONAL": 127}
PDOS = (0x181, 0x281, 0x381, 0x481)


@contextmanager
def master_on(interface: str) -> Iterator[Any]:
    """Yield a network of the canopen library with the nodes 1 and 2."""
    network: Any = canopen.Network()
    network.connect(interface="socketcan", channel=interface)
    for number in (1, 2):
        network.add_node(number, str(EDS)).sdo.RESPONSE_TIMEOUT = LIMIT_S
    try:
        yield network
    finally:
        network.disconnect()


def test_nmt_commands_change_states_and_heartbeats_show_them(vcan: str, tmp_path: Path) -> None:
    identities = Identity(1), Identity(2, WireLayout.LEGACY, cells=12)
    toml = canopen_table(tmp_path / "store")
    with (
        chain(vcan, tmp_path, *identities, toml=toml) as run,
        master_on(vcan) as master,
        run.running() as gateway,
    ):
        watch = run.watch
        node = master[1]
        wait_for(lambda: len(watch.boot_ups) == 2, "boot-ups")

        def states(number: int = 1) -> list[int]:
            return [frame.data[0] for frame in watch.of(0x700 + number)]

        def go(state: str) -> None:
            begin = len(states())
            node.nmt.state = state
            wait_for(lambda: states()[begin:][-1:] == [STATES[state]], state)

        for each in (1, 2):
            master[each].sdo[0x2100][4].raw = 60_000
        node.sdo[0x1017].raw = 50
        wait_for(lambda: len(states()) >= 6, "heartbeats")
        run.feed(0, times=2)
        assert not any(map(watch.of, PDOS)), "no PDO before OPERATIONAL"
        go("OPERATIONAL")
        run.feed(0, times=2)
        wait_for(lambda: all(map(watch.of, PDOS)), "PDOs")
        go("STOPPED")
        before = len(watch.recorded)
        run.feed(0, times=2)
        master.send_message(0x601, b"\x40\x00\x10\x00\0\0\0\0")  # not answered while STOPPED
        go("PRE-OPERATIONAL")
        assert node.sdo[0x1017].raw == 50
        watch.wait_for_mark()
        after = watch.recorded[before:]
        assert [f.data[1:4].hex() for f in after if f.can_id == 0x581] == ["171000"]
        assert not {f.can_id for f in after} & set(PDOS)
        for command, kept in (("RESET COMMUNICATION", 50_000), ("RESET", 60_000)):
            node.sdo[0x2100][4].raw = 50_000
            node.sdo[0x1017].raw = 50
            begin = len(states())
            node.nmt.state = command
            wait_for(lambda begin=begin: BOOT_UP in states()[begin:], command)  # type: ignore[misc]
            assert (node.sdo[0x1017].raw, node.sdo[0x2100][4].raw) == (1000, kept), command
        assert states(2).count(BOOT_UP) == 1, "the other node has not noticed"
        assert gateway.end() == 0, gateway.log
