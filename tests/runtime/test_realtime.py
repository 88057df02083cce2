"""Real-time priority: who gets which, and what is said where it is not permitted."""

import os
import threading

import pytest

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime import realtime
from kontronik_can_gw.runtime.worker import start_beside_the_loop


class Scheduler:
    """Stands for the kernel's: which thread has which policy and priority."""

    def __init__(self) -> None:
        self.of: dict[int, tuple[int, int]] = {}
        self.permits = True

    def set(self, pid: int, policy: int, param: os.sched_param) -> None:
        if not self.permits:
            raise PermissionError(1, "Operation not permitted")
        self.of[pid or threading.get_native_id()] = (policy, param.sched_priority)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Scheduler:
    scheduler = Scheduler()
    monkeypatch.setattr(os, "sched_setscheduler", scheduler.set)
    monkeypatch.setattr(realtime, "_lock_memory", lambda: None)
    monkeypatch.setattr(realtime._Taken, "priority", None)
    return scheduler


def test_the_loop_goes_before_the_threads_beside_it(kernel: Scheduler) -> None:
    ended = threading.Event()
    sleepers = [threading.Thread(target=ended.wait, daemon=True) for _ in range(2)]
    sleepers[0].start()
    realtime.begin(30)
    assert start_beside_the_loop(sleepers[1])
    assert kernel.of[threading.get_native_id()] == (os.SCHED_FIFO, 30)
    assert [kernel.of[each.native_id or 0] for each in sleepers] == [(os.SCHED_FIFO, 29)] * 2
    ended.set()


def test_what_is_not_permitted_is_said_with_the_remedy(
    kernel: Scheduler, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel.permits = False
    monkeypatch.delenv("INVOCATION_ID", raising=False)
    with pytest.raises(RunError, match="prlimit --rtprio=20"):
        realtime.begin(20)
    monkeypatch.setenv("INVOCATION_ID", "1")  # a service
    with pytest.raises(RunError, match="LimitRTPRIO=20"):
        realtime.begin(20)
