"""One ESC's serial port as the loop has it: opened, read, lost, found again, and talked about."""

import logging
import selectors
import time
from collections.abc import Callable
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.states import device_text
from kontronik_can_gw.esc.telemetry import NS_PER_BYTE, SECOND, LinkState
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.runtime.fault_log import FaultLog
from kontronik_can_gw.runtime.poller import Registry
from kontronik_can_gw.runtime.retry import Retry
from kontronik_can_gw.runtime.serial_port import (
    NoPort,
    PortLost,
    SerialPort,
    device_of,
    is_mini_uart,
)
from kontronik_can_gw.runtime.snapshot import PortFacts
from kontronik_can_gw.runtime.usb_adapters import Identity, find_adapter, identity_at

LONGEST_RETRY_NS = SECOND
DIAGNOSIS_NS = 3 * SECOND
SETTINGS_NS = SECOND // 2
"""While another program has echo on, what the ESC sends goes back to it."""


class EscPort:
    """One ESC's port. ``reopened``: how often it came back; ``line_errors``: since the start, by kind.

    While the port is lost it is in ``lost``, so that nobody need look at each.
    """

    def __init__(
        self,
        index: int,
        path: str,
        gateway: Gateway,
        selector: Registry,
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
        self._selector = selector
        self._conditions = conditions
        self._clock = clock
        self._empty_ns = 0
        """The port was empty then."""
        self._undrained_ns: int | None = None
        """The last read left something, which came after this."""
        self._retry = Retry(LONGEST_RETRY_NS)
        self.report_due = 0
        """When ``report`` has something to do."""
        self._diagnosis_due = 0
        self._diagnosed: set[str] = set()
        self._counted: dict[str, int] = {}
        self._count_due = 0
        self._served = True
        self._seen_waiting = False
        self._lost_counters = (0, 0)
        self._lost_since: int | None = None
        self._proven = False

    @property
    def name(self) -> str:
        return self._gateway.escs[self._index].settings.name

    @property
    def complaint(self) -> str:
        """Why there is no telemetry, as far as it is known; empty while there is."""
        for name in (self._port_condition, self._link_condition, self._diagnosis_condition):
            if reason := self._conditions.reason(name):
                return reason
        return ""

    def facts(self) -> PortFacts:
        """For the statistics."""
        is_open = self.port is not None
        path = self.path if self.port is None else self.port.path
        again = max(0, self.reopened)
        return PortFacts(
            self.name,
            path,
            is_open,
            self.complaint,
            again,
            dict(self.line_errors),
            self._lost_since,
        )

    def open(self, now: int, wait: bool, others: tuple[Identity | None, ...] = ()) -> None:
        """Open the port. RunError where that fails, unless ``wait``: then it is tried again.

        ``others``: adapters that are known to belong to other ESCs.
        """
        try:
            port = SerialPort(self._path_now(others))
        except RunError as error:
            if not wait:
                raise RunError(f"{self.name}: {error}") from None
            # which was said when it was lost
            unplugged = isinstance(error, NoPort) and self.reopened >= 0
            self._failed(str(error), now, quiet=unplugged)
            return
        self._empty_ns, self._undrained_ns = self._clock(), None
        port.discard()  # what came before we listened has no time
        self.port = port
        self.identity = port.identity()
        self.reopened += 1
        self._lost_since = None
        self._proven = False
        self._lost.discard(self)
        self._diagnosis_due = now + DIAGNOSIS_NS
        self._counted = port.line_errors()
        self._served, self._seen_waiting = True, False
        self._selector.register(port.fileno(), selectors.EVENT_READ, self.serve)
        self._gateway.port_opened(self._index, now)
        said = f"{self.name}: {port.path} is open"
        if self._conditions.is_on(self._port_condition):
            self._conditions.end(self._port_condition, said, now)
        else:
            self._conditions.say(logging.INFO, said)
        if is_mini_uart(port.path):
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
        self._served = True
        if self.port is None:
            return
        try:
            data = self.port.read()
        except PortLost as error:
            path = self.port.path
            self.close()
            self._failed(f"{path}: lost ({error}).", now)
            return
        if data:
            if not self._proven:
                # a port that goes as soon as it has come is tried more and more seldom
                self._proven = True
                self._retry.succeeded()
            since = self._undrained_ns
            if since is None:
                since = max(self._empty_ns, self._selector.before)
            # nothing came faster than the wire allows
            self._undrained_ns = (
                None if self.port.drained else min(now, since + len(data) * NS_PER_BYTE)
            )
            self._gateway.receive_bytes(self._index, data, now, since)

    def reopen(self, now: int, others: tuple[Identity | None, ...] = ()) -> None:
        """Try again what is due."""
        if self in self._lost and now >= self.due:
            self.open(now, True, others)

    def close(self) -> None:
        """Close the port."""
        if self.port is not None:
            self._selector.unregister(self.port.fileno())
            self.port.close()
            self.port = None

    def is_stuck(self) -> bool:
        """True if bytes have waited since the last call but one and none were read: the loop does not serve this port."""
        waiting = self.port is not None and not self._served and self.port.waits_to_be_read
        stuck = waiting and self._seen_waiting
        self._served, self._seen_waiting = False, waiting
        return stuck

    def follow_link(self, now: int) -> None:
        """The link's state, layout or device changed: say so."""
        esc, told, name = self._gateway.escs[self._index], self._conditions, self.name
        self._diagnosis_due = now + DIAGNOSIS_NS
        if esc.link in (LinkState.LOST, LinkState.PORT_ERROR):
            self._lost_counters = (esc.counters.crc_errors, esc.counters.dropped_bytes)
            quiet = esc.link is LinkState.PORT_ERROR  # which is said by itself
            text = f"{name}: telemetry lost; its values are marked as not available"
            told.begin(self._link_condition, text, now, quiet=quiet, since=esc.live_ns)
            told.forget(self._quality_condition)
        if esc.link not in (LinkState.OK, LinkState.DEGRADED):
            return
        self._diagnosed.clear()
        told.forget(self._diagnosis_condition)
        layout = ("unknown layout", "V4", "legacy")[esc.layout]
        device = device_text(esc.info.device) if esc.info else None
        said = (
            f"{name}: telemetry {esc.link.name.lower()} ({layout}{f', {device}' if device else ''})"
        )
        if told.is_on(self._link_condition):
            crc_errors = esc.counters.crc_errors - self._lost_counters[0]
            dropped = esc.counters.dropped_bytes - self._lost_counters[1]
            told.end(
                self._link_condition,
                said,
                now,
                f"; {crc_errors} CRC errors, {dropped} bytes dropped meanwhile",
            )
        elif esc.link is LinkState.DEGRADED:
            told.begin(self._quality_condition, f"{said}: many CRC errors or dropped bytes", now)
        elif told.is_on(self._quality_condition):
            told.end(self._quality_condition, said, now)
        else:
            told.say(logging.INFO, said)

    def report(self, now: int) -> None:
        """Count line errors once a second, look at the port's settings twice; say why nothing comes."""
        self.report_due = now + SETTINGS_NS
        if self.port is None:
            return
        if now >= self._count_due:
            self._count_due = now + SECOND
            self._count(self.port.line_errors())
        if not self.port.settings_hold():
            text = f"{self.name}: another program changed the settings of {self.port.path}: set to 115200 8E1 again"
            self._conditions.event(f"{self.name}: settings", text, now)
        if self._diagnosis_due and now >= self._diagnosis_due:
            self._diagnosis_due = now + DIAGNOSIS_NS
            diagnosis = self._gateway.escs[self._index].diagnosis()
            if diagnosis and diagnosis not in self._diagnosed:
                self._diagnosed.add(diagnosis)
                self._conditions.begin(
                    self._diagnosis_condition,
                    f"{self.name}: no telemetry: {diagnosis}{self._line_error_words()}",
                    now,
                )

    def _count(self, counts: dict[str, int]) -> None:
        for kind, count in counts.items():
            # the driver's own begin anew with each plugging in
            new = max(0, count - self._counted.get(kind, 0))
            self.line_errors[kind] = self.line_errors.get(kind, 0) + new
            if kind != "break":  # a break is a framing error too
                self._gateway.escs[self._index].line_errors += new
        self._counted = counts

    def _line_error_words(self) -> str:
        counts = [
            f"{count} {kind} errors"
            for kind, count in self.line_errors.items()
            if count and kind != "break"
        ]
        return f" (the driver counts {', '.join(counts)})" if counts else ""

    def _failed(self, reason: str, now: int, quiet: bool = False) -> None:
        self.due = self._retry.failed(now)
        self._lost.add(self)
        self._lost_since = self._lost_since or now
        self._gateway.port_lost(self._index, now)
        self._conditions.begin(
            self._port_condition, f"{self.name}: {reason} Trying again.", now, quiet=quiet
        )

    def _path_now(self, others: tuple[Identity | None, ...]) -> str:
        """Where the port is: an adapter that was unplugged may come back under another number.

        RunError where the configured path is another ESC's adapter now: its values would be taken for this one's.
        """
        if self.identity is None or self.path.startswith("/dev/serial/") or self.identity in others:
            return self.path  # adapters with one serial number for all cannot be told apart
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

    @property
    def _port_condition(self) -> str:
        return f"{self.name}: port"

    @property
    def _link_condition(self) -> str:
        return f"{self.name}: telemetry"

    @property
    def _quality_condition(self) -> str:
        return f"{self.name}: line quality"

    @property
    def _diagnosis_condition(self) -> str:
        return f"{self.name}: diagnosis"
