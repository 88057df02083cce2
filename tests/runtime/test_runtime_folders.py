"""Folders for locks and status. A gateway never uses a folder that another user controls."""

import os
from pathlib import Path

import pytest

from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.runtime.system.locks import Locks

pytestmark = pytest.mark.promise("folders")


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the root of a machine with /run and /tmp, but without a session."""
    for name in ("run", "tmp"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(folders, "RUN", tmp_path / "run")
    monkeypatch.setattr(folders, "TEMPORARY", tmp_path / "tmp")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    return tmp_path


@pytest.fixture
def ordinary_user(monkeypatch: pytest.MonkeyPatch) -> int:
    """Make this process look like an ordinary user's. The system's folder is not writable."""
    uid = os.geteuid()
    access = os.access
    monkeypatch.setattr(os, "geteuid", lambda: uid or 1000)

    def may_access(path: Path, mode: int) -> bool:
        return Path(path).parent.name != "run" and access(path, mode)

    monkeypatch.setattr(os, "access", may_access)
    if uid == 0:
        lstat = Path.lstat

        def own(path: Path) -> os.stat_result:
            found = list(lstat(path))
            found[4] = 1000 if found[4] == 0 else found[4]
            return os.stat_result(found)

        monkeypatch.setattr(Path, "lstat", own)
    return uid or 1000


def test_root_and_the_services_user_share_the_systems_folder(
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shared = root / "run" / "kontronik-can-gw"
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert folders.runtime_folder("lock") == shared / "lock"
    monkeypatch.setattr(os, "geteuid", lambda: 990)
    monkeypatch.setattr(os, "access", lambda path, _mode: path == shared / "lock")
    (shared / "lock").mkdir(parents=True)
    assert folders.runtime_folder("lock") == shared / "lock"
    assert folders.runtime_folder("status") == root / "tmp" / "kontronik-can-gw-990" / "status"


def test_folder_of_a_session_is_preferred_to_the_one_in_tmp(
    root: Path,
    ordinary_user: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fallback = root / "tmp" / f"kontronik-can-gw-{ordinary_user}"
    assert folders.runtime_folder("status") == fallback / "status"
    session = root / "run" / "user" / str(ordinary_user)
    session.mkdir(parents=True)
    assert folders.runtime_folder("status") == session / "kontronik-can-gw" / "status"
    given = root / "given"
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(given))
    assert folders.runtime_folder("status") == session / "kontronik-can-gw" / "status", "not there"
    given.mkdir()
    assert folders.runtime_folder("status") == given / "kontronik-can-gw" / "status"


def test_without_a_session_the_folder_in_tmp_is_private_and_locks_hold(
    root: Path,
    ordinary_user: int,
) -> None:
    said: list[str] = []
    first = Locks(said.append)
    second = Locks(said.append)
    assert first.lock_only(["can0: CANopen node 5"]) == []
    assert second.lock_only(["can0: CANopen node 5"]) == ["can0: CANopen node 5"]
    assert said == []
    folder = root / "tmp" / f"kontronik-can-gw-{ordinary_user}"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert folder / "status" in folders.status_folders()
    first.close()


@pytest.mark.parametrize("kind", ["writable by all", "link", "file"])
def test_folder_in_tmp_that_another_user_controls_is_refused(
    root: Path,
    ordinary_user: int,
    kind: str,
) -> None:
    folder = root / "tmp" / f"kontronik-can-gw-{ordinary_user}"
    if kind == "writable by all":
        folder.mkdir()
        folder.chmod(0o777)
    elif kind == "link":
        (root / "elsewhere").mkdir()
        folder.symlink_to(root / "elsewhere")
    else:
        folder.touch()
    with pytest.raises(OSError, match="belongs to another user"):
        folders.make_runtime_folder("status")
    assert folder / "status" not in folders.status_folders()
    assert not (root / "elsewhere" / "status").exists()
    said: list[str] = []
    assert Locks(said.append).lock_only(["x"]) == []
    assert len(said) == 1
    assert "belongs to another user" in said[0]
