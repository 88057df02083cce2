"""Reads a process's resources and start time from /proc.

The start time distinguishes a process from an earlier one with the same pid.
"""

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ProcessFacts:
    """The resources that a process uses. 0 if unknown."""

    rss_bytes: int = 0
    open_fds: int = 0
    threads: int = 0


def process_facts() -> ProcessFacts:
    """Return the resources that this process uses now, from two files of /proc."""
    threads = 0
    rss_bytes = 0
    open_fds = 0
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = _stat_fields("self")
        threads = int(fields[17])
        rss_bytes = int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
    with contextlib.suppress(OSError):
        names = os.listdir("/proc/self/fd")  # noqa: PTH208  the names suffice
        open_fds = len(names) - 1  # listing the folder opens one
    return ProcessFacts(rss_bytes, open_fds, threads)


def start_ticks(pid: int) -> int:
    """Return the start time of a process in clock ticks since boot.

    Pid and start time together identify a process. 0 if the time is unknown, -1 for a process
    that has ended and only waits for its parent.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = _stat_fields(str(pid))
        has_ended = fields[0] in (b"Z", b"X")
        return -1 if has_ended else int(fields[19])
    return 0


def pid_namespace() -> str:
    """Return the namespace of this process's pids. "" if unknown."""
    with contextlib.suppress(OSError):
        return str(Path("/proc/self/ns/pid").readlink())
    return ""


def _stat_fields(pid: str) -> list[bytes]:
    """Return the fields of /proc/PID/stat after the program's name.

    The name may contain spaces and parentheses.
    """
    return Path("/proc", pid, "stat").read_bytes().rpartition(b")")[2].split()
