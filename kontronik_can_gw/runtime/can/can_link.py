"""The CAN interface as the loop has it: opened, lost, found again, received from.

Sending is in transmitter.py, the controller's state in can_controller.py.
"""

import contextlib
import errno
import logging
import select
import time
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
_OK = Sent.OK  # an enumeration's members are slow to look up


class CanLink:
    """The interface of a gateway. ``esc_at`` names the ESC that a path leads to: it must never be opened as a CAN adapter."""

    def __init__(
        self,
        config: CanConfig,
        gateway: Gateway,
        poller: Poller,
        conditions: FaultLog,
        esc_at: Callable[[str], str | None] = lambda _path: None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.config = config
        self.port: CanPort | None = None
        self.transmitter = Transmitter(config.channel, gateway, conditions, clock)
        self.controller = CanController(config, gateway, conditions)
        self._gateway = gateway
        self._poller = poller
        self._conditions = conditions
        self.condition = f"CAN {config.channel}: interface"
        self.opening_condition = f"CAN {config.channel}: opening"
        self._opening_since: int | None = None
        """When the opening beside the loop began that has not ended yet."""
        self._clock = clock
        self._retry = Retry(MAX_RETRY_NS)
        self._own_ids = IdLocks(config, gateway, conditions)
        self._receive_ids: frozenset[int] | None = None
        """What the open port was asked to receive."""
        self.is_proven = False
        """A frame was taken since the interface failed last."""
        self._drained = True
        self._noted = PortInput()
        self._stuck = StuckCheck(self._noted)
        if (fd := self.controller.fileno()) is not None:
            poller.register(fd, self.hear)
        self.must_open = False  # the first opening is under way, and its failure ends the gateway
        self._opener = CanOpener(config, esc_at)
        poller.register(self._opener.fileno(), self._follow_opener)

    @property
    def due(self) -> int:
        """When ``reopen``, ``transmit`` or, in bus-off, the controller's ``ask`` has something to do.

        Otherwise the controller is asked when the loop comes round: it need not be woken for that.
        """
        due = self.transmitter.due
        if self.controller.is_off:
            due = min(due, self.controller.due)
        return due if self._retry.due is None else min(due, self._retry.due)

    @property
    def is_open(self) -> bool:
        return self.port is not None

    def open(self, now: int, wait: bool) -> None:
        """Open the interface, or start to. RunError if that fails, unless ``wait``; a driver's failure is raised by a later turn.

        RunError in any case if another gateway has one of our node-IDs or sends our messages.
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
        """Try again what is due."""
        if self._retry.due is None or now < self._retry.due or self.port is not None:
            return
        try:
            if self._open(now):
                self._gateway.can_returned(max(now, self._clock()))  # to open may take long
        except RunError as error:
            self._failed(str(error), now)

    def _follow_opener(self, now: int, _events: int = 0) -> None:
        """An opening beside the loop has ended."""
        result = self._opener.take()
        if result is not None:
            self._opening_since = None
        if isinstance(result, CanPort):
            self._use(result, now)
            self._gateway.can_returned(now)
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
                f"CAN {self.config.interface} {self.config.channel}: still opening: "
                "the driver does not return. Check the adapter; restart the gateway if it was replaced."
            )
            self._conditions.begin(self.opening_condition, text, now, since=since)

    def close(self) -> None:
        """Close everything. A second call changes nothing."""
        self._close_port()  # first: the opener's thread waits for a slow driver, this one does not
        if (opener_fd := self._opener.fileno()) >= 0:
            self._poller.unregister(opener_fd)
            self._opener.close()
        self._own_ids.close()
        if (fd := self.controller.fileno()) is not None:
            self._poller.unregister(fd)
            self.controller.close()

    def _open(self, now: int) -> bool:
        """Opens the interface. False if it will be open later."""
        self._retry.due = None
        if (port := self._opener.open()) is not None:
            self._use(port, now)
        else:
            self._opening_since = now
        return port is not None

    def _use(self, port: CanPort, now: int) -> None:
        """Takes over an open port."""
        self.port = port
        self._retry.due = None
        self.transmitter.forget_failures()
        self.controller.is_off = False
        self._stuck = StuckCheck(self._noted)
        if (fd := port.fileno()) is not None:
            self._poller.register(fd, self.serve)
        self._receive_ids = None
        self.follow_ids()
        self._gateway.can_opened(now)
        self.controller.refresh(now)  # older reports, as that it was down, are past
        text = f"CAN {self.config.interface} {self.config.channel} is open"
        if self._conditions.is_on(self.opening_condition):
            self._conditions.end(self.opening_condition, text, now)
        elif not self._conditions.is_on(self.condition):  # otherwise logged when a frame is sent
            self._conditions.say(logging.INFO, text)

    def _close_port(self) -> None:
        self.transmitter.forget_failures()
        if self.port is not None:
            if (fd := self.port.fileno()) is not None:
                with contextlib.suppress(KeyError, ValueError):
                    self._poller.unregister(fd)
            self._opener.close_port(self.port)
            self.port = None

    def _failed(self, reason: str, now: int) -> None:
        self.is_proven = False
        self._retry.failed(now)
        self.transmitter.clear()
        self._gateway.set_can_state(CanState.DOWN, now)
        self._conditions.begin(self.condition, f"{reason} Trying again.", now)

    def _lost(self, answer: Sent, now: int) -> None:
        """The interface is down or gone: to be opened anew."""
        self._close_port()
        self._failed(_reason_of_loss(self.config, answer), now)
        self.controller.ask(now)  # it may be there again already

    # --- what comes

    def ask(self, now: int) -> None:
        """Learn from the kernel how the interface is; it answers at once, so that the loop need not be woken for that."""
        self.controller.ask(now)
        self.hear(now)
        if self.port is not None:
            self.controller.end_unconfirmed_off(self.port, now)

    def hear(self, now: int, _events: int = 0) -> None:
        """The kernel has reported something of the interface."""
        for facts in self.controller.take():
            self._follow(facts, now)

    def _follow(self, facts: LinkFacts, now: int) -> None:
        self.controller.note(facts, now)
        if self.port is None:
            if facts.up and self._retry.due is not None:
                self._retry.due = now
        elif not facts.exists or not facts.up:
            self._lost(Sent.DOWN if facts.exists else Sent.GONE, now)
        else:
            self.controller.note_state(facts, self.port, now)
            self.controller.follow(self.port, now)

    def follow_ids(self) -> None:
        """Let the open port receive what the gateway listens to, if that has changed."""
        ids = self._gateway.receive_ids
        if self.port is None or ids is self._receive_ids:
            return
        had_fd = self.port.fileno() is not None
        self._receive_ids = ids
        self.port.set_receive_ids(ids)
        if not had_fd and (fd := self.port.fileno()) is not None:
            self._poller.register(fd, self.serve)
        self._own_ids.lock()

    def serve(self, now: int, events: int = select.POLLIN) -> None:
        """The port is readable, or can be sent to again."""
        self._noted.served = True
        if self.port is None:
            return
        if events & select.POLLOUT:
            self.transmitter.due = NEVER
            self._watch(select.POLLIN)
        if events & select.POLLIN:
            since = self._poller.before if self._drained else 0
            frames = self.port.receive()
            self._drained = self.port.drained
            self._gateway.status.received_frames += len(frames)
            for frame, at in frames:
                # a wall clock that was set moves no frame out of the time in which it must have come
                self._gateway.receive_frame(
                    frame, now, now if at is None else min(max(at, since), now)
                )
            self._follow_reception(now)

    def is_stuck(self) -> bool:
        """True if the loop does not serve this port."""
        return self._stuck.is_stuck(self.port)

    def transmit(self, now: int) -> None:
        """Hands over the frames that are due, as far as the interface takes them.

        In bus-off nothing is handed over: it would be sent late, after the restart, or be lost.
        """
        frames, port, transmitter = self._gateway.take_frames(now), self.port, self.transmitter
        if frames:
            transmitter.put(frames)
        if port is None or self.controller.is_off:
            if frames:
                self._gateway.not_sent(now)
            transmitter.clear()
            transmitter.forget_failures()
            return
        answer = transmitter.transmit(port, now)
        if answer is None:
            return
        if answer is _OK:
            if not self.is_proven:
                self._prove(now)
        elif answer is Sent.FULL:
            self._watch(select.POLLIN | select.POLLOUT)
        elif answer is not Sent.BUSY:
            self._lost(answer, now)
            return
        self.controller.follow(port, now)

    def _watch(self, events: int) -> None:
        if self.port is not None and (fd := self.port.fileno()) is not None:
            self._poller.register(fd, self.serve, events)

    def _prove(self, now: int) -> None:
        """The interface works: a frame was taken."""
        self.is_proven = True
        self._retry.succeeded()
        self._conditions.end(
            self.condition, f"CAN {self.config.channel}: frames are sent again", now
        )

    def _follow_reception(self, now: int) -> None:
        """What receiving showed of the interface itself."""
        port = self.port
        assert port is not None
        if port.overruns:
            self._gateway.receive_overrun(now)
        port.overruns = 0
        if port.gone:
            self._lost(Sent.GONE, now)
        else:
            self.controller.follow(port, now)


def _reason_of_loss(config: CanConfig, answer: Sent) -> str:
    """What is wrong with an interface that answered DOWN or GONE."""
    if config.interface != "socketcan":
        return f"CAN {config.interface} {config.channel}: the adapter has failed."
    number = errno.ENETDOWN if answer is Sent.DOWN else errno.ENODEV
    return str(socketcan_error(config, number))
