"""LSS slaves and a foreign master on a bus of several nodes (CiA 305). More: lss_dialogues/*.txt."""

from types import SimpleNamespace
from typing import Any

import canopen
import canopen.lss
import pytest
from dialogue import QUIET, Bench
from wire import wire_to

UNCONFIGURED = 255


def master_of(bench: Bench) -> Any:
    """A foreign master whose requests all nodes hear."""
    master: Any = wire_to(bench).lss
    master.RESPONSE_TIMEOUT = 0.0002  # what is answered is there before it waits
    return master


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The foreign master pauses 200 ms after each part of an identity, for slow devices."""
    monkeypatch.setattr(canopen.lss, "time", SimpleNamespace(sleep=lambda _: None))


def test_a_foreign_master_finds_each_of_several_slaves_by_fastscan_and_gives_it_a_node_id() -> None:
    bench = Bench(node_ids=[UNCONFIGURED] * 6 + [100], changes=QUIET)
    master = master_of(bench)
    for number in range(1, 7):
        ok, found = master.fast_scan()
        place = found[3] - 77
        assert ok and tuple(found) == bench.nodes[place].identity.identity
        assert [n for n, node in enumerate(bench.nodes) if node.lss.configuring] == [place]
        master.configure_node_id(number)
        assert master.inquire_lss_address(canopen.lss.CS_INQUIRE_SERIAL_NUMBER) == found[3]
        master.send_switch_state_global(master.WAITING_STATE)
        assert bench.nodes[place].node_id == number
    assert master.fast_scan() == (False, None)


def test_a_foreign_master_configures_and_stores() -> None:
    bench = Bench(node_ids=[UNCONFIGURED] * 3, changes=QUIET)
    master = master_of(bench)
    identity = bench.nodes[1].identity.identity
    assert master.send_switch_state_selective(*identity)
    assert [node.lss.configuring for node in bench.nodes] == [False, True, False]
    assert tuple(map(master.inquire_lss_address, range(0x5A, 0x5E))) == identity
    assert master.inquire_node_id() == UNCONFIGURED
    master.configure_node_id(0x2A)
    for refused, value in ((master.configure_node_id, 0), (master.configure_bit_timing, 2)):
        with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
            refused(value)
    master.activate_bit_timing(100)
    master.store_configuration()
    assert [stored.node_id for stored in bench.on_disk] == [None, 0x2A, None]
