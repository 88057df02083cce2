"""The machine as the checks see it: files below a root, programs that only read, processes, users.

Nothing is changed. Names are absolute paths on the machine. Tests use another root.
"""

import contextlib
import grp
import os
import pwd
import re
import stat
import subprocess
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path, PurePath
from typing import NamedTuple

from kontronik_can_gw.runtime.system.clock import (
    MAX_ERROR_US,
    ClockFacts,
    hardware_clock,
    max_error_us,
)

_PATIENCE_S = 5.0
"""Longest time that a program may take."""


_ESCAPE = re.compile(r"\\([0-7]{3})")
"""A blank or another character in the names of /proc/self/mountinfo."""


class Process(NamedTuple):
    """A running program."""

    pid: int
    name: str
    words: tuple[str, ...]

    @property
    def is_gateway(self) -> bool:
        """True for `kontronik-can-gw run` and `python -m kontronik_can_gw run`."""
        names = {word.rpartition("/")[2] for word in self.words[:4]}
        is_ours = not names.isdisjoint({"kontronik-can-gw", "kontronik_can_gw"})
        return is_ours and "run" in self.words[1:]

    def __str__(self) -> str:
        name = "kontronik-can-gw" if self.is_gateway else self.name
        return f"{name} (pid {self.pid})"


class Machine:
    """The machine below ``root``."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def path(self, name: str) -> Path:
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str:
        """Return the text of a small file. Empty if it cannot be read."""
        with contextlib.suppress(OSError):
            return self.path(name).read_bytes().decode("utf-8", "replace").strip("\0\n ")
        return ""

    def target_of(self, name: str) -> str:
        """Return the target of a symbolic link. Empty if there is none."""
        with contextlib.suppress(OSError):
            return str(self.path(name).readlink())
        return ""

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder. Empty if it cannot be read."""
        with contextlib.suppress(OSError):
            return sorted(each.name for each in self.path(folder).iterdir())
        return []

    def status(self, name: str) -> os.stat_result | None:
        """Return the status of a file. None if it does not exist or is not visible."""
        with contextlib.suppress(OSError):
            return self.path(name).stat()
        return None

    def exists(self, name: str) -> bool:
        return self.status(name) is not None

    def real(self, name: str) -> str:
        """Return a path without symbolic links."""
        root = os.path.realpath(self.root)
        path = os.path.realpath(self.path(name))
        if root != "/":
            path = path.removeprefix(root)
        return path or "/"

    def space(self, folder: str) -> tuple[bool, int]:
        """Return two facts about a folder's file system: if it is read-only, and its free bytes.

        There are 0 free bytes if no more files can be created.
        """
        found = os.statvfs(self.path(folder))
        is_full = found.f_files and not found.f_favail
        free = 0 if is_full else found.f_bavail * found.f_frsize
        return bool(found.f_flag & os.ST_RDONLY), free

    def file_system(self, folder: str) -> str:
        """Return the type of the file system of a folder, such as "ext4". Empty if unknown."""
        real = PurePath(self.real(folder))
        found = ""
        longest = 0
        for line in self.text("/proc/self/mountinfo").splitlines():
            fields, _, rest = line.partition(" - ")
            name = _ESCAPE.sub(lambda found: chr(int(found[1], 8)), fields.split(" ")[4])
            place = PurePath(name)
            if real.is_relative_to(place) and len(place.parts) >= longest:  # the last one is on top
                longest = len(place.parts)
                found = rest.partition(" ")[0]
        return found

    def may(self, name: str, mode: int) -> bool:
        """Return True if this process may use a file or folder in a mode of ``os.access``.

        Access lists are respected.
        """
        return os.access(self.path(name), mode)

    def clock(self) -> ClockFacts:
        """Return the state of the wall clock."""
        error = max_error_us()
        return ClockFacts(
            synchronized=None if error is None else error < MAX_ERROR_US,
            hardware=hardware_clock(self.path("/sys/class/rtc")),
        )

    def run(self, *command: str) -> str:
        """Return the output of a program, regardless of its exit code.

        Empty if the program is missing or takes too long.
        """
        return self.outputs(*command)[0]

    def outputs(self, *command: str, patience_s: float = _PATIENCE_S) -> tuple[str, str | None]:
        """Return the standard output and the standard error of a program.

        The second is None if the program is missing or takes too long.
        """
        path = os.environ.get("PATH", os.defpath)
        path += ":/usr/sbin:/sbin"  # contains `ip`, and is missing in the PATH of some users
        env = os.environ | {"LC_ALL": "C", "PATH": path}
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=patience_s,
                env=env,
            )
            return done.stdout.decode("utf-8", "replace"), done.stderr.decode("utf-8", "replace")
        return "", None

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
        pids = [int(name) for name in self.names("/proc") if name.isdigit()]
        for pid in pids:
            name = self.text(f"/proc/{pid}/comm")
            if pid != os.getpid() and name:
                words = self.text(f"/proc/{pid}/cmdline").split("\0")
                found.append(Process(pid, name, tuple(words)))
        return found

    @property
    def has_gateway(self) -> bool:
        return any(process.is_gateway for process in self.processes)

    def openers(self, device: os.stat_result) -> Iterator[Process]:
        """Yield the processes that have a character device open and are visible to this user."""
        for process in self.processes:
            folder = f"/proc/{process.pid}/fd"
            files = (self.status(f"{folder}/{number}") for number in self.names(folder))
            devices = [file.st_rdev for file in files if file and stat.S_ISCHR(file.st_mode)]
            if device.st_rdev in devices:
                yield process
