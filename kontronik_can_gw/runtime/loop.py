"""The live gateway: one loop over serial ports, CAN interface and time. No thread is started here.

What may touch what: everything belongs to the thread that calls ``run``; only ``stop`` may be called from elsewhere (a signal handler,
another thread). Threads of their own (worker.py) have the parameter store (store.py), the statistics (statistics.py), captures
(recorder.py), the log (fault_log.py), and of python-can's drivers opening (can_opener.py) and reception (open_can.py).
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, cast

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.can.can_link import CanLink
from kontronik_can_gw.runtime.files.parameter_saver import ParameterSaver
from kontronik_can_gw.runtime.housekeeping import Housekeeping
from kontronik_can_gw.runtime.poller import MIN_HELD_UP_NS, Handler, Poller
from kontronik_can_gw.runtime.ports.esc_port import LOOK_NS, EscPort
from kontronik_can_gw.runtime.ports.usb_adapters import Identity
from kontronik_can_gw.runtime.status.facts import ProgramFacts
from kontronik_can_gw.runtime.status.statistics import Statistics
from kontronik_can_gw.runtime.system.fault_log import FaultLog, duration
from kontronik_can_gw.runtime.system.sd_notify import Notifier
from kontronik_can_gw.runtime.system.worker import Handover
from kontronik_can_gw.times import MS, SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.files.recorder import Recorder
    from kontronik_can_gw.runtime.files.store import ParameterStore
    from kontronik_can_gw.runtime.native_poller import NativePoller

_WAKES_PER_TIMEOUT = 4
"""The loop wakes at least this often within the shortest telemetry time-out: by how much of it a value may go early.

