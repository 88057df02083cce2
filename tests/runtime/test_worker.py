"""The thread beside the loop: what it is handed is done in order, and nothing that fails or stands still harms its owner."""

import os
import select
import signal
import threading

import pytest

from kontronik_can_gw.runtime import worker as worker_module
from kontronik_can_gw.runtime.worker import Handover, Worker

PATIENCE = 120


def readable(fd: int) -> bool:
    return bool(select.select([fd], [], [], 0)[0])


def test_a_handover_has_a_limit_and_is_readable_while_it_holds_something() -> None:
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


def test_a_closed_handover_writes_to_no_descriptor_that_is_anothers_by_now() -> None:
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


def test_an_end_read_with_the_last_items_is_not_lost(
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


def test_a_job_that_fails_is_reported_and_the_next_one_is_done(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(worker_module, "FAILURE_PAUSE_S", 0)
    done, failures = [], []
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
    assert worker.stop(PATIENCE) and silent.stop(PATIENCE)
    assert (done, failures) == ([1], ["ZeroDivisionError('of ours')"])
    assert caplog.messages == ["test: ZeroDivisionError('of ours')"], "where nobody else is told"


def test_no_signal_is_delivered_to_a_thread_beside_the_loop() -> None:
    """They are to wake the loop."""
    masks: list[set[int]] = []
    thread = threading.Thread(
        target=lambda: masks.append({*signal.pthread_sigmask(signal.SIG_BLOCK, ())})
    )
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert worker_module.start_beside_the_loop(thread)
    thread.join()
    assert {signal.SIGTERM, signal.SIGINT, signal.SIGHUP} <= masks[0]
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
