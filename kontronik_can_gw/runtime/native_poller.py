"""Runs turns of the loop in C, if the core is in C, too.

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
from kontronik_can_gw.runtime.poller import MIN_HELD_UP_NS, Handler, Poller
from kontronik_can_gw.runtime.port_input import PortInput
from kontronik_can_gw.times import MS

if TYPE_CHECKING:
    from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
    from kontronik_can_gw.native.core import NativeCore
    from kontronik_can_gw.runtime.can.can_link import CanLink
    from kontronik_can_gw.runtime.can.can_port import CanPort
    from kontronik_can_gw.runtime.can.transmitter import Transmitter

_HANDOVER_NS = 250 * MS
"""C hands recorded calls over after the first turn at this age. Until then, a loss of power
loses them."""


def poller_for(gateway: Gateway) -> Poller:
    """Return the poller for the gateway's core."""
    return NativePoller(gateway) if gateway.core.language == "C" else Poller()


class NativePoller(Poller):
    """A poller that also runs turns of the loop in C. ``count`` is their number."""

    is_native = True

    def __init__(self, gateway: Gateway, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self.count = 0
        self._gateway = gateway
        self._core = cast("NativeCore", gateway.core)
        self._turns = self._core.turns()
        self._turns.request.is_recorded = gateway.is_recorded
        self._seen_changes = -1
        self._fits = True
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

    def turn(
        self,
        can: "CanLink",
        last: int,
        due: int,
        leave: int,
        period: int,
    ) -> list[tuple[Handler, int]] | None:
        """Run turns in C until there is work for the loop. Returns the handlers to call then.

        Returns None if turns in C are not possible now. ``last`` is the time of the last turn,
        ``due`` of the loop's own next work, and ``leave`` of the latest return. ``period`` is the
        longest duration of a wait. All are in ns.
        """
        gateway = self._gateway
        if self._core.reports_live or gateway.frames_wait or gateway.is_held:
            return None
        port = _plain_port(can, gateway)
        if port is None or not self._watches():
            return None
        turns = self._turns
        request, times, result = turns.request, turns.times, turns.result
        times.now = last
        times.polled = self.now
        times.bus_empty = self.before
        gate = can.gate
        _write_departures(gate, turns.departures)
        request.leave = min(leave, last + _HANDOVER_NS) if gateway.is_recorded else leave
        request.due = min(due, self._core.deadline_in_python())
        request.outputs_due = gateway.next_deadline(with_core=False)
        self._set_bus(port, period, can.transmitter)
        recorded = cast("RecordedGateway", gateway) if gateway.is_recorded else None
        if recorded is not None:
            recorded.prepare_turns(last)
        turns.begin()
        while turns.run():
            if not self._follow():
                self._core.dispatch_others(times.now)
                if turns.has_unread:
                    self._core.receive(*turns.read())
                turns.leave()
                break
        _read_departures(turns.departures, gate, times.now)
        self.count += result.turns
        self.before = times.bus_empty
        self.now = times.polled
        self.late = result.late
        if recorded is not None:
            recorded.turned(turns.entries(), result.taken)
        self.is_over = bool(result.is_over)
        if unsent := turns.unsent():
            can.transmitter.put_refused(unsent, turns.full_since)
        if result.event >= 0 and turns.has_advanced:
            self._finish(can, times.now)
        return self.handlers(turns.ready()) if result.happened else []

    def _set_bus(self, port: "CanPort", period_ns: int, transmitter: "Transmitter") -> None:
        request = self._turns.request
        request.bus = port.fileno()
        request.count_fd = port.count_fd
        max_turn_ns = transmitter.max_turn_ns()
        request.period = period_ns
        request.check_period = transmitter.gate.period_ns
        request.frame_size = port.frame_size
        request.max_turn = max_turn_ns
        request.max_late = max(MIN_HELD_UP_NS, max_turn_ns)

    def _finish(self, can: "CanLink", now: int) -> None:
        """Make the rest of a turn at the turn's own time, as a replay does."""
        self._core.advance_in_python(now)
        self._gateway.advance(now, with_core=False)
        can.transmit(now)

    def _follow(self) -> bool:
        """Follow the event that C returned, or let time pass for the outputs.

        Return False if the loop must make the rest of the turn. Usually the outputs make only
        frames, if anything, and C sends these first.
        """
        gateway, core, turns = self._gateway, self._core, self._turns
        request = turns.request
        event, now = turns.result.event, turns.times.now
        revision = gateway.revision
        if is_due := event == OUTPUTS:
            gateway.advance(now, with_core=False)
        else:
            core.dispatch(event, now)
        if core.link_changes or core.reports_live or gateway.revision != revision:
            return False
        if not is_due and event & Event.QUIET:  # the gate follows it
            return False
        request.outputs_due = outputs_due = gateway.next_deadline(with_core=False)
        request.due = due = min(request.due, core.deadline_in_python())
        if now >= (min(due, outputs_due) if is_due else due):
            return False
        if frames := gateway.output_frames:
            if not turns.add_output_frames(frames):
                return False
            frames.clear()
        return True

    def _watches(self) -> bool:
        if self._seen_changes != self.changes:
            self._seen_changes = self.changes
            self._fits = self._turns.watch(self.watched())
        return self._fits


def _write_departures(gate: Gate, departures: Any) -> None:
    """Tell turns in C which frames are under way."""
    under_way = gate.under_way
    departures.count = under_way.count
    departures.still_since = gate.still_since
    departures.checked = under_way.looked
    departures.older = under_way.frames
    departures.newer = 0
    departures.check_due = gate.look_due


def _read_departures(departures: Any, gate: Gate, now: int) -> None:
    """Tell the gate which frames are under way after turns in C."""
    gate.adopt(
        departures.count,
        departures.accepted,
        departures.older,
        departures.newer,
        departures.checked,
        departures.still_since,
        departures.check_due,
        now,
    )


def _plain_port(can: "CanLink", gateway: Gateway) -> "CanPort | None":
    """Return the interface if C can hand frames to its socket now, otherwise None."""
    port = can.port
    is_plain = can.is_proven and can.transmitter.is_idle and not can.controller.is_off
    if port is None or port.gone or not is_plain or port.state is not gateway.status.can_state:
        return None
    return port if port.is_socket else None
