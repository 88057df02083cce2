"""Watches the wall clock: is it synchronised, was it set, is there a hardware clock.

The kernel knows all of it, whichever service sets the clock (systemd-timesyncd, chrony, ntpd, PTP):

* adjtimex(2) has the largest possible error. A service that synchronises the clock lowers it, and
  without a service the kernel raises it up to 16 s. Reading it needs no privilege.
* A timer with TFD_TIMER_CANCEL_ON_SET (timerfd_create(2)) reports that the clock was set.
* /sys/class/rtc lists the hardware clocks, which keep the time while the power is off.

Without these calls the state is unknown, and the gateway runs as usual.
"""

import contextlib
import errno
import os
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw.times import MS, SECOND

MAX_ERROR_US = 16_000_000
"""Error from which the clock is not synchronised. systemd's timedatectl uses the same limit."""
_MIN_STEP_NS = MS
"""A smaller change is no step. The kernel also reports, for example, a new offset to TAI."""
_TIMER_FLAGS = os.O_NONBLOCK | os.O_CLOEXEC
_ABSOLUTE_AND_CANCELLED = 1 | 2
"""TFD_TIMER_ABSTIME | TFD_TIMER_CANCEL_ON_SET"""
_MAX_ERROR = 3
"""Position of maxerror in struct timex, counted in longs. An int and its padding fill the first."""
_CLOCKS = Path("/sys/class/rtc")


class ClockFacts(NamedTuple):
    """The state of the wall clock. None means unknown."""

    synchronized: bool | None = None
    max_error_s: float | None = None
    """The largest error of a synchronised clock."""
    hardware: str | None = None
    """Name of the hardware clock. Empty if there is none."""
    steps: int = 0
    """Number of times that the clock was set since the start."""
    last_step_ns: int | None = None
    """Unix time directly after the last step."""
    last_step_by_ns: int = 0
    """Size of the last step, negative if the clock was set back."""

    @property
    def in_words(self) -> str:
        """Whether the clock is synchronised, and the hardware clock, as a text."""
        state = {True: "synchronised", False: "not synchronised", None: "state unknown"}
        text = state[self.synchronized]
        if self.hardware is not None:
            text += f", hardware clock {self.hardware}" if self.hardware else ", no hardware clock"
        return text


def hardware_clock(folder: Path = _CLOCKS) -> str | None:
    """Return the name of the first hardware clock. Empty if there is none, None if unknown."""
    try:
        for clock in sorted(folder.iterdir()):
            with contextlib.suppress(OSError):
                return (clock / "name").read_text(encoding="ascii", errors="replace").strip()
    except FileNotFoundError:
        return ""
    except OSError:
        return None
    return ""


def max_error_us() -> int | None:
    """Return the largest possible error of the clock in µs. None if it is unknown."""
    libc = _libc()
    if libc is None:
        return None
    # struct timex begins with an int and four longs: modes, offset, freq, maxerror, esterror
    numbers = _timex()
    try:
        numbers[0] = 0  # read only
        if libc.adjtimex(numbers) < 0:
            return None
    except AttributeError:
        return None
    return int(numbers[_MAX_ERROR])


@cache
def _timex() -> Any:
    """Return a buffer for struct timex. Its first number is 0, so that nothing is changed."""
    import ctypes

    return (ctypes.c_long * 64)()


@cache
def _libc() -> Any:
    """Return the C library. None if ctypes cannot be used here."""
    try:
        import ctypes

        return ctypes.CDLL(None, use_errno=True)
    except (ImportError, MemoryError, OSError):
        return None


class SetTimer:
    """A timer of the kernel that is cancelled when the clock is set.

    If the system has no such timer, ``was_set`` is always False.
    """

    def __init__(self) -> None:
        self._fd = _timer_descriptor()

    def was_set(self) -> bool:
        """Return True if the clock was set since the last call."""
        if self._fd is None:
            return False
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return False
        except OSError as error:
            return error.errno == errno.ECANCELED
        return False

    def close(self) -> None:
        """Close the timer."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


def _timer_descriptor() -> int | None:
    """Return the descriptor of a new timer. None if the system has no such timer."""
    libc = _libc()
    if libc is None:
        return None
    import ctypes

    latest = 0x7FFF_FFFF if sys.maxsize < 1 << 32 else 1 << 33
    spec = (ctypes.c_long * 4)(0, 0, latest, 0)
    try:
        fd = int(libc.timerfd_create(time.CLOCK_REALTIME, _TIMER_FLAGS))
        if fd < 0:
            return None
        if libc.timerfd_settime(fd, _ABSOLUTE_AND_CANCELLED, spec, None) < 0:
            os.close(fd)
            return None
    except AttributeError:
        return None
    return fd


def _offset_ns() -> int:
    """Return the wall clock's time minus the monotonic clock's."""
    return time.time_ns() - time.monotonic_ns()


class ClockWatch:
    """Follows the wall clock. ``poll`` never waits. Call it about once a second.

    A step that happens between two calls is seen at the second one, with its size. Several steps
    between two calls count as one.
    """

    def __init__(
        self,
        offset: Callable[[], int] = _offset_ns,
        max_error: Callable[[], int | None] = max_error_us,
        hardware: Callable[[], str | None] = hardware_clock,
        timer: SetTimer | None = None,
    ) -> None:
        self._offset = offset
        self._max_error = max_error
        self._timer = timer or SetTimer()
        self._last_offset = offset()
        self.facts = ClockFacts(hardware=hardware())
        self.poll(time.monotonic_ns())

    def poll(self, now: int) -> int | None:
        """Update ``facts``. Returns the size in ns if the clock was set since the last call.

        ``now`` is the monotonic time.
        """
        offset = self._offset()
        by_ns = offset - self._last_offset
        self._last_offset = offset
        error = self._max_error()
        is_synchronized = None if error is None else error < MAX_ERROR_US
        facts = self.facts._replace(
            synchronized=is_synchronized,
            max_error_s=error / 1e6 if error is not None and is_synchronized else None,
        )
        is_step = self._timer.was_set() and abs(by_ns) >= _MIN_STEP_NS
        if is_step:
            facts = facts._replace(
                steps=facts.steps + 1, last_step_ns=now + offset, last_step_by_ns=by_ns
            )
        self.facts = facts
        return by_ns if is_step else None

    def close(self) -> None:
        """Close the timer."""
        self._timer.close()


def step_in_words(by_ns: int) -> str:
    """Return the size of a step as a text."""
    return f"by {by_ns / SECOND:+.3f} s"
