"""The live gateway: one selector loop over serial ports, CAN interface and time. No thread is started here.

What may touch what: everything belongs to the thread that calls ``run``; only ``stop`` may be called from elsewhere (a signal handler,
another thread). Threads of their own have the parameter store (store.py), the statistics (statistics.py), captures (recorder.py),
the log (log_writer.py), and reception where python-can has no descriptor (bus_reader.py).
"""

import contextlib
import logging
import os
import selectors
import time
from collections import deque
from collections.abc import Callable, Sequence

from kontronik_can_gw.canopen.lss import UNCONFIGURED
from kontronik_can_gw.canopen.nmt import NmtState
from kontronik_can_gw.canopen.storage import Stored, encode
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.can_link import CanLink
from kontronik_can_gw.runtime.esc_port import EscPort
from kontronik_can_gw.runtime.fault_log import FaultLog
from kontronik_can_gw.runtime.poller import Poller
from kontronik_can_gw.runtime.recorder import Recorder
from kontronik_can_gw.runtime.serial_port import Identity
from kontronik_can_gw.runtime.snapshot import (
    ProgramFacts,
    StoreFacts,
    name_in_words,
    process_facts,
    snapshot,
)
from kontronik_can_gw.runtime.statistics import Statistics
from kontronik_can_gw.runtime.store import ParameterStore
from kontronik_can_gw.runtime.systemd import Notifier

log = logging.getLogger("kontronik_can_gw")

