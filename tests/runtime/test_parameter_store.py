"""The parameter files: order, results, damage, failing disks, and power loss at any time."""

import errno
import itertools
import os
import select
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from kontronik_can_gw.canopen.storage import Stored, decode, encode
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.files.store import ParameterStore

pytestmark = pytest.mark.promise("parameters")

PATIENCE = 30.0
"""Seconds that a result may take on a busy machine before a test fails."""


def numbered(number: int, size: int = 16) -> bytes:
    """Return the content of a file that has a number and ``size`` further bytes."""
    values = {
        0x210001: number.to_bytes(4, "little"),
        0x210002: bytes(size),
    }
    return encode(Stored(None, values))


def number_of(stored: Stored) -> int:
    return int.from_bytes(stored.values.get(0x210001, b""), "little")


OLD = numbered(1)
NEW = numbered(2)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[ParameterStore]:
    made = ParameterStore(tmp_path / "params")
    yield made
    made.close(PATIENCE)


def put(store: ParameterStore, name: str, data: bytes) -> str | None:
    """Save one content. Return its result, read when the descriptor is readable as in the loop."""
    assert store.save(name, data)
    assert select.select([store.fileno()], [], [], PATIENCE)[0], "no result came"
    ((about, problem),) = store.results()
    assert select.select([store.fileno()], [], [], 0)[0] == []
    assert about == name
    return problem


def test_saved_parameters_are_loaded_by_the_next_store(
    tmp_path: Path,
    store: ParameterStore,
) -> None:
    assert store.load("a", decode) == (None, None)
    assert list(tmp_path.iterdir()) == [], "nothing is made by reading"
    assert put(store, "a", OLD) is None
    for number in range(10):
        assert store.save("a" * 12, numbered(number))
    assert store.close(PATIENCE), "it waits for what is queued"
    assert store.results() == [("a" * 12, None)] * 10
    assert not store.save("a", NEW)
    again = ParameterStore(tmp_path / "params")
    assert again.load("a", decode) == (decode(OLD), None)
    stored, _ = again.load("a" * 12, decode)
    assert stored is not None
    assert number_of(stored) == 9
    assert again.close(0)


def test_files_and_a_new_folder_are_accessible_only_to_their_owner(
    tmp_path: Path,
    store: ParameterStore,
) -> None:
    before = os.umask(0)
    try:
        assert put(store, "esc1", OLD) is None
    finally:
        os.umask(before)
    found = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.rglob("*")}
    assert found == {"params": 0o700, "esc1.params": 0o600}


def test_saving_is_refused_if_no_thread_can_be_started(
    store: ParameterStore,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", start)
        assert not store.save("esc1", OLD)
    assert put(store, "esc1", OLD) is None


# --- damage


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("target")])
def test_file_that_is_not_regular_is_neither_read_nor_awaited(
    tmp_path: Path,
    store: ParameterStore,
    make: Callable[[Path], object],
) -> None:
    path = place(tmp_path, OLD) / "esc1.params"
    path.rename(path.with_name("target"))
    make(path)
    assert store.load("esc1", bytes) == (None, f"{path}: it is not a regular file")


def place(tmp_path: Path, data: bytes) -> Path:
    folder = tmp_path / "params"
    folder.mkdir(exist_ok=True)
    (folder / "esc1.params").write_bytes(data)
    return folder


OTHER_VERSION = OLD.replace(b'"version":1', b'"version":9')


@pytest.mark.parametrize(
    "data",
    [OLD[:-5], b"", b"\0" * 200, OLD + b"\n", OTHER_VERSION],
)
def test_damaged_file_is_reported_and_the_newest_one_is_kept(
    tmp_path: Path,
    store: ParameterStore,
    data: bytes,
) -> None:
    folder = place(tmp_path, b"older rubbish")
    store.load("esc1", decode)
    place(tmp_path, data)
    stored, reason = store.load("esc1", decode)
    assert stored is None
    assert reason is not None
    assert str(folder / "esc1.params") in reason
    assert [path.name for path in folder.iterdir()] == ["esc1.params.damaged"]
    assert store.load("esc1", decode) == (None, None)
    assert put(store, "esc1", NEW) is None
    assert store.load("esc1", decode) == (decode(NEW), None)
    assert (folder / "esc1.params.damaged").read_bytes() == data


