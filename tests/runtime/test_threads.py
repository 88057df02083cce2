"""Threads beside the loop, and their priority.

A thread does its jobs in order. A job that fails or blocks does not harm its owner.
"""

import io
import logging
import os
import select
import signal
import threading

import pytest

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.system import realtime
from kontronik_can_gw.runtime.system import worker as worker_module
from kontronik_can_gw.runtime.system.fault_log import CAPACITY, BackgroundHandler
from kontronik_can_gw.runtime.system.worker import Handover, Worker, start_beside_the_loop

pytestmark = pytest.mark.promise("threads")

PATIENCE = 120


def readable(fd: int) -> bool:
    return bool(select.select([fd], [], [], 0)[0])


def test_handover_has_a_limit_and_is_readable_while_it_has_items() -> None:
    handover: Handover[int] = Handover(3)
    assert not readable(handover.fileno())
    assert [handover.put(n) for n in range(4)] == [True, True, True, False]
    assert handover.take(2) == [0, 1]
    assert readable(handover.fileno())
    assert handover.take(2) == [2]
    assert not readable(handover.fileno())
    handover.wake()
    assert readable(handover.fileno())
    assert handover.take() == []
    handover.close()
    handover.close()
    assert handover.fileno() == -1


def test_closed_handover_never_writes_to_a_reused_descriptor() -> None:
    handover: Handover[int] = Handover()
    number = handover.fileno()
    handover.close()
    other = os.eventfd(0, os.EFD_NONBLOCK)
    try:
        assert other == number, "the number was not used again: this test shows nothing"
        assert handover.put(1)
        handover.wake()
        assert not readable(other)
        assert handover.take() == [1]
    finally:
        os.close(other)


def test_end_read_with_the_last_items_is_not_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[int] = []
    worker: Worker[int] = Worker("test", done.extend)
    take = worker._items.take

    def ended_just_before() -> list[int]:
        worker.end()
        return take()

    monkeypatch.setattr(worker._items, "take", ended_just_before)
    worker.put(1)
    assert worker.start()
    assert worker._thread is not None
    worker._thread.join(PATIENCE)
    assert not worker._thread.is_alive()
    assert done == [1]


def test_job_that_fails_is_reported_and_the_next_job_is_done(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(worker_module, "FAILURE_PAUSE_S", 0)
    done = []
    failures = []
    reached = threading.Event()

    def work(items: list[int]) -> None:
        if 0 in items:
            raise ZeroDivisionError("of ours")
        done.extend(items)

    def failed(error: Exception) -> None:
        failures.append(repr(error))
        reached.set()

    worker: Worker[int] = Worker("test", work, failed=failed)
    silent: Worker[int] = Worker("test", work)
    for each in (silent, worker):
        each.start()
        each.put(0)
    assert reached.wait(PATIENCE)
    worker.put(1)
    assert worker.stop(PATIENCE)
    assert silent.stop(PATIENCE)
    assert done == [1]
    assert failures == ["ZeroDivisionError('of ours')"]
    assert caplog.messages == ["test: ZeroDivisionError('of ours')"], "without a callback"


def test_no_signal_is_delivered_to_a_thread_beside_the_loop() -> None:
    """Signals must wake the loop."""
    masks: list[set[int]] = []
    thread = threading.Thread(
        target=lambda: masks.append({*signal.pthread_sigmask(signal.SIG_BLOCK, ())})
    )
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert start_beside_the_loop(thread)
    thread.join()
    assert {signal.SIGTERM, signal.SIGINT, signal.SIGHUP} <= masks[0]
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


# --- the thread of the log


class StuckStream(io.StringIO):
    """A stream that blocks until it is set free."""

    def __init__(self) -> None:
        super().__init__()
        self.stands = threading.Event()
        self.free = threading.Event()
        self.written: list[str] = []

    def write(self, text: str) -> int:
        self.stands.set()
        assert self.free.wait(60)
        self.written.append(text)
        return len(text)


def test_blocked_stream_delays_no_caller_and_losses_are_logged() -> None:
    stream = StuckStream()
    handler = BackgroundHandler(stream, longest_end_s=0)
    handler.handle(logging.makeLogRecord({"msg": "first"}))
    assert stream.stands.wait(60)
    for n in range(CAPACITY + 500):
        handler.handle(logging.makeLogRecord({"msg": "line %d", "args": (n,)}))
    handler.close()
    assert stream.written == [], "all this happened before the first line was written"
    stream.free.set()
    handler._longest_end_s = 60
    handler.close()
    assert stream.written[0] == "first\n"
    lines = stream.written[1].splitlines()
    assert lines[:CAPACITY] == [f"line {n}" for n in range(CAPACITY)]
    assert lines[CAPACITY:] == ["500 log lines were lost: they could not be written in time"]


@pytest.mark.parametrize(
    "error",
    [OSError(5, "Input/output error"), ValueError("I/O operation on closed file")],
)
def test_stream_that_fails_raises_no_exception(error: Exception) -> None:
    class Broken(io.StringIO):
        def write(self, text: str) -> int:
            raise error

    handler = BackgroundHandler(Broken())
    for text, *args in (("nobody reads this",), ("%d", "not a number")):
        handler.handle(logging.makeLogRecord({"msg": text, "args": tuple(args)}))
    handler.close()


# --- real-time priority


class Scheduler:
    """Replacement for the kernel's scheduler: policy and priority of each thread."""

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


def test_loop_has_priority_over_the_threads_beside_it(kernel: Scheduler) -> None:
    ended = threading.Event()
    sleepers = [threading.Thread(target=ended.wait, daemon=True) for _ in range(2)]
    sleepers[0].start()
    realtime.begin(30)
    assert start_beside_the_loop(sleepers[1])
    assert kernel.of[threading.get_native_id()] == (os.SCHED_FIFO, 30)
    assert [kernel.of[each.native_id or 0] for each in sleepers] == [(os.SCHED_FIFO, 29)] * 2
    ended.set()


def test_priority_that_is_not_permitted_is_reported_with_the_remedy(
    kernel: Scheduler,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kernel.permits = False
    monkeypatch.delenv("INVOCATION_ID", raising=False)
    with pytest.raises(RunError, match="prlimit --rtprio=20"):
        realtime.begin(20)
    monkeypatch.setenv("INVOCATION_ID", "1")  # a service
    with pytest.raises(RunError, match="LimitRTPRIO=20"):
        realtime.begin(20)
