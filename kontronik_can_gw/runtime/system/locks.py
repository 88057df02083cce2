"""Locks that prevent two gateways on one machine from using the same node-ID, messages or file.

A lock is a file that is locked with flock(2), in a folder where only gateways may write. It ends
with the process, even if the process is killed. Its name contains the network namespace, because
two namespaces may have different interfaces of the same name. If no lock can be created, the
gateway logs this once and runs without it.
"""

import contextlib
import fcntl
import logging
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import ids_in_words
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.files.disk import open_regular, reason_of
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.runtime.system.folders import make_runtime_folder, runtime_folder
from kontronik_can_gw.status import UNCONFIGURED

log = logging.getLogger("kontronik_can_gw")

PREFIX = ""
"""Prefix of the names of all locks, for tests that run at the same time."""
_MAX_NAME = 200
"""Maximum length of a lock's name in bytes. The system's limit for a file name is 255 bytes."""


class Taken(Exception):
    """Raised if another process holds the lock."""


def file_name(name: str) -> str:
    """Return the name of the file for a lock in this network namespace."""
    namespace = 0
    with contextlib.suppress(OSError):
        namespace = Path("/proc/self/ns/net").stat().st_ino
    text = (PREFIX + name).replace("%", "%25").replace("/", "%2F")
    data = os.fsencode(text)
    if len(data) > _MAX_NAME:
        text = f"{zlib.crc32(data):08x}{os.fsdecode(data[-_MAX_NAME:])}"
    return f"{namespace}.{text}"


def lock_file(path: Path) -> int:
    """Lock a file and return its descriptor. Creates the file if it is missing.

    Raises Taken if another process holds the lock, and OSError if the file cannot be opened. A
    file that root creates can also be opened by the folder's group, which is the service's group.
    """
    fd = open_regular(path, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.geteuid() == 0:
            with contextlib.suppress(OSError):
                os.fchown(fd, -1, path.parent.stat().st_gid)
                os.fchmod(fd, 0o660)
    except BlockingIOError:
        os.close(fd)
        raise Taken from None
    except BaseException:
        os.close(fd)
        raise
    if os.fstat(fd).st_nlink:
        return fd
    os.close(fd)  # its holder has removed it, so the name may lead to another file now
    return lock_file(path)


class Locks:
    """A set of locks. ``report`` is called once with each text that describes a failure."""

    def __init__(self, report: Callable[[str], None] = log.warning) -> None:
        self._report = report
        self._reported: set[str] = set()
        self._held: dict[str, tuple[Path, int]] = {}

    def lock_only(self, names: Iterable[str]) -> list[str]:
        """Hold exactly these locks from now on. Returns the names that another gateway holds."""
        wanted = dict.fromkeys(names)
        for name in self._held.keys() - wanted.keys():
            path, fd = self._held.pop(name)
            # The file is removed while it is locked, so that it is not another process's file.
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(fd)
        return [name for name in wanted if name not in self._held and not self._take(name)]

    def close(self) -> None:
        """Release all locks."""
        self.lock_only(())

    def _take(self, name: str) -> bool:
        """Acquire one lock. Returns False if another gateway holds it.

        Returns True also if the lock cannot be created.
        """
        folder = runtime_folder("lock")
        try:
            path = make_runtime_folder("lock") / file_name(name)
            self._held[name] = (path, lock_file(path))
        except Taken:
            return False
        except OSError as error:
            text = (
                f"{folder}: {reason_of(error)}. "
                "A second gateway could use the same node-IDs and messages."
            )
            if text not in self._reported:
                self._reported.add(text)
                self._report(text)
        return True


# --- the ids of a gateway


def names_of(gateway: Gateway, channel: str) -> list[str]:
    """Return the names of the locks for the ids that a gateway uses now."""
    conflicts = gateway.conflicts
    names = []
    for output in gateway.node_outputs:
        for node in output.node_states():
            if node.node_id != UNCONFIGURED:
                names.append(f"{output.node_title} {node.node_id}")
    first = conflicts.first_own_id()
    if first is not None:
        names.append(f"messages from {first:X}h on")
    names += [ids_in_words(block) for block in conflicts.own_blocks()]
    return [f"{channel}: {name}" for name in names]


def in_use(name: str) -> RunError:
    """Return the error for a lock that another gateway holds."""
    return RunError(
        f"CAN {name}: used by another gateway on this machine. "
        "End that gateway, or change node-ID or dbc.base_id."
    )


class IdLocks:
    """The locks for the ids of a gateway.

    A virtual interface needs no locks, because it exists only in this process.
    """

    def __init__(self, config: CanConfig, gateway: Gateway, conditions: FaultLog) -> None:
        self._config = config
        self._gateway = gateway
        self._conditions = conditions
        self._locks = Locks(report=lambda text: conditions.log(logging.WARNING, text))
        self._names: list[str] = []

    def lock(self, at_start: bool = False) -> None:
        """Lock the ids that the gateway uses now.

        If another gateway uses one of them, RunError is raised ``at_start``. Later an error is
        logged, and the next call tries again.
        """
        if self._config.interface == "virtual":
            return
        names = names_of(self._gateway, self._config.channel)
        if names == self._names:
            return
        all_taken = self._locks.lock_only(names)
        self._names = [] if all_taken else names
        for taken in all_taken:
            if at_start:
                raise in_use(taken)
            self._conditions.log(logging.ERROR, str(in_use(taken)))

    def close(self) -> None:
        """Release the locks."""
        self._locks.close()
