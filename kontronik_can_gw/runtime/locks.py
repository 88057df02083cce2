"""What only one gateway on this machine may have: a node-ID, the DBC's messages, a file that is written, an MQTT topic.

A lock is a file with flock(2) on it, in a folder where only gateways write: it ends with the process whatever ends it, and nobody who may
not write there can have one. Its name holds the network namespace, for interfaces of the same name in two of them are two interfaces.
A file that belongs neither to us, nor to root, nor to the folder's owner is reported and not obeyed. Where no lock can be made the gateway
goes on without, and says so once.
"""

import contextlib
import errno
import fcntl
import logging
import os
import stat
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import ids_in_words

log = logging.getLogger("kontronik_can_gw")

SYSTEM_FOLDER = Path("/run/kontronik-can-gw/lock")
"""Made by tmpfiles.d for the service's user; root's gateways lock there too, and containers that have it mounted."""
PREFIX = ""
"""Before the names of all locks, for tests that run side by side."""
_NAME = "kontronik-can-gw"
_MAX_NAME = 200
"""Bytes of a file's name, of which more than 255 cannot be."""
_TRIES = 100
_OPEN = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY


class Taken(Exception):
    """Another process has the lock."""


def node_lock(channel: str, node_id: int) -> str:
    """The name of the lock on a node-ID."""
    return f"{channel}/node/{node_id}"


def messages_lock(channel: str, first_id: int) -> str:
    """The name of the lock on the DBC output whose lowest CAN id this is."""
    return f"{channel}/messages/{first_id:X}"


def ids_lock(channel: str, block: int) -> str:
    """The name of the lock on a block of ids (frames.id_block) of an output."""
    return f"{channel}/ids/{ids_in_words(block)}"


def lock_folder() -> Path:
    """Where this user's gateways lock: together with the service where they may, else in a folder of the user's own."""
    if os.geteuid() == 0 or os.access(
        SYSTEM_FOLDER if SYSTEM_FOLDER.exists() else SYSTEM_FOLDER.parent, os.W_OK
    ):
        return SYSTEM_FOLDER
    given = os.environ.get("XDG_RUNTIME_DIR", "")
    if given.startswith("/") and os.access(given, os.W_OK):
        return Path(given, _NAME, "lock")
    return Path(f"/tmp/{_NAME}-{os.geteuid()}")  # noqa: S108  it is looked at before it is used


def network_namespace() -> int:
    """The number of the network namespace that this process is in; 0 where it is unknown."""
    with contextlib.suppress(OSError):
        return Path("/proc/self/ns/net").stat().st_ino
    return 0


def file_name(name: str, namespace: int) -> str:
    """The file that stands for a lock."""
    text = (PREFIX + name).replace("%", "%25").replace("/", "%2F")
    if len(data := os.fsencode(text)) > _MAX_NAME:
        text = f"{zlib.crc32(data):08x}{os.fsdecode(data[-_MAX_NAME:])}"
    return f"{namespace}.{text}"


def is_held(status: os.stat_result, lines: str) -> bool:
    """Whether somebody has a file locked, by the text of /proc/locks: so it need not be opened, which others may not."""
    place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    return any("FLOCK" in line and place in line.split() for line in lines.splitlines())


def lock_file(name: str | Path, folder: int | None = None) -> int:
    """Make a file, lock it, return its descriptor. Taken where another process has it, OSError where it cannot be had.

    ``folder``: a descriptor that ``name`` is relative to. No link is followed, and a file is ours only if it belongs to us, to root, or
    to the folder's owner. Root lets the folder's group open those that it makes.
    """
    for _ in range(_TRIES):
        around = Path(name).parent.stat() if folder is None else os.fstat(folder)
        try:
            fd = os.open(name, _OPEN | os.O_CREAT | os.O_EXCL, 0o600, dir_fd=folder)
            if os.geteuid() == 0:
                with contextlib.suppress(OSError):
                    # root's stays root's; the folder's group may open it
                    os.fchown(fd, -1, around.st_gid)
                    os.fchmod(fd, 0o660)
        except FileExistsError:
            try:
                fd = os.open(name, _OPEN, dir_fd=folder)
            except FileNotFoundError:  # given back just now
                continue
        try:
            found = os.fstat(fd)
            if found.st_nlink == 0:
                os.close(fd)
                continue
            ours = found.st_uid in (0, os.geteuid(), around.st_uid)
            if not (ours and stat.S_ISREG(found.st_mode) and found.st_nlink == 1):
                raise PermissionError(
                    errno.EPERM, f"belongs to user {found.st_uid}, or is no plain file"
                )
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # who had it removes it while it is locked: the name may stand for another file by now
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.stat(name, dir_fd=folder, follow_symlinks=False), found):
                    return fd
        except BlockingIOError:
            os.close(fd)
            raise Taken from None
        except BaseException:
            os.close(fd)
            raise
        os.close(fd)
    raise OSError(errno.EBUSY, "comes and goes")


