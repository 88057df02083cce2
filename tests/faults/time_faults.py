"""Faults of time: a wall clock that is set, a process that is suspended."""

import signal
import time

from harness import Bench, Fault, fault

LIMIT_S = 1.0


def _step(bench: Bench, fault: Fault, times: int, to: float | None, by: float = 0) -> None:
    for _ in range(times):
        with bench.injection(fault, []) as injection:
            right = time.time() - time.monotonic()
            bench.watch.note_clocks()
            time.clock_settime(time.CLOCK_REALTIME, time.time() + by if to is None else to)
            bench.watch.note_clocks()
            try:
                time.sleep(1.2)
            finally:
                time.clock_settime(time.CLOCK_REALTIME, right + time.monotonic())
                bench.watch.note_clocks()
            injection.cleared()


@fault("Time", "wall clock set 1 h forward, and back", None)
def forward(bench: Bench, fault: Fault, times: int) -> None:
    _step(bench, fault, times, None, 3600)


@fault("Time", "wall clock set 1 h back, and forward", None)
def back(bench: Bench, fault: Fault, times: int) -> None:
    _step(bench, fault, times, None, -3600)


@fault("Time", "wall clock set to 1970, and right again", None)
def epoch(bench: Bench, fault: Fault, times: int) -> None:
    _step(bench, fault, times, time.monotonic() + 5)  # no kernel takes less: it would have been started before 1970


@fault("Time", "process suspended (SIGSTOP, SIGCONT)", LIMIT_S)
def suspended(bench: Bench, fault: Fault, times: int) -> None:
    """For 10 s and for less; nothing old is sent as new."""
    assert bench.gateway is not None
    for i in range(times):
        with bench.injection(fault) as injection:
            bench.gateway.process.send_signal(signal.SIGSTOP)
            time.sleep((10, 0.4, 2)[i % 3])
            injection.cleared()
            bench.gateway.process.send_signal(signal.SIGCONT)
            injection.wait_recovery()
