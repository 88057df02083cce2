"""What the kernel says of a process: its resources, and what distinguishes it from one that had its pid before."""

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ProcessFacts:
    """What the process uses. 0 where it is unknown."""

    rss_bytes: int = 0
    open_fds: int = 0
    threads: int = 0


def process_facts() -> ProcessFacts:
    """About this process, now: two looks into /proc."""
    threads = rss = fds = 0
    with contextlib.suppress(OSError, ValueError, IndexError):
        found = _stat_fields("self")
        threads, rss = int(found[17]), int(found[21]) * os.sysconf("SC_PAGE_SIZE")
    with contextlib.suppress(OSError):
        fds = len(os.listdir("/proc/self/fd")) - 1  # noqa: PTH208  names are enough; one is that of the listing itself
    return ProcessFacts(rss, fds, threads)


def start_ticks(pid: int) -> int:
    """When a process started, in clock ticks since boot: with the pid it is one and no other.

    0 where it is unknown, -1 for a process that has ended and only waits for its parent.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        found = _stat_fields(str(pid))
        return -1 if found[0] in (b"Z", b"X") else int(found[19])
    return 0


def pid_namespace() -> str:
    """The namespace of this process's pids; '' where it is unknown."""
    with contextlib.suppress(OSError):
        return str(Path("/proc/self/ns/pid").readlink())
    return ""


def _stat_fields(pid: str) -> list[bytes]:
    """The fields of /proc/PID/stat after the program's name, which may hold anything."""
    return Path("/proc", pid, "stat").read_bytes().rpartition(b")")[2].split()
