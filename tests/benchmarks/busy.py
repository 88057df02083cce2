"""The maximum latency of the gateway with real-time priority, beside programs that use all
processors.

The host of a virtual machine can stop a whole CPU. A process on each CPU with a higher priority
than the gateway and the feeder measures these pauses: it sleeps for 1 ms again and again, and notes
when it wakes too late. A pause within the delay of a frame is not counted as delay.

Linux passes the bytes of a serial port on to its reader by a worker of normal priority. The busy
loops delay this worker, and with it the gateway. So there are two benchmarks: with the workers as
they are, and with real-time priority for them, too.
"""

import gc
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

from programs import EVERYTHING, Context, Figure, LeftOut, once, started

_REALTIME = f"[run]\nrealtime_priority = 20\n{EVERYTHING}"
_WATCHER_PRIORITY = 90
"""Above the feeder (80) and the gateway (20)."""
_WORKER_PRIORITY = 85
_WORKERS = "kworker/u"
"""Begin of the names of the kernel's workers that are bound to no CPU."""
_NEW_WORKERS_S = 0.1
"""The kernel starts and ends workers all the time."""
_SLEEP_NS = 1_000_000
_SHORTEST_PAUSE_NS = 100_000
_MOST_LATE = 20_000
"""MOST_LATE of feeder.c."""
_BUSY_LOOP = (sys.executable, "-c", "while True: pass")

Span = tuple[int, int]
"""Begin and end in ns of the monotonic clock."""


def delay_busy(context: Context) -> list[Figure]:
    """Maximum latency with 8 ESCs, recorder and CANopen under SCHED_FIFO, beside two busy loops."""
    return _longest_delay(context, "busy CPUs", nullcontext())


def delay_busy_workers(context: Context) -> list[Figure]:
    """The same with real-time priority for the kernel's workers, which serve the serial ports."""
    if os.geteuid():
        raise LeftOut("no permission to set the priority of kernel workers: run it as root")
    return _longest_delay(context, "busy CPUs, workers", _helper("workers"))


def _longest_delay(
    context: Context,
    name: str,
    workers: AbstractContextManager[object],
) -> list[Figure]:
    _require_realtime()
    longer = replace(context, seconds=context.long_seconds)
    pauses: list[Span] = []
    with ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(started(_BUSY_LOOP))
        stack.enter_context(_measured_pauses(pauses))
        stack.enter_context(workers)
        run = once(longer, "ours", 8, config=_REALTIME)
    late = [(begin, end) for begin, end in run.result["late"]]
    if len(late) == _MOST_LATE:
        raise RuntimeError(f"more than {_MOST_LATE} frames were later than 1 ms")
    own = [end - begin - paused((begin, end), pauses) for begin, end in late]
    longest_us = max(own, default=0) / 1000 if late else run.delay["max"]
    note = f"with the pauses of the host {run.delay['max']:.0f}, over {longer.seconds:g} s"
    return [
        Figure(f"{name}, p99", run.delay["p99"], "us"),
        Figure(f"{name}, maximum", longest_us, "us", "<= 2000", note),
        Figure(f"{name}, longest pause", max(map(_length, pauses), default=0) / 1000, "us"),
    ]


def _length(span: Span) -> int:
    return span[1] - span[0]


def paused(delay: Span, pauses: Iterable[Span]) -> int:
    """Return for how long at least one CPU was paused within a delay, in ns."""
    total = 0
    counted_to = delay[0]
    for begin, end in sorted(pauses):
        begin = max(begin, counted_to)
        end = min(end, delay[1])
        if end > begin:
            total += end - begin
            counted_to = end
    return total


def _require_realtime() -> None:
    policy = os.sched_getscheduler(0)
    param = os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_WATCHER_PRIORITY))
    except OSError:
        raise LeftOut(
            f"no permission for SCHED_FIFO: sudo prlimit --rtprio={_WATCHER_PRIORITY} "
            "--memlock=unlimited --pid $$"
        ) from None
    os.sched_setscheduler(0, policy, param)


@contextmanager
def _measured_pauses(pauses: list[Span]) -> Iterator[None]:
    """Measure the pauses of each CPU during the block. Add them to ``pauses`` at its end."""
    with ExitStack() as stack:
        cpus = sorted(os.sched_getaffinity(0))
        watchers = [stack.enter_context(_helper(str(cpu))) for cpu in cpus]
        yield
        for watcher in watchers:
            said, _ = watcher.communicate()  # closes its standard input
            pauses += [(begin, end) for begin, end in json.loads(said)]


@contextmanager
def _helper(task: str) -> Iterator[subprocess.Popen[str]]:
    """Run this file with a task until the end of the block, or of its standard input."""
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with started([sys.executable, __file__, task], **streams) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.communicate()


def watch(cpu: int) -> None:
    """Print the pauses of a CPU as soon as standard input ends."""
    os.sched_setaffinity(0, [cpu])
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_WATCHER_PRIORITY))
    gc.disable()
    pauses = []
    ended = False
    while not ended:
        due = time.monotonic_ns() + _SLEEP_NS
        ended = _has_ended(_SLEEP_NS / 1e9)
        now = time.monotonic_ns()
        if now - due > _SHORTEST_PAUSE_NS:
            pauses.append((due, now))
    print(json.dumps(pauses))


def raise_workers() -> None:
    """Give kernel workers real-time priority until standard input ends."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_WATCHER_PRIORITY))
    raised: set[int] = set()
    while not _has_ended(_NEW_WORKERS_S):
        for pid in _workers():
            with suppress(ProcessLookupError):  # it has ended
                if os.sched_getscheduler(pid) == os.SCHED_OTHER:
                    os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(_WORKER_PRIORITY))
                    raised.add(pid)
    for pid in _workers() & raised:
        with suppress(ProcessLookupError):
            os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))


def _workers() -> set[int]:
    """Return the process numbers of the kernel's workers that are bound to no CPU."""
    found = set()
    for file in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):  # it has ended
            if file.read_text().startswith(_WORKERS):
                found.add(int(file.parent.name))
    return found


def _has_ended(wait_s: float) -> bool:
    """Wait for the end of standard input for at most this long. Return if it came."""
    return bool(select.select([sys.stdin], [], [], wait_s)[0])


if __name__ == "__main__":
    if sys.argv[1] == "workers":
        raise_workers()
    else:
        watch(int(sys.argv[1]))
