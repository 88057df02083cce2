"""The CAN interface as the loop has it: opened, lost, found again; what waits to be sent; what the kernel tells of it."""

import contextlib
import errno
import logging
import selectors
import time
from collections.abc import Callable, Sequence

from kontronik_can_gw.canopen.lss import UNCONFIGURED
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.esc.values import CanState
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Conflict, Gateway
from kontronik_can_gw.runtime.can_port import CanPort
from kontronik_can_gw.runtime.fault_log import FaultLog
from kontronik_can_gw.runtime.link_monitor import LinkFacts, LinkMonitor, link_monitor
from kontronik_can_gw.runtime.locks import Locks, in_use, messages_lock, node_lock
from kontronik_can_gw.runtime.open_can import open_can
from kontronik_can_gw.runtime.poller import Registry
from kontronik_can_gw.runtime.retry import Retry
from kontronik_can_gw.runtime.snapshot import CanFacts, name_in_words
from kontronik_can_gw.runtime.socketcan_port import socketcan_error
from kontronik_can_gw.transmit_queue import Sent, TransmitQueue

LONGEST_RETRY_NS = SECOND // 2
BUSY_RETRY_NS = 2 * MS
LASTING_BUSY_NS = SECOND
ASK_NS, ASK_OFF_NS = SECOND, 100 * MS
"""How often the kernel is asked for the controller's state: as a rule, and in bus-off."""
ASK_RESTARTING_NS, SETTLING_NS = 20 * MS, 200 * MS
_OK = Sent.OK  # an enumeration's members are slow to look up
MAX_LATE_NS = 250 * MS
"""Measurements that are handed over later than this, or the shortest telemetry time-out, are old."""
RESTARTED_NS = SECOND
"""So long behind a restart a driver may go on telling of bus-off."""