class Locks:
    """The locks of one process; they end by ``close`` and with the process. ``report`` is given what a person should know."""

    def __init__(
        self, folder: Path | None = None, report: Callable[[str], None] = log.warning
    ) -> None:
        self._path = folder
        self._report = report
        self._folder: int | None = None
        self._held: dict[str, int] = {}
        self._reported: set[str] = set()

    def hold(self, names: Iterable[str]) -> list[str]:
        """Have exactly these from now on. Returns those that another gateway has."""
        wanted = dict.fromkeys(names)
        for name in [held for held in self._held if held not in wanted]:
            self._give_back(name)
        if not wanted or not self._open_folder():
            return []
        return [name for name in wanted if name not in self._held and not self._take(name)]

    def close(self) -> None:
        """Give everything back."""
        for name in list(self._held):
            self._give_back(name)
        if self._folder is not None:
            os.close(self._folder)
            self._folder = None

    def _open_folder(self) -> bool:
        if self._folder is not None:
            return True
        path = self._path = self._path or lock_folder()
        is_system = path == SYSTEM_FOLDER
        try:
            path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
            with contextlib.suppress(FileExistsError):
                path.mkdir(mode=0o755 if is_system else 0o700)
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            found = os.fstat(folder)
            others_may_remove = found.st_mode & 0o022 and not found.st_mode & stat.S_ISVTX
            # the system's is made by root, and who owns it is a gateway
            if not is_system and (found.st_uid not in (0, os.geteuid()) or others_may_remove):
                os.close(folder)
                raise PermissionError(
                    errno.EPERM, f"belongs to user {found.st_uid}, or others may write to it"
                )
        except OSError as error:
            self._say(
                f"{path}: {error.strerror}. Nothing keeps a second gateway from the same node-IDs and messages."
            )
            return False
        with contextlib.suppress(OSError):
            # systemd-tmpfiles leaves a folder in /tmp alone that somebody has locked
            fcntl.flock(folder, fcntl.LOCK_SH | fcntl.LOCK_NB)
        self._folder = folder
        return True

    def _take(self, name: str) -> bool:
        """Have one lock, or do without; False where another gateway has it."""
        file = file_name(name, network_namespace())
        path = Path(str(self._path), file)
        try:
            self._held[name] = lock_file(file, self._folder)
        except Taken:
            return False
        except OSError as error:
            if _holder(path) == 0:  # root's, which only root may open
                return False
            self._say(
                f"{path}: cannot be locked: {error.strerror}. This lock is not obeyed; remove the file."
            )
        owner = None if path.parent == SYSTEM_FOLDER else _holder(SYSTEM_FOLDER / file)
        if owner == 0:
            self._give_back(name)
            return False
        if owner is not None:
            self._say(
                f"{name}: a gateway of user {owner} has this too; this one goes on. End one of them."
            )
        return True

    def _give_back(self, name: str) -> None:
        fd = self._held.pop(name, None)
        if fd is None:
            return
        with contextlib.suppress(OSError):  # while it is locked nobody else can have this name
            os.unlink(file_name(name, network_namespace()), dir_fd=self._folder)
        os.close(fd)

    def _say(self, text: str) -> None:
        if text not in self._reported:
            self._reported.add(text)
            self._report(text)


def _holder(path: Path) -> int | None:
    """The owner of a file that somebody has locked; None where nobody has."""
    with contextlib.suppress(OSError):
        found = path.lstat()
        if is_held(found, Path("/proc/locks").read_text()):
            return found.st_uid
    return None


def in_use(name: str) -> RunError:
    """What is said of a lock that another gateway has."""
    channel, what, number = name.rsplit("/", 2)
    if what == "node":
        return RunError(
            f"CANopen node {number} on {channel}: another gateway on this machine is this node. End it, or change canopen.node_id."
        )
    if what == "ids":
        return RunError(
            f"CAN {channel}: another gateway on this machine sends with {number}. End it, or give it another node-ID."
        )
    return RunError(
        f"CAN {channel}: another gateway on this machine sends the messages from {number}h on. End it, or change dbc.base_id."
    )
