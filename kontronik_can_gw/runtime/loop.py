"""The live gateway: one selector loop over serial ports, CAN interface and time. No thread is started here.

What may touch what: everything belongs to the thread that calls ``run``; only ``stop`` may be called from elsewhere (a signal handler,
another thread). Where python-can has no descriptor to wait on, the CAN port receives by a thread (bus_reader.py).
"""

import contextlib
import logging
import os
import selectors
import time
from collections import deque
from collections.abc import Callable, Sequence

from kontronik_can_gw.cia301.nmt import NmtState
from kontronik_can_gw.cia301.storage import Stored, encode
from kontronik_can_gw.cia305.lss import UNCONFIGURED
from kontronik_can_gw.config import CanConfig
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.protocol.states import device_text
from kontronik_can_gw.runtime.can_port import CanPort, Sent
from kontronik_can_gw.runtime.mailboxes import Mailboxes
from kontronik_can_gw.runtime.serial_port import PortLost, SerialPort, device_of
from kontronik_can_gw.runtime.store import ParameterStore
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import MS, SECOND, LinkState

log = logging.getLogger("kontronik_can_gw")

FIRST_RETRY_NS, LONGEST_RETRY_NS = 100 * MS, SECOND
BUSY_RETRY_NS = 2 * MS
LASTING_BUSY_NS = SECOND
LEAST_SUSPENDED_NS, SUSPENDED_NS = 20 * MS, 250 * MS
"""A loop that comes round this much too late was held up or suspended: what waits on the ports is old."""
_LAST_SAVE_S = 0.2
DIAGNOSIS_NS = 3 * SECOND


class _Retry:
    """When to try again: at once more and more seldom, up to a bound."""

    def __init__(self) -> None:
        self.due: int | None = None
        self._pause = FIRST_RETRY_NS

    def failed(self, now: int) -> None:
        self.due = now + self._pause
        self._pause = min(self._pause * 2, LONGEST_RETRY_NS)

    def succeeded(self) -> None:
        self.due = None
        self._pause = FIRST_RETRY_NS


class _Esc:
    """One ESC's port."""

    def __init__(self, index: int, name: str, path: str) -> None:
        self.index = index
        self.name = name
        self.path = path
        self.port: SerialPort | None = None
        self.retry = _Retry()
        self.complaint = ""
        self.diagnosis_due = 0
        self.line_errors = 0
        self.line_errors_due = 0


