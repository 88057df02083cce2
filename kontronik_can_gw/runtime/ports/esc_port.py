"""One ESC's serial port as the loop has it: opened, read, lost, found again; and what is logged of that ESC."""

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.decoder import Counters
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.poller import Poller
from kontronik_can_gw.runtime.port_input import StuckCheck
from kontronik_can_gw.runtime.ports.serial_port import (
    NoPort,
    PortLost,
    SerialPort,
    device_of,
    is_mini_uart,
)
from kontronik_can_gw.runtime.ports.usb_adapters import Identity, find_adapter, identity_at
from kontronik_can_gw.runtime.retry import Retry
from kontronik_can_gw.runtime.status.facts import PortFacts
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, NEVER, SECOND

MAX_RETRY_NS = SECOND
LOOK_NS = 100 * MS
"""Interval at which the ports' settings are checked while the loop turns in Python (LOOK in linux.c).

If another program switches echo on, the driver returns to the ESC what it sends until the next check.
"""
DIAGNOSIS_NS = 3 * SECOND
"""Without telemetry for this long, the reason is looked for."""


class EscPort:
    """One ESC's port. ``reopened``: how often it came back; ``line_errors``: since the start, by kind.

    While the port is lost it is in ``lost``, so that the others need not be checked.
    """

    def __init__(
        self,
        index: int,
        path: str,
        gateway: Gateway,
        poller: Poller,
        conditions: FaultLog,
        lost: "set[EscPort]",
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.path = path
        self.port: SerialPort | None = None
        self.identity: Identity | None = None
        self.reopened = -1
        self.due = 0
        """While it is lost: when ``reopen`` has something to do."""
        self.line_errors: dict[str, int] = {}
        self._index = index
        self._lost = lost
        self._gateway = gateway
        self._protocol = gateway.escs[index].protocol
        self._poller = poller
        self._conditions = conditions
        self._clock = clock
        self._noted = poller.noted(index)
        self._retry = Retry(MAX_RETRY_NS)
        self.log = EscLog(index, gateway, conditions)
        self._counted: Mapping[str, int] = {}
        self._stuck = StuckCheck(self._noted)
        self._lost_since: int | None = None

    @property
    def name(self) -> str:
        return self._gateway.escs[self._index].settings.name

    def facts(self) -> PortFacts:
        """For the statistics."""
        return PortFacts(
            self.name,
            self.path if self.port is None else self.port.path,
            self.port is not None,
            self.log.complaint,
            max(0, self.reopened),
            dict(self.line_errors),
            self._lost_since,
            self.log.diagnosis,
        )

    def open(self, now: int, wait: bool, others: tuple[Identity | None, ...] = ()) -> None:
        """Open the port. RunError where that fails, unless ``wait``: then it is tried again.

        ``others``: adapters that are known to belong to other ESCs.
        """
        try:
            port = SerialPort(self._path_now(others), self._protocol)
        except RunError as error:
            if not wait:
                raise RunError(f"{self.name}: {error}") from None
            # which was said when it was lost
            unplugged = isinstance(error, NoPort) and self.reopened >= 0
            self._failed(str(error), now, quiet=unplugged)
            return
        noted = self._noted
        noted.empty_ns, noted.undrained_ns, noted.is_plain = self._clock(), NEVER, False
        noted.settings[:], noted.restored = port.settings, False
        port.discard()  # what came before we listened has no time
        self.port = port
        self.identity = port.identity()
        self.reopened += 1
        self._lost_since = None
        self._lost.discard(self)
        self.log.await_telemetry(now)
        self._counted = port.line_errors()
        self._stuck = StuckCheck(noted)
        self._poller.register(port.fileno(), self.serve, esc=self._index)
        self._gateway.port(self._index, True, now)
        said = f"{self.name}: {port.path} is open"
        if self._conditions.is_on(self.log.port_condition):
            self._conditions.end(self.log.port_condition, said, now)
        else:
            self._conditions.say(logging.INFO, said)
        if self._protocol.even_parity and is_mini_uart(port.path):
            self._conditions.say(
                logging.WARNING,
                f"{self.name}: {port.path} is a Raspberry Pi's mini-UART, which cannot do even parity: frames may be lost or never "
                "come. Use ttyAMA0.",
            )

    def is_at(self, path: str) -> bool:
        """True if a path leads to this ESC, whatever its name is now."""
        device = device_of(path)
        if device is not None and device == device_of(self.path):
            return True
        if device is not None and self.port is not None and device == device_of(self.port.path):
            return True
        return self.identity is not None and identity_at(path) == self.identity

    def serve(self, now: int, _events: int = 0) -> None:
        """The port is readable."""
        noted, port = self._noted, self.port
        noted.served = True
        if port is None:
            return
        try:
            data = port.read()
        except PortLost as error:
            self.close()
            self._failed(f"{port.path}: lost ({error}).", now)
            return
        if data:
            if not noted.is_plain:
                # a port that goes as soon as it has come is tried more and more seldom
                noted.is_plain = True
                self._retry.succeeded()
            since = noted.undrained_ns
            if since == NEVER:
                since = max(noted.empty_ns, self._poller.before)
            # nothing came faster than the wire allows
            passed = since + len(data) * self._protocol.byte_ns
            noted.undrained_ns = NEVER if port.drained else min(now, passed)
            self._gateway.receive_bytes(self._index, data, now, since)

    def reopen(self, now: int, others: tuple[Identity | None, ...] = ()) -> None:
        """Try again what is due."""
        if self in self._lost and now >= self.due:
            self.open(now, True, others)

    def close(self) -> None:
        """Close the port."""
        if self.port is not None:
            self._poller.unregister(self.port.fileno())
            self.port.close()
            self.port = None

    def is_stuck(self) -> bool:
        """True if the loop does not serve this port."""
        return self._stuck.is_stuck(self.port)

    def hold_settings(self) -> None:
        """Restore the port's settings if another program has changed them; ``report`` logs that."""
        if self.port is not None and not self.port.settings_hold():
            self._noted.restored = True

    def report(self, now: int) -> None:
        """Count line errors; log restored settings, and the reason if no telemetry is received."""
        if self.port is None:
            return
        if (counts := self.port.line_errors()) is not self._counted:
            self._count(counts)
        if self._noted.restored:
            self._noted.restored = False
            text = f"{self.name}: another program changed the settings of {self.port.path}: set to {self._protocol.line} again"
            self._conditions.event(f"{self.name}: settings", text, now)
        self.log.diagnose(self.line_errors, now)

    def _count(self, counts: Mapping[str, int]) -> None:
        for kind, count in counts.items():
            # the driver's own begin anew with each plugging in
            new = max(0, count - self._counted.get(kind, 0))
            self.line_errors[kind] = self.line_errors.get(kind, 0) + new
            if kind != "break":  # a break is a framing error too
                self._gateway.escs[self._index].line_errors += new
        self._counted = counts

    def _failed(self, reason: str, now: int, quiet: bool = False) -> None:
        self.due = self._retry.failed(now)
        self._lost.add(self)
        self._lost_since = self._lost_since or now
        self._gateway.port(self._index, False, now)
        self._conditions.begin(
            self.log.port_condition, f"{self.name}: {reason} Trying again.", now, quiet=quiet
        )

    def _path_now(self, others: tuple[Identity | None, ...]) -> str:
        """Where the port is: an adapter that was unplugged may come back under another number.

        RunError where the configured path is another ESC's adapter now: its values would be taken for this one's.
        """
        if self.identity is None or self.path.startswith("/dev/serial/") or self.identity in others:
            return self.path  # adapters with the same serial number cannot be distinguished
        found = find_adapter(self.identity)
        if found is not None:
            return self.path if Path(self.path).resolve() == Path(found) else found
        if any(
            other is not None and find_adapter(other) == str(Path(self.path).resolve())
            for other in others
        ):
            raise RunError(
                f"{self.path}: is another ESC's adapter now. Name ports by /dev/serial/by-id or by-path."
            )
        return self.path


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
        self._losses = self._esc.losses
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
        is_hidden_loss = esc.losses > self._losses and not conditions.is_on(self._link_condition)
        self._losses = esc.losses
        if esc.link in (LinkState.LOST, LinkState.PORT_ERROR):
            self._lost_counters = (esc.counters.crc_errors, esc.counters.dropped_bytes)
            quiet = esc.link is LinkState.PORT_ERROR  # which is said by itself
            text = f"{name}: telemetry lost; its values are marked as not available"
            conditions.begin(self._link_condition, text, now, quiet=quiet, since=esc.live_ns)
            conditions.forget(self._quality_condition)
        if esc.link not in (LinkState.OK, LinkState.DEGRADED):
            return
        if is_hidden_loss:  # while the process was held up, or within one turn
            text = (
                f"{name}: telemetry was lost for a moment; its values were marked as not available"
            )
            conditions.event(self._link_condition, text, now)
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
