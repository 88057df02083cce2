"""Transmit PDOs: events, SYNC, inhibit time, event timer (CiA 301, 7.2.2).

The bytes of a PDO come from a compiled plan like those of a DBC message, straight from the ESC's snapshot.

Event of types 254 and 255: new data of what is mapped (a UART frame, a second, a download). A PDO that carries a status object (errors,
operating state, link status) is sent when one of these changes instead. When telemetry is lost, PDOs with live values stop, unless they
carry the link status: those go on, with all ones (80..0h for signed types) for what is not available.
"""

from collections.abc import Callable

from kontronik_can_gw.canopen.bound_values import CompiledPdo, compile_pdo
from kontronik_can_gw.canopen.cob_ids import Taken
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable
from kontronik_can_gw.canopen.pdo_parameters import EVENT_TYPES, TpdoParameters
from kontronik_can_gw.esc.telemetry import SECOND, EscTelemetry, Event
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.output import NEVER
from kontronik_can_gw.signals.plan import EXPECTED_LIVE_HZ


class Tpdo(TpdoParameters):
    """One transmit PDO of one node: when it is sent."""

    def __init__(
        self,
        number: int,
        dictionary: Dictionary,
        esc: EscTelemetry,
        gateway: GatewayStatus,
        send: Callable[[CanFrame], None],
        taken: Taken,
    ) -> None:
        super().__init__(number, dictionary, taken)
        self.due = NEVER
        self.sent = 0
        """Frames so far."""
        self.pending = False
        """It waits for the inhibit time to end: further events change nothing."""
        self.triggers = 0
        """The events (of telemetry.Event) that are news to it."""
        self._esc = esc
        self._escs = (esc,)
        self._gateway = gateway
        self._send_frame = send
        self._started = False
        self._by_event = True
        self._compiled: CompiledPdo | None = None
        self._last_status = -1
        self._last_ns = -NEVER
        self._held_until = -NEVER
        self._event_due = NEVER
        self._fresh = False
        self._syncs = 0
        self._sync_waits = False
        self.bind(self.configure)

    @property
    def on_change(self) -> bool:
        """True if changes of a status object are what causes it."""
        return self._compiled is not None and self._compiled.status is not None

    @property
    def rate_hz(self) -> float:
        """Frames a second to be expected with the UART at 100 Hz; those sent on change or at SYNC (10 Hz taken) by their cycle."""
        if not self._running:
            return 0.0
        if self.type not in EVENT_TYPES:
            return 10.0 / max(1, self.type)
        cycle = SECOND / self.event_ns if self.event_ns else 0.0
        if self.on_change:
            return cycle or 1.0
        events = EXPECTED_LIVE_HZ if self.triggers & Event.LIVE else 1.0
        return max(cycle, min(events, SECOND / self.inhibit_ns) if self.inhibit_ns else events)

    def configure(self, now: int) -> None:
        """Take over what the dictionary says. A PDO that begins to exist in OPERATIONAL begins like at its start."""
        was_running = self._running
        self.read()
        self._by_event = self.type in EVENT_TYPES
        self._held_until = self._last_ns + self.inhibit_ns
        self._compiled = compile_pdo(self.mapped, self._esc.protocol) if self.mapped else None
        self.triggers = 0 if self._compiled is None else self._compiled.triggers
        if self._started and self._running and not was_running:
            self.start(now)
            return
        goes_on = self._started and self._running
        self.pending = self.pending and self._by_event and goes_on
        self._event_due = self._next_event(now) if goes_on else NEVER
        self._set_due()

    @property
    def _running(self) -> bool:
        return self.valid and self._compiled is not None

    def start(self, now: int) -> None:
        """The node has become OPERATIONAL: event-driven PDOs say once what is."""
        self._started = True
        self._last_ns = self._held_until = -NEVER
        self._last_status = -1
        self._fresh = True
        self.pending = False
        self._syncs = 0
        self._sync_waits = self.sync_start != 0
        self._event_due = NEVER
        if self._running and self._by_event:
            self._event_due = self._next_event(now)
            self._request(now)
        self._set_due()

    def stop(self) -> None:
        """No PDO outside OPERATIONAL."""
        self._started = False
        self.pending = False
        self._event_due = self.due = NEVER

    def on_event(self, now: int) -> None:
        """Something of ``triggers`` happened."""
        compiled = self._compiled
        if not self._started or not self.valid or compiled is None:
            return
        if self.pending:
            if now >= self._held_until:
                self._send(now)
            return
        if compiled.status is not None:
            status = compiled.status(self._escs, self._gateway, now, 0, 0)
            if status == self._last_status:
                return
            self._last_status = status
        self._news(now)

    def on_download(self, variable: Variable, now: int) -> None:
        """An object was written over the bus."""
        mapped = any(entry is variable for entry in self.mapped)
        if mapped and self._started and self._running:
            self._news(now)

    def repeat(self, now: int) -> None:
        """Send once more what is sent on change only."""
        if self._started and self._running and self.on_change:
            self._news(now)

    def on_sync(self, counter: int, now: int, answer: bool = True) -> None:
        """A SYNC message; ``counter`` 0 where it has none. Without ``answer`` it is only counted."""
        if not self._started or not self._running or self.type > 240:
            return
        if self._sync_waits and counter:
            if counter != self.sync_start:
                return
            self._sync_waits = False  # this SYNC counts as the first
        if self.type == 0:
            if self._fresh and answer:
                self._send(now)
            return
        self._syncs += 1
        if self._syncs >= self.type:
            self._syncs = 0
            if answer:
                self._send(now)

    def advance(self, now: int) -> None:
        """Event timer, and what the inhibit time held back."""
        if now < self.due:
            return
        if now >= self._event_due:
            self._event_due = self._next_event(now)
            self._request(now)
        elif self.pending and now >= self._held_until:
            self._send(now)
        self._set_due()

    def _news(self, now: int) -> None:
        self._fresh = True
        if self._by_event:
            self._request(now)

    def _request(self, now: int) -> None:
        if now >= self._held_until:
            self._send(now)
        else:
            self.pending = self._fresh = True
            self._set_due()

    def _send(self, now: int) -> None:
        self.pending = False
        compiled = self._compiled
        assert compiled is not None
        if compiled.needs_live and self._esc.live is None:
            self._set_due()
            return
        self._fresh = False
        self._last_ns = now
        self._held_until = now + self.inhibit_ns
        self.due = self._event_due = self._next_event(now)
        bits = compiled.pack(self._escs, self._gateway, now, 0, 0)
        self._last_status = bits & compiled.status_mask
        self.sent += 1
        self._send_frame(CanFrame(self.cob_id, bits.to_bytes(compiled.length, "little")))

    def _next_event(self, now: int) -> int:
        return now + self.event_ns if self.event_ns and self._by_event else NEVER

    def _set_due(self) -> None:
        due = self._event_due
        self.due = self._held_until if self.pending and self._held_until < due else due
