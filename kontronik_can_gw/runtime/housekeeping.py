"""Does the loop's periodic work, about once a second.

It counts line errors, updates the log, collects the recorder's reports, publishes the status
document, and sends status and keep-alive to the service manager.
"""

import gc
import logging
import time
from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING, cast

from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.printable import counted
from kontronik_can_gw.runtime.can.can_link import CanLink
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.files.parameter_saver import ParameterSaver
from kontronik_can_gw.runtime.ports.esc_port import EscPort
from kontronik_can_gw.runtime.status.facts import CanFacts, ProgramFacts, gateway_facts
from kontronik_can_gw.runtime.status.snapshot import Moment
from kontronik_can_gw.runtime.status.statistics import Statistics
from kontronik_can_gw.runtime.system.clock import ClockFacts, ClockWatch, step_in_words
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.runtime.system.process import ProcessFacts, process_facts
from kontronik_can_gw.runtime.system.sd_notify import Notifier
from kontronik_can_gw.runtime.system.worker import Report
from kontronik_can_gw.status import name_in_words
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.capture.recorded_gateway import RecordedGateway
    from kontronik_can_gw.runtime.files.recorder import Recorder

log = logging.getLogger("kontronik_can_gw")

ROUND_NS = SECOND
MAX_LATE_NS = SECOND // 2
"""Delay after which a due round wakes the loop, which usually wakes earlier for other reasons."""
PROCESS_NS = 10 * SECOND
"""Interval between queries of the process's resources. One costs more than the rest of a round."""
COLLECT_NS = 60 * SECOND
"""Interval of full garbage collections, which take less than a millisecond.

CPython keeps up to 2 000 freed tuples of each size for later use, some MB in all, and frees them
only in a full collection. Automatic collections are off (cli/run.py, ``settle_memory``). The
objects of the start are frozen, so that a collection does not visit them.
"""
STATUS_NS = SECOND
"""Shortest interval between two status lines for the service manager."""


