"""Opens, reads and reopens the serial port of one ESC, and logs the faults of that ESC."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.decoder import Counters
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.printable import counted
from kontronik_can_gw.runtime.poller import Poller
from kontronik_can_gw.runtime.port_input import StuckCheck
from kontronik_can_gw.runtime.ports.serial_port import (
    NoPort,
    PortLost,
    SerialPort,
    device_of,
    is_mini_uart,
)
from kontronik_can_gw.runtime.ports.usb_adapters import UsbIdentity, find_adapter, identity_at
from kontronik_can_gw.runtime.retry import Retry
from kontronik_can_gw.runtime.status.facts import PortFacts
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, NEVER, SECOND

MAX_RETRY_NS = SECOND
CHECK_EACH_NS = 100 * MS
"""Interval between checks of the ports' settings.

Twin in C: CHECK_EACH of native/linux.c.

If another program switches echo on, the driver returns the ESC's bytes to it until the next check.
"""
DIAGNOSIS_NS = 3 * SECOND
"""After this time without telemetry, the gateway looks for the reason."""


class EscPort:
    """The serial port of one ESC. It is opened again after each loss.

    While the port is lost, it is a member of the set ``lost``. So the loop need not check the
    other ports.
    """

    def __init__(
        self,
        index: int,
        path: str,
        gateway: Gateway,
        poller: Poller,
        conditions: FaultLog,
        lost: "set[EscPort]",
        clock: Callable[[], int],
    ) -> None:
        self.path = path
        self.port: SerialPort | None = None
        self.identity: UsbIdentity | None = None
        self.reopened = -1
        """Number of times that the port was opened again. -1 before it was opened at all."""
        self.line_errors: dict[str, int] = {}
        """Line errors since the start of the gateway, by kind."""
        self._index = index
        self._lost = lost
        self._gateway = gateway
        self._protocol = gateway.escs[index].protocol
        self._poller = poller
        self._conditions = conditions
        self._clock = clock
        self._noted = poller.noted(index)
        self.retry = Retry(MAX_RETRY_NS)
        self.log = EscLog(index, gateway, conditions)
        self._counted: Mapping[str, int] = {}
        self._stuck = StuckCheck(self._noted)
        self._lost_since: int | None = None

    @property
    def name(self) -> str:
        return self._gateway.escs[self._index].settings.name

    def facts(self) -> PortFacts:
        """Return the state of the port for the status document."""
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

    def open(self, now: int, wait: bool, others: tuple[UsbIdentity | None, ...] = ()) -> None:
        """Open the port.

        Raises RunError if that fails. With ``wait`` it raises nothing, and ``reopen`` tries again.
        ``others`` are the adapters of the other ESCs.
        """
        try:
            port = SerialPort(self._path_now(others), self._protocol)
        except RunError as error:
            if not wait:
                raise RunError(f"{self.name}: {error}") from None
            # The loss of an unplugged adapter has already been logged.
            is_unplugged = isinstance(error, NoPort) and self.reopened >= 0
            self._failed(str(error), now, quiet=is_unplugged)
            return
        noted = self._noted
        noted.empty_ns = self._clock()
        noted.undrained_ns = NEVER
        noted.is_plain = False
        noted.settings[:] = port.settings
        noted.is_restored = False
        port.discard()  # the time of arrival of older bytes is unknown
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
        text = f"{self.name}: {port.path} is open"
        if self._conditions.is_on(self.log.port_condition):
            self._conditions.end(self.log.port_condition, text, now)
        else:
            self._conditions.log(logging.INFO, text)
        if self._protocol.even_parity and is_mini_uart(port.path):
            text = (
                f"{self.name}: {port.path} is a Raspberry Pi's mini-UART, which does not support "
                "even parity. Some or all frames may be lost. Use ttyAMA0."
            )
            self._conditions.log(logging.WARNING, text)

    def is_at(self, path: str) -> bool:
        """Return True if a path leads to this ESC, even under another name."""
        device = device_of(path)
        if device is not None and device == device_of(self.path):
            return True
        if device is not None and self.port is not None and device == device_of(self.port.path):
            return True
        return self.identity is not None and identity_at(path) == self.identity

    def serve(self, now: int, _events: int = 0) -> None:
        """Read the port, and hand its bytes to the gateway. Call it when the port is readable."""
        noted = self._noted
        port = self.port
        noted.is_served = True
        if port is None:
            return
        try:
            data = port.read()
        except PortLost as error:
            self.close()
            self._failed(f"{port.path}: lost ({error}). Check plug and power of the adapter.", now)
            return
        if data:
            if not noted.is_plain:
                # Until bytes arrive, the pauses between attempts grow. So a port that is lost
                # each time as soon as it is open is tried less and less often.
                noted.is_plain = True
                self.retry.succeeded()
            since = noted.undrained_ns
            if since == NEVER:
                since = max(noted.empty_ns, self._poller.times.before)
            if port.is_drained:
                noted.undrained_ns = NEVER
            else:
                # The bytes cannot have arrived faster than the wire transmits them.
                transmitted_ns = since + len(data) * self._protocol.byte_ns
                noted.undrained_ns = min(now, transmitted_ns)
            self._gateway.receive_bytes(self._index, data, now, since)

    def reopen(self, now: int, others: tuple[UsbIdentity | None, ...] = ()) -> None:
        """Open a lost port again if the next attempt is due."""
        if self in self._lost and now >= self.retry.due:
            self.open(now, True, others)

    def close(self) -> None:
        """Close the port."""
        if self.port is not None:
            self._poller.unregister(self.port.fileno())
            self.port.close()
            self.port = None

    def is_stuck(self) -> bool:
        """Return True if the loop does not serve this port."""
        return self._stuck.is_stuck(self.port)

    def restore_settings(self) -> None:
        """Restore the port's settings if another program has changed them.

        ``report`` logs the change.
        """
        if self.port is not None and not self.port.settings_hold():
            self._noted.is_restored = True

    def report(self, now: int) -> None:
        """Count line errors; log restored settings, and the reason if no telemetry is received."""
        if self.port is None:
            return
        counts = self.port.line_errors()
        if counts is not self._counted:
            self._count(counts)
        if self._noted.is_restored:
            self._noted.is_restored = False
            text = (
                f"{self.name}: another program changed the settings of {self.port.path}: "
                f"restored to {self._protocol.line}"
            )
            self._conditions.event(f"{self.name}: settings", text, now)
        self.log.diagnose(self.line_errors, now)

    def _count(self, counts: Mapping[str, int]) -> None:
        for kind, count in counts.items():
            # The driver's counters restart at 0 when the adapter is plugged in again.
            new = max(0, count - self._counted.get(kind, 0))
            self.line_errors[kind] = self.line_errors.get(kind, 0) + new
            if kind != "break":  # a break is a framing error too
                self._gateway.escs[self._index].line_errors += new
        self._counted = counts

    def _failed(self, reason: str, now: int, quiet: bool = False) -> None:
        self.retry.failed(now)
        self._lost.add(self)
        self._lost_since = self._lost_since or now
        self._gateway.port(self._index, False, now)
        self._conditions.begin(
            self.log.port_condition, f"{self.name}: {reason} Trying again.", now, quiet=quiet
        )

    def _path_now(self, others: tuple[UsbIdentity | None, ...]) -> str:
        """Return the present path of the port.

        An adapter that was unplugged may get another device number when it is plugged in again.
        Raises RunError if the configured path leads to another ESC's adapter now, because that
        ESC's values would be taken for values of this one.
        """
        if self.identity is None or self.path.startswith("/dev/serial/") or self.identity in others:
            return self.path  # adapters with the same serial number cannot be distinguished
        found = find_adapter(self.identity)
        if found is not None:
            return self.path if Path(self.path).resolve() == Path(found) else found
        real_path = Path(self.path).resolve()
        for other in others:
            if other is not None and find_adapter(other) == str(real_path):
                raise RunError(
                    f"{self.path}: is another ESC's adapter now. "
                    "Use the names in /dev/serial/by-id or by-path for all ports."
                )
        return self.path


class EscLog:
    """Logs the faults of one ESC, and finds the reason if no telemetry is received."""

    def __init__(self, index: int, gateway: Gateway, conditions: FaultLog) -> None:
        self._esc = gateway.escs[index]
        self._conditions = conditions
        name = self._esc.settings.name
        self.port_condition = f"{name}: port"
        """Name of the condition "the port is not open" in the fault log."""
        self._link_condition = f"{name}: telemetry"
        self._device_condition = f"{name}: layout or device"
        self._quality_condition = f"{name}: line quality"
        self._diagnosis_condition = f"{name}: diagnosis"
        self._diagnosis_due = 0
        self._diagnosed: set[str] = set()
        self._lost_counters = (0, 0)
        self._losses = self._esc.losses
        self._since: Counters | None = self._esc.counters.copy()
        """Counters at least a second older than ``_sampled``. A diagnosis counts from them.

        None while telemetry is received and in the first second after its loss.
        """
        self._sampled: tuple[int, Counters] | None = None
        """Time and counters of the newest sample. None while telemetry is received."""

    @property
    def complaint(self) -> str:
        """The known reason why there is no telemetry. Empty if there is telemetry."""
        for name in (self.port_condition, self._link_condition, self._diagnosis_condition):
            reason = self._conditions.reason(name)
            if reason:
                return reason
        return ""

    def await_telemetry(self, now: int) -> None:
        """Postpone the next diagnosis, because telemetry may still arrive."""
        self._diagnosis_due = now + DIAGNOSIS_NS

    def follow_link(self, now: int) -> None:
        """Log a change of the link's state, of the layout or of the device."""
        esc = self._esc
        conditions = self._conditions
        name = esc.settings.name
        self.await_telemetry(now)
        is_hidden_loss = esc.losses > self._losses and not conditions.is_on(self._link_condition)
        self._losses = esc.losses
        if esc.link in (LinkState.LOST, LinkState.PORT_ERROR):
            self._lost_counters = (esc.counters.crc_errors, esc.counters.dropped_bytes)
            is_quiet = esc.link is LinkState.PORT_ERROR  # the fault of the port is logged instead
            text = f"{name}: telemetry lost; its values are marked as not available"
            conditions.begin(self._link_condition, text, now, quiet=is_quiet, since=esc.live_ns)
            conditions.forget(self._quality_condition)
        if esc.link not in (LinkState.OK, LinkState.DEGRADED):
            return
        # It began and ended while the process was suspended, or in one iteration.
        if is_hidden_loss:
            text = (
                f"{name}: telemetry was lost for a moment; its values were marked as not available"
            )
            conditions.event(self._link_condition, text, now)
        self._diagnosed.clear()
        conditions.forget(self._diagnosis_condition)
        source = esc.protocol.layout_text(esc.layout) or "unknown layout"
        device = esc.protocol.device_name(esc.info)
        if device:
            source += f", {device}"
        said = f"{name}: telemetry {esc.link.name.lower()} ({source})"
        if conditions.is_on(self._link_condition):
            crc_errors = esc.counters.crc_errors - self._lost_counters[0]
            dropped = esc.counters.dropped_bytes - self._lost_counters[1]
            dropped_bytes = counted(dropped, "byte")
            losses = f"; {counted(crc_errors, 'CRC error')}, {dropped_bytes} dropped meanwhile"
            conditions.end(self._link_condition, said, now, losses)
        elif esc.link is LinkState.DEGRADED:
            text = f"{said}: many CRC errors or dropped bytes"
            conditions.begin(self._quality_condition, text, now)
        elif conditions.is_on(self._quality_condition):
            conditions.end(self._quality_condition, said, now)
        else:
            conditions.event(self._device_condition, said, now, logging.INFO)

    @property
    def diagnosis(self) -> str | None:
        """The reason why no frame is received, found in the bytes of the last seconds.

        None while frames are received, and for a second after the last one.
        """
        if self._esc.up or self._since is None:
            return None
        return self._esc.counters.diagnosis(self._since)

    def diagnose(self, line_errors: Mapping[str, int], now: int) -> None:
        """Log the reason why no frame is received, each reason once. Call it regularly."""
        if self._esc.up:
            self._since = None
            self._sampled = None
            return
        if self._sampled is None:
            self._sampled = (now, self._esc.counters.copy())
        elif now - self._sampled[0] >= SECOND:
            self._since = self._sampled[1]
            self._sampled = (now, self._esc.counters.copy())
        if not self._diagnosis_due or now < self._diagnosis_due:
            return
        self._diagnosis_due = now + DIAGNOSIS_NS
        diagnosis = self.diagnosis
        if diagnosis and diagnosis not in self._diagnosed:
            self._diagnosed.add(diagnosis)
            counts = _describe(line_errors)
            text = f"{self._esc.settings.name}: no telemetry: {diagnosis}{counts}"
            self._conditions.begin(self._diagnosis_condition, text, now)


def _describe(line_errors: Mapping[str, int]) -> str:
    counts = []
    for kind, count in line_errors.items():
        if count and kind != "break":
            counts.append(counted(count, f"{kind} error"))
    if not counts:
        return ""
    return f" (the driver counts {', '.join(counts)})"
