"""Sets real-time priority (SCHED_FIFO) and locks memory, so that other programs delay no frame.

The loop's thread gets the configured priority, and the threads beside it get one less. Without
that, a thread that holds the interpreter's lock could wait for other programs, and the loop would
wait for it. The kernel always reserves a share of 5 % for other programs (sched_rt_runtime_us).
"""

import contextlib
import os
import resource
import threading

from kontronik_can_gw.errors import RunError

# Flags of mlockall(2): lock present and future pages, each when it is first used.
_LOCK_CURRENT = 1
_LOCK_FUTURE = 2
_LOCK_ON_FAULT = 4


class _Taken:
    """The priority that this module has set. A priority set by chrt is not changed."""

    priority: int | None = None


def begin(priority: int) -> None:
    """Set real-time priority for this thread, which runs the loop, and the threads beside it.

    Raises RunError with the remedy if the process has no permission.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        raise RunError(
            f"run.realtime_priority = {priority}: not permitted. {_how(priority)}, and start again."
        ) from None
    except OSError as error:
        raise RunError(
            f"run.realtime_priority = {priority}: {error.strerror or error}. Remove it."
        ) from None
    _Taken.priority = priority
    for thread in threading.enumerate():
        if thread is not threading.current_thread():
            follow(thread)
    _lock_memory()


def follow(thread: threading.Thread) -> None:
    """Give a thread beside the loop the loop's priority minus one, if real-time priority is set."""
    if _Taken.priority is None or thread.native_id is None:
        return
    param = os.sched_param(max(1, _Taken.priority - 1))
    with contextlib.suppress(OSError):  # the thread has ended
        os.sched_setscheduler(thread.native_id, os.SCHED_FIFO, param)


def _how(priority: int) -> str:
    if "INVOCATION_ID" in os.environ:  # systemd
        return (
            "Type sudo systemctl edit kontronik-can-gw, add below [Service] the lines "
            f"RestrictRealtime=no, LimitRTPRIO={priority} and LimitMEMLOCK=infinity"
        )
    return f"Type sudo prlimit --rtprio={priority} --memlock=unlimited --pid $$ in this shell"


def _lock_memory() -> None:
    """Lock the process's memory, unless there is a limit, because an allocation would exceed it."""
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return
    import ctypes  # takes a megabyte, so it is imported only if it is needed

    ctypes.CDLL(None, use_errno=True).mlockall(_LOCK_CURRENT | _LOCK_FUTURE | _LOCK_ON_FAULT)
