"""Runs iterations of the loop in C, if the core is in C, too.

The loop in C only reads ports, and sends due frames. It returns for all other work.
"""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from kontronik_can_gw.esc.telemetry import Event
from kontronik_can_gw.gateway.gate import Gate
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.native.turns import OUTPUTS
from kontronik_can_gw.runtime.poller import Poller, Work
from kontronik_can_gw.runtime.port_input import PortInput
from kontronik_can_gw.times import MS

if TYPE_CHECKING:
    from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
    from kontronik_can_gw.native.core import NativeCore
    from kontronik_can_gw.runtime.can.can_link import CanLink
    from kontronik_can_gw.runtime.can.can_port import CanPort

_HANDOVER_NS = 250 * MS
"""C hands recorded calls over after the first iteration at this age. Until then, a power loss
loses them."""


def poller_for(gateway: Gateway) -> Poller:
    """Return the poller for the gateway's core."""
    return NativePoller(gateway) if gateway.core.language == "C" else Poller()


class NativePoller(Poller):
    """A poller that also runs iterations of the loop in C."""

    is_native = True

    def __init__(self, gateway: Gateway, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self.count = 0
        """Number of iterations in C."""
        self._gateway = gateway
        self._core = cast("NativeCore", gateway.core)
        self._turns = self._core.turns()
        self._turns.request.is_recorded = gateway.is_recorded
        self.times = self._turns.times
        self.times.now = self.times.polled = self.times.before = clock()
        self._seen_changes = -1
        self._can_watch = True
        self._signals: tuple[int, int] | None = None
        self._woken_before = -1

    def noted(self, esc: int) -> PortInput:
        return cast(PortInput, self._turns.inputs[esc])

    def begin(self) -> None:
        """Let each signal wake the loop in C, because signal handlers run only after C returns."""
        if threading.current_thread() is threading.main_thread():
            self._signals = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
            self._woken_before = signal.set_wakeup_fd(self._signals[1], warn_on_full_buffer=False)
            self.register(self._signals[0], self._signalled)

    def close(self) -> None:
        super().close()
        self._turns.close()
        if self._signals is not None:
            signal.set_wakeup_fd(self._woken_before)
            for fd in self._signals:
                os.close(fd)
            self._signals = None

    def _signalled(self, _now: int, _events: int) -> None:
        assert self._signals is not None
        with contextlib.suppress(BlockingIOError):
            os.read(self._signals[0], 4096)

    def can_run(self, can: "CanLink") -> bool:
        """Return True if C can make the next iteration. Python makes it in these cases:

        1. Python needs each live frame, for a PDO that C cannot make or for ``record.when``.
        2. The gateway has frames to send, or they are held or limited.
        3. There is no interface with a socket, or its state was not passed to the gateway yet.
        4. The gate to the bus looks closely (``Gate.may_run_in_c``), or the bus is off.
        5. There are more descriptors than C can watch.
        """
        gateway = self._gateway
        port = can.port
        if self._core.reports_live or gateway.frames_wait or gateway.is_held:
            return False
        if port is None or port.is_gone or not port.is_socket:
            return False
        if port.state is not gateway.status.can_state or can.controller.is_off:
            return False
        return can.transmitter.is_idle and self._watch_descriptors()

    def run(self, can: "CanLink", due: int, leave: int, period: int) -> Work:
        """Run iterations in C until there is work for the loop. ``can_run`` must be true.

        ``due`` is the time of the loop's own next work, and ``leave`` of the latest return.
        ``period`` is the longest duration of a wait. All are in ns.
        """
        turns = self._turns
        recorded = cast("RecordedGateway", self._gateway) if self._gateway.is_recorded else None
        if recorded is not None:
            leave = min(leave, self.times.now + _HANDOVER_NS)
            recorded.prepare_turns(self.times.now)
        self._set_request(can, due, leave, period)
        _write_departures(can.gate, turns.departures)
        turns.begin()
        while turns.run():
            if not self._follow_event():
                self._leave()
                break
        can.gate.adopt(turns.departures, self.times.now)
        result = turns.result
        self.count += result.turns
        self.late = result.late
        if recorded is not None:
            recorded.turned(turns.entries(), result.taken)
        if unsent := turns.unsent():
            can.transmitter.put_refused(unsent, turns.queue.full_since)
        if result.event >= 0 and turns.reads.has_advanced:
            self._finish(can)
        ready = self.handlers(turns.ready()) if result.happened else []
        return Work(ready, not result.is_over)

    def _set_request(self, can: "CanLink", due: int, leave: int, period: int) -> None:
        request = self._turns.request
        port = cast("CanPort", can.port)
        request.due = min(due, self._core.deadline_in_python())
        request.outputs_due = self._gateway.next_deadline(with_core=False)
        request.leave = leave
        request.period = period
        request.check_period = can.gate.period_ns
        request.max_turn = can.transmitter.max_turn_ns
        request.bus = port.fileno()
        request.count_fd = port.count_fd
        request.frame_size = port.frame_size

    def _leave(self) -> None:
        """Leave the rest of the iteration to the loop, after an event."""
        turns = self._turns
        self._core.dispatch_others(self.times.now)
        if turns.reads.size:
            self._core.receive(*turns.read())
        turns.leave()

    def _finish(self, can: "CanLink") -> None:
        """Make the rest of an iteration at its own time, as a replay does."""
        now = self.times.now
        self._core.advance_in_python(now)
        self._gateway.advance(now, with_core=False)
        can.transmit(now)

    def _follow_event(self) -> bool:
        """Follow the event that C returned, or let time pass for the outputs.

        Return False if the loop must make the rest of the iteration. Usually the outputs make only
        frames, if anything, and C sends these first.
        """
        gateway = self._gateway
        core = self._core
        turns = self._turns
        request = turns.request
        event = turns.result.event
        now = self.times.now
        revision = gateway.revision
        if is_due := event == OUTPUTS:
            gateway.advance(now, with_core=False)
        else:
            core.dispatch(event, now)
        if core.link_changes or core.reports_live or gateway.revision != revision:
            return False
        if event & Event.QUIET:  # the gate follows it
            return False
        request.outputs_due = gateway.next_deadline(with_core=False)
        request.due = min(request.due, core.deadline_in_python())
        if now >= request.due or (is_due and now >= request.outputs_due):
            return False
        return turns.add_output_frames(gateway.output_frames)

    def _watch_descriptors(self) -> bool:
        """Let C watch the descriptors. Return False if that is impossible."""
        if self._seen_changes != self.changes:
            self._seen_changes = self.changes
            self._can_watch = self._turns.watch(self.watched())
        return self._can_watch


def _write_departures(gate: Gate, departures: Any) -> None:
    """Tell iterations in C which frames are under way."""
    under_way = gate.under_way
    departures.count = under_way.count
    departures.still_since = gate.still_since
    departures.checked = under_way.looked
    departures.older = under_way.frames
    departures.newer = 0
    departures.check_due = gate.look_due
