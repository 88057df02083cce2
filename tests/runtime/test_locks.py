"""Node-IDs and messages belong to one gateway on a machine; nobody but a gateway can take one."""

import fcntl
import os
from pathlib import Path

import pytest

from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime import locks
from kontronik_can_gw.runtime.can_link import CanLink
from kontronik_can_gw.runtime.fault_log import FaultLog
from kontronik_can_gw.runtime.locks import (
    Locks,
    Taken,
    file_name,
    lock_file,
    messages_lock,
    network_namespace,
    node_lock,
)
from kontronik_can_gw.runtime.poller import Poller

CHANNEL = "can0"
NODE = node_lock(CHANNEL, 5)
ME, SERVICE, STRANGER = os.geteuid(), 61234, 61235

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="to give files to other users is root's")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The system's folder, of this test alone."""
    path = tmp_path / "run" / "lock"
    path.parent.mkdir()
    monkeypatch.setattr(locks, "SYSTEM_FOLDER", path)
    return path


def file_of(name: str) -> Path:
    return locks.SYSTEM_FOLDER / file_name(name, network_namespace())


def make(name: str, uid: int = ME, mode: int = 0o600) -> Path:
    path = file_of(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch(mode)
    if uid != ME:
        os.chown(path, uid, uid)
    return path


def test_what_one_has_another_cannot_have_until_it_is_given_back() -> None:
    first, second = Locks(), Locks()
    names = [node_lock(CHANNEL, 5), node_lock(CHANNEL, 6), messages_lock(CHANNEL, 0x680)]
    assert first.hold(names) == []
    assert first.hold(names) == []
    assert second.hold([node_lock(CHANNEL, 6), node_lock(CHANNEL, 7)]) == [node_lock(CHANNEL, 6)]
    assert first.hold([node_lock(CHANNEL, 5)]) == []
    assert second.hold([node_lock(CHANNEL, 6), node_lock(CHANNEL, 7)]) == []
    first.close()
    assert second.hold([node_lock(CHANNEL, 5)]) == []
    second.close()
    assert list(locks.SYSTEM_FOLDER.iterdir()) == []


@pytest.mark.parametrize("what", ["dbc", "canopen", "dronecan"])
def test_a_second_gateway_with_the_same_node_or_messages_is_refused(
    what: str,
) -> None:
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
            made = [setup.make for setup in loaded.outputs]
            gateway = Gateway(loaded.escs, loaded.layout, 0, canopen=loaded.canopen, further=made)
            sides.append(CanLink(loaded.config.can, gateway, Poller(), FaultLog()))
        sides[0].open(0, wait=True)
        with pytest.raises(
            RunError,
            match=f"messages from 680h|CANopen node 42 on {CHANNEL}|sends with 29-bit ids with 2Ah",
        ):
            sides[1].open(0, wait=True)
        sides[0].close()
        sides[1].open(0, wait=True)
    finally:
        for side in sides:
            side.close()


# --- others


@pytest.mark.parametrize("kind", ["fifo", "folder", "hard link", "link"])
def test_what_is_no_plain_file_is_reported_and_not_obeyed(kind: str, tmp_path: Path) -> None:
    path = make(NODE)
    target = tmp_path / "other"
    target.write_text("kept")
    if kind == "hard link":
        target.unlink()
        os.link(path, target)
    else:
        path.unlink()
        {"fifo": os.mkfifo, "folder": os.mkdir, "link": lambda name: os.symlink(target, name)}[
            kind
        ](path)
    said: list[str] = []
    mine = Locks(report=said.append)
    with target.open() as other:
        if kind == "link":
            fcntl.flock(other, fcntl.LOCK_EX)
        assert mine.hold([NODE, node_lock(CHANNEL, 6)]) == []
    mine.close()
    assert len(said) == 1 and "cannot be locked" in said[0]
    assert kind == "hard link" or target.read_text() == "kept"


@needs_root
@pytest.mark.parametrize(
    ("folders_owner", "files_owner", "obeyed"),
    [
        (SERVICE, SERVICE, True),
        (SERVICE, 0, True),
        (0, STRANGER, False),
        (SERVICE, STRANGER, False),
    ],
)
def test_only_what_is_roots_or_the_services_is_obeyed(
    folders_owner: int, files_owner: int, obeyed: bool
) -> None:
    path = make(NODE, files_owner)
    os.chown(path.parent, folders_owner, folders_owner)
    path.parent.chmod(0o1777)
    said: list[str] = []
    mine = Locks(report=said.append)
    with path.open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        assert mine.hold([NODE]) == ([NODE] if obeyed else [])
    mine.close()
    assert bool(said) is not obeyed


@needs_root
def test_a_users_gateway_reports_the_services_lock_and_obeys_roots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    roots = node_lock(CHANNEL, 6)
    with make(NODE, SERVICE).open() as service, make(roots).open() as root:
        said: list[str] = []
        mine = Locks(tmp_path / "mine", said.append)
        for file in (service, root):
            fcntl.flock(file, fcntl.LOCK_EX)
        assert mine.hold([NODE, roots, node_lock(CHANNEL, 7)]) == [roots]
        mine.close()
    assert said == [
        f"{NODE}: a gateway of user {SERVICE} has this too; this one goes on. End one of them."
    ]


def test_a_file_that_its_holder_removes_is_not_mistaken_for_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The holder removes its file between our opening and our locking: the name is free again, and what we have locked is nothing."""
    path = tmp_path / "x"
    path.touch()
    real = fcntl.flock
    removed: list[bool] = []

    def flock(fd: int, operation: int) -> None:
        if not removed:
            path.unlink()
            removed.append(True)
        real(fd, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    fd = lock_file(str(path))
    assert os.path.samestat(os.fstat(fd), path.stat())
    with pytest.raises(Taken):
        lock_file(str(path))
    os.close(fd)


# --- folders


@pytest.mark.parametrize(
    ("uid", "writable", "expected"),
    [
        (0, "", "SYSTEM"),
        (1000, "SYSTEM", "SYSTEM"),
        (1000, "/run/user/1000", "/run/user/1000/kontronik-can-gw/lock"),
        (1000, "", "/tmp/kontronik-can-gw-1000"),
    ],
)
def test_the_folder_is_the_services_or_the_users_own(
    uid: int, writable: str, expected: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.mkdir(parents=True)
    system = str(folder)
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    allowed = writable.replace("SYSTEM", system)
    monkeypatch.setattr(os, "access", lambda path, _mode: str(path) == allowed)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1000")
    assert str(locks.lock_folder()) == expected.replace("SYSTEM", system)


@pytest.mark.parametrize(
    "kind", ["link", "file", "open to all", pytest.param("a stranger's", marks=needs_root)]
)
def test_a_users_folder_that_others_can_change_is_reported_once_and_done_without(
    kind: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine"
    if kind in ("link", "file"):
        path.symlink_to(tmp_path) if kind == "link" else path.touch()
    else:
        path.mkdir(0o700)
        path.chmod(0o777) if kind == "open to all" else os.chown(path, STRANGER, STRANGER)
    said: list[str] = []
    mine = Locks(path, said.append)
    assert mine.hold([NODE]) == mine.hold([NODE, node_lock(CHANNEL, 6)]) == []
    mine.close()
    assert len(said) == 1
    assert "Nothing keeps a second gateway" in said[0]


@pytest.mark.parametrize(
    "name", [NODE, node_lock("/dev/serial/by-id/usb-A%2F_1@115200", 127), f"{'/ä' * 150}/node/1"]
)
def test_a_file_name_stands_for_one_lock_in_one_network_namespace(name: str) -> None:
    file = file_name(name, 4026531840)
    assert "/" not in file
    assert len(os.fsencode(file)) < 250
    assert file != file_name(name + "0", 4026531840)
    assert file != file_name(name, 4026531841)
