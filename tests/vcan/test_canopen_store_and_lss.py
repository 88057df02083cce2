"""Parameters and node-IDs on disk, over restarts, kill -9, damage and a read-only folder; LSS with the canopen library as master."""

import os
import random
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from canopen.lss import LssError, LssMaster
from sdo_poller import Sdo
from vcan_tools import (
    SERIAL,
    Candump,
    GatewayProcess,
    Master,
    canopen_configuration,
    gateway_process,
    nodes_running,
    wait_for,
)

from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.simulator import EscOptions

SAVE, LOAD = (int.from_bytes(word, "little") for word in (b"save", b"load"))
NO_DBC = "[dbc]\nenabled = false"
HARDWARE, DEVICE_STATE = 0x06060000, 0x08000022
BOOT_UP = b"\0"
PRODUCT, REVISION = 0x4B4F4E01, 0x00010000
KILLS = 10
SLACK_S = 0.15


@contextmanager
def one_node(vcan: str, folder: Path) -> Iterator[tuple[str, Master, Candump]]:
    """The configuration text of a gateway with one node and a silent ESC, that may be started again and again."""
    with PtyEsc() as port, Candump(vcan) as dump, Master(vcan) as master:
        yield canopen_configuration(vcan, [port.path], folder / "store", dbc=NO_DBC), master, dump


@contextmanager
def started(toml: str, folder: Path, dump: Candump) -> Iterator[GatewayProcess]:
    begin = len(dump.of(0x701))
    with gateway_process(folder / "gateway.toml", toml) as gateway:
        wait_for(lambda: len(dump.of(0x701)) > begin, 5, "a boot-up")
        yield gateway


def test_what_is_saved_is_there_after_a_restart_and_gone_when_restored(vcan: str, tmp_path: Path) -> None:
    def kept(master: Master) -> list[int]:
        return [
            master.number(1, *where)
            for where in ((0x1017, 0), (0x2100, 1), (0x2100, 2), (0x2100, 3), (0x1804, 1), (0x1A04, 0), (0x1A04, 1))
        ]

    saved = [200, 11, 5, 2, 0x400001F1, 2, 0x20200108]
    with one_node(vcan, tmp_path) as (toml, master, dump):
        with started(toml, tmp_path, dump) as gateway:
            defaults = kept(master)
            assert defaults == [1000, 7, 49, 5, 0xC0000000, 0, 0]
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
            assert kept(master) == saved
            master.write(1, 0x1010, 1, SAVE, 4)
            master.write(1, 0x2100, 1, 99, 1)  # not saved
            gateway.wait_for_line("esc1: parameters stored", 3)
            assert gateway.end() == 0
        with started(toml, tmp_path, dump) as gateway:
            assert kept(master) == saved
            gateway.wait_for_line("esc1: pole_pairs is 11", 3)
            master.node(1).nmt.state = "OPERATIONAL"
            wait_for(lambda: len(dump.of(0x1F1)) > 5, 3, "the PDO that was saved")
            assert dump.of(0x1F1)[-1].data[0] & 0x0F == 0
            master.write(1, 0x1011, 1, LOAD, 4)
            assert kept(master) == saved, "defaults come with the reset"
            master.node(1).nmt.state = "RESET"
            wait_for(lambda: dump.of(0x701)[-1].data == BOOT_UP, 2, "a boot-up")
            assert kept(master) == defaults
            assert gateway.end() == 0
        with started(toml, tmp_path, dump):
            assert kept(master) == defaults


def whole(sdo: Sdo) -> set[int]:
    """The generations that the five stored objects are of; one if what is stored is whole."""
    found = set()
    for index, sub, base in GENERATION:
        answer = sdo.upload(1, index, sub)
        assert answer is not None
        assert answer[0] & 0xE0 == 0x40, answer.hex()
        found.add(int.from_bytes(answer[4:], "little") - base)
    return found


GENERATION = ((0x1017, 0, 1000), (0x1805, 5, 0), (0x2100, 2, 0), (0x2100, 4, 300), (0x2100, 8, 0))
"""Objects of both parts of the store; generation n writes base + n into each."""


def test_killed_at_any_instant_of_saving_old_or_new_is_there_and_never_a_half(vcan: str, tmp_path: Path) -> None:
    chance = random.Random(301)
    confirmed, asked = 1, 1
    in_flight = 0
    sdo = Sdo(vcan, 0x581)

    def download(index: int, sub: int, value: int) -> bool:
        size = 4 if index == 0x1010 or (index, sub) == (0x2100, 2) else 2
        content = value.to_bytes(size, "little")
        sdo.send(1, 0x23 | (4 - size) << 2, index & 0xFF, index >> 8, sub, *content)
        answer = sdo.receive(0.4)
        assert answer is None or answer[1][0] == 0x60, answer
        return answer is not None

    with one_node(vcan, tmp_path) as (toml, _, dump):
        for kill in range(KILLS + 1):
            with started(toml, tmp_path, dump) as gateway:
                if kill:
                    assert "defaults" not in gateway.log
                    there = whole(sdo)
                    assert len(there) == 1, f"a half: {there}"
                    assert there <= {confirmed, asked}, "what was confirmed is gone"
                    confirmed = asked = there.pop()
                if kill == KILLS:
                    break
                process = gateway.process
                # each second time at any instant of the loop, else close to that of a save
                at_a_save = kill % 2 == 0
                death = threading.Timer(chance.random() * (0.002 if at_a_save else 0.2), process.kill)
                if not at_a_save:
                    death.start()
                armed = not at_a_save
                begin = confirmed
                running = True
                while running:
                    generation = asked + 1
                    running = all(download(index, sub, base + generation) for index, sub, base in GENERATION)
                    if not running:
                        break
                    asked = generation
                    if not armed and confirmed > begin:
                        death.start()
                        armed = True
                    running = download(0x1010, 1, SAVE)
                    confirmed = generation if running else confirmed
                    in_flight += not running
                assert process.wait(2) == -9
    sdo.close()
    print(f"{KILLS} kills, {in_flight} of them while a save was under way, {confirmed} generations")
    assert confirmed > KILLS


