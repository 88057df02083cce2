"""What the checks see of the machine: files below a root, programs that only read, processes and users. Nothing is changed.

Names are absolute paths on the machine; tests use another root.
"""

import contextlib
import grp
import os
import pwd
import stat
import subprocess
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

_PATIENCE_S = 5.0


class Process(NamedTuple):
    """A running program."""

    pid: int
    name: str
    words: tuple[str, ...]

    @property
    def is_gateway(self) -> bool:
        """True for a gateway of ours: `kontronik-can-gw run`, or `python -m kontronik_can_gw run`."""
        names = {word.rpartition("/")[2] for word in self.words[:4]}
        return "run" in self.words[1:] and bool({"kontronik-can-gw", "kontronik_can_gw"} & names)

    def __str__(self) -> str:
        return f"{'kontronik-can-gw' if self.is_gateway else self.name} (pid {self.pid})"


class Machine:
    """The machine below ``root``."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def path(self, name: str) -> Path:
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str:
        """A small file's text; empty where it cannot be read."""
        with contextlib.suppress(OSError):
            return self.path(name).read_bytes().decode("utf-8", "replace").strip("\0\n ")
        return ""

    def names(self, folder: str) -> list[str]:
        """Names in a folder; empty where it cannot be read."""
        with contextlib.suppress(OSError):
            return sorted(each.name for each in self.path(folder).iterdir())
        return []

    def status(self, name: str) -> os.stat_result | None:
        """None where there is nothing of that name that we may see."""
        with contextlib.suppress(OSError):
            return self.path(name).stat()
        return None

    def exists(self, name: str) -> bool:
        return self.status(name) is not None

    def real(self, name: str) -> str:
        """The path without symbolic links."""
        root = os.path.realpath(self.root)
        return os.path.realpath(self.path(name)).removeprefix("" if root == "/" else root) or "/"

    def space(self, folder: str) -> tuple[bool, int]:
        """Whether a folder's file system is read-only, and its free bytes: 0 where no more files can be made."""
        found = os.statvfs(self.path(folder))
        is_full = found.f_files and not found.f_favail
        free = 0 if is_full else found.f_bavail * found.f_frsize
        return bool(found.f_flag & os.ST_RDONLY), free

    def may(self, name: str, mode: int) -> bool:
        """True if this process may use a file or folder so (as for ``os.access``), access lists included."""
        return os.access(self.path(name), mode)

    def run(self, *command: str) -> str:
        """Output of a program, whatever its exit code; empty where it is missing or takes too long."""
        path = (
            f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin"  # `ip` is not on every user's
        )
        env = os.environ | {"LC_ALL": "C", "PATH": path}
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_PATIENCE_S, env=env
            )  # fmt: skip
            return done.stdout.decode("utf-8", "replace")
        return ""

    @cached_property
    def user(self) -> str:
        """The name of this process's user."""
        try:
            return pwd.getpwuid(os.geteuid()).pw_name
        except KeyError:
            return str(os.geteuid())

    def group_name(self, gid: int) -> str:
        try:
            return grp.getgrgid(gid).gr_name
        except KeyError:
            return str(gid)

    @cached_property
    def processes(self) -> list[Process]:
        """All visible processes except this one."""
        found = []
        for pid in (int(name) for name in self.names("/proc") if name.isdigit()):
            if pid != os.getpid() and (name := self.text(f"/proc/{pid}/comm")):
                words = self.text(f"/proc/{pid}/cmdline").split("\0")
                found.append(Process(pid, name, tuple(words)))
        return found

    @property
    def runs_gateway(self) -> bool:
        return any(process.is_gateway for process in self.processes)

    def openers(self, device: os.stat_result) -> Iterator[Process]:
        """Processes that have a character device open, as far as this user may see."""
        for process in self.processes:
            folder = f"/proc/{process.pid}/fd"
            held = (self.status(f"{folder}/{number}") for number in self.names(folder))
            if any(s and stat.S_ISCHR(s.st_mode) and s.st_rdev == device.st_rdev for s in held):
                yield process
