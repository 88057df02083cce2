"""Starting a thread beside the loop."""

import signal
import threading

from kontronik_can_gw.runtime import realtime


def start_beside_the_loop(thread: threading.Thread) -> bool:
    """Start a thread that no signal is delivered to: they are to wake the loop. False: the system gives no thread now."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        thread.start()  # it inherits the mask
    except RuntimeError:
        return False
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    realtime.follow(thread)
    return True
