"""What the loop does now and then, not with each frame: line errors, sums of the log, captures' reports, statistics, signs of life."""

import gc
import logging
import time
from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING

from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.can.can_link import CanLink
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.files.parameter_saver import ParameterSaver
from kontronik_can_gw.runtime.ports.esc_port import EscPort
from kontronik_can_gw.runtime.status.facts import CanFacts, ProgramFacts, gateway_facts
from kontronik_can_gw.runtime.status.snapshot import Moment
from kontronik_can_gw.runtime.status.statistics import Statistics
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.runtime.system.process import ProcessFacts, process_facts
from kontronik_can_gw.runtime.system.sd_notify import Notifier
from kontronik_can_gw.runtime.system.worker import Report
from kontronik_can_gw.status import name_in_words
from kontronik_can_gw.times import SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.runtime.files.recorder import Recorder

log = logging.getLogger("kontronik_can_gw")

ROUND_NS = SECOND
MAX_LATE_NS = SECOND // 2
"""The loop is woken for a round only if the round is late by this much: usually something else wakes the loop before."""
PROCESS_NS = 10 * SECOND
"""How often the process's resources are asked for: that costs more than the rest of a round."""
COLLECT_NS = 60 * SECOND
"""Interval of full garbage collections, which take less than a millisecond.

CPython keeps up to 2 000 freed tuples of each size for later use, some MB in all, and frees them only in a full collection. None runs by
itself (cli/run.py, ``settle_memory``). The objects of the start are frozen, so that a collection does not visit them.
"""
STATUS_NS = SECOND
"""The service manager is given a line at most this often."""


class Housekeeping:
    """``due``: when ``run`` has something to do; ``wake_due``: when the loop is to be woken for it."""

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
        self.due = self.wake_due = 0
        self._gateway = gateway
        self._escs = escs
        self._can = can
        self._conditions = conditions
        self._saver = saver
        self._notifier = notifier
        self._statistics = statistics
        self._recorder = recorder
        self._program = program
        self._alive_due = 0 if notifier.watchdog_ns is not None else None
        self._notify_due = 0
        self._collect_due: int | None = None
        self._process, self._process_due = ProcessFacts(), 0

    def run(self, now: int) -> None:
        """One round."""
        self.due = now + ROUND_NS
        for esc in self._escs:
            esc.report(now)
        self._can.report(now)
        self._log_conflicts(now)
        self._conditions.advance(now)
        self.follow_recorder(now)
        self.publish(now)
        self._notify(now)
        self._collect(now)
        self.wake_due = self.due + MAX_LATE_NS
        if (due := self._alive_due) is not None and due > now:  # else something is stuck
            self.due, self.wake_due = min(self.due, due), min(self.wake_due, due)

    def _collect(self, now: int) -> None:
        """Free what the interpreter keeps of freed objects, once a minute."""
        if self._collect_due is not None and now >= self._collect_due:
            gc.collect()
            self._collect_due = None
        if self._collect_due is None:
            self._collect_due = now + COLLECT_NS

    def publish(self, now: int) -> None:
        """Hand the statistics' thread what a document is made of, if it is time."""
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
            )
            statistics.publish(moment)
        self._log(statistics.reports(now), now)

    def _process_now(self, now: int) -> ProcessFacts:
        if now >= self._process_due:
            self._process_due, self._process = now + PROCESS_NS, process_facts()
        return self._process

    def follow_recorder(self, now: int) -> None:
        """Give the recorder what a replay needs to know, and log what it reports."""
        if self._recorder is None:
            return
        self._recorder.note(self._gateway, now)
        self._log(self._recorder.reports(now), now)

    def _log(self, reports: Sequence[Report], now: int) -> None:
        for name, begins, text in reports:
            (self._conditions.begin if begins else self._conditions.end)(name, text, now)

    def report_outputs(self, now: int) -> None:
        """Log rejected parameters and what the outputs report, such as new states of nodes."""
        for index, key in self._gateway.take_rejected_parameters():
            log.warning(
                "%s: the stored %04Xh:%02X is ignored: it does not fit this EDS, or clashes",
                self._escs[index].name,
                key >> 8,
                key & 0xFF,
            )
        for output in self._gateway.outputs:
            for subject, text in output.take_news():
                self._conditions.event(subject, text, now, logging.INFO)

    def _log_conflicts(self, now: int) -> None:
        """Others on the bus begin, or cease, to send with our ids."""
        for conflict in self._gateway.conflicts.take():
            which = f"CAN {self._can.config.channel}: {conflict.ids}"
            if conflict.over:
                text = f"{which}: nobody else sends with it"
                self._conditions.end(which, text, now, f"; {conflict.count} frames")
                continue
            change = "Change one, as by dbc.base_id."
            remedy = change if conflict.node is None else "Two nodes with one node-ID?"
            text = (
                f"{which}: somebody else sends with it too; here it is {conflict.whose}. {remedy}"
            )
            self._conditions.begin(which, text, now)

    def status_words(self) -> str:
        """How things are, in one line."""
        state = name_in_words(self._gateway.status.can_state.name)
        words = [f"CAN {self._can.config.channel} {state}"]
        words += [
            f"{esc.settings.name}: telemetry {name_in_words(esc.link.name)}"
            for esc in self._gateway.escs
        ]
        return "; ".join(words)

    def _notify(self, now: int) -> None:
        """Give the service manager a line, and a sign of life while everything is served in time."""
        if now >= self._notify_due and self._notifier.present:
            self._notify_due = now + STATUS_NS
            self._notifier.status(self.status_words())
        if self._alive_due is None or now < self._alive_due:
            return
        if any([*(esc.is_stuck() for esc in self._escs), self._can.is_stuck()]):
            return  # not fed: a port that is not served in time is a reason to begin anew
        self._alive_due = now + (self._notifier.watchdog_ns or SECOND)
        self._notifier.watchdog()


def _can_facts(can: CanLink, conditions: FaultLog) -> CanFacts:
    """What the statistics show of the interface."""
    config, known = can.config, can.controller.facts or LinkFacts(exists=False)
    faults = (
        can.opening_condition,
        can.condition,
        can.transmitter.condition,
        can.controller.condition,
    )
    return CanFacts(
        config.interface,
        config.channel,
        known.bitrate or (config.bitrate if config.interface != "socketcan" else None),
        can.is_open,
        next(filter(None, map(conditions.reason, faults)), ""),
        can.transmitter.is_stalled,
        known.restart_ms,
        known.error_counters,
    )
