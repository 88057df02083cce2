"""Hands frames to the CAN interface as the gate to the bus decides (gateway/gate.py).

It owns the frames that wait, passes events of the port to the gate, and does the gate's acts.
"""

from collections.abc import Callable, Sequence

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gate import Gate
from kontronik_can_gw.gateway.gate_table import Act
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent, TransmitQueue
from kontronik_can_gw.runtime.can import interface_restart
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.gate_reports import GateReports
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, NEVER

MAX_LATE_NS = 250 * MS
"""Longest delay of a measurement. The shortest telemetry timeout may be a lower limit."""


class Transmitter:
    """Hands frames to an open port, and tries refused frames again.

    ``ask_restart`` requests a restart of the interface of this name. ``prove`` is called when the
    interface sends frames.
    """

    def __init__(
        self,
        config: CanConfig,
        gateway: Gateway,
        conditions: FaultLog,
        prove: Callable[[int], None],
        clock: Callable[[], int],
    ) -> None:
        self.queue = TransmitQueue(gateway.status)
        self.gate = Gate(_shortest_timeout_ns(gateway), config.restart_after_ns)
        self.ask_restart: Callable[[str], None] = interface_restart.request
        self.reports = GateReports(config, self.gate, gateway.status, conditions)
        self._gateway = gateway
        self._status = gateway.status
        self._clock = clock
        self._is_told = False
        """True if the gateway holds its frames because of a call of ``hold``."""
        self._is_after_advance = False
        """True if a replay has already taken the frames of this step."""
        self._has_failed = False
        """True if a port without a socket was busy for too long."""
        self._works: dict[Act, Callable[[int], object]] = {
            Act.HOLD: self._hold,
            Act.RELEASE: self._release,
            Act.PROVE: prove,
            Act.LIMIT: self._limit,
            Act.UNLIMIT: lambda now: gateway.limit(False, False, now),
            Act.DROP: lambda _now: self.queue.drop_measurements(),
            Act.FAIL: self._fail,
            Act.ASK: lambda _now: self.ask_restart(config.channel),
            Act.COUNT: self.reports.count_restart,
            Act.NOT_RESTARTED: self.reports.report_missing_unit,
            Act.WORKED: self.reports.report_restarts,
            Act.STALLED: self.reports.report_stall,
            Act.SLOW: self.reports.report_slow,
        }

    @property
    def max_turn_ns(self) -> int:
        """The age at which a frame is too old to be sent, from the iteration's start."""
        return min(MAX_LATE_NS, self.gate.timeout_ns)

    def max_wait_ns(self) -> int:
        """Return the longest wait of the loop: a quarter of the shortest timeout of the ESCs.

        It is a millisecond less, because a wait is rounded up to a millisecond.
        """
        return _shortest_timeout_ns(self._gateway) // 4 - MS

    @property
    def is_idle(self) -> bool:
        """True if no frame waits, is held or is limited, and the port refused none."""
        return not len(self.queue) and self.gate.may_run_in_c

    def put_refused(self, frames: Sequence[CanFrame], since: int) -> None:
        """Append frames that an iteration in C could not send.

        ``since`` is the time since which the port has accepted no frame.
        """
        self.gate.refused_since = since
        self.queue.put_all(frames)

    def look(self, port: CanPort, now: int) -> None:
        """Follow the interface's count. Call it before time passes for the gateway.

        A replay then takes the frames of this step as they are taken here.
        """
        self.gate.look(port.frames_left(), port.frames_queued(), now)
        self.work(now)

    def transmit(self, port: CanPort | None, now: int) -> Sent | None:
        """Take the gateway's due frames, and hand them to the port until it refuses one.

        1. Returns the last result of the port, or None if it was given no frame or the next
           attempt is not due yet.
        2. GONE is also returned if a port without a socket was busy for too long.
        3. None is also returned if frames became too late meanwhile. The next iteration drops them.
        4. While frames are held, only the first frame is handed over.
        """
        gate = self.gate
        gateway = self._gateway
        gate.timeout_ns = _shortest_timeout_ns(gateway)
        is_limited = gateway.is_limited
        self._is_after_advance = True
        if gate.is_quiet != gateway.status.is_quiet:
            self._follow_quiet(now)
        gate.advance(now)
        if gate.is_held and gateway.output_frames:
            gate.request(now)
        if gate.acts:
            self.work(now)
        answer = None
        if port is None or gate.is_off:
            pass
        elif gateway.is_held:
            # Frames that are released now are sent in the next iteration, at once, as in a replay.
            answer = self._send_first_frame(port, now)
        elif is_limited:
            # Also in the iteration that ends the limit. A replay takes no frames in it.
            answer = self._send_limited(port, now)
        else:
            self.queue.put_all(gateway.take_frames(now))
            if gate.may_try(now):
                answer = self._send(port, None, now)
        self._is_after_advance = False
        return answer

    def advance(self, now: int) -> None:
        """Let time pass for the gate, without handing over frames."""
        self.gate.advance(now)
        self.work(now)

    def work(self, now: int) -> None:
        """Do the gate's work."""
        acts = self.gate.acts
        while acts:
            act = acts.pop(0)
            if act in self._works:
                self._works[act](now)
        self.reports.end_faults(now)

    # --- handing over

    def _send(self, port: CanPort, most: int | None, now: int) -> Sent | None:
        """Hand frames to the port until it refuses one, at most ``most``."""
        gate = self.gate
        frames = self.queue.in_order()
        if not frames:
            gate.refused_since = NEVER
            gate.made_room()
            return None
        count, answer = port.send_all(frames[:most], self._clock, now + self.max_turn_ns)
        self.queue.remove(frames, count)
        if count:
            self._status.sent_frames += count
            gate.accepted(count, now)
            if gate.acts:
                self.work(now)
        if answer is Sent.OK:
            return answer
        if answer is Sent.LATE:
            return None
        return self._note_refusal(answer, now)

    def _send_limited(self, port: CanPort, now: int) -> Sent | None:
        """Hand over as many frames as the gate permits. Values are packed only now.

        Answers and measurements alternate while both wait.
        """
        gateway = self._gateway
        self.queue.put_all(gateway.take_some(0, now))
        room = self.gate.room(now)
        if not room or not self.gate.may_try(now):
            return None
        self.queue.put_all(gateway.take_some(self.queue.share_of_measurements(room), now))
        answer = self._send(port, room, now)
        was_refused = answer is not None and answer is not Sent.OK
        if was_refused and gateway.is_limited and self.queue.drop_measurements():
            gateway.limit(True, True, now)  # they would get old
        return answer

    def _send_first_frame(self, port: CanPort, now: int) -> Sent | None:
        gate = self.gate
        if not gate.wants_first_frame(now):
            return None
        frame = self._gateway.first_frame(now)
        if frame is None:
            gate.no_first_frame(now)
            self.work(now)
            return None
        count, answer = port.send_all((frame,), self._clock, now + self.max_turn_ns)
        if not count:
            self._gateway.not_sent(now)
            if answer is Sent.LATE:
                return answer
            return self._note_refusal(answer, now)
        self._status.sent_frames += 1
        gate.accepted_first(now)
        self.work(now)
        self.look(port, now)
        return answer

    def _note_refusal(self, answer: Sent, now: int) -> Sent:
        """Follow a refused frame. Returns GONE if the port has failed."""
        self._status.send_failures += 1
        if answer is Sent.BUSY or answer is Sent.FULL:
            self.gate.refused(answer is Sent.FULL, now)
            self.work(now)
            if self._has_failed:
                self._has_failed = False
                return Sent.GONE
        return answer

    def suspended(self, now: int) -> bool:
        """Follow a suspension of the process. Returns True if measurements were discarded."""
        replaced = self._status.replaced_frames
        self.gate.suspended(now)
        self.work(now)
        return self._status.replaced_frames != replaced

    # --- the gate's work

    def _hold(self, now: int) -> None:
        """Discard all frames that wait, and let the gateway hold its frames."""
        gateway = self._gateway
        if self._is_told and not gateway.output_frames and not len(self.queue):
            return
        if self._is_after_advance:
            frames = gateway.take_frames(now)
            if frames:
                gateway.not_sent(now)
                self.queue.put_all(frames)  # counts them as lost
        self.queue.put_all(gateway.output_frames)
        self.queue.clear()
        gateway.hold(now)
        self._is_told = True

    def _release(self, now: int) -> None:
        self._is_told = False
        self._gateway.release(now)

    def _limit(self, now: int) -> None:
        self._gateway.limit(True, self.queue.drop_measurements(), now)

    def _fail(self, _now: int) -> None:
        self._has_failed = True

    def _follow_quiet(self, now: int) -> None:
        """Follow the begin or the end of the gateway's quiet mode."""
        is_quiet = bool(self._status.is_quiet)
        self.gate.quiet(is_quiet, now)
        self.work(now)
        self.reports.report_quiet(is_quiet, now)


def _shortest_timeout_ns(gateway: Gateway) -> int:
    """Return the shortest timeout of all ESCs, after which live data are not available."""
    return min([esc.settings.timeout_ns for esc in gateway.escs])
