"""What CANopen nodes keep on disk over restarts, node-IDs given by LSS, and the first answer of a node. (Damage, a full or a read-only
disk, kill -9: the fault programme and the dialogues.)"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from canopen.lss import LssError
from encoding import Identity
from vcan_tools import (
    LIMIT_S,
    SERIAL,
    Chain,
    GatewayProcess,
    Master,
    canopen_table,
    chain,
    wait_for,
)

SAVE, LOAD = (int.from_bytes(word, "little") for word in (b"save", b"load"))
PRODUCT, REVISION = 0x4B4F4E01, 0x00010000
KEPT = ((0x1017, 0), (0x2100, 1), (0x2100, 2), (0x2100, 3), (0x1804, 1), (0x1A04, 0), (0x1A04, 1))
DEFAULTS = [1000, 7, 49, 5, 0xC0000000, 0, 0]
SAVED = [200, 11, 5, 2, 0x400001F1, 2, 0x20200108]


@contextmanager
def started(run: Chain) -> Iterator[GatewayProcess]:
    """A gateway whose node has sent its boot-up: from there on a master may ask."""
    boot_ups = len(run.watch.boot_ups)
    with run.running() as gateway:
        wait_for(lambda: len(run.watch.boot_ups) > boot_ups, "a boot-up")
        yield gateway


def test_what_is_saved_is_there_after_a_restart_and_gone_when_restored(
    vcan: str, tmp_path: Path
) -> None:
    with (
        chain(vcan, tmp_path, Identity(1), toml=canopen_table(tmp_path / "store")) as run,
        Master(vcan) as master,
    ):

        def kept() -> list[int]:
            return [master.number(1, *where) for where in KEPT]

        with started(run) as gateway:
            assert kept() == DEFAULTS
            master.write(1, 0x1017, 0, 200, 2)
            for sub, value, size in ((1, 11, 1), (2, 5, 4), (3, 2, 4)):
                master.write(1, 0x2100, sub, value, size)
            spare = master.node(1).tpdo[5]
            spare.read()
            spare.clear()
            spare.add_variable(0x2020, 1)
            spare.add_variable(0x2021, 1)
            spare.cob_id, spare.enabled, spare.event_timer = 0x1F1, True, 100
            spare.save()
            assert kept() == SAVED
            master.write(1, 0x1010, 1, SAVE, 4)
            master.write(1, 0x2100, 1, 99, 1)  # not saved
            gateway.wait_for_line("esc1: parameters stored")
            assert gateway.end() == 0
        with started(run) as gateway:
            assert kept() == SAVED
            gateway.wait_for_line("esc1: pole_pairs is 11")
            master.node(1).nmt.state = "OPERATIONAL"
            wait_for(lambda: len(run.watch.of(0x1F1)) > 3, "the PDO that was saved")
            master.write(1, 0x1011, 1, LOAD, 4)
            assert kept() == SAVED, "defaults come with the reset"
            boot_ups = len(run.watch.boot_ups)
            master.node(1).nmt.state = "RESET"
            wait_for(lambda: len(run.watch.boot_ups) > boot_ups, "a boot-up")
            assert kept() == DEFAULTS
            assert gateway.end() == 0
        with started(run):
            assert kept() == DEFAULTS


def test_lss_names_nodes_and_what_it_stored_holds_after_a_restart(
    vcan: str, tmp_path: Path
) -> None:
    """By selection, whose answers are waited for. What is not there shows by no answer: fastscan is tried by masters of others."""
    toml = canopen_table(tmp_path / "store", 255)
    with chain(vcan, tmp_path, Identity(1), Identity(2), toml=toml) as run, Master(vcan) as master:
        run.watch._nodes = set(range(1, 128))
        lss = master.network.lss
        lss.RESPONSE_TIMEOUT = LIMIT_S
        with run.running() as gateway:
            wait_for(lambda: gateway.log.count("waits for LSS") == 2, "the log lines")
            # NMT start of all, SYNC, SDO: none of a node without an ID
            for can_id, data in (
                (0, b"\x01\x00"),
                (0x80, b""),
                (0x67F, b"\x40\x00\x10\x00\0\0\0\0"),
            ):
                master.network.send_message(can_id, data)
            for number, node in ((1, 0x21), (0, 0x05)):
                assert lss.send_switch_state_selective(0, PRODUCT, REVISION, SERIAL + number)  # type: ignore[no-untyped-call]
                assert lss.inquire_node_id() == 255  # type: ignore[no-untyped-call]
                with pytest.raises(LssError):
                    lss.configure_node_id(128)  # type: ignore[no-untyped-call]
                lss.configure_node_id(node)  # type: ignore[no-untyped-call]
                lss.store_configuration()  # type: ignore[no-untyped-call]
                assert node not in {each for _, each in run.watch.boot_ups}, (
                    "it holds when the configuration state is left"
                )
                lss.send_switch_state_global(lss.WAITING_STATE)  # type: ignore[no-untyped-call]
                wait_for(
                    lambda node=node: node in {each for _, each in run.watch.boot_ups},  # type: ignore[misc]
                    "a boot-up",
                )
                assert master.number(node, 0x1018, 4) == SERIAL + number
            sent = {frame.can_id for frame in run.watch.recorded} - run.watch.table.keys()
            said = {0, 0x80, 0x67F, 0x7E4, 0x7E5, 0x605, 0x585, 0x621, 0x5A1, 0x705, 0x721}
            assert sent <= said, "silent but for LSS, boot-up and heartbeat, SDO"

            # a configured node's new ID holds from the next reset of its communication on
            assert lss.send_switch_state_selective(0, PRODUCT, REVISION, SERIAL)  # type: ignore[no-untyped-call]
            with pytest.raises(LssError):
                lss.configure_node_id(0x21)  # type: ignore[no-untyped-call]  # the other node's
            lss.configure_node_id(0x28)  # type: ignore[no-untyped-call]
            lss.send_switch_state_global(lss.WAITING_STATE)  # type: ignore[no-untyped-call]
            assert [master.number(5, 0x2101, sub) for sub in (1, 2)] == [5, 0x28]
            assert not run.watch.of(0x728)
            master.node(5).nmt.state = "RESET COMMUNICATION"
            wait_for(lambda: run.watch.of(0x728), "a boot-up with the new ID")
            assert master.number(0x28, 0x1018, 4) == SERIAL
            assert gateway.end() == 0
        run.watch.boot_ups.clear()
        with run.running():
            wait_for(lambda: len(run.watch.boot_ups) == 2, "boot-ups with what LSS stored")
            assert {node for _, node in run.watch.boot_ups} == {5, 0x21}
            assert [master.number(node, 0x1018, 4) for node in (5, 0x21)] == [SERIAL, SERIAL + 1]
