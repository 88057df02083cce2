"""Processor time that a virtual machine wants and does not get, seen from outside: nobody inside can see that.

It is taken by the host of this machine ("steal" in /proc/stat) or by other work on it (run queue, /proc/PID/schedstat).
"""

import contextlib
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

WINDOW_S = 1.0
"""A tenth of it is what the shortest limits of the programme leave to a gateway."""


class Sample(NamedTuple):
    at_s: float
    taken_s: float
    """Since some time, of one processor."""


def worst_share(samples: Sequence[Sample], begin_s: float, end_s: float) -> float:
    """The largest share that was taken over ``WINDOW_S``, or over the whole time if that is shorter."""
    before = [each for each in samples if each.at_s <= begin_s][-1:]
    inside = before + [each for each in samples if begin_s < each.at_s <= end_s]
    if not inside:
        return 0.0
    window_s = min(WINDOW_S, 0.9 * (inside[-1].at_s - inside[0].at_s))
    worst = 0.0
    for last in inside[1:]:
        for first in [each for each in inside if last.at_s - each.at_s >= window_s][-1:]:
            worst = max(worst, (last.taken_s - first.taken_s) / (last.at_s - first.at_s))
    return worst


class Load:
    """Samples in a thread, as context manager."""

    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.machine: int | None = None
        """The process that has started the virtual machine, in a session of its own."""
        self.waits: dict[str, int] = {}
        """What each thread of it has waited so far, in ns."""
        self._waited_ns = 0
        self._per_s = os.sysconf("SC_CLK_TCK") * (os.cpu_count() or 1)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def take(self) -> None:
        with self._lock:
            for process in self._processes() if self.machine else ():
                with contextlib.suppress(OSError, IndexError):
                    # it may end meanwhile, even while its threads are listed
                    for file in process.glob("task/*/schedstat"):
                        waited = int(file.read_text().split()[1])
                        self._waited_ns += waited - self.waits.get(str(file), 0)
                        self.waits[str(file)] = waited
            # user, nice, system, idle, iowait, irq, softirq, steal
            stolen = int(Path("/proc/stat").read_text().split()[8])
            taken_s = stolen / self._per_s + self._waited_ns / 1e9
            self.samples.append(Sample(time.monotonic(), taken_s))

    def _processes(self) -> list[Path]:
        """Those of the sessions that ``machine`` has begun; it starts another one that watches over it."""
        session_of: dict[Path, str] = {}
        begun = set()
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                words = stat.read_text(errors="replace").rpartition(")")[2].split()
                session_of[stat.parent] = words[3]
                if words[1] == str(self.machine):
                    begun.add(words[3])
        return [process for process, session in session_of.items() if session in begun]

    def _run(self) -> None:
        while not self._stop.wait(0.5):
            self.take()

    def __enter__(self) -> Self:
        self.take()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
