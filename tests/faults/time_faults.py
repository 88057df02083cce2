"""Faults of time: a wall clock that is set, a process that is suspended."""

import signal
import time
from collections.abc import Callable
from functools import partial

from harness import Bench, Injection, injected


def clock_set(bench: Bench, _injection: Injection, _n: int, to: Callable[[], float]) -> None:
    right = time.time() - time.monotonic()
    bench.watch.note_clocks()
    time.clock_settime(time.CLOCK_REALTIME, to())
    bench.watch.note_clocks()
    try:
        time.sleep(1.2)
    finally:
        time.clock_settime(time.CLOCK_REALTIME, right + time.monotonic())
        bench.watch.note_clocks()


for name, to in (
    ("wall clock set 1 h forward, and back", lambda: time.time() + 3600),
    ("wall clock set 1 h back, and forward", lambda: time.time() - 3600),
    # no kernel takes less: it would have been started before 1970
    ("wall clock set to 1970, and right again", lambda: time.monotonic() + 5),
):
    injected("Time", name, None, escs=[])(partial(clock_set, to=to))


@injected("Time", "process suspended (SIGSTOP, SIGCONT)", 1.0)
def suspended(bench: Bench, injection: Injection, n: int) -> None:
    """For 10 s and for less; nothing old is sent as new."""
    assert bench.gateway is not None
    bench.gateway.process.send_signal(signal.SIGSTOP)
    time.sleep((10, 0.4, 2)[n % 3])
    injection.cleared()
    bench.gateway.process.send_signal(signal.SIGCONT)
