"""What only one gateway on this machine may have: a node-ID, the DBC's messages, a file that is written.

A lock is a file with flock(2) on it, in a folder where only gateways write: it ends with the process whatever ends it, and nobody who may
not write there can have one. Its name holds the network namespace, for interfaces of the same name in two of them are two interfaces.
Where no lock can be made the gateway goes on without, and says so once.
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
from kontronik_can_gw.runtime.files.disk import reason_of
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.runtime.system.folders import make_runtime_folder, runtime_folder
from kontronik_can_gw.status import UNCONFIGURED

log = logging.getLogger("kontronik_can_gw")

PREFIX = ""
"""Before the names of all locks, for tests that run side by side."""
_MAX_NAME = 200
"""Bytes of a file's name, of which more than 255 cannot be."""


class Taken(Exception):
    """Another process has the lock."""


def file_name(name: str) -> str:
    """The file that stands for a lock in this network namespace."""
    namespace = 0
    with contextlib.suppress(OSError):
        namespace = Path("/proc/self/ns/net").stat().st_ino
    text = (PREFIX + name).replace("%", "%25").replace("/", "%2F")
    if len(data := os.fsencode(text)) > _MAX_NAME:
        text = f"{zlib.crc32(data):08x}{os.fsdecode(data[-_MAX_NAME:])}"
    return f"{namespace}.{text}"


def lock_file(path: Path) -> int:
    """Lock a file, made where there is none; returns its descriptor. Taken where another process has it, OSError where it cannot be had.

    Root lets the folder's group, the service's, open those that it makes.
    """
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
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
    os.close(fd)  # its holder removed it just now: the name stands for another file
    return lock_file(path)


class Locks:
    """Locks that are held together. ``report`` is given what goes wrong, each text once."""

    def __init__(self, report: Callable[[str], None] = log.warning) -> None:
        self._report = report
        self._reported: set[str] = set()
        self._held: dict[str, tuple[Path, int]] = {}

    def hold(self, names: Iterable[str]) -> list[str]:
        """Have exactly these from now on. Returns those that another gateway has."""
        wanted = dict.fromkeys(names)
        for name in self._held.keys() - wanted.keys():
            path, fd = self._held.pop(name)
            with contextlib.suppress(OSError):  # while it is locked nobody else can have this name
                path.unlink()
            os.close(fd)
        return [name for name in wanted if name not in self._held and not self._take(name)]

    def close(self) -> None:
        """Give everything back."""
        self.hold(())

    def _take(self, name: str) -> bool:
        """Take one lock. Returns False if another gateway has it, True also if no lock can be made."""
        folder = runtime_folder("lock")
        try:
            path = make_runtime_folder("lock") / file_name(name)
            self._held[name] = path, lock_file(path)
        except Taken:
            return False
        except OSError as error:
            text = f"{folder}: {reason_of(error)}. Nothing keeps a second gateway from the same node-IDs and messages."
            if text not in self._reported:
                self._reported.add(text)
                self._report(text)
        return True


# --- the ids of a gateway


def names_of(gateway: Gateway, channel: str) -> list[str]:
    """The names of the locks on the ids that a gateway has now."""
    conflicts = gateway.conflicts
    names = []
    for output in gateway.node_outputs:
        for node in output.node_states():
            if node.node_id != UNCONFIGURED:
                names.append(f"{output.node_title} {node.node_id}")
    if (first := conflicts.first_own_id()) is not None:
        names.append(f"messages from {first:X}h on")
    names += [ids_in_words(block) for block in conflicts.own_blocks()]
    return [f"{channel}: {name}" for name in names]


def in_use(name: str) -> RunError:
    """What is said of a lock that another gateway has."""
    return RunError(
        f"CAN {name}: another gateway on this machine sends this. End it, or change node-ID or dbc.base_id."
    )


class IdLocks:
    """The locks on the ids of a gateway. A virtual interface is in this process only: it needs none."""

    def __init__(self, config: CanConfig, gateway: Gateway, conditions: FaultLog) -> None:
        self._config = config
        self._gateway = gateway
        self._conditions = conditions
        self._locks = Locks(report=lambda text: conditions.say(logging.WARNING, text))
        self._names: list[str] = []

    def lock(self, at_start: bool = False) -> None:
        """Lock what the gateway has now. RunError ``at_start`` where another gateway has it; later that is logged, and tried again."""
        if self._config.interface == "virtual":
            return
        names = names_of(self._gateway, self._config.channel)
        if names == self._names:
            return
        all_taken = self._locks.hold(names)
        self._names = [] if all_taken else names
        for taken in all_taken:
            if at_start:
                raise in_use(taken)
            self._conditions.say(logging.ERROR, str(in_use(taken)))

    def close(self) -> None:
        """Release them."""
        self._locks.close()
