"""Turns of the loop in C, while the core is there, too, and nothing but plain reads and frames that are due is to be done."""

import os
import signal
import threading
from typing import TYPE_CHECKING

from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.can_link import CanLink
from kontronik_can_gw.runtime.poller import Handler, Poller

if TYPE_CHECKING:
    from kontronik_can_gw.native.core import NativeCore


class NativeTurns:
    """Waits as Poller.wait does, and turns meanwhile."""

    def __init__(self, gateway: Gateway, core: "NativeCore", poller: Poller) -> None:
        self._gateway, self._core, self._poller = gateway, core, poller
        self._turns = core.turns()
        self.inputs = self._turns.inputs
        self._seen_changes = -1
        self._fits = True
        self._signals: tuple[int, int] | None = None

    def begin(self) -> None:
        """A signal is followed when C is left: let it wake that, at whatever moment it comes."""
        if threading.current_thread() is threading.main_thread():
            self._signals = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
            signal.set_wakeup_fd(self._signals[1], warn_on_full_buffer=False)
            self._poller.register(self._signals[0], self._signalled)

    def close(self) -> None:
        """Signals wake nothing any more."""
        if self._signals is not None:
            signal.set_wakeup_fd(-1)
            for fd in self._signals:
                os.close(fd)
            self._signals = None

    def _signalled(self, _now: int, _events: int) -> None:
        assert self._signals is not None
        os.read(self._signals[0], 4096)

    def wait(
        self, can: CanLink, last: int, due: int, leave: int, period: int, limits: tuple[int, int]
    ) -> list[tuple[Handler, int]] | None:
        """Turn until something is to be done that C leaves to the loop; the handlers of what is ready then.

        None where it is not the time for that. ``last``: the last turn; ``due``: what the loop has to do apart from the core;
        ``leave``: when to come back in any case; ``period``: how long a wait is at most; ``limits``: how late a turn, and the sending of
        its frames, may be.
        """
        gateway, poller = self._gateway, self._poller
        if self._core.reports_live or gateway.frames_wait:
            return None
        if (bus := can.plain_socket) is None or not self._watches():
            return None
        turns = self._turns
        state = turns.state
        state.now, state.asked, state.before, state.bus = last, poller.now, poller.before, bus
        state.due, state.leave, state.period = due, leave, period
        state.max_late, state.max_turn = limits
        state.records = gateway.prepare_turns(last)
        turns.run()
        poller.follow(state.before, state.asked, state.late)
        if state.taken or state.recorded:
            gateway.turned(turns.entries(), state.taken)
        if state.found >= 0:
            self._core.follow(state.found, state.now)
        if state.unsent:
            can.transmitter.put(turns.unsent())
        return poller.handlers(turns.ready())

    def _watches(self) -> bool:
        if self._seen_changes != self._poller.changes:
            self._seen_changes = self._poller.changes
            self._fits = self._turns.watch(self._poller.watched())
        return self._fits