class Housekeeping:
    """The periodic work of the loop."""

    def __init__(
        self,
        gateway: Gateway,
        escs: Sequence[EscPort],
        can: CanLink,
        conditions: FaultLog,
        saver: ParameterSaver,
        *,
        notifier: Notifier,
        statistics: Statistics | None,
        recorder: "Recorder | None",
        program: ProgramFacts,
    ) -> None:
        self.due = 0
        """Time of the next round, if the loop is awake then."""
        self.wake_due = 0
        """Time at which the loop must wake up for the round."""
        self._gateway = gateway
        self._escs = escs
        self._can = can
        self._conditions = conditions
        self._saver = saver
        self._notifier = notifier
        self._statistics = statistics
        self._recorder = recorder
        self._program = program
        self.clock_watch: ClockWatch | None = None
        self._alive_due = 0 if notifier.watchdog_ns is not None else None
        """Time of the next keep-alive. None if the service manager expects none."""
        self._notify_due = 0
        self.is_ready = False
        """True if the service manager was told that the gateway runs."""
        self._collect_due: int | None = None
        self._process = ProcessFacts()
        self._process_due = 0

    def run(self, now: int) -> None:
        """Do one round of the periodic work."""
        self.due = now + ROUND_NS
        for esc in self._escs:
            esc.report(now)
        self._can.report(now)
        self._log_conflicts(now)
        self._conditions.advance(now)
        self._follow_clock(now)
        self.follow_recorder(now)
        self.publish(now)
        self._notify(now)
        self._collect(now)
        self.wake_due = self.due + MAX_LATE_NS
        # A keep-alive that is overdue was not sent because a port is stuck.
        if self._alive_due is not None and self._alive_due > now:
            self.due = min(self.due, self._alive_due)
            self.wake_due = min(self.wake_due, self._alive_due)

    def _follow_clock(self, now: int) -> None:
        """Follow the wall clock, and log that it was set."""
        if self.clock_watch is None:
            return
        by_ns = self.clock_watch.poll(now)
        if by_ns is not None:
            text = f"the clock was set {step_in_words(by_ns)}"
            self._conditions.event("clock", text, now, logging.INFO)
        self.note_clock()

    def note_clock(self) -> None:
        """Give the state of the wall clock to the recorder."""
        if self._recorder is not None:
            self._recorder.clock_facts = self._clock_facts

    @property
    def _clock_facts(self) -> ClockFacts:
        return ClockFacts() if self.clock_watch is None else self.clock_watch.facts

    def close(self) -> None:
        """Stop following the wall clock."""
        if self.clock_watch is not None:
            self.clock_watch.close()

    def _collect(self, now: int) -> None:
        """Free the memory that the interpreter keeps for reuse, once a minute."""
        if self._collect_due is not None and now >= self._collect_due:
            gc.collect()
            self._collect_due = None
        if self._collect_due is None:
            self._collect_due = now + COLLECT_NS

    def publish(self, now: int) -> None:
        """Hand the data for a status document to the thread that writes it, if one is due."""
        statistics = self._statistics
        if statistics is None:
            return
        if now >= statistics.due:
            moment = Moment(
                gateway_facts(self._gateway),
                now=now,
                wall=time.time(),
                program=self._program,
                process=self._process_now(now),
                ports=[esc.facts() for esc in self._escs],
                can=_can_facts(self._can, self._conditions),
                store=self._saver.facts(),
                log_lines=list(self._conditions.recent),
                recorder=None if self._recorder is None else copy(self._recorder.facts),
                clock=self._clock_facts,
            )
            statistics.publish(moment)
        self._log(statistics.reports(now), now)

    def _process_now(self, now: int) -> ProcessFacts:
        if now >= self._process_due:
            self._process_due = now + PROCESS_NS
            self._process = process_facts()
        return self._process

    def follow_recorder(self, now: int) -> None:
        """Give the gateway's state to the recorder, and log the recorder's faults."""
        if self._recorder is None:
            return
        gateway = cast("RecordedGateway", self._gateway)  # a recorder records one
        self._recorder.note(gateway, now)
        self._log(self._recorder.reports(now), now)
        for name, text in self._recorder.take_events():
            self._conditions.event(name, text, now, logging.INFO)

    def _log(self, reports: Sequence[Report], now: int) -> None:
        for name, begins, text in reports:
            if begins:
                self._conditions.begin(name, text, now)
            else:
                self._conditions.end(name, text, now)

    def report_outputs(self, now: int) -> None:
        """Log rejected parameters and what the outputs report, such as new states of nodes."""
        for index, key in self._gateway.take_rejected_parameters():
            log.warning(
                "%s: the stored value of %04Xh:%02X is ignored, because it does not fit this EDS "
                "or conflicts with another value",
                self._escs[index].name,
                key >> 8,
                key & 0xFF,
            )
        for output in self._gateway.outputs:
            for subject, text in output.take_news():
                self._conditions.event(subject, text, now, logging.INFO)

    def _log_conflicts(self, now: int) -> None:
        """Log the begin and the end of conflicts with other devices that send with our ids."""
        for conflict in self._gateway.conflicts.take():
            condition = f"CAN {self._can.config.channel}: {conflict.ids}"
            if conflict.is_over:
                text = f"{condition}: no other device uses it now"
                self._conditions.end(condition, text, now, f"; {counted(conflict.count, 'frame')}")
                continue
            remedy = "Two nodes with one node-ID?"
            if conflict.node is None:
                remedy = "Change one of the ids, for example with dbc.base_id."
            text = (
                f"{condition}: another device sends with it, too. "
                f"This gateway uses it for {conflict.whose}. {remedy}"
            )
            self._conditions.begin(condition, text, now)

    def status_words(self) -> str:
        """Return the states of the interface and the ESCs in one line."""
        state = name_in_words(self._gateway.status.can_state.name)
        words = [f"CAN {self._can.config.channel} {state}"]
        if self._gateway.status.is_quiet:
            words.append("quiet")
        words += [
            f"{esc.settings.name}: telemetry {name_in_words(esc.link.name)}"
            for esc in self._gateway.escs
        ]
        return "; ".join(words)

    def report_ready(self) -> None:
        """Report to the service manager that the gateway runs.

        An interface whose failure ends the gateway must be open before.
        """
        if not self._can.must_open:
            self.is_ready = True
            self._notifier.ready(self.status_words())

    def _notify(self, now: int) -> None:
        """Send a status line to the service manager, and a keep-alive if no port is stuck.

        A port that the loop does not serve in time is a reason to restart the process.
        """
        if now >= self._notify_due and self._notifier.is_present:
            self._notify_due = now + STATUS_NS
            self._notifier.status(self.status_words())
        if self._alive_due is None or now < self._alive_due:
            return
        # Each check must be called, because it compares two successive calls.
        checks = [esc.is_stuck() for esc in self._escs]
        checks.append(self._can.is_stuck())
        if any(checks):
            return
        self._alive_due = now + (self._notifier.watchdog_ns or SECOND)
        self._notifier.watchdog()


def _can_facts(can: CanLink, conditions: FaultLog) -> CanFacts:
    """Return the state of the interface for the status document."""
    config = can.config
    known = can.controller.facts or LinkFacts(exists=False)
    bitrate = known.bitrate
    if not bitrate and config.interface != "socketcan":
        bitrate = config.bitrate
    faults = (
        can.opening_condition,
        can.condition,
        can.transmitter.reports.stalled,
        can.transmitter.reports.slow,
        can.controller.condition,
    )
    return CanFacts(
        interface=config.interface,
        channel=config.channel,
        bitrate=bitrate or None,
        open=can.is_open,
        complaint=next(filter(None, map(conditions.reason, faults)), None),
        stalled=can.gate.is_stalled,
        slow=can.gate.is_slow,
        restart_ms=known.restart_ms,
        error_counters=known.error_counters,
    )
