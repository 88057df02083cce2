"""The longest delay of the gateway with real-time priority, beside programs that use all CPU time.

The host of a virtual machine can stop a whole CPU. A process on each CPU with a higher priority
than the gateway and the feeder measures these pauses: it sleeps for 1 ms again and again, and notes
when it wakes too late. A pause within the delay of a frame is not counted as delay.
"""

import gc
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from programs import EVERYTHING, Context, Figure, LeftOut, once, started

_REALTIME = f"[run]\nrealtime_priority = 20\n{EVERYTHING}"
_WATCHER_PRIORITY = 90
"""Above the feeder (80) and the gateway (20)."""
_SLEEP_NS = 1_000_000
_SHORTEST_PAUSE_NS = 100_000
_MOST_LATE = 20_000
"""MOST_LATE of feeder.c."""
_BUSY_LOOP = (sys.executable, "-c", "while True: pass")

Span = tuple[int, int]
"""Begin and end in ns of the monotonic clock."""


def delay_busy(context: Context) -> list[Figure]:
    """Longest delay with 8 ESCs, recorder and CANopen under SCHED_FIFO, beside two busy loops."""
    _require_realtime()
    longer = replace(context, seconds=context.long_seconds)
    pauses: list[Span] = []
    with ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(started(_BUSY_LOOP))
        stack.enter_context(_measured_pauses(pauses))
        run = once(longer, "ours", 8, config=_REALTIME)
    late = [(begin, end) for begin, end in run.result["late"]]
    if len(late) == _MOST_LATE:
        raise RuntimeError(f"more than {_MOST_LATE} frames were later than 1 ms")
    own = [end - begin - paused((begin, end), pauses) for begin, end in late]
    longest_us = max(own, default=0) / 1000 if late else run.delay["max"]
    note = f"with the pauses of the host {run.delay['max']:.0f}, over {longer.seconds:g} s"
    return [
        Figure("busy CPUs, 99 %", run.delay["p99"], "us"),
        Figure("busy CPUs, longest delay", longest_us, "us", "<= 2000", note),
        Figure("busy CPUs, longest pause", max(map(_length, pauses), default=0) / 1000, "us"),
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
        watchers = []
        for cpu in sorted(os.sched_getaffinity(0)):
            streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
            process = started([sys.executable, __file__, cpu], **streams)
            watchers.append(stack.enter_context(process))
        yield
        for watcher in watchers:
            said, _ = watcher.communicate()  # closes its standard input
            pauses += [(begin, end) for begin, end in json.loads(said)]


def watch(cpu: int) -> None:
    """Print the pauses of a CPU as soon as standard input ends."""
    os.sched_setaffinity(0, [cpu])
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_WATCHER_PRIORITY))
    gc.disable()
    pauses = []
    ended = False
    while not ended:
        due = time.monotonic_ns() + _SLEEP_NS
        ended = bool(select.select([sys.stdin], [], [], _SLEEP_NS / 1e9)[0])
        now = time.monotonic_ns()
        if now - due > _SHORTEST_PAUSE_NS:
            pauses.append((due, now))
    print(json.dumps(pauses))


if __name__ == "__main__":
    watch(int(sys.argv[1]))