A millisecond sooner, for a wait is rounded up to one.
"""
_LAST_SAVE_S = 0.2


class Loop:
    """Owns ports, interface and gateway while it runs."""

    def __init__(
        self,
        gateway: Gateway,
        ports: Sequence[str],
        can_config: CanConfig,
        wait_for_devices: bool = False,
        store: "ParameterStore | None" = None,
        clock: Callable[[], int] = time.monotonic_ns,
        notifier: Notifier | None = None,
        statistics: Statistics | None = None,
        program: ProgramFacts | None = None,
        recorder: "Recorder | None" = None,
        poller: Poller | None = None,
    ) -> None:
        self.gateway = gateway
        self.conditions = FaultLog()
        self._clock = clock
        self._wait = wait_for_devices
        self._store = store
        self._notifier = notifier or Notifier({})
        self._statistics = statistics
        self._recorder = recorder
        self._now = self._look_due = self._revision = 0
        self._due: int | None = None  # not known since something was done
        self._stopping = False
        self._reason = "stopped"
        self._is_ready = False
        self._poller = poller or Poller(clock)
        self._lost: set[EscPort] = set()
        self.escs = [
            EscPort(i, path, gateway, self._poller, self.conditions, self._lost, clock)
            for i, path in enumerate(ports)
        ]
        self.can = CanLink(can_config, gateway, self._poller, self.conditions, self._esc_at, clock)
        self._saver = ParameterSaver(gateway, self.escs, store)
        self._housekeeping = Housekeeping(
            gateway,
            self.escs,
            self.can,
            self.conditions,
            self._saver,
            notifier=self._notifier,
            statistics=self._statistics,
            recorder=recorder,
            program=program or ProgramFacts(""),
        )
        self._wake: Handover[None] = Handover()
        self._poller.register(self._wake.fileno(), self._woken)
        if store is not None:
            self._poller.register(store.fileno(), self._saver.take_results)

    def stop(self, reason: str = "stopped") -> None:
        """End ``run`` soon; safe in a signal handler and from another thread. ``reason`` is logged."""
        self._reason = reason
        self._stopping = True
        self._wake.wake()

    def open(self) -> None:
        """Open interface and ports. RunError if one is missing, unless the configuration says to wait for it; nothing stays open then."""
        now = self._clock()
        self.conditions.hold()  # what was opened is logged when all is: an error at start is the only line
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
            self.can.port.discard()  # a node that has not booted yet receives nothing
        self.conditions.release()
        self._housekeeping.publish(now)  # the first time takes the longest

    def run(self) -> None:
        """Until ``stop``. Then a last status is sent and everything is closed."""
        self.begin()
        try:
            while not self._stopping:
                self.turn()
        except UserError as error:
            self._reason = f"ended ({error})"
            raise
        except BaseException as error:
            self._reason = f"ended by a fault of the program ({error!r})"
            raise
        finally:
            self.end()

    def begin(self) -> None:
        """Start the gateway."""
        self._poller.begin()
        now = self._now = self._clock()
        self.gateway.start(now, self.can.is_open)
        self.can.follow_ids()  # before the boot-up message: a master may ask as soon as it sees it
        self.can.transmit(now)
        self._report_ready()

    def _report_ready(self) -> None:
        """Tell the service manager once that the gateway runs: not before an interface that must open is open."""
        if not (self._is_ready or self.can.must_open):
            self._is_ready = True
            self._notifier.ready(self._housekeeping.status_words())

    def turn(self) -> None:
        """Wait until something has come or is due, and do it."""
        period = self.gateway.core.shortest_timeout_ns // _WAKES_PER_TIMEOUT - MS
        ready = None
        if self._poller.is_native:
            leave = self._housekeeping.due  # what the controller says is asked for with it
            native = cast("NativePoller", self._poller)
            ready = native.turn(self.can, self._now, self._own_deadline(), leave, period)
        if in_python := ready is None:
            if self._due is None:
                self._due = self._next_deadline()
            ready = self._poller.wait(self._now, min(self._now + period, self._due))
            is_over = self._poller.now < self._due
        else:
            is_over, self._due = self._poller.is_over, None
        now, late = self._poller.now, self._poller.late
        held_up = late > MIN_HELD_UP_NS and late > self.can.transmitter.max_turn_ns()
        if held_up:
            self._follow_hold_up(late, now)
        if held_up or ready or not is_over:
            now, self._due = self._serve(ready, now), None
        elif now >= self.can.controller.due:
            self.can.ask(now)
            self._due = None
        self._now = now
        if in_python and now >= self._look_due:
            self._look_due = now + LOOK_NS
            for esc in self.escs:
                esc.hold_settings()
        if now >= self._housekeeping.due:
            self._housekeeping.run(now)
            self._due = None

    def _serve(self, ready: list[tuple[Handler, int]], now: int) -> int:
        """Take what has come, do what is due, send what is made of it. Returns the time."""
        gateway, can = self.gateway, self.can
        for handler, events in ready:
            handler(now, events)
        if self._lost or can.port is None or now >= can.controller.due:
            now = self._reopen(now)
        has_outputs = gateway.has_outputs
        if has_outputs:
            self._saver.save(now)  # first: what it answers belongs to this turn, in a replay too
        gateway.advance(now)
        if has_outputs:
            self._follow_outputs(now)
        can.transmit(now)
        self._report_ready()
        if changes := gateway.take_link_changes():
            for index in dict.fromkeys(changes):
                self.escs[index].log.follow_link(now)
        return now

    def _follow_outputs(self, now: int) -> None:
        """Follow changes of the outputs: ids to receive, states of nodes."""
        revision = self.gateway.revision
        if revision != self._revision:
            self._revision = revision
            self.can.follow_ids()
            self._housekeeping.report_outputs(now)

    def end(self) -> None:
        """A last status is sent and everything is closed."""
        now = self._clock()
        self._housekeeping.follow_recorder(now)  # what is known of the devices by now
        self.gateway.stop(now)
        self.can.transmit(now)
        self.conditions.say(logging.INFO, f"{self._reason} {totals(self.gateway, now)}")
        self.close()

    def close(self) -> None:
        """Close everything."""
        for esc in self.escs:
            esc.close()
        self.can.close()
        self._poller.close()
        if self._statistics is not None:
            self._statistics.close()
        if self._recorder is not None:
            self._recorder.close()
            self._housekeeping.follow_recorder(self._clock())  # the last words
        if self._store is not None:
            self._store.close(_LAST_SAVE_S)
        self._wake.close()  # ``stop`` may still come, without effect

    def _woken(self, _now: int, _events: int) -> None:
        self._wake.take()

    def _next_deadline(self) -> int:
        if self.gateway.frames_wait:  # of a change that sending itself brought about
            return 0
        return min(self._own_deadline(), self.gateway.next_deadline())

    def _own_deadline(self) -> int:
        """Of what is to be done apart from the gateway."""
        due = min(self.can.due, self._housekeeping.wake_due)
        for esc in self._lost:
            due = min(due, esc.due)
        return due

    def _others(self, esc: EscPort) -> tuple[Identity | None, ...]:
        return tuple(other.identity for other in self.escs if other is not esc)

    def _esc_at(self, path: str) -> str | None:
        """The name of the ESC that a path leads to."""
        return next((esc.name for esc in self.escs if esc.is_at(path)), None)

    def _follow_hold_up(self, late: int, now: int) -> None:
        """What was measured before is old; commands and answers are not (how old bytes are, ``since`` says)."""
        text = f"the process was suspended for {late / SECOND:.1f} s: measurements that waited to be sent are dropped and made anew"
        self.conditions.event("suspended", text, now)
        self.gateway.held_up(now, self.can.transmitter.drop_measurements())

    def _reopen(self, now: int) -> int:
        """Open what is due. Returns the time: it may have taken long on a slow machine."""
        for esc in tuple(self._lost):
            esc.reopen(now, self._others(esc))
        self.can.reopen(now)
        if now >= self.can.controller.due:
            self.can.ask(now)
        return max(now, self._clock())


def totals(gateway: Gateway, now: int) -> str:
    """What the gateway has done, in one line."""
    status, escs = gateway.status, gateway.escs
    live = sum(esc.counters.live for esc in escs)
    crc_errors = sum(esc.counters.crc_errors for esc in escs)
    losses = sum(esc.losses for esc in escs)
    return (
        f"after {duration(now - status.started_ns)}: {live} live frames received, {crc_errors} CRC errors, telemetry lost {losses} times; "
        f"{status.sent_frames} CAN frames sent, {status.dropped_frames} dropped, bus-off {status.bus_off_count} times"
    )