def test_a_damaged_file_gives_defaults_an_emergency_and_a_kept_copy(vcan: str, tmp_path: Path) -> None:
    file = tmp_path / "store" / "esc1.params"
    with one_node(vcan, tmp_path) as (toml, master, dump):
        with started(toml, tmp_path, dump) as gateway:
            master.write(1, 0x2100, 1, 11, 1)
            master.write(1, 0x1010, 1, SAVE, 4)
            gateway.end()
        content = file.read_bytes()
        damaged = content.replace(b'"0B"', b'"0C"')
        assert damaged != content
        for spoiled in (damaged, content[:-20], b""):
            file.write_bytes(spoiled)
            dump.frames.clear()
            with started(toml, tmp_path, dump) as gateway:
                wait_for(lambda: len(dump.of(0x81)) == 1, 2, "an emergency")
                assert dump.of(0x81)[0].data == bytes((0x00, 0x63, 0x01, 0xFF, 0, 0, 0, 0))
                assert master.number(1, 0x1003, 1) & 0xFFFF == 0x6300
                assert master.number(1, 0x2100, 1) == 7
                lines = [line for line in gateway.lines if "stored parameters" in line]
                assert len(lines) == 1
                assert "esc1.params" in lines[0]
                assert "Running on defaults" in lines[0]
                assert (tmp_path / "store" / "esc1.params.damaged").read_bytes() == spoiled
                master.write(1, 0x2100, 1, 12, 1)
                master.write(1, 0x1010, 1, SAVE, 4)
                wait_for(lambda: len(dump.of(0x81)) == 2, 2, "0000h")
                assert dump.of(0x81)[1].data[:3] == bytes(3)
                gateway.end()
        with started(toml, tmp_path, dump):
            assert master.number(1, 0x2100, 1) == 12


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A folder that nobody can write to; for root, who may write everywhere, by a read-only mount."""
    folder.mkdir()
    if os.geteuid():
        folder.chmod(0o555)
        yield
        folder.chmod(0o755)
        return
    subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "none", str(folder)], check=True)
    yield
    subprocess.run(["umount", str(folder)], check=True)


def test_a_read_only_folder_refuses_saves_and_the_gateway_lives_on(vcan: str, tmp_path: Path) -> None:
    with one_node(vcan, tmp_path) as (toml, master, dump):
        with read_only(tmp_path / "store"), started(toml, tmp_path, dump) as gateway:
            for _ in range(2):
                assert master.refusal(lambda: master.write(1, 0x1010, 1, SAVE, 4)) == HARDWARE
            gateway.wait_for_line("esc1: parameters cannot be stored", 3)
            assert master.refusal(lambda: master.write(1, 0x1011, 1, LOAD, 4)) == HARDWARE
            master.write(1, 0x2100, 1, 11, 1)
            assert master.number(1, 0x2100, 1) == 11
            assert gateway.end() == 0
        assert not list((tmp_path / "store").iterdir())


def test_read_only_over_the_bus_refuses_every_write_and_lss(vcan: str, tmp_path: Path) -> None:
    with nodes_running(vcan, tmp_path, EscOptions(), options="read_only = true", dbc=NO_DBC) as (_, _, gateway, master):
        assert master.refusal(lambda: master.write(1, 0x1017, 0, 100, 2)) == DEVICE_STATE
        assert master.refusal(lambda: master.write(1, 0x1010, 1, SAVE, 4)) == DEVICE_STATE
        lss = lss_of(master)
        lss.send_switch_state_global(lss.CONFIGURATION_STATE)  # type: ignore[no-untyped-call]
        with pytest.raises(LssError):
            lss.configure_node_id(9)  # type: ignore[no-untyped-call]
        with pytest.raises(LssError):
            lss.store_configuration()  # type: ignore[no-untyped-call]
        assert lss.inquire_node_id() == 1  # type: ignore[no-untyped-call]
        assert gateway.end() == 0


# --- LSS


def lss_of(master: Master) -> LssMaster:
    lss = master.network.lss
    lss.RESPONSE_TIMEOUT = 0.1
    return lss


def test_unconfigured_nodes_are_found_and_named(vcan: str, tmp_path: Path) -> None:
    escs = [EscOptions()] * 3
    ids = (0x21, 0x7F, 0x05)
    with nodes_running(vcan, tmp_path, *escs, node_id=255, dbc=NO_DBC) as (run, dump, gateway, master):
        run.start()
        wait_for(lambda: gateway.log.count("waits for LSS") == 3, 3, "the log lines")
        time.sleep(2)
        assert len(run.live(2)) > 100
        assert not dump.frames, "silent but for LSS"
        master.network.send_message(0, b"\x01\x00")  # NMT start of all, SYNC, SDO: none of a node without an ID
        master.network.send_message(0x80, b"")
        master.network.send_message(0x67F, b"\x40\x00\x10\x00\0\0\0\0")

        lss = lss_of(master)
        found = []
        for node_id in ids:
            seen, identity = lss.fast_scan()  # type: ignore[no-untyped-call]
            assert seen
            found.append(identity)
            assert lss.inquire_node_id() == 255  # type: ignore[no-untyped-call]
            lss.configure_node_id(node_id)  # type: ignore[no-untyped-call]
            lss.store_configuration()  # type: ignore[no-untyped-call]
            assert not dump.of(0x700 + node_id)
            left = time.time()
            lss.send_switch_state_global(lss.WAITING_STATE)  # type: ignore[no-untyped-call]
            wait_for(lambda n=node_id: dump.of(0x700 + n) != [], 2, "a boot-up")  # type: ignore[misc]
            assert dump.of(0x700 + node_id)[0].data == BOOT_UP
            assert dump.of(0x700 + node_id)[0].time - left < SLACK_S, "at once"
            assert master.number(node_id, 0x1018, 4) == identity[3]
        assert found == [[0, PRODUCT, REVISION, SERIAL + n] for n in range(3)]
        assert lss.fast_scan() == (False, None)  # type: ignore[no-untyped-call]
        for node_id in ids:
            master.node(node_id).nmt.state = "OPERATIONAL"
        wait_for(lambda: all(len(dump.of(0x180 + n)) > 20 for n in ids), 3, "PDOs of the new nodes")
        toml = (tmp_path / "gateway.toml").read_text()
        run.stop()
        assert gateway.end() == 0
        dump.frames.clear()
        with gateway_process(tmp_path / "gateway.toml", toml):
            wait_for(lambda: all(dump.of(0x700 + n) for n in ids), 5, "boot-ups with what LSS stored")
            serials = [master.number(n, 0x1018, 4) for n in ids]
            assert serials == [SERIAL, SERIAL + 1, SERIAL + 2]
            assert [master.number(n, 0x2101, 1) for n in ids] == list(ids)


def test_a_configured_nodes_new_id_holds_from_reset_communication_on(vcan: str, tmp_path: Path) -> None:
    with nodes_running(vcan, tmp_path, EscOptions(), EscOptions(), dbc=NO_DBC) as (run, dump, gateway, master):
        run.start()
        lss = lss_of(master)
        lss.RESPONSE_TIMEOUT = 0.5

        def select(serial: int) -> bool:
            try:
                return bool(lss.send_switch_state_selective(0, PRODUCT, REVISION, serial))  # type: ignore[no-untyped-call]
            except LssError:
                return False

        assert not select(SERIAL + 2)
        assert select(SERIAL + 1)
        assert lss.inquire_node_id() == 2  # type: ignore[no-untyped-call]
        with pytest.raises(LssError):
            lss.configure_node_id(128)  # type: ignore[no-untyped-call]
        with pytest.raises(LssError):
            lss.configure_node_id(1)  # type: ignore[no-untyped-call]  # the other node's
        lss.configure_node_id(40)  # type: ignore[no-untyped-call]
        lss.send_switch_state_global(lss.WAITING_STATE)  # type: ignore[no-untyped-call]
        assert [master.number(2, 0x2101, sub) for sub in (1, 2)] == [2, 40]
        time.sleep(0.2)
        assert not dump.of(0x728)
        master.node(2).nmt.state = "RESET COMMUNICATION"
        wait_for(lambda: dump.of(0x728) != [], 2, "a boot-up with the new ID")
        assert dump.of(0x728)[0].data == BOOT_UP
        last = len(dump.of(0x702))
        master.node(40).nmt.state = "OPERATIONAL"
        wait_for(lambda: len(dump.of(0x1A8)) > 20, 3, "PDOs with the new ID")
        assert struct.unpack("<IHh", dump.of(0x1A8)[-1].data)[1] in {live.battery_voltage for _, live in run.live(1)}
        assert master.number(40, 0x1018, 4) == SERIAL + 1
        assert len(dump.of(0x702)) == last
        assert [frame.data for frame in dump.of(0x701)].count(BOOT_UP) == 1, "the other node has not noticed"
        toml = (tmp_path / "gateway.toml").read_text()
        run.stop()
        assert gateway.end() == 0
        dump.frames.clear()
        with gateway_process(tmp_path / "gateway.toml", toml):
            wait_for(lambda: dump.of(0x702) != [], 5, "a boot-up")
            assert not dump.of(0x728), "it was not stored"