def test_unreadable_file_is_kept_and_half_a_new_file_is_never_read(
    tmp_path: Path,
    store: ParameterStore,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A temporary error of the disk must not lose the settings."""
    folder = place(tmp_path, OLD)
    (folder / "esc1.params.tmp").write_bytes(NEW)

    def fail(_path: Path, _flags: int) -> int:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patched:
        patched.setattr("kontronik_can_gw.runtime.files.store.open_regular", fail)
        stored, reason = store.load("esc1", decode)
    assert stored is None
    assert reason
    assert reason.endswith("Input/output error")
    assert store.load("esc1", decode) == (decode(OLD), None)
    assert [path.name for path in folder.iterdir()] == ["esc1.params"]


# --- power loss


Step = tuple[str, ...]


class Recorder:
    """Records the calls that change or sync the disk, in their order.

    The call given as ``failing`` raises ``error``.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        folder: Path,
        failing: Step = (),
        error: OSError | None = None,
    ) -> None:
        self.steps: list[Step] = []
        self._folder = folder
        self._failing = failing
        self._error = error
        self._names: dict[int, str] = {}
        self._real: dict[str, Callable[..., Any]] = {}
        names = "open write fsync close unlink replace rename mkdir truncate ftruncate"
        for name in names.split():
            self._real[name] = getattr(os, name)
            monkeypatch.setattr(os, name, getattr(self, f"_{name}", self._unexpected))

    def _fail_at(self, *step: str) -> None:
        if step == self._failing and self._error is not None:
            raise self._error

    def _name(self, path: Any) -> str:
        return str(Path(path).relative_to(self._folder.parent))

    def _unexpected(self, *arguments: Any) -> None:
        raise AssertionError(f"not a call that may change a parameter file: {arguments}")

    def _open(
        self,
        path: Any,
        flags: int,
        *more: Any,
        **options: Any,
    ) -> int:
        if Path(path).is_relative_to(self._folder):
            self._fail_at("create", self._name(path))
        fd: int = self._real["open"](path, flags, *more, **options)
        if Path(path).is_relative_to(self._folder.parent):
            self._names[fd] = self._name(path)
            if flags & os.O_CREAT:
                assert flags & os.O_EXCL
                self.steps.append(("create", self._names[fd]))
        return fd

    def _write(self, fd: int, data: bytes) -> int:
        if any(step[0] == "write" for step in self.steps):  # the first part is always written
            self._fail_at("write", self._names[fd])
        count: int = self._real["write"](fd, data[:50])  # a system may write only a part
        self.steps.append(("write", self._names[fd], bytes(data[:count]).decode("latin-1")))
        return count

    def _fsync(self, fd: int) -> None:
        self._fail_at("fsync", self._names[fd])
        self._real["fsync"](fd)
        self.steps.append(("fsync", self._names[fd]))

    def _close(self, fd: int) -> None:
        self._real["close"](fd)
        self._fail_at("close", self._names.pop(fd, ""))

    def _unlink(self, path: Any, *more: Any, **options: Any) -> None:
        self._real["unlink"](path, *more, **options)
        self.steps.append(("unlink", self._name(path)))

    def _replace(self, source: Any, target: Any) -> None:
        self._fail_at("rename", self._name(source))
        self._real["replace"](source, target)
        self.steps.append(("rename", self._name(source), self._name(target)))

    def _mkdir(self, path: Any, *more: Any) -> None:
        self._real["mkdir"](path, *more)
        self.steps.append(("mkdir", self._name(path)))


