"""Real-time priority, so that no other program's load delays a frame: SCHED_FIFO, and memory that is never given away.

The loop's thread has the priority that was asked for, the threads beside it one less: a thread that held the interpreter's lock and had to
wait for other programs would hold the loop up with it. The kernel leaves others a share in any case (sched_rt_runtime_us, 5 %).
"""

import contextlib
import os
import resource
import threading

from kontronik_can_gw.errors import RunError

_LOCK_CURRENT, _LOCK_FUTURE, _LOCK_ON_FAULT = 1, 2, 4
"""Of mlockall(2): what is used, as it comes to be used."""


class _Taken:
    """What was taken here: what others gave this process (chrt) is left as it is."""

    priority: int | None = None


def begin(priority: int) -> None:
    """Take real-time priority for this thread, the loop's, and those beside it. RunError where this process has no right to it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        raise RunError(
            f"run.realtime_priority = {priority}: not permitted. {_how(priority)}, then start again."
        ) from None
    except OSError as error:
        raise RunError(
            f"run.realtime_priority = {priority}: {error.strerror or error}. Leave it out."
        ) from None
    _Taken.priority = priority
    for thread in threading.enumerate():
        if thread is not threading.current_thread():
            follow(thread)
    _lock_memory()


def follow(thread: threading.Thread) -> None:
    """Give a thread beside the loop its priority: that of the loop less one; nothing where it has none."""
    if _Taken.priority is None or thread.native_id is None:
        return
    param = os.sched_param(max(1, _Taken.priority - 1))
    with contextlib.suppress(OSError):  # it has ended by now
        os.sched_setscheduler(thread.native_id, os.SCHED_FIFO, param)


def _how(priority: int) -> str:
    if "INVOCATION_ID" in os.environ:  # systemd
        return (
            "sudo systemctl edit kontronik-can-gw, and there under [Service]: RestrictRealtime=no, "
            f"LimitRTPRIO={priority} and LimitMEMLOCK=infinity, each on a line"
        )
    return f"Once, for this shell: sudo prlimit --rtprio={priority} --memlock=unlimited --pid $$"


def _lock_memory() -> None:
    """Keep what is used in memory, where that has no limit: with one, an allocation would fail some day."""
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return
    import ctypes  # a megabyte that others need not pay for

    ctypes.CDLL(None, use_errno=True).mlockall(_LOCK_CURRENT | _LOCK_FUTURE | _LOCK_ON_FAULT)