class Loop:
    """Owns ports, interface and gateway while it runs."""

    def __init__(
        self,
        gateway: Gateway,
        ports: Sequence[str],
        can_config: CanConfig,
        wait_for_devices: bool = False,
        store: ParameterStore | None = None,
        status_ns: int = 0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.gateway = gateway
        self._clock = clock
        self._can_config = can_config
        self._wait = wait_for_devices
        self._store = store
        self._to_keep: deque[tuple[int, Stored]] = deque()
        self._keeping = 0
        self._node_changes = 0
        self._node_states: list[tuple[int, NmtState]] = []
        self._status_ns = status_ns
        self._status_due = 0 if status_ns else None
        self._status_before: tuple[int, list[int]] = (0, [])
        self._escs = [
            _Esc(i, esc.settings.name, path) for i, (esc, path) in enumerate(zip(gateway.escs, ports, strict=True))
        ]
        self._can: CanPort | None = None
        self._can_retry = _Retry()
        self._can_complaint = ""
        self._receive_ids: frozenset[int] | None = None
        """What the open CAN port was told to receive."""
        self._mailboxes = Mailboxes()
        self._busy_until: int | None = None
        self._busy_since: int | None = None
        self._stalled = False
        self._selector = selectors.DefaultSelector()
        self._held: list[str] | None = []  # what was opened is said when all is: an error at start is the only line
        self._stopping = False
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._selector.register(self._wake_read, selectors.EVENT_READ, None)
        if store is not None:
            self._selector.register(store.fileno(), selectors.EVENT_READ, store)

    def stop(self) -> None:
        """End ``run`` soon; safe in a signal handler and from another thread."""
        self._stopping = True
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"\0")

    def open(self) -> None:
        """Open interface and ports. RunError if one is missing, unless the configuration says to wait for it; nothing stays open then."""
        now = self._clock()
        try:
            # ports first, and locked: so that nothing else, a CAN adapter's driver included, opens them
            for esc in self._escs:
                self._open_port(esc, now)
            self._open_can(now)
        except UserError:
            self.close()
            raise
        for esc in self._escs:
            if esc.port is not None:
                esc.port.discard()  # an interface may take seconds to open
        if self._can is not None:
            self._can.discard()  # a node that has not booted yet hears nothing
        for line in self._held or ():
            log.info(line)
        self._held = None

    def run(self) -> None:
        """Until ``stop``. Then a last status is sent and everything is closed."""
        gateway, clock = self.gateway, self._clock
        now = clock()
        gateway.start(now, self._can is not None)
        self._follow_receive_ids()  # before the boot-up message: a master may ask as soon as it sees it
        self._transmit(now)
        try:
            while not self._stopping:
                last = now
                pause = max(0, self._next_deadline() - clock())
                ready = self._selector.select(pause / SECOND)
                now = clock()
                if now - last - pause > LEAST_SUSPENDED_NS and now - last - pause > self._suspended_ns():
                    self._discard_input(now - last - pause, now)
                    ready = []  # what they announced is gone; a hang-up comes again
                for key, _ in ready:
                    self._serve(key, now)
                self._reopen(now)
                gateway.advance(now)
                self._keep(now)
                self._follow_receive_ids()
                self._transmit(now)
                self._report(now)
        finally:
            now = clock()
            gateway.stop(now)
            self._transmit(now)
            self.close()

    def close(self) -> None:
        """Close everything."""
        for esc in self._escs:
            self._close_port(esc)
        if self._can is not None:
            self._close_can()
        self._selector.close()
        if self._store is not None:
            self._store.close(_LAST_SAVE_S)
        for fd in (self._wake_read, self._wake_write):
            with contextlib.suppress(OSError):
                os.close(fd)
        # ``stop`` may still come: it must not write to a descriptor of another's
        self._wake_read = self._wake_write = -1

    def _next_deadline(self) -> int:
        if self.gateway.frames_wait:  # of a change that sending itself brought about
            return 0
        due = [self.gateway.next_deadline()]
        due += [esc.retry.due for esc in self._escs if esc.retry.due is not None]
        due += [w for w in (self._can_retry.due, self._busy_until, self._status_due) if w is not None]
        return min(due)

    def _serve(self, key: selectors.SelectorKey, now: int) -> None:
        what = key.data
        if isinstance(what, _Esc):
            if what.port is None:
                return
            try:
                data = what.port.read()
            except PortLost as error:
                self._port_lost(what, str(error), now)
                return
            if data:
                self.gateway.receive_bytes(what.index, data, now)
        elif isinstance(what, CanPort):
            self._receive(what, now)
        elif isinstance(what, ParameterStore):
            self._take_kept(what, now)
        else:
            with contextlib.suppress(OSError):
                os.read(self._wake_read, 64)

    def _suspended_ns(self) -> int:
        """Held up for longer, what waits on the ports is old: a master may change the ESCs' time-outs."""
        return min([SUSPENDED_NS, *(esc.settings.timeout_ns for esc in self.gateway.escs)])

    def _discard_input(self, late: int, now: int) -> None:
        log.warning(
            "the process was suspended for %.1f s: what waited on the serial ports and for CAN is thrown away",
            late / SECOND,
        )
        lost = self._mailboxes.dropped
        self._clear_mailboxes()
        if self._can is not None:
            self._can.discard()
            self._follow_reception(self._can, now)
        if self._mailboxes.dropped != lost:  # an answer is too late by now, but what is wrong has to be known
            self.gateway.can_returned(now)
        for esc in self._escs:
            if esc.port is not None:
                esc.port.discard()

    # --- serial ports

    def _open_port(self, esc: _Esc, now: int) -> None:
        try:
            port = SerialPort(esc.path)
        except RunError as error:
            if not self._wait and esc.retry.due is None:
                raise RunError(f"{esc.name}: {error}") from None
            self._port_failed(esc, str(error), now)
            return
        port.discard()  # what came before we listened has no time
        esc.port = port
        esc.retry.succeeded()
        esc.diagnosis_due = now + DIAGNOSIS_NS
        esc.line_errors = port.line_errors()
        self._selector.register(port.fileno(), selectors.EVENT_READ, esc)
        self.gateway.port_opened(esc.index, now)
        self._say_open(f"{esc.name}: {esc.path} is open")
        esc.complaint = ""

    def _port_failed(self, esc: _Esc, reason: str, now: int) -> None:
        esc.retry.failed(now)
        self.gateway.port_lost(esc.index, now)
        if reason != esc.complaint:
            esc.complaint = reason
            log.warning("%s: %s Trying again.", esc.name, reason)

    def _port_lost(self, esc: _Esc, reason: str, now: int) -> None:
        self._close_port(esc)
        self._port_failed(esc, f"{esc.path}: lost ({reason}).", now)

    def _close_port(self, esc: _Esc) -> None:
        if esc.port is not None:
            self._selector.unregister(esc.port.fileno())
            esc.port.close()
            esc.port = None

    def _reopen(self, now: int) -> None:
        for esc in self._escs:
            if esc.retry.due is not None and now >= esc.retry.due:
                self._open_port(esc, now)
        if self._can_retry.due is not None and now >= self._can_retry.due:
            if self._can is None:
                self._open_can(now)
            else:
                self._can_retry.due = None  # an interface that was down is tried by sending
            if self._can_retry.due is None:
                self.gateway.can_returned(now)

    # --- parameters

    def _keep(self, now: int) -> None:
        """Hand what is to be stored to the store's thread; while the disk has not taken what came before, it waits."""
        self._to_keep += self.gateway.take_saves()
        while self._to_keep:
            index, stored = self._to_keep[0]
            if self._store is not None and self._store.save(self._escs[index].name, encode(stored)):
                self._keeping += 1
            elif self._keeping:
                return
            else:
                log.error("%s: parameters cannot be stored: there is no store for them", self._escs[index].name)
                self.gateway.saved(index, "no store", now)
            self._to_keep.popleft()

    def _take_kept(self, store: ParameterStore, now: int) -> None:
        for name, error in store.results():
            self._keeping -= 1
            index = next(esc.index for esc in self._escs if esc.name == name)
            if error is None:
                log.info("%s: parameters stored", name)
            else:
                log.error("%s: parameters cannot be stored: %s", name, error)
            self.gateway.saved(index, error, now)

    # --- CAN

    def _open_can(self, now: int) -> None:
        try:
            self._refuse_escs_as_channel()
            port = CanPort(self._can_config)
        except RunError as error:
            if not self._wait and self._can_retry.due is None:
                raise
            self._can_failed(str(error), now)
            return
        self._can = port
        self._can_retry.due = None
        if (fd := port.fileno()) is not None:
            self._selector.register(fd, selectors.EVENT_READ, port)
        self._receive_ids = None
        self._follow_receive_ids()
        self._say_open(f"CAN {self._can_config.interface} {self._can_config.channel} is open")

    def _follow_receive_ids(self) -> None:
        """Tell the open port what to receive, if that has changed."""
        ids = self.gateway.receive_ids
        if self._can is None or ids is self._receive_ids:
            return
        had_fd = self._can.fileno() is not None
        self._receive_ids = ids
        self._can.set_receive_ids(ids)
        if not had_fd and (fd := self._can.fileno()) is not None:
            self._selector.register(fd, selectors.EVENT_READ, self._can)

    def _receive(self, port: CanPort, now: int) -> None:
        if port is not self._can:
            return
        frames = port.receive()
        self.gateway.status.received_frames += len(frames)
        for frame in frames:
            self.gateway.receive_frame(frame, now)
        if frames and self._can_retry.due is not None:
            self._can_retry.due = now  # it was down, and works again
        self._follow_reception(port, now)

    def _follow_reception(self, port: CanPort, now: int) -> None:
        """What receiving told of the interface itself."""
        self.gateway.status.bus_off_count += port.bus_off_count
        if port.overruns:
            self.gateway.receive_overrun(now)
        port.bus_off_count = port.overruns = 0
        if port.gone:
            self._can_lost(Sent.GONE, now)
        else:
            self.gateway.set_can_state(port.state, now)

    def _refuse_escs_as_channel(self) -> None:
        """Whatever its name is now: what leads to an ESC must not be opened as a CAN interface, which would send to it."""
        device = device_of(self._can_config.channel)
        for esc in self._escs:
            if device is not None and device == device_of(esc.path):
                raise RunError(
                    f"can.channel {self._can_config.channel} is the port of {esc.name}: nothing may be sent to an ESC."
                )

    def _can_failed(self, reason: str, now: int) -> None:
        self._can_retry.failed(now)
        if self._can_retry.due is not None:
            self._clear_mailboxes()
        self.gateway.set_can_state(CanState.DOWN, now)
        if reason != self._can_complaint:
            self._can_complaint = reason
            log.warning("%s Trying again.", reason)

    def _close_can(self) -> None:
        if self._can is not None:
            if (fd := self._can.fileno()) is not None:
                with contextlib.suppress(KeyError, ValueError):
                    self._selector.unregister(fd)
            self._can.close()
            self._can = None

    def _can_lost(self, answer: Sent, now: int) -> None:
        """The interface is down, or gone and to be opened anew."""
        self._busy_since = None
        if answer is Sent.GONE:
            self._close_can()
        self._can_failed(f"CAN interface {self._can_config.channel}: {'gone' if answer is Sent.GONE else 'down'}.", now)

    def _clear_mailboxes(self) -> None:
        self._mailboxes.clear()
        self._count_losses()

    def _count_losses(self) -> None:
        status, waiting = self.gateway.status, self._mailboxes
        status.replaced_frames, status.dropped_frames = waiting.replaced, waiting.dropped

    def _transmit(self, now: int) -> None:
        status, waiting = self.gateway.status, self._mailboxes
        for frame in self.gateway.take_frames():
            waiting.put(frame)
        if self._can is None or self._can_retry.due is not None:
            self._clear_mailboxes()
            return
        self._count_losses()
        if not len(waiting):
            return
        if self._busy_until is not None and now < self._busy_until:
            return
        self._busy_until = None
        count, answer = waiting.flush(self._can.send)
        status.sent_frames += count
        if count:
            self._busy_since = None
        if answer is Sent.OK:
            self._can_works()
        else:
            status.send_failures += 1
            if answer is Sent.BUSY:
                self._busy_since = self._busy_since or now
                if now - self._busy_since > LASTING_BUSY_NS:
                    if self._can.tells_busy_from_gone:
                        self._stall()
                    else:
                        answer = Sent.GONE
            if answer is not Sent.BUSY:
                self._can_lost(answer, now)
                return
            self._busy_until = now + BUSY_RETRY_NS
        if count and self._stalled:
            self._stalled = False
            self.gateway.can_returned(now)
        self.gateway.set_can_state(self._can.state, now)

    def _stall(self) -> None:
        """The bus has not taken a frame for long: what waits is too old to be of use."""
        self._clear_mailboxes()
        if not self._stalled:
            self._stalled = True
            name = self._can_config.channel
            self._can_complaint = f"CAN {name}: no frame can be sent: nobody acknowledges, or the bus is full."
            log.warning("%s Trying again.", self._can_complaint)

    def _can_works(self) -> None:
        self._can_retry.succeeded()
        if self._can_complaint:
            self._can_complaint = ""
            log.info("CAN %s: frames are sent again", self._can_config.channel)

    # --- words

    def _say_open(self, line: str) -> None:
        if self._held is None:
            log.info(line)
        else:
            self._held.append(line)

    def _report_nodes(self) -> None:
        if self.gateway.node_changes == self._node_changes:
            return
        self._node_changes = self.gateway.node_changes
        for index, key in self.gateway.take_misfits():
            where = f"{key >> 8:04X}h:{key & 0xFF:02X}"
            log.warning(
                "%s: the stored %s is passed over: it does not fit this EDS, or clashes", self._escs[index].name, where
            )
        states = [(node_id, state) for node_id, state, _ in self.gateway.node_states()]
        before, self._node_states = self._node_states, states
        for index, (node_id, state) in enumerate(states):
            if before and before[index] == (node_id, state):
                continue
            words = "waits for LSS" if node_id == UNCONFIGURED else f"{node_id} {_words(state.name)}"
            log.info("%s: CANopen node %s", self._escs[index].name, words)

    def _tell_status(self, now: int) -> None:
        """One line about everything, for who wants it every so often."""
        status, states = self.gateway.status, self.gateway.node_states()
        counts = [status.sent_frames, *(pdos for _, _, pdos in states)]
        then, before = self._status_before
        self._status_before = (now, counts)
        self._status_due = now + self._status_ns
        if not before:
            return
        seconds = (now - then) / SECOND
        rates = [(new - old) / seconds for new, old in zip(counts, before, strict=True)]
        words = [f"CAN {_words(status.can_state.name)} {rates[0]:.0f} frames/s"]
        for number, esc in enumerate(self.gateway.escs):
            rate = "" if esc.frame_rate is None else f" {esc.frame_rate / 10:.0f} Hz"
            words.append(f"{esc.settings.name}: telemetry {_words(esc.link.name)}{rate}")
            if states and states[number][0] != UNCONFIGURED:
                node_id, state, _ = states[number]
                words.append(f"node {node_id} {_words(state.name)} {rates[1 + number]:.0f} PDOs/s")
        log.info("%s", "; ".join(words))

    def _report(self, now: int) -> None:
        self._report_nodes()
        if self._status_due is not None and now >= self._status_due:
            self._tell_status(now)
        for index in dict.fromkeys(self.gateway.take_link_changes()):
            esc, port = self.gateway.escs[index], self._escs[index]
            port.diagnosis_due = now + DIAGNOSIS_NS
            if esc.link in (LinkState.OK, LinkState.DEGRADED):
                layout = ("unknown layout", "V4", "legacy")[esc.layout]
                device = device_text(esc.info.device) if esc.info else None
                log.info(
                    "%s: telemetry %s (%s%s)", port.name, esc.link.name.lower(), layout, f", {device}" if device else ""
                )
            elif esc.link is LinkState.LOST:
                log.warning("%s: telemetry lost; its values are marked as not available", port.name)
        for port in self._escs:
            if port.port is not None and now >= port.line_errors_due:
                port.line_errors_due = now + SECOND
                count = port.port.line_errors()
                self.gateway.escs[port.index].line_errors += max(0, count - port.line_errors)
                port.line_errors = count
            if port.port is not None and port.diagnosis_due and now >= port.diagnosis_due:
                port.diagnosis_due = now + DIAGNOSIS_NS
                diagnosis = self.gateway.escs[port.index].diagnosis()
                if diagnosis and diagnosis != port.complaint:
                    port.complaint = diagnosis
                    log.warning("%s: no telemetry: %s", port.name, diagnosis)


def _words(name: str) -> str:
    """A constant's name as people read it."""
    return name.lower().replace("_", "-")