def after_power_loss(files: dict[str, str], steps: list[Step]) -> list[dict[str, str]]:
    """Return every state that the disk may have after a power loss.

    ``files`` has the contents of the disk before the steps. Changes without fsync may be on disk
    or not:

    - Each change of a folder may be lost or kept, in any order. A renaming is one change.
    - A file may have any first part of its new content, or zeros.

    A disk that keeps more order has one of these states too.
    """
    contents: dict[int, str] = dict(enumerate(files.values()))
    secured: dict[int, str] = dict(contents)
    entries = {name: inode for inode, name in enumerate(files)}
    durable = dict(entries)
    pending: list[dict[str, int | None]] = []
    for step in steps:
        if step[0] == "create":
            inode = len(contents)
            contents[inode] = secured[inode] = ""
            entries[step[1]] = inode
            pending.append({step[1]: inode})
        elif step[0] == "write":
            contents[entries[step[1]]] += step[2]
        elif step[0] == "fsync" and step[1] in entries:
            secured[entries[step[1]]] = contents[entries[step[1]]]
        elif step[0] == "fsync":  # the step is about a folder, and entries include its name
            durable = dict(entries)
            pending = []
        elif step[0] == "unlink":
            del entries[step[1]]
            pending.append({step[1]: None})
        elif step[0] == "rename":
            entries[step[2]] = entries.pop(step[1])
            pending.append({step[2]: entries[step[2]], step[1]: None})
    found = []
    for kept in itertools.product((False, True), repeat=len(pending)):
        names: dict[str, int] = dict(durable)
        for change in itertools.compress(pending, kept):
            for name, entry in change.items():
                if entry is None:
                    names.pop(name, None)
                else:
                    names[name] = entry
        torn = {i for i in names.values() if contents[i] != secured[i]}
        for damage in range(4 if torn else 1):
            state = {}
            for name, inode in names.items():
                whole = contents[inode]
                safe = secured[inode]
                if inode in torn:
                    half = whole[: (len(safe) + len(whole)) // 2]
                    whole = (safe, half, "\0" * len(whole), whole)[damage]
                state[name] = whole
            found.append(state)
    return found


def recorded(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    *contents: bytes,
    load: bool = False,
) -> list[Step]:
    """Return the steps of the store on disk for one load, or for several savings in succession.

    Each confirmation is a step too.
    """
    store = ParameterStore(folder)
    with monkeypatch.context() as patched:
        recorder = Recorder(patched, folder)
        if load:
            store.load("esc1", decode)
        for data in contents:
            problem = put(store, "esc1", data)
            recorder.steps.append(("confirmed" if problem is None else problem, data.decode()))
    assert store.close(PATIENCE)
    return recorder.steps


FILE = "params/esc1.params"
TEMPORARY = f"{FILE}.tmp"
DAMAGED = f"{FILE}.damaged"


def faults(files: dict[str, str], steps: list[Step]) -> list[str]:
    """Return the wrong contents that may be found after a power loss.

    The content confirmed last is right, and so is the one being saved.
    """
    asked = [files.get(FILE, "")]
    asked += [step[1] for step in steps if step[0] == "confirmed"]
    wrong = []
    for length in range(len(steps) + 1):
        done = steps[:length]
        confirmed = sum(step[0] == "confirmed" for step in done)
        allowed = asked[confirmed : confirmed + 2]
        found = [state.get(FILE, "") for state in after_power_loss(files, done)]
        wrong += [content for content in found if content not in allowed]
    return wrong


@pytest.mark.parametrize("left_over", [False, True])
@pytest.mark.parametrize("first", [False, True])
def test_loss_of_power_at_any_instant_leaves_the_old_or_new_content(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    left_over: bool,
    first: bool,
) -> None:
    folder = tmp_path / "params"
    folder.mkdir()
    files = {} if first else {FILE: OLD.decode()}
    if left_over:
        files[TEMPORARY] = "half of so"
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    steps = recorded(
        monkeypatch,
        folder,
        NEW,
        numbered(3),
        numbered(4),
    )
    of_a_new_folder = recorded(monkeypatch, tmp_path / "new", NEW)
    assert of_a_new_folder[:2] == [("mkdir", "new"), ("fsync", ".")]
    assert sum(step[0] == "confirmed" for step in steps) == 3
    assert faults(files, steps) == []


def test_damaged_file_exists_at_every_instant(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = place(tmp_path, b"rubbish")
    (folder / "esc1.params.damaged").write_bytes(b"older")
    files = {FILE: "rubbish", DAMAGED: "older"}
    steps = recorded(monkeypatch, folder, NEW, load=True)
    assert ("rename", FILE, DAMAGED) in steps
    moved = steps.index(("fsync", "params"))
    assert moved < steps.index(("create", TEMPORARY))
    for length in range(len(steps) + 1):
        for state in after_power_loss(files, steps[:length]):
            if length > moved:
                assert state[DAMAGED] == "rubbish"
                assert state.get(FILE, "") in ("", NEW.decode())
            else:
                assert state in ({DAMAGED: "rubbish"}, {FILE: "rubbish", DAMAGED: "older"})


OF_THE_FILE = [(step, TEMPORARY) for step in ("create", "write", "fsync", "close", "rename")]


@pytest.mark.promise("full-disk")
@pytest.mark.parametrize("failing", [*OF_THE_FILE, ("fsync", "params")])
def test_failure_at_any_step_is_reported_and_leaves_a_complete_file(
    tmp_path: Path,
    store: ParameterStore,
    monkeypatch: pytest.MonkeyPatch,
    failing: Step,
) -> None:
    folder = place(tmp_path, OLD)
    with monkeypatch.context() as patched:
        Recorder(patched, folder, failing, OSError(errno.ENOSPC, "full"))
        assert put(store, "esc1", NEW) == f"{folder / 'esc1.params'}: full"
    assert [path.name for path in folder.iterdir()] == ["esc1.params"]
    expected = NEW if failing == ("fsync", "params") else OLD
    assert (folder / "esc1.params").read_bytes() == expected
    assert put(store, "esc1", NEW) is None
    assert store.load("esc1", decode) == (decode(NEW), None)


# --- two gateways


def test_node_is_locked_by_one_gateway_until_it_closes(tmp_path: Path) -> None:
    first = ParameterStore(tmp_path / "store")
    second = ParameterStore(tmp_path / "store")
    first.lock("esc1")
    with pytest.raises(RunError, match=r"esc1\.params: is in use by another gateway"):
        second.lock("esc1")
    second.lock("esc2")
    first.close(1)
    second.lock("esc1")
    second.close(1)
    (tmp_path / "file").write_text("")
    without = ParameterStore(tmp_path / "file" / "store")
    assert without.lock("esc1"), "a reason, and the gateway runs all the same"
    without.close(1)