class CanLink:
    """The interface of a gateway. ``esc_at`` names the ESC that a path leads to: it must never be opened as a CAN adapter."""

    def __init__(
        self,
        config: CanConfig,
        gateway: Gateway,
        selector: Registry,
        conditions: FaultLog,
        esc_at: Callable[[str], str | None] = lambda _path: None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.config = config
        self.port: CanPort | None = None
        self.just_opened = False
        """Set at each opening; who looks at it sets it back."""
        self.mailboxes = TransmitQueue()
        self.facts: LinkFacts | None = None
        """What the kernel told last; None where it tells nothing of this interface."""
        self._gateway = gateway
        self._selector = selector
        self._conditions = conditions
        self._esc_at = esc_at
        self._clock = clock
        self._turn_ns = 0
        self._retry = Retry(LONGEST_RETRY_NS)
        self._locks = Locks(report=lambda text: conditions.say(logging.WARNING, text))
        self._locked: list[str] = []
        self._receive_ids: frozenset[int] | None = None
        """What the open port was told to receive."""
        self._busy_until: int | None = None
        self._busy_since: int | None = None
        self._stalled = False
        self._is_proven = False
        """A frame was taken since the interface failed last."""
        self._off = False
        self._runs_since: int | None = None
        self._restarted_ns = -RESTARTED_NS
        self._served = True
        self._drained = True
        self._seen_waiting = False
        self._monitor: LinkMonitor | None = None
        self._ask_due: int | None = None
        if (
            config.interface == "socketcan"
            and (monitor := link_monitor(config.channel)) is not None
        ):
            self._monitor = monitor
            self._ask_due = 0
            selector.register(monitor.fileno(), selectors.EVENT_READ, self.hear)

    @property
    def due(self) -> int | None:
        """When ``reopen``, ``ask_if_due`` or ``transmit`` has something to do."""
        if self._retry.due is None and self._busy_until is None:
            return self._ask_due
        return min(d for d in (self._retry.due, self._busy_until, self._ask_due) if d is not None)

    def rests(self, now: int) -> bool:
        """True where ``reopen`` and ``ask_if_due`` have nothing to do, and the port was not opened just now."""
        return (
            self.port is not None
            and not self.just_opened
            and (self._ask_due is None or now < self._ask_due)
        )

    @property
    def longest_turn_ns(self) -> int:
        """A frame that is to go out so long after its turn began is old by now."""
        return min(MAX_LATE_NS, self._gateway.shortest_timeout_ns)

    @property
    def is_open(self) -> bool:
        return self.port is not None

    @property
    def complaint(self) -> str:
        """What is wrong with the bus; empty while frames are sent."""
        for name in (
            self._interface_condition,
            self._sending_condition,
            self._controller_condition,
        ):
            if reason := self._conditions.reason(name):
                return reason
        return ""

    def facts_for_statistics(self) -> CanFacts:
        """What the statistics show of the interface."""
        told = self.facts or LinkFacts(exists=False)
        bitrate = told.bitrate or (
            self.config.bitrate if self.config.interface != "socketcan" else None
        )
        config = self.config
        return CanFacts(
            config.interface,
            config.channel,
            bitrate,
            self.is_open,
            self.complaint,
            self._stalled,
            told.restart_ms,
            told.error_counters,
        )

    # --- life

    def open(self, now: int, wait: bool) -> None:
        """Open the interface. RunError where that fails, unless ``wait``: then it is tried again.

        Where another gateway has one of our node-IDs or sends our messages it is a RunError in any case.
        """
        self._lock(at_start=True)
        try:
            self._open(now)
        except RunError as error:
            if not wait:
                raise
            self._failed(str(error), now)

    def reopen(self, now: int) -> None:
        """Try again what is due."""
        if self._retry.due is None or now < self._retry.due or self.port is not None:
            return
        try:
            self._open(now)
        except RunError as error:
            self._failed(str(error), now)
            return
        self._gateway.can_returned(max(now, self._clock()))  # to open may take long

    def close(self) -> None:
        """Close everything."""
        self._close_port()
        self._locks.close()
        if self._monitor is not None:
            self._selector.unregister(self._monitor.fileno())
            self._monitor.close()
            self._monitor = None

    def _open(self, now: int) -> None:
        self._refuse_escs_as_channel()
        try:
            port = open_can(self.config)
        except OSError as error:  # it went away a moment ago
            raise RunError(
                f"CAN interface {self.config.channel}: {error.strerror or error}."
            ) from None
        self.port = port
        self._retry.due = None
        self._busy_until = self._busy_since = None
        self._off = False
        self._served, self._seen_waiting = True, False
        if (fd := port.fileno()) is not None:
            self._selector.register(fd, selectors.EVENT_READ, self.serve)
        self.just_opened = True
        self._receive_ids = None
        self.follow_ids()
        self._gateway.can_opened(now)
        self._refresh_facts(now)  # what was told before, as that it was down, is past
        if not self._conditions.is_on(self._interface_condition):
            # otherwise it is said when a frame is sent
            self._conditions.say(
                logging.INFO, f"CAN {self.config.interface} {self.config.channel} is open"
            )

    def _lock(self, at_start: bool = False) -> None:
        """Have what only one gateway may have on this interface."""
        if self.config.interface == "virtual":  # is in this process only
            return
        channel = self.config.channel
        names = [
            node_lock(channel, node_id)
            for node_id in self._gateway.node_ids
            if node_id != UNCONFIGURED
        ]
        if (first := self._gateway.first_message_id) is not None:
            names.append(messages_lock(channel, first))
        if names == self._locked:
            return
        self._locked = names
        all_taken = self._locks.hold(names)
        if all_taken:
            self._locked = []  # to be tried again
        for taken in all_taken:
            if at_start:
                raise in_use(taken)
            self._conditions.say(logging.ERROR, str(in_use(taken)))

    def _refuse_escs_as_channel(self) -> None:
        """Whatever its name is now: what leads to an ESC must not be opened as a CAN interface, which would send to it."""
        if (esc := self._esc_at(self.config.channel)) is not None:
            raise RunError(
                f"can.channel {self.config.channel} is the port of {esc}: nothing may be sent to an ESC."
            )

    def _close_port(self) -> None:
        self._busy_until = self._busy_since = None
        if self.port is not None:
            if (fd := self.port.fileno()) is not None:
                with contextlib.suppress(KeyError, ValueError):
                    self._selector.unregister(fd)
            self.port.close()
            self.port = None

    def _failed(self, reason: str, now: int) -> None:
        self._is_proven = False
        self._retry.failed(now)
        self.clear()
        self._gateway.set_can_state(CanState.DOWN, now)
        self._conditions.begin(self._interface_condition, f"{reason} Trying again.", now)

    def _lost(self, answer: Sent, now: int) -> None:
        """The interface is down or gone: to be opened anew."""
        self._close_port()
        number = errno.ENETDOWN if answer is Sent.DOWN else errno.ENODEV
        if self.config.interface == "socketcan":
            self._failed(str(socketcan_error(self.config, number)), now)
        else:
            self._failed(
                f"CAN {self.config.interface} {self.config.channel}: the adapter has failed.", now
            )
        self.ask(now)  # it may be there again already

    # --- what the kernel tells

    def ask(self, now: int) -> None:
        """Ask how the interface is."""
        if self._monitor is not None:
            self._monitor.ask()
            self._ask_due = now + (ASK_OFF_NS if self._off else ASK_NS)

    def ask_if_due(self, now: int) -> None:
        if self._ask_due is not None and now >= self._ask_due:
            self.ask(now)

    def hear(self, now: int, _events: int = 0) -> None:
        """The kernel has told something."""
        for facts in self._monitor.take() if self._monitor is not None else ():
            self._follow(facts, now)

    def _follow(self, facts: LinkFacts, now: int) -> None:
        self.facts = facts
        self._follow_bitrate(facts.bitrate, now)
        if self.port is None:
            if facts.up and self._retry.due is not None:
                self._retry.due = now
            return
        if not facts.exists or not facts.up:
            self._lost(Sent.DOWN if facts.exists else Sent.GONE, now)
            return
        # a driver may learn of a restart later than who hears its error frames
        behind = facts.state is CanState.BUS_OFF and (
            self._off or now - self._restarted_ns < RESTARTED_NS
        )
        if facts.state is not None and facts.state is not self.port.state and not behind:
            self.port.note_state(facts.state)
        self._follow_state(now)

    @property
    def _sends_in_vain(self) -> bool:
        """True in the bus-off of a real controller: what is sent now is lost. (On a vcan error frames are somebody's test.)"""
        return self._off and self.facts is not None and self.facts.state is not None

    def _has_restarted(self, now: int) -> bool:
        """Whether a controller that left bus-off takes frames again; before that they vanish without a word.

        The kernel says "restarted" first, then lets the queue run, then starts the controller; only then its state is another one. There
        are drivers that learn that late: they are not waited for.
        """
        self._refresh_facts(now)
        if self.facts is None:
            return True
        if not self.facts.up or not self.facts.running:
            self._runs_since = None
            return False
        if self.facts.state is CanState.BUS_OFF:
            self._runs_since = now if self._runs_since is None else self._runs_since
            self._ask_due = now + ASK_RESTARTING_NS
            return now - self._runs_since > SETTLING_NS
        return True

    def _refresh_facts(self, now: int) -> None:
        """How the interface is now; what waits of older news is passed over."""
        self.ask(now)
        told = self._monitor.take() if self._monitor is not None else []
        if told:
            self.facts = told[-1]
            self._follow_bitrate(self.facts.bitrate, now)

    # --- frames

    def follow_ids(self) -> None:
        """Tell the open port what to receive, if that has changed."""
        ids = self._gateway.receive_ids
        if self.port is None or ids is self._receive_ids:
            return
        had_fd = self.port.fileno() is not None
        self._receive_ids = ids
        self.port.set_receive_ids(ids)
        if not had_fd and (fd := self.port.fileno()) is not None:
            self._selector.register(fd, selectors.EVENT_READ, self.serve)
        self._lock()

    def serve(self, now: int, events: int = selectors.EVENT_READ) -> None:
        """The port is readable, or can be sent to again."""
        self._served = True
        if self.port is None:
            return
        if events & selectors.EVENT_WRITE:
            self._busy_until = None
            self._watch(selectors.EVENT_READ)
        if events & selectors.EVENT_READ:
            since = self._selector.before if self._drained else 0
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
        """True if frames have waited since the last call but one and none were read: the loop does not serve this port."""
        waiting = self.port is not None and not self._served and self.port.waits_to_be_read
        stuck = waiting and self._seen_waiting
        self._served, self._seen_waiting = False, waiting
        return stuck

    def drop_measurements(self) -> bool:
        """Throw away the measurements that wait to be sent; True where there were any. Answers stay, in their order."""
        dropped = self.mailboxes.drop_measurements()
        self._count_losses()
        return dropped

    def clear(self) -> None:
        """Throw away what waits to be sent."""
        self.mailboxes.clear()
        self._count_losses()

    def transmit(self, now: int) -> None:
        """Hand what is to be sent to the interface, as far as it takes it."""
        status, waiting = self._gateway.status, self.mailboxes
        frames = self._gateway.take_frames()
        waiting.put_all(frames)
        if self.port is None or (self._off and self._sends_in_vain):
            if frames:
                self._gateway.not_sent(now)
            self.clear()
            self._busy_until = self._busy_since = None
            return
        self._count_losses()
        if self._busy_until is not None:
            if now < self._busy_until:
                return
            self._busy_until = None
        if not waiting:
            if not self._stalled:
                self._busy_since = None
            return
        self._turn_ns = now
        count, answer = waiting.flush(self._send)
        status.sent_frames += count
        if count:
            self._busy_since = None
        if answer is _OK:
            if not self._is_proven:
                self._works(now)
        elif answer is Sent.LATE:
            return  # what is old of it the next turn drops
        else:
            status.send_failures += 1
            if answer in (Sent.BUSY, Sent.FULL):
                answer = self._busy(answer, now)
            if answer in (Sent.DOWN, Sent.GONE):
                self._lost(answer, now)
                return
        if count and self._stalled:
            self._stalled = False
            self._conditions.end(
                self._sending_condition, f"CAN {self.config.channel}: frames are sent again", now
            )
            self._gateway.can_returned(now)
        self._follow_state(now)

    def _send(self, frames: Sequence[CanFrame]) -> tuple[int, Sent]:
        assert self.port is not None
        return self.port.send_all(frames, self._clock, self._turn_ns + self.longest_turn_ns)

    def _busy(self, answer: Sent, now: int) -> Sent:
        """The interface takes no more for now; GONE if it has not for so long that it must be."""
        assert self.port is not None
        self._busy_since = self._busy_since or now
        if now - self._busy_since > LASTING_BUSY_NS:
            if not self.port.reports_full:
                return Sent.GONE
            self._stall(now)
        self._busy_until = now + BUSY_RETRY_NS
        if answer is Sent.FULL:  # it tells when there is room
            self._busy_until = now + LASTING_BUSY_NS
            self._watch(selectors.EVENT_READ | selectors.EVENT_WRITE)
        return answer

    def _watch(self, events: int) -> None:
        if self.port is not None and (fd := self.port.fileno()) is not None:
            self._selector.modify(fd, events, self.serve)

    def _stall(self, now: int) -> None:
        """The bus has not taken a frame for long: what waits is too old to be of use."""
        self.clear()
        self._stalled = True
        text = f"CAN {self.config.channel}: no frame can be sent: nobody acknowledges, or the bus is full. Trying again."
        self._conditions.begin(self._sending_condition, text, now)

    def _works(self, now: int) -> None:
        self._is_proven = True
        self._retry.succeeded()
        self._conditions.end(
            self._interface_condition, f"CAN {self.config.channel}: frames are sent again", now
        )

    def _count_losses(self) -> None:
        status, waiting = self._gateway.status, self.mailboxes
        status.replaced_frames, status.dropped_frames = waiting.replaced, waiting.dropped

    def _follow_reception(self, now: int) -> None:
        """What receiving told of the interface itself."""
        port = self.port
        assert port is not None
        if port.overruns:
            self._gateway.receive_overrun(now)
        port.overruns = 0
        if port.gone:
            self._lost(Sent.GONE, now)
        else:
            self._follow_state(now)

    def _follow_state(self, now: int) -> None:
        port, status = self.port, self._gateway.status
        assert port is not None
        if port.bus_off_count:
            status.bus_off_count += port.bus_off_count
            port.bus_off_count = 0
        if port.state is status.can_state:
            return
        if self._off and port.state is not CanState.BUS_OFF:
            if not self._has_restarted(now):
                return
            self._restarted_ns, self._runs_since = now, None
        self._off = port.state is CanState.BUS_OFF
        self._gateway.set_can_state(port.state, now)
        name = f"CAN {self.config.channel}"
        if port.state is CanState.BUS_OFF:
            self._conditions.begin(
                self._controller_condition, f"{name}: bus-off.{self._restart_hint()}", now
            )
            self.ask(now)
        elif port.state is CanState.ERROR_PASSIVE:
            text = f"{name}: error-passive: wrong bit rate, a cable or termination fault, or nobody acknowledges."
            self._conditions.begin(self._controller_condition, text, now)
        elif port.state is not CanState.UNKNOWN:
            word = name_in_words(port.state.name)
            self._conditions.end(self._controller_condition, f"{name}: {word}", now)

    def _follow_bitrate(self, bitrate: int | None, now: int) -> None:
        name, wanted = self.config.channel, self.config.bitrate
        if bitrate and bitrate != wanted:
            text = f"CAN {name} runs at {bitrate} bit/s, can.bitrate says {wanted}: make them the same."
            self._conditions.begin(f"CAN {name}: bit rate", text, now)
        elif bitrate:
            self._conditions.end(
                f"CAN {name}: bit rate", f"CAN {name} runs at {bitrate} bit/s", now
            )

    def _restart_hint(self) -> str:
        if self.facts is None or self.facts.restart_ms != 0:
            return ""
        name = self.config.channel
        return (
            f" restart-ms is 0, so it stays there until somebody restarts it: sudo ip link set {name} down && sudo ip link set {name} "
            "up. For good: the same with up type can restart-ms 100."
        )

    # --- words

    def follow_conflicts(self, now: int) -> None:
        """Others that send with our ids: say when it begins and when it is over."""
        for conflict in self._gateway.take_conflicts():
            self._tell(conflict, now)

    def _tell(self, conflict: Conflict, now: int) -> None:
        bits = "29-bit id" if conflict.is_extended else "id"
        which = f"CAN {self.config.channel}: {bits} {conflict.can_id:X}h"
        if conflict.over:
            self._conditions.end(
                which, f"{which}: nobody else sends with it", now, f"; {conflict.count} frames"
            )
            return
        remedy = (
            "Two nodes with one node-ID?"
            if conflict.node is not None
            else "Change one, as by dbc.base_id."
        )
        self._conditions.begin(
            which,
            f"{which}: somebody else sends with it too; here it is {conflict.whose}. {remedy}",
            now,
        )

    @property
    def _interface_condition(self) -> str:
        return f"CAN {self.config.channel}: interface"

    @property
    def _sending_condition(self) -> str:
        return f"CAN {self.config.channel}: sending"

    @property
    def _controller_condition(self) -> str:
        return f"CAN {self.config.channel}: controller"
