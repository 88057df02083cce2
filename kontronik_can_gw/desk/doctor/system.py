"""Access of the checks to the machine: files below a root, read-only programs, processes. Nothing is changed.

Names are absolute paths on the machine; tests use another root.
"""

import contextlib
import grp
import os
import pwd
import shutil
import stat
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

PROGRAM_PATH = os.environ.get("PATH", os.defpath) + ":/usr/sbin:/sbin"
"""Search path for programs: `ip` is not on every user's path."""
_PATIENCE_S = 5.0


class Process(NamedTuple):
    """A running program."""

    pid: int
    name: str
    words: tuple[str, ...] = ()

    @property
    def is_gateway(self) -> bool:
        """True for a gateway of ours: `kontronik-can-gw run`, or `python -m kontronik_can_gw run`."""
        names = [word.rpartition("/")[2] for word in self.words[:4]]
        return "run" in self.words[1:] and bool(
            {"kontronik-can-gw", "kontronik_can_gw"} & set(names)
        )

    def __str__(self) -> str:
        return f"{'kontronik-can-gw' if self.is_gateway else self.name} (pid {self.pid})"


@dataclass(frozen=True)
class User:
    """A user: name, user-ID and the IDs of all groups."""

    name: str
    uid: int
    groups: frozenset[int] = field(default_factory=frozenset)

    def may(self, status: os.stat_result, bits: int) -> bool:
        """True if the mode allows all of ``bits`` (4 read, 2 write, 1 enter or run)."""
        if self.uid == 0:
            return True
        shift = 6 if status.st_uid == self.uid else 3 if status.st_gid in self.groups else 0
        return status.st_mode >> shift & bits == bits


class FileSystem(NamedTuple):
    """Free space of a folder's file system."""

    read_only: bool
    free_bytes: int
    free_files: int | None
    """None where the file system has no such limit."""


class System:
    """The machine below ``root``."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    # --- files

    def path(self, name: str) -> Path:
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str | None:
        """A small file's text; None where it cannot be read. Device trees end theirs with NUL."""
        try:
            return self.path(name).read_bytes().decode("utf-8", "replace").strip("\0\n ")
        except OSError:
            return None

    def number(self, name: str) -> int | None:
        """A file with one number in it."""
        try:
            return int(self.text(name) or "", 0)
        except ValueError:
            return None

    def names(self, folder: str) -> list[str]:
        """Names in a folder; empty where it cannot be read."""
        try:
            return sorted(each.name for each in self.path(folder).iterdir())
        except OSError:
            return []

    def exists(self, name: str) -> bool:
        return self.status(name) is not None

    def real(self, name: str) -> str:
        """The path without symbolic links."""
        found = os.path.realpath(self.path(name))
        root = os.path.realpath(self.root)
        return found if root == "/" else found.removeprefix(root) or "/"

    def status(self, name: str) -> os.stat_result | None:
        try:
            return self.path(name).stat()
        except OSError:
            return None

    def file_system(self, name: str) -> FileSystem | None:
        try:
            found = os.statvfs(self.path(name))
        except OSError:
            return None
        files = found.f_favail if found.f_files else None
        return FileSystem(bool(found.f_flag & os.ST_RDONLY), found.f_bavail * found.f_frsize, files)

    def may_open(self, name: str) -> bool:
        """True if this process may read and write a file, access lists included."""
        return os.access(self.path(name), os.R_OK | os.W_OK)

    def may_fill(self, name: str) -> bool:
        """True if this process may make files in a folder."""
        return os.access(self.path(name), os.W_OK | os.X_OK)

    # --- programs

    def run(self, *command: str) -> str | None:
        """Output of a program, whatever its exit code; None where it is missing or takes too long."""
        program = shutil.which(command[0], path=PROGRAM_PATH)
        if program is None:
            return None
        try:
            done = subprocess.run(
                [program, *command[1:]],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=_PATIENCE_S,
                check=False,
                env={**os.environ, "LC_ALL": "C"},
            )
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout

    @property
    def has_systemd(self) -> bool:
        return self.exists("/run/systemd/system")

    # --- users

    @cached_property
    def user(self) -> User:
        """The user of this process."""
        uid = os.geteuid()
        name = str(uid)
        with contextlib.suppress(KeyError):
            name = pwd.getpwuid(uid).pw_name
        return User(name, uid, frozenset((*os.getgroups(), os.getegid())))

    def user_named(self, name: str, more_groups: Sequence[str] = ()) -> User | None:
        """A user by name, with the groups from the system and ``more_groups``; None where there is none."""
        try:
            found = pwd.getpwnam(name)
        except KeyError:
            return None
        groups = os.getgrouplist(name, found.pw_gid)
        return User(name, found.pw_uid, frozenset(groups) | self.group_numbers(more_groups))

    def dynamic_user(self, name: str, groups: Sequence[str]) -> User:
        """A user that systemd creates when the service starts (DynamicUser)."""
        return User(name, -1, self.group_numbers(groups))

    def group_numbers(self, names: Sequence[str]) -> frozenset[int]:
        """The numbers of those groups that there are."""
        return frozenset(group.gr_gid for group in grp.getgrall() if group.gr_name in names)

    def group_name(self, gid: int) -> str:
        try:
            return grp.getgrgid(gid).gr_name
        except KeyError:
            return str(gid)

    # --- processes

    @cached_property
    def processes(self) -> list[Process]:
        """All visible processes except this one."""
        found = []
        for pid in self.names("/proc"):
            if not pid.isdigit() or int(pid) == os.getpid():
                continue
            name = self.text(f"/proc/{pid}/comm")
            if name is not None:
                words = (self.text(f"/proc/{pid}/cmdline") or "").split("\0")
                found.append(Process(int(pid), name, tuple(words)))
        return found

    def openers(self, device: os.stat_result) -> tuple[list[Process], bool]:
        """Processes that have a character device open or locked; False if there may be others that this user cannot see."""
        found: dict[int, Process] = {}
        complete = bool(self.processes) and self.exists("/proc/1/comm")
        for process in self.processes:
            folder = f"/proc/{process.pid}/fd"
            try:
                numbers = [each.name for each in self.path(folder).iterdir()]
            except PermissionError:
                complete = False
                continue
            except OSError:  # it ended meanwhile
                continue
            for number in numbers:
                status = self.status(f"{folder}/{number}")
                if status and stat.S_ISCHR(status.st_mode) and status.st_rdev == device.st_rdev:
                    found[process.pid] = process
        known = {process.pid: process for process in self.processes}
        for pid in self._lockers(device) - {os.getpid()}:
            found[pid] = known.get(pid) or Process(pid, "a program that we may not see")
        return [found[pid] for pid in sorted(found)], complete

    def _lockers(self, file: os.stat_result) -> set[int]:
        """Processes that have locked a file; every user can see them."""
        where = f"{os.major(file.st_dev):02x}:{os.minor(file.st_dev):02x}:{file.st_ino}"
        lines = [line.split() for line in (self.text("/proc/locks") or "").splitlines()]
        return {
            int(words[4])
            for words in lines
            if len(words) > 5 and words[5] == where and words[4].isdigit()
        }