MIN_HELD_UP_NS = 20 * MS
"""A loop that comes round this much too late at least, and by ``Transmitter.max_turn_ns``, was held up."""
_LOOKS_PER_TIMEOUT = 8
"""The ports are looked at so often within the shortest telemetry time-out at least: by how much of it a value may go early."""
STATUS_NS = SECOND
"""The service manager is told a line at most this often."""
LOOK_NS = 100 * MS
"""How often there is a look round: statistics, line errors, log sums, signs of life."""
_LAST_SAVE_S = 0.2


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
        notifier: Notifier | None = None,
        statistics: Statistics | None = None,
        program: ProgramFacts | None = None,
        recorder: Recorder | None = None,
        poller: Poller | None = None,
    ) -> None:
        self.gateway = gateway
        self.conditions = FaultLog()
        self._clock = clock
        self._wait = wait_for_devices
        self._store = store
        self._to_keep: deque[tuple[int, Stored]] = deque()
        self._keeping = 0
        self._node_changes = 0
        self._node_states: list[tuple[int, NmtState]] = []
        self._status_ns = status_ns
        self._status_due = 0 if status_ns else None
        self._status_before: tuple[int, list[int]] = (0, [])
        self._notifier = notifier or Notifier({})
        self._now = 0
        self._look_due = 0
        self._alive_due = 0 if self._notifier.watchdog_ns is not None else None
        self._notify_due = 0
        self._statistics = statistics or Statistics(None, None)
        self._program = program or ProgramFacts("")
        self._store_error = ""
        self._recorder = recorder
        self._stopping = False
        self._poller = poller or Poller(clock)
        self._lost: set[EscPort] = set()
        self.escs = [
            EscPort(i, path, gateway, self._poller, self.conditions, self._lost, clock)
            for i, path in enumerate(ports)
        ]
        self.can = CanLink(can_config, gateway, self._poller, self.conditions, self._esc_at, clock)
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._poller.register(self._wake_read, selectors.EVENT_READ, self._woken)
        if store is not None:
            self._poller.register(store.fileno(), selectors.EVENT_READ, self._take_kept)

    def stop(self) -> None:
        """End ``run`` soon; safe in a signal handler and from another thread."""
        self._stopping = True
        self._wake()

    def open(self) -> None:
        """Open interface and ports. RunError if one is missing, unless the configuration says to wait for it; nothing stays open then."""
        now = self._clock()
        self.conditions.hold()  # what was opened is said when all is: an error at start is the only line
        try:
            # ports first, and locked: so that nothing else, a CAN adapter's driver included, opens them
            for esc in self.escs:
                esc.open(now, self._wait, self._others(esc))
            self.can.open(now, self._wait)
            if self._recorder is not None:
                self._recorder.start(self._wait)
                self.conditions.say(logging.INFO, f"recording to {self._recorder.words}")
        except UserError:
            self.close()
            raise
        if self.can.port is not None:
            self.can.port.discard()  # a node that has not booted yet hears nothing
        self.conditions.release()
        self._publish(now)  # the first time takes the longest

    def run(self) -> None:
        """Until ``stop``. Then a last status is sent and everything is closed."""
        self.begin()
        try:
            while not self._stopping:
                self.turn()
        finally:
            self.end()

    def begin(self) -> None:
        """The gateway starts: what is said once."""
        now = self._now = self._clock()
        self.gateway.start(now, self.can.is_open)
        self.can.follow_ids()  # before the boot-up message: a master may ask as soon as it sees it
        self.can.transmit(now)
        self._notifier.ready(self._status_words())

    def turn(self) -> None:
        """Wait until something has come or is due, and do it."""
        gateway, can, clock = self.gateway, self.can, self._clock
        last = self._now
        due = self._next_deadline()
        pause = min(due, last + gateway.shortest_timeout_ns // _LOOKS_PER_TIMEOUT) - clock()
        if pause < 0:
            pause = 0
        ready = self._poller.wait(pause)
        now = self._poller.now
        late = now - last - pause
        if late > MIN_HELD_UP_NS and late > can.transmitter.max_turn_ns:
            self._follow_hold_up(late, now)
        elif not ready and now < due:  # only looked
            self._now = now
            return
        for handler, events in ready:
            handler(now, events)
        if self._lost or not can.is_idle(now):
            now = self._reopen(now)
        self._now = now
        if gateway.nodes is not None:
            self._keep(now)  # in front: what it answers belongs to this turn, in a replay too
        gateway.advance(now)
        can.follow_ids()
        can.transmit(now)
        if gateway.node_changes != self._node_changes:
            self._report_nodes(now)
        if changes := gateway.take_link_changes():
            for index in dict.fromkeys(changes):
                self.escs[index].follow_link(now)
        if now >= self._look_due:
            self._look_round(now)

    def end(self) -> None:
        """A last status is sent and everything is closed."""
        now = self._clock()
        self.gateway.stop(now)
        self.can.transmit(now)
        self.close()

    def close(self) -> None:
        """Close everything."""
        for esc in self.escs:
            esc.close()
        self.can.close()
        self._poller.close()
        self._statistics.close()
        if self._recorder is not None:
            self._recorder.close()
            self._follow_recorder(self._clock())  # the last words
        if self._store is not None:
            self._store.close(_LAST_SAVE_S)
        for fd in (self._wake_read, self._wake_write):
            with contextlib.suppress(OSError):
                os.close(fd)
        # ``stop`` may still come: it must not write to a descriptor of another's
        self._wake_read = self._wake_write = -1

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"\0")

    def _woken(self, _now: int, _events: int) -> None:
        with contextlib.suppress(OSError):
            os.read(self._wake_read, 64)

    def _next_deadline(self) -> int:
        gateway = self.gateway
        if gateway.frames_wait:  # of a change that sending itself brought about
            return 0
        due = gateway.next_deadline()
        if self._look_due < due:
            due = self._look_due
        for esc in self._lost:
            due = min(due, esc.due)
        can_due = self.can.due
        return min(can_due, due)

    def _others(self, esc: EscPort) -> tuple[Identity | None, ...]:
        return tuple(other.identity for other in self.escs if other is not esc)

    def _esc_at(self, path: str) -> str | None:
        """The name of the ESC that a path leads to."""
        return next((esc.name for esc in self.escs if esc.is_at(path)), None)

    def _follow_hold_up(self, late: int, now: int) -> None:
        """What was measured before is old; commands and answers are not (how old bytes are, ``since`` tells)."""
        text = f"the process was suspended for {late / SECOND:.1f} s: measurements that waited to be sent are dropped and made anew"
        self.conditions.event("suspended", text, now)
        self.gateway.held_up(now, self.can.transmitter.drop_measurements())

    def _reopen(self, now: int) -> int:
        """Open what is due. Returns the time: it may have taken long on a slow machine."""
        for esc in [esc for esc in self._lost if now >= esc.due] if self._lost else ():
            esc.reopen(now, self._others(esc))
        self.can.reopen(now)
        self.can.controller.ask_if_due(now)
        return max(now, self._clock())

    # --- parameters

    def _keep(self, now: int) -> None:
        """Hand what is to be stored to the store's thread; while the disk has not taken what came before, it waits."""
        if saves := self.gateway.take_saves():
            self._to_keep += saves
        while self._to_keep:
            index, stored = self._to_keep[0]
            if self._store is not None and self._store.save(self.escs[index].name, encode(stored)):
                self._keeping += 1
            elif self._keeping:
                return
            else:
                log.error(
                    "%s: parameters cannot be stored: there is no store for them",
                    self.escs[index].name,
                )
                self.gateway.saved(index, "no store", now)
            self._to_keep.popleft()

    def _take_kept(self, now: int, _events: int) -> None:
        for name, error in self._store.results() if self._store is not None else ():
            self._keeping -= 1
            index = next(index for index, esc in enumerate(self.escs) if esc.name == name)
            if error is None:
                log.info("%s: parameters stored", name)
            else:
                log.error("%s: parameters cannot be stored: %s", name, error)
            self._store_error = "" if error is None else f"{name}: {error}"
            self.gateway.saved(index, error, now)

    # --- statistics

    def _publish(self, now: int) -> None:
        """Let the statistics' thread tell how things are, if it is time."""
        if self._statistics.wanted(now):
            store = (
                None
                if self._store is None
                else StoreFacts(len(self._to_keep) + self._keeping, self._store_error)
            )
            document = snapshot(
                self.gateway,
                now=now,
                wall=time.time(),
                program=self._program,
                process=process_facts(),
                ports=[esc.facts() for esc in self.escs],
                can=self.can.facts_for_statistics(),
                store=store,
                log_lines=list(self.conditions.recent),
                recorder=None if self._recorder is None else self._recorder.facts,
            )
            self._statistics.publish(document)
        for begins, text in self._statistics.reports(now):
            if begins:
                self.conditions.begin("statistics", text, now)
            else:
                self.conditions.end("statistics", text, now)

    # --- captures

    def _follow_recorder(self, now: int) -> None:
        if self._recorder is None:
            return
        self._recorder.note(self.gateway, now)
        for name, begins, text in self._recorder.reports(now):
            if name == "losses":
                self.conditions.event("captures: losses", text, now)
            elif begins:
                self.conditions.begin(f"captures: {name}", text, now)
            else:
                self.conditions.end(f"captures: {name}", text, now)

    # --- the service manager

    def _tell_manager(self, now: int) -> None:
        if now >= self._notify_due and self._notifier.present:
            self._notify_due = now + STATUS_NS
            self._notifier.status(self._status_words())
        if self._alive_due is None or now < self._alive_due:
            return
        if any([*(esc.is_stuck() for esc in self.escs), self.can.is_stuck()]):
            return  # not fed: what is not served in time is a reason to begin anew
        self._alive_due = now + (self._notifier.watchdog_ns or SECOND)
        self._notifier.watchdog()

    def _status_words(self) -> str:
        """How things are, in one line."""
        words = [
            f"CAN {self.can.config.channel} {name_in_words(self.gateway.status.can_state.name)}"
        ]
        words += [
            f"{esc.settings.name}: telemetry {name_in_words(esc.link.name)}"
            for esc in self.gateway.escs
        ]
        return "; ".join(words)

    # --- words

    def _report_nodes(self, now: int) -> None:
        self._node_changes = self.gateway.node_changes
        for index, key in self.gateway.take_misfits():
            where = f"{key >> 8:04X}h:{key & 0xFF:02X}"
            log.warning(
                "%s: the stored %s is passed over: it does not fit this EDS, or clashes",
                self.escs[index].name,
                where,
            )
        states = [(node_id, state) for node_id, state, _ in self.gateway.node_states()]
        before, self._node_states = self._node_states, states
        for index, (node_id, state) in enumerate(states):
            if before and before[index] == (node_id, state):
                continue
            words = (
                "waits for LSS"
                if node_id == UNCONFIGURED
                else f"{node_id} {name_in_words(state.name)}"
            )
            name = f"{self.escs[index].name}: CANopen node"
            self.conditions.event(name, f"{name} {words}", now, logging.INFO)

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
        words = [f"CAN {name_in_words(status.can_state.name)} {rates[0]:.0f} frames/s"]
        for number, esc in enumerate(self.gateway.escs):
            rate = "" if esc.frame_rate is None else f" {esc.frame_rate / 10:.0f} Hz"
            words.append(f"{esc.settings.name}: telemetry {name_in_words(esc.link.name)}{rate}")
            if states and states[number][0] != UNCONFIGURED:
                node_id, state, _ = states[number]
                words.append(
                    f"node {node_id} {name_in_words(state.name)} {rates[1 + number]:.0f} PDOs/s"
                )
        log.info("%s", "; ".join(words))

    def _look_round(self, now: int) -> None:
        """What need not be done each time the loop comes round."""
        self._look_due = now + LOOK_NS
        for esc in self.escs:
            esc.report(now)
        self.can.follow_conflicts(now)
        self.conditions.advance(now)
        if self._status_due is not None and now >= self._status_due:
            self._tell_status(now)
        self._follow_recorder(now)
        self._publish(now)
        self._tell_manager(now)
