"""Gives child processes the default signal dispositions, whatever started this process.

`nohup` ignores SIGHUP, and a shell ignores SIGINT and SIGQUIT for a job in the background. A child
inherits an ignored or blocked signal, and then never reacts to the signal that a test sends to it.
"""

import signal
from types import FrameType

_SIGNALS = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGCHLD)
"""Signals that a parent may ignore.

Python sets SIGPIPE itself, and `subprocess` resets it in each child.
"""


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """Does nothing. A handler is reset to the default in a child, an ignored signal is not."""


def use_defaults_in_children() -> None:
    """Replaces each ignored signal by a handler that does nothing, and unblocks all signals.

    This process still ignores the same signals as before.
    """
    for number in _SIGNALS:
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, _ignore)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
