"""ESCs -> gateway process with two CANopen nodes, the DBC beside them -> vcan -> the canopen library as master."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from encoding import Identity
from vcan_tools import Chain, Master, Recorded, canopen_table, chain, wait_for

from kontronik_can_gw.esc.kontronik.codec import Layout

BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
COMMANDS = {OPERATIONAL: "OPERATIONAL", STOPPED: "STOPPED", PRE_OPERATIONAL: "PRE-OPERATIONAL"}
TPDO1, TPDO2, TPDO3, TPDO4 = 0x180, 0x280, 0x380, 0x480
PDOS = (TPDO1, TPDO2, TPDO3, TPDO4)
TIMEOUT = 0x2100, 4


class Nodes:
    """The running gateway, and what a test asks of it."""

    def __init__(self, run: Chain, master: Master) -> None:
        self.run, self.master, self.watch = run, master, run.watch
        self.begin = len(run.watch.recorded)

    def of(self, can_id: int) -> list[Recorded]:
        """Frames since the test's beginning."""
        return [frame for frame in self.watch.recorded[self.begin :] if frame.can_id == can_id]

    def states(self, node: int) -> list[int]:
        return [frame.data[0] for frame in self.of(0x700 + node)]

    def go(self, node: int, state: int) -> None:
        """Command a state and wait for the heartbeat that tells it."""
        begin = len(self.states(node))
        self.master.node(node).nmt.state = COMMANDS[state]
        wait_for(
            lambda: self.states(node)[begin:][-1:] == [state], f"node {node} {COMMANDS[state]}"
        )


@pytest.fixture
def nodes(vcan: str, tmp_path: Path) -> Iterator[Nodes]:
    identities = Identity(1), Identity(2, Layout.LEGACY, cells=12)
    with (
        chain(vcan, tmp_path, *identities, toml=canopen_table(tmp_path / "store")) as run,
        Master(vcan) as master,
        run.running() as gateway,
    ):
        wait_for(lambda: len(run.watch.boot_ups) == 2, "boot-ups")
        for node in (1, 2):
            master.write(node, *TIMEOUT, 60_000, 2)
        yield Nodes(run, master)
        assert gateway.end() == 0, gateway.log


def test_heartbeats_and_nmt_commands(nodes: Nodes) -> None:
    master = nodes.master
    master.write(1, 0x1017, 0, 50, 2)
    wait_for(lambda: len(nodes.states(1)) >= 5, "heartbeats")
    assert set(nodes.states(1)) == {PRE_OPERATIONAL}
    nodes.run.feed(0, times=2)
    assert [nodes.of(pdo + 1) for pdo in PDOS] == [[]] * 4, "no PDO before OPERATIONAL"
    nodes.go(1, OPERATIONAL)
    nodes.run.feed(0, times=2)
    wait_for(lambda: all(nodes.of(pdo + 1) for pdo in PDOS), "PDOs")
    nodes.go(1, STOPPED)
    before = len(nodes.watch.recorded)
    nodes.run.feed(0, times=2)
    master.network.send_message(0x601, b"\x40\x00\x10\x00\0\0\0\0")  # while STOPPED: never answered
    nodes.go(1, PRE_OPERATIONAL)
    assert master.number(1, 0x1017) == 50
    nodes.run.catch_up()
    after = nodes.watch.recorded[before:]
    assert [f.data[1:4].hex() for f in after if f.can_id == 0x581] == ["171000"]
    assert not {f.can_id for f in after} & {pdo + 1 for pdo in PDOS}
    for command, kept in (("RESET COMMUNICATION", 50_000), ("RESET", 60_000)):
        master.write(1, *TIMEOUT, 50_000, 2)
        master.write(1, 0x1017, 0, 50, 2)
        begin = len(nodes.states(1))
        master.node(1).nmt.state = command
        wait_for(lambda begin=begin: BOOT_UP in nodes.states(1)[begin:], command)  # type: ignore[misc]
        assert (master.number(1, 0x1017), master.number(1, *TIMEOUT)) == (1000, kept), command
    assert BOOT_UP not in nodes.states(2), "the other node has not noticed"
