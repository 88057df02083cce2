"""Opens the gateway's CAN interface, receives from it, and opens it again after a failure.

transmitter.py sends frames, and can_controller.py follows the controller's state.
"""

import contextlib
import errno
import logging
import select
from collections.abc import Callable

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.can.can_controller import CanController
from kontronik_can_gw.runtime.can.can_opener import CanOpener
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.can.socketcan_port import socketcan_error
from kontronik_can_gw.runtime.can.transmitter import Transmitter
from kontronik_can_gw.runtime.poller import Poller
from kontronik_can_gw.runtime.port_input import PortInput, StuckCheck
from kontronik_can_gw.runtime.retry import Retry
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.runtime.system.locks import IdLocks
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import NEVER, SECOND

MAX_RETRY_NS = SECOND // 2
SLOW_OPENING_NS = 10 * SECOND
"""A driver that takes longer to open an interface is reported. slcan sleeps for two seconds."""


class CanLink:
    """The CAN interface of a gateway.

    ``esc_at`` returns the name of the ESC to which a path leads, or None. The port of an ESC must
    never be opened as a CAN adapter.
    """

    def __init__(
        self,
        config: CanConfig,
        gateway: Gateway,
        poller: Poller,
        conditions: FaultLog,
        esc_at: Callable[[str], str | None],
        clock: Callable[[], int],
    ) -> None:
        self.config = config
        self.port: CanPort | None = None
        self.transmitter = Transmitter(config, gateway, conditions, self._end_fault, clock)
        self.gate = self.transmitter.gate
        self.controller = CanController(config, gateway, self.gate, conditions)
        self._gateway = gateway
        self._poller = poller
        self._conditions = conditions
        self.condition = f"CAN {config.channel}: interface"
        self.opening_condition = f"CAN {config.channel}: opening"
        self._opening_since: int | None = None
        """Start of the opening by the opener's thread. None if the thread does not open."""
        self._retry = Retry(MAX_RETRY_NS)
        self._own_ids = IdLocks(config, gateway, conditions)
        self._receive_ids: frozenset[int] | None = None
        """The ids that the open port receives."""
        self._is_drained = True
        self._noted = PortInput()
        self._stuck = StuckCheck(self._noted)
        fd = self.controller.fileno()
        if fd is not None:
            poller.register(fd, self.hear)
        self.must_open = False
        """True during the first opening by the thread, if its failure ends the gateway."""
        self._opener = CanOpener(config, esc_at)
        poller.register(self._opener.fileno(), self._follow_opener)

    @property
    def due(self) -> int:
        """Time of the next call of ``reopen``, ``transmit`` or, in bus-off, ``controller.ask``.

        Except in bus-off the loop asks the controller in any of its iterations, and need not wake
        up for that.
        """
        due = min(self.gate.due, self._retry.due)
        return min(due, self.controller.due) if self.controller.is_off else due

    @property
    def is_open(self) -> bool:
        return self.port is not None

    def open(self, now: int, wait: bool) -> None:
        """Open the interface, or let the opener's thread open it.

        Raises RunError if another gateway uses one of our node-IDs or sends our messages. Without
        ``wait``, RunError is also raised if the interface cannot be opened. If the thread opens
        it, a later iteration of the loop raises this error.
        """
        self._own_ids.lock(at_start=True)
        try:
            if not self._open(now):
                self.must_open = not wait
        except RunError as error:
            if not wait:
                raise
            self._failed(str(error), now)

    def reopen(self, now: int) -> None:
        """Open a lost interface again if the next attempt is due."""
        if now < self._retry.due or self.port is not None:
            return
        try:
            self._open(now)
        except RunError as error:
            self._failed(str(error), now)

    def _follow_opener(self, now: int, _events: int = 0) -> None:
        """Use the result of the opener's thread. Call it when the opener is readable."""
        result = self._opener.take()
        if result is not None:
            self._opening_since = None
        if isinstance(result, CanPort):
            self._use(result, now)
        elif result is not None:
            if self.must_open:
                raise result
            self._conditions.forget(self.opening_condition)
            self._failed(str(result), now)
        self.must_open = self.must_open and result is None

    def report(self, now: int) -> None:
        """Log a driver that takes long to open the interface, or never returns."""
        since = self._opening_since
        if since is not None and now - since >= SLOW_OPENING_NS:
            text = (
                f"CAN {self.config.interface} {self.config.channel}: still opening, "
                "because the driver does not return. "
                "Check the adapter. If it was replaced, restart the gateway."
            )
            self._conditions.begin(self.opening_condition, text, now, since=since)

    def close(self) -> None:
        """Close everything. A second call changes nothing."""
        self._close_port()  # first, so that the opener's thread waits for a slow driver
        opener_fd = self._opener.fileno()
        if opener_fd >= 0:
            self._poller.unregister(opener_fd)
            self._opener.close()
        self._own_ids.close()
        fd = self.controller.fileno()
        if fd is not None:
            self._poller.unregister(fd)
            self.controller.close()

    def _open(self, now: int) -> bool:
        """Open the interface. Returns False if the opener's thread opens it."""
        self._retry.due = NEVER
        port = self._opener.open()
        if port is None:
            self._opening_since = now
            self.gate.opening(now)
            return False
        self._use(port, now)
        return True

    def _use(self, port: CanPort, now: int) -> None:
        """Use an open port."""
        self.port = port
        self._retry.due = NEVER
        self.gate.opened(port.frames_left(), now, port.is_socket)
        self.controller.is_off = False
        self._stuck = StuckCheck(self._noted)
        fd = port.fileno()
        if fd is not None:
            self._poller.register(fd, self.serve)
        self._receive_ids = None
        self.follow_ids()
        self._gateway.can_opened(now)
        self.controller.refresh(now)  # older reports, for example of a link down, are obsolete
        text = f"CAN {self.config.interface} {self.config.channel} is open"
        if self._conditions.is_on(self.opening_condition):
            self._conditions.end(self.opening_condition, text, now)
        elif not self._conditions.is_on(self.condition):
            # After a failure, the recovery is logged when the first frame is sent.
            self._conditions.log(logging.INFO, text)
        self.transmitter.work(now)

    def _close_port(self) -> None:
        if self.port is not None:
            fd = self.port.fileno()
            if fd is not None:
                with contextlib.suppress(KeyError, ValueError):
                    self._poller.unregister(fd)
            self._opener.close_port(self.port)
            self.port = None

    def _failed(self, reason: str, now: int, is_down: bool = False) -> None:
        self._retry.failed(now)
        self.gate.lost(is_down, now)
        self.transmitter.work(now)
        self._gateway.set_can_state(CanState.DOWN, now)
        sentence = reason if reason.endswith(".") else f"{reason}."  # drivers write no full stop
        self._conditions.begin(self.condition, f"{sentence} Trying again.", now)

    def _lost(self, answer: Sent, now: int) -> None:
        """Close an interface that is down or was removed, and schedule its opening."""
        self._close_port()
        self._failed(_reason_of_loss(self.config, answer), now, answer is Sent.DOWN)
        self.controller.ask(now)  # it may already be usable again

    # --- receiving

    def ask(self, now: int) -> None:
        """Ask the kernel for the state of the interface, and use its immediate answer."""
        self.controller.ask(now)
        self.hear(now)
        if self.port is not None:
            self.controller.end_unconfirmed_off(self.port, now)
        self.transmitter.advance(now)

    def hear(self, now: int, _events: int = 0) -> None:
        """Use the kernel's reports on the interface. Call it when they are readable."""
        for facts in self.controller.take():
            self._follow(facts, now)

    def _follow(self, facts: LinkFacts, now: int) -> None:
        self.controller.note(facts, now)
        if self.port is None:
            if facts.up and self._retry.due != NEVER:
                self._retry.due = now
        elif not facts.exists or not facts.up:
            self._lost(Sent.DOWN if facts.exists else Sent.GONE, now)
        else:
            self.controller.note_state(facts, self.port, now)
            self.controller.follow(self.port, now)

    def follow_ids(self) -> None:
        """Update the ids that the open port receives, if the gateway's ids have changed."""
        ids = self._gateway.receive_ids
        if self.port is None or ids is self._receive_ids:
            return
        had_fd = self.port.fileno() is not None
        self._receive_ids = ids
        self.port.set_receive_ids(ids)
        fd = self.port.fileno()
        if fd is not None and not had_fd:
            self._poller.register(fd, self.serve)
        self._own_ids.lock()

    def serve(self, now: int, events: int = select.POLLIN) -> None:
        """Receive frames. Call it when the port is readable, or writable again."""
        self._noted.is_served = True
        if self.port is None:
            return
        if events & select.POLLOUT:
            self.gate.made_room()
            self._watch(select.POLLIN)
        if events & select.POLLIN:
            since = self._poller.times.before if self._is_drained else 0
            frames = self.port.receive()
            self._is_drained = self.port.is_drained
            self._gateway.status.received_frames += len(frames)
            for frame, received_ns in frames:
                if received_ns is None:
                    received_ns = now
                else:
                    # The time depends on the wall clock, which may have been set. The limits are
                    # the times between which the frame must have been received.
                    received_ns = min(max(received_ns, since), now)
                self._gateway.receive_frame(frame, now, received_ns)
            self._follow_reception(now)

    def is_stuck(self) -> bool:
        """Return True if the loop does not serve this port."""
        return self._stuck.is_stuck(self.port)

    def look(self, now: int) -> None:
        """Follow the frames that have left. Call it before time passes for the gateway."""
        if self.port is not None and now >= self.gate.look_due:
            self.transmitter.look(self.port, now)

    def transmit(self, now: int) -> None:
        """Hand the due frames to the interface until it refuses one. In bus-off they are held."""
        port = self.port
        if port is not None and self.controller.is_off:
            self.gate.bus_off(self.controller.stays_off, now)
        answer = self.transmitter.transmit(port, now)
        if port is None or answer is None:
            return
        if answer is Sent.FULL:
            self._watch(select.POLLIN | select.POLLOUT)
        elif answer is Sent.DOWN or answer is Sent.GONE:
            self._lost(answer, now)
            return
        self.controller.follow(port, now)

    def _watch(self, events: int) -> None:
        fd = None if self.port is None else self.port.fileno()
        if fd is not None:
            self._poller.register(fd, self.serve, events)

    def _end_fault(self, now: int) -> None:
        """End the fault of the interface, because it sends frames."""
        self._retry.succeeded()
        text = f"CAN {self.config.channel}: frames are sent again"
        self._conditions.end(self.condition, text, now)

    def _follow_reception(self, now: int) -> None:
        """Report overruns, a lost interface or a new controller state after a reception."""
        port = self.port
        assert port is not None
        if port.overruns:
            self._gateway.receive_overrun(now)
        port.overruns = 0
        if port.is_gone:
            self._lost(Sent.GONE, now)
        else:
            self.controller.follow(port, now)


def _reason_of_loss(config: CanConfig, answer: Sent) -> str:
    """Return the error message for an interface that returned DOWN or GONE."""
    if config.interface != "socketcan":
        return f"CAN {config.interface} {config.channel}: the adapter has failed."
    number = errno.ENETDOWN if answer is Sent.DOWN else errno.ENODEV
    return str(socketcan_error(config, number))
