"""Transmit PDOs: what each is filled with, when it runs, SYNC (CiA 301, 7.2.2). The core sends them: each is one of its slots.

The bytes of a PDO come from a compiled plan like those of a DBC message, straight from the ESC's snapshot.

Event of types 254 and 255: new data of what is mapped (a UART frame, a second, a download). A PDO that carries a status object (errors,
operating state, link status) is sent when one of these changes instead. When telemetry is lost, PDOs with live values stop, unless they
carry the link status: those go on, with all ones (80..0h for signed types) for what is not available.
"""

from kontronik_can_gw.canopen.bound_values import compile_pdo
from kontronik_can_gw.canopen.cob_ids import Taken
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable
from kontronik_can_gw.canopen.pdo_parameters import EVENT_TYPES, TpdoParameters
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.telemetry import SECOND, Event
from kontronik_can_gw.signals.plan import EXPECTED_LIVE_HZ
from kontronik_can_gw.slots import Slot, SlotPlan, SlotSettings


class Tpdo(TpdoParameters):
    """One transmit PDO of one node."""

    def __init__(
        self,
        number: int,
        dictionary: Dictionary,
        protocol: EscProtocol,
        slot: Slot,
        taken: Taken,
    ) -> None:
        super().__init__(number, dictionary, taken)
        self._protocol = protocol
        self._slot = slot
        self._started = False
        self._plan: SlotPlan | None = None
        self._syncs = 0
        self._sync_waits = False
        self.bind(self.configure)

    @property
    def sent(self) -> int:
        """Frames so far."""
        return self._slot.sent

    @property
    def on_change(self) -> bool:
        """True if changes of a status object are what causes it."""
        return self._plan is not None and self._plan.watched != 0

    @property
    def rate_hz(self) -> float:
        """Frames a second to be expected with the UART at 100 Hz; those sent on change or at SYNC (10 Hz taken) by their cycle."""
        if self._plan is None or not self.valid:
            return 0.0
        if self.type not in EVENT_TYPES:
            return 10.0 / max(1, self.type)
        cycle = SECOND / self.event_ns if self.event_ns else 0.0
        if self.on_change:
            return cycle or 1.0
        events = EXPECTED_LIVE_HZ if self._plan.triggers & Event.LIVE else 1.0
        return max(cycle, min(events, SECOND / self.inhibit_ns) if self.inhibit_ns else events)

    def configure(self, now: int) -> None:
        """Take over what the dictionary says. A PDO that begins to exist in OPERATIONAL begins like at its start."""
        was_running = self._running
        self.read()
        self._plan = compile_pdo(self.mapped, self._protocol) if self.mapped else None
        settings = None
        if self.valid and self._plan is not None:
            by_event = self.type in EVENT_TYPES
            times = (self.inhibit_ns, self.event_ns)
            settings = SlotSettings(self._plan, self.cob_id, by_event, *times)
        if not was_running:
            self._begin_syncs()
        self._slot.configure(settings, now)

    @property
    def _running(self) -> bool:
        return self._started and self.valid and self._plan is not None

    def start(self, now: int) -> None:
        """The node has become OPERATIONAL: event-driven PDOs say once what is."""
        self._started = True
        self._begin_syncs()
        self._slot.start(now)

    def stop(self) -> None:
        """No PDO outside OPERATIONAL."""
        self._started = False
        self._slot.stop()

    def on_download(self, variable: Variable, now: int) -> None:
        """An object was written over the bus."""
        if any(entry is variable for entry in self.mapped):
            self._slot.news(now)

    def repeat(self, now: int) -> None:
        """Send once more what is sent on change only."""
        if self.on_change:
            self._slot.news(now)

    def on_sync(self, counter: int, now: int, answer: bool = True) -> None:
        """A SYNC message; ``counter`` 0 where it has none. Without ``answer`` it is only counted."""
        if not self._running or self.type > 240:
            return
        if self._sync_waits and counter:
            if counter != self.sync_start:
                return
            self._sync_waits = False  # this SYNC counts as the first
        if self.type == 0:
            if self._slot.is_news and answer:
                self._slot.send(now)
            return
        self._syncs += 1
        if self._syncs >= self.type:
            self._syncs = 0
            if answer:
                self._slot.send(now)

    def _begin_syncs(self) -> None:
        self._syncs = 0
        self._sync_waits = self.sync_start != 0
