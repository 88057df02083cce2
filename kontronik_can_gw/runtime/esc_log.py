"""What is logged of one ESC: telemetry lost and found, the quality of its line, why nothing comes."""

import logging
from collections.abc import Mapping

from kontronik_can_gw.esc.decoder import Counters
from kontronik_can_gw.esc.telemetry import SECOND, LinkState
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.fault_log import FaultLog

DIAGNOSIS_NS = 3 * SECOND
"""Without telemetry for this long, the reason is looked for."""


class EscLog:
    """The conditions of one ESC in the fault log. ``port_condition`` is the name of what is wrong with its port."""

    def __init__(self, index: int, gateway: Gateway, conditions: FaultLog) -> None:
        self._esc = gateway.escs[index]
        self._conditions = conditions
        name = self._esc.settings.name
        self.port_condition = f"{name}: port"
        self._link_condition = f"{name}: telemetry"
        self._quality_condition = f"{name}: line quality"
        self._diagnosis_condition = f"{name}: diagnosis"
        self._diagnosis_due = 0
        self._diagnosed: set[str] = set()
        self._lost_counters = (0, 0)
        self._since: Counters | None = self._esc.counters.copy()
        """Counters at a time before that of ``_sampled``; None: not known since telemetry came."""
        self._sampled: tuple[int, Counters] | None = None

    @property
    def complaint(self) -> str:
        """Why there is no telemetry, as far as it is known; empty while there is."""
        for name in (self.port_condition, self._link_condition, self._diagnosis_condition):
            if reason := self._conditions.reason(name):
                return reason
        return ""

    def await_telemetry(self, now: int) -> None:
        """Telemetry may come from now on: a diagnosis is not due yet."""
        self._diagnosis_due = now + DIAGNOSIS_NS

    def follow_link(self, now: int) -> None:
        """The link's state, layout or device changed: say so."""
        esc, conditions, name = self._esc, self._conditions, self._esc.settings.name
        self.await_telemetry(now)
        if esc.link in (LinkState.LOST, LinkState.PORT_ERROR):
            self._lost_counters = (esc.counters.crc_errors, esc.counters.dropped_bytes)
            quiet = esc.link is LinkState.PORT_ERROR  # which is said by itself
            text = f"{name}: telemetry lost; its values are marked as not available"
            conditions.begin(self._link_condition, text, now, quiet=quiet, since=esc.live_ns)
            conditions.forget(self._quality_condition)
        if esc.link not in (LinkState.OK, LinkState.DEGRADED):
            return
        self._diagnosed.clear()
        conditions.forget(self._diagnosis_condition)
        layout = esc.protocol.layout_text(esc.layout) or "unknown layout"
        device = esc.protocol.device_name(esc.info)
        said = (
            f"{name}: telemetry {esc.link.name.lower()} ({layout}{f', {device}' if device else ''})"
        )
        if conditions.is_on(self._link_condition):
            crc_errors = esc.counters.crc_errors - self._lost_counters[0]
            dropped = esc.counters.dropped_bytes - self._lost_counters[1]
            conditions.end(
                self._link_condition,
                said,
                now,
                f"; {crc_errors} CRC errors, {dropped} bytes dropped meanwhile",
            )
        elif esc.link is LinkState.DEGRADED:
            conditions.begin(
                self._quality_condition, f"{said}: many CRC errors or dropped bytes", now
            )
        elif conditions.is_on(self._quality_condition):
            conditions.end(self._quality_condition, said, now)
        else:
            conditions.say(logging.INFO, said)

    @property
    def diagnosis(self) -> str | None:
        """Why no frame comes, in words, from the bytes of the last seconds; None while frames come, and shortly after."""
        if self._esc.up or self._since is None:
            return None
        return self._esc.counters.diagnosis(self._since)

    def diagnose(self, line_errors: Mapping[str, int], now: int) -> None:
        """Log why nothing comes, each reason once. To be called all the time."""
        if self._esc.up:
            self._since = self._sampled = None
            return
        if self._sampled is None:
            self._sampled = now, self._esc.counters.copy()
        elif now - self._sampled[0] >= SECOND:
            self._since, self._sampled = self._sampled[1], (now, self._esc.counters.copy())
        if not self._diagnosis_due or now < self._diagnosis_due:
            return
        self._diagnosis_due = now + DIAGNOSIS_NS
        diagnosis = self.diagnosis
        if diagnosis and diagnosis not in self._diagnosed:
            self._diagnosed.add(diagnosis)
            text = f"{self._esc.settings.name}: no telemetry: {diagnosis}{_in_words(line_errors)}"
            self._conditions.begin(self._diagnosis_condition, text, now)


def _in_words(line_errors: Mapping[str, int]) -> str:
    counts = [
        f"{count} {kind} errors" for kind, count in line_errors.items() if count and kind != "break"
    ]
    return f" (the driver counts {', '.join(counts)})" if counts else ""
