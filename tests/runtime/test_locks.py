"""Only one gateway on a machine can use a node-ID or send a message. Only gateways take locks."""

import errno
import fcntl
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from wire_world import Bus, World

from kontronik_can_gw.assembly.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.can import can_controller, can_opener
from kontronik_can_gw.runtime.can.can_link import CanLink
from kontronik_can_gw.runtime.poller import Poller
from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.runtime.system.locks import Locks, Taken, file_name, lock_file

pytestmark = pytest.mark.promise("locks")

CHANNEL = "can0"
NODES = [f"{CHANNEL}: CANopen node {number}" for number in (5, 6, 7)]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the lock folder of this test. Any user may create it."""
    path = tmp_path / "run" / "kontronik-can-gw" / "lock"
    monkeypatch.setattr(folders, "RUN", tmp_path / "run")
    monkeypatch.setattr(folders, "TEMPORARY", tmp_path / "tmp")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    path.parent.mkdir(parents=True)
    return path


@pytest.mark.rights
def test_lock_is_exclusive_until_it_is_released(folder: Path) -> None:
    first = Locks()
    second = Locks()
    assert first.lock_only(NODES[:2]) == []
    assert first.lock_only(NODES[:2]) == []
    mode = {0: 0o660}.get(os.geteuid(), 0o600)
    assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {mode}
    assert second.lock_only(NODES[1:]) == [NODES[1]]
    assert first.lock_only(NODES[:1]) == []
    assert second.lock_only(NODES[1:]) == []
    first.close()
    assert second.lock_only(NODES[:1]) == []
    second.close()
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("target")])
def test_lock_is_a_regular_file(
    folder: Path,
    make: Callable[[Path], object],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Another program of the service's user may have created anything in its place."""
    path = folder / file_name(NODES[0])
    folder.mkdir(parents=True)
    make(path)
    locks = Locks()
    assert locks.lock_only(NODES[:1]) == []
    assert f"{folder}: it is not a regular file. A second gateway could use" in caplog.text
    assert [each.name for each in folder.iterdir()] == [path.name]
    locks.close()


def test_lock_file_that_its_holder_removes_is_created_again(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The holder removes its file after we open it and before we lock it.

    Our lock would then be on a file that has no name.
    """
    path = tmp_path / "x"
    real = fcntl.flock

    def flock(fd: int, operation: int) -> None:
        monkeypatch.undo()
        path.unlink()
        real(fd, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    fd = lock_file(path)
    assert os.path.samestat(os.fstat(fd), path.stat())
    with pytest.raises(Taken):
        lock_file(path)
    os.close(fd)


@pytest.mark.parametrize("what", ["dbc", "canopen", "dronecan"])
def test_second_gateway_with_the_same_node_or_messages_is_refused(what: str) -> None:
    tables = {
        "can": {"channel": CHANNEL},
        "dbc": {"enabled": what == "dbc"},
        "canopen": {"enabled": what == "canopen", "node_id": 42, "store": "/nowhere"},
        "dronecan": {"enabled": what == "dronecan", "node_id": 42},
        "esc": [{"port": "p"}],
    }
    loaded = assemble(parse(tables, "test"))
    sides = []
    try:
        for _ in range(2):
            gateway = Gateway(loaded.core_settings, 0, outputs=loaded.outputs)
            sides.append(
                CanLink(
                    loaded.config.can,
                    gateway,
                    Poller(),
                    FaultLog(),
                    lambda _path: None,
                    time.monotonic_ns,
                )
            )
        sides[0].open(0, wait=True)
        names = "messages from 680h on|CANopen node 42|29-bit ids with 2Ah .*"
        said = f"CAN can0: ({names}): used by another"
        with pytest.raises(RunError, match=said):
            sides[1].open(0, wait=True)
        sides[0].close()
        sides[1].open(0, wait=True)
    finally:
        for side in sides:
            side.close()


@pytest.mark.parametrize("kind", ["folder", "link", "no locks there"])
def test_lock_that_cannot_be_taken_is_reported_once_and_not_needed(
    kind: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_locks(_fd: int, _kind: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    if kind == "no locks there":
        monkeypatch.setattr("fcntl.flock", no_locks)
    elif kind == "link":
        folder.mkdir(parents=True)
        for name in NODES:
            (folder / file_name(name)).symlink_to(tmp_path / "other")
    else:
        folder.touch()
    said: list[str] = []
    mine = Locks(said.append)
    assert mine.lock_only(NODES[:1]) == mine.lock_only(NODES) == []
    mine.close()
    assert len(said) == 1
    assert "A second gateway could use" in said[0]
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    "name",
    [NODES[0], "/dev/serial/by-id/usb-A%2F_1@115200", "/ä" * 150],
)
def test_every_lock_has_a_distinct_and_valid_file_name(name: str) -> None:
    assert "/" not in file_name(name)
    assert len(os.fsencode(file_name(name))) < 250
    assert file_name(name) != file_name(name + "0")


def waiting_gateway(monkeypatch: pytest.MonkeyPatch) -> CanLink:
    """Return a CANopen gateway whose node waits for LSS. Its interface is open."""
    tables = {
        "can": {"channel": CHANNEL},
        "dbc": {"enabled": False},
        "canopen": {"enabled": True, "node_id": 255, "store": "/nowhere"},
        "esc": [{"port": "p"}],
    }
    loaded = assemble(parse(tables, "test"))
    gateway = Gateway(loaded.core_settings, 0, outputs=loaded.outputs)
    monkeypatch.setattr(can_opener, "open_can", lambda _config: Bus(World()))
    monkeypatch.setattr(can_controller, "link_monitor", lambda _name: None)
    link = CanLink(
        loaded.config.can,
        gateway,
        World().poller,
        FaultLog(),
        lambda _path: None,
        time.monotonic_ns,
    )
    link.open(0, wait=False)
    gateway.start(0)
    return link


def assign_node_id(link: CanLink, node_id: int) -> None:
    """Assign a node-ID by LSS: configuration state, node-ID, waiting state. The node boots."""
    for data in ("04 01", f"11 {node_id:02x}", "04 00"):
        request = bytes.fromhex(data).ljust(8, b"\0")
        link._gateway.receive_frame(CanFrame(0x7E5, request), 0, 0)
    link._gateway.advance(0)
    link.follow_ids()


def test_node_id_assigned_by_lss_is_locked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link = waiting_gateway(monkeypatch)
    other = Locks()
    assert other.lock_only(NODES[:1]) == []
    other.close()
    assign_node_id(link, 5)
    assert other.lock_only(NODES[:1]) == NODES[:1]
    link.close()
    assert other.lock_only(NODES[:1]) == []
    other.close()


def test_node_id_assigned_by_lss_that_another_gateway_has_is_logged(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    link = waiting_gateway(monkeypatch)
    other = Locks()
    assert other.lock_only(NODES[:1]) == []
    assign_node_id(link, 5)
    assert "can0: CANopen node 5: used by another gateway on this machine." in caplog.text
    link.close()
    other.close()
