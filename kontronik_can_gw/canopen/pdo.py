"""Transmit PDOs, 180xh and 1A0xh: parameters, the rules by which a master may change them, SYNC (CiA 301, 7.2.2 and 7.5.2.37/38).

The core sends them: each is one of its slots. The bytes of a PDO come from a compiled plan like those of a DBC message, straight from the
ESC's snapshot.

Event of types 254 and 255: new data of what is mapped (a UART frame, a second, a download). A PDO that carries a status object (errors,
operating state, link status) is sent when one of these changes instead. When telemetry is lost, PDOs with live values stop, unless they
carry the link status: those go on, with all ones (80..0h for signed types) for what is not available.
"""

from collections.abc import Callable, Sequence

from kontronik_can_gw.canopen.bound_values import bits_of, compile_pdo
from kontronik_can_gw.canopen.cob_ids import INVALID_BIT, Taken, check_free
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, Variable, key
from kontronik_can_gw.canopen.sync import LAST_SYNC_TYPE, SyncTransmission
from kontronik_can_gw.core.slots import Slot, SlotPlan, SlotSettings
from kontronik_can_gw.esc.telemetry import Event
from kontronik_can_gw.signals.plan import EXPECTED_LIVE_HZ
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS, NEVER, SECOND

COMMUNICATION, MAPPING = 0x1800, 0x1A00
MAX_TPDOS = 512
COB_ID, TYPE, INHIBIT, EVENT_TIMER, SYNC_START = 1, 2, 3, 5, 6
EVENT_TYPES = (254, 255)
_FRAME_BIT = 1 << 29
_MAX_BITS = 64


class Tpdo:
    """One transmit PDO of one node. ``status`` counts the PDOs that were replaced."""

    def __init__(
        self,
        number: int,
        dictionary: Dictionary,
        slot: Slot,
        status: GatewayStatus,
        taken: Taken,
    ) -> None:
        self.number = number
        self.cob_id = 0
        self.valid = False
        self.type = 255
        """Transmission type."""
        self.inhibit_ns = self.event_ns = 0
        self.mapped: list[Variable] = []
        """What is in the PDO; empty where nothing is."""
        self.indices = index, mapping = COMMUNICATION + number, MAPPING + number
        self.mappings = list(dictionary.subs(mapping))
        self._dictionary = dictionary
        self._taken = taken
        self._slot = slot
        self._plan: SlotPlan | None = None
        self._started = False
        self.sync = SyncTransmission(slot, status)
        bind, written, check_entry = dictionary.bind, self.configure, self._check_entry
        bind(index, COB_ID, check=self._check_cob_id, written=written)
        bind(index, TYPE, check=self._check_type, written=written)
        bind(index, INHIBIT, check=self._check_while_invalid, written=written)
        bind(index, EVENT_TIMER, written=written)
        bind(index, SYNC_START, check=self._check_sync_start, written=written)
        bind(mapping, check=self._check_count, written=written)
        for variable in self.mappings:
            bind(mapping, variable.entry.sub, check=check_entry, written=written)

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
        """Usual frames a second with the UART at 100 Hz and SYNC at 10 Hz. Changes are not counted."""
        return self._rate_hz(is_worst=False)

    @property
    def worst_rate_hz(self) -> float:
        """The same if the status objects that cause it change all the time."""
        return self._rate_hz(is_worst=True)

    def _rate_hz(self, is_worst: bool) -> float:
        if self._plan is None or not self.valid:
            return 0.0
        if self.type not in EVENT_TYPES:
            return 10.0 / max(1, self.type)
        cycle = SECOND / self.event_ns if self.event_ns else 0.0
        if self.on_change and not is_worst:
            return cycle or 1.0
        events = EXPECTED_LIVE_HZ if self._plan.triggers & Event.LIVE else 1.0
        return max(cycle, min(events, SECOND / self.inhibit_ns) if self.inhibit_ns else events)

    # --- parameters

    def read(self) -> None:
        """Take over what the dictionary says. SdoAbort where something is mapped that cannot be."""
        number = self._dictionary.number
        index, mapping = self.indices
        cob_id = number(index, COB_ID)
        self.cob_id = cob_id & 0x7FF
        self.valid = not cob_id & INVALID_BIT
        self.type = number(index, TYPE)
        self.inhibit_ns = number(index, INHIBIT) * MS // 10
        self.event_ns = number(index, EVENT_TIMER) * MS
        self.sync.configure(self.type, number(index, SYNC_START))
        self.mapped = self._resolve_all(number(mapping))

    def check(self) -> None:
        """Whether the parameters as they are make a PDO. SdoAbort if not."""
        _check_length(self.mapped)
        self._check_type(self.type)
        self._check_id(self._dictionary.number(self.indices[0], COB_ID))

    def configure(self, now: int) -> None:
        """Take over what the dictionary says. A PDO that begins to exist in OPERATIONAL begins like at its start."""
        was_running = self._running
        self.read()
        self._plan = compile_pdo(self.mapped) if self.mapped else None
        settings = None
        if self.valid and self._plan is not None:
            by_event = self.type in EVENT_TYPES
            times = (self.inhibit_ns, self.event_ns)
            settings = SlotSettings(self._plan, self.cob_id, by_event, *times)
        if not was_running:
            self.sync.begin()
        self._slot.configure(settings, now)

    def reset(self, node_id: int, now: int) -> list[int]:
        """Take over the parameters as they are after a reset. Returns the keys of those that were rejected.

        Stored parameters that no longer make sense with this EDS give way to the defaults; without a free COB-ID there is no PDO.
        """
        rejected = []
        try:
            self.read()
            self.check()
        except SdoAbort:
            for number, variable in self._dictionary.variables.items():
                if number >> 8 in self.indices:
                    if variable.value != (default := variable.default(node_id)):
                        rejected.append(number)
                    variable.value = default
            self.read()
            cob_id = self._dictionary.get(self.indices[0], COB_ID)
            try:
                self.check()
            except SdoAbort:
                if cob_id is not None and self.valid:
                    cob_id.value = int(cob_id.value) | INVALID_BIT
                    rejected.append(key(self.indices[0], COB_ID))
        self.configure(now)
        return rejected

    def _resolve_all(self, count: int) -> list[Variable]:
        number, mapping = self._dictionary.number, self.indices[1]
        return [self.resolve(number(mapping, sub)) for sub in range(1, count + 1)]

    def resolve(self, mapping: int) -> Variable:
        """The object of a mapping entry (index, sub-index, bits). SdoAbort where it cannot be mapped."""
        index, sub, bits = mapping >> 16, mapping >> 8 & 0xFF, mapping & 0xFF
        variable = self._dictionary.find(index, sub)
        mappable = variable.entry.mappable and variable.readable
        if not mappable or not bits_of(variable) or bits_of(variable) != bits:
            raise SdoAbort(Abort.NOT_MAPPABLE)
        return variable

    def _check_cob_id(self, value: int) -> None:
        """A new 180xh:1.

        SdoAbort 06090030h for 29 bits, restricted ids, a change while the PDO exists, and a PDO with nothing mapped;
        06040043h for an id in use.
        """
        if not value & INVALID_BIT and (
            not self.mapped or (self.valid and value & 0x7FF != self.cob_id)
        ):
            raise SdoAbort(Abort.VALUE)
        self._check_id(value)

    def _check_id(self, value: int) -> None:
        # Bit 30, no RTR, may be 0: most masters write it so. An RTR is not answered either way.
        if value & _FRAME_BIT or value & 0x1FFFF800:
            raise SdoAbort(Abort.VALUE)
        if not value & INVALID_BIT:
            check_free(value & 0x7FF, self, self._taken)

    def _check_type(self, value: int) -> None:
        """A new 180xh:2. Reserved types and 252, 253 (on request by RTR) are refused: 06090030h."""
        if LAST_SYNC_TYPE < value < EVENT_TYPES[0]:
            raise SdoAbort(Abort.VALUE)

    def _check_while_invalid(self, _value: int) -> None:
        """Inhibit time and SYNC start value cannot change while the PDO exists: 06090030h."""
        if self.valid:
            raise SdoAbort(Abort.VALUE)

    def _check_sync_start(self, value: int) -> None:
        """A new 180xh:6."""
        self._check_while_invalid(value)
        if value > LAST_SYNC_TYPE:
            raise SdoAbort(Abort.VALUE)

    def _check_count(self, count: int) -> None:
        """A new 1A0xh:0. The PDO must not exist; the entries must be there and be 64 bits at most."""
        if self.valid:
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if self._dictionary.get(self.indices[1], count) is None:
            raise SdoAbort(Abort.PDO_LENGTH)
        _check_length(self._resolve_all(count))

    def _check_entry(self, mapping: int) -> None:
        """A new 1A0xh:1..8. The PDO must not exist and sub-index 0 must be 0, else 06010000h."""
        if self.valid or self._dictionary.number(self.indices[1]):
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if mapping:
            self.resolve(mapping)

    # --- transmission

    @property
    def _running(self) -> bool:
        return self._started and self.valid and self._plan is not None

    def start(self, now: int) -> None:
        """The node has become OPERATIONAL: event-driven PDOs say once what is."""
        self._started = True
        self.sync.begin()
        self._slot.start(now)

    def stop(self) -> None:
        """No PDO outside OPERATIONAL."""
        self._started = False
        self.sync.stop()
        self._slot.stop()

    def on_download(self, variable: Variable, now: int) -> None:
        """An object was written over the bus."""
        if any(entry is variable for entry in self.mapped):
            self._slot.news(now)

    def repeat(self, now: int) -> None:
        """Send once more what is sent on change only."""
        if self.on_change:
            self._slot.news(now)

    def on_sync(self, counter: int, now: int, answer: bool) -> None:
        """Counts a SYNC, see SyncTransmission."""
        if self._running:
            self.sync.on_sync(counter, now, answer)


def _check_length(mapped: Sequence[Variable]) -> None:
    if sum(map(bits_of, mapped)) > _MAX_BITS:
        raise SdoAbort(Abort.PDO_LENGTH)


class Tpdos(list[Tpdo]):
    """All transmit PDOs of a node in ascending order, as many as the EDS has.

    ``slot`` returns another slot of the core.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        slot: Callable[[], Slot],
        status: GatewayStatus,
        taken: Taken,
    ) -> None:
        super().__init__(
            Tpdo(number, dictionary, slot(), status, taken)
            for number in range(MAX_TPDOS)
            if dictionary.get(COMMUNICATION + number) is not None
        )
        self._held_up_ns = -NEVER
        self.due = NEVER
        """When ``advance`` has something to do, or earlier."""

    def release_ids(self) -> None:
        """What PDOs had is free for another."""
        for tpdo in self:
            tpdo.valid = False

    def stop(self) -> None:
        """No PDO outside OPERATIONAL."""
        for tpdo in self:
            tpdo.stop()

    def on_sync(self, counter: int, now: int, at: int) -> None:
        """Counts a SYNC that arrived ``at``. A SYNC from before a hold-up is not answered."""
        answer = at > self._held_up_ns
        for tpdo in self:
            tpdo.on_sync(counter, now, answer)
            self.due = min(self.due, tpdo.sync.due)

    def advance(self, now: int) -> None:
        """Sends the PDOs that wait for their turn after SYNCs that were read at once."""
        if now < self.due:
            return
        for tpdo in self:
            tpdo.sync.advance(now)
        self.due = min((tpdo.sync.due for tpdo in self), default=NEVER)

    def held_up(self, now: int) -> None:
        """The process was held up until ``now``."""
        self._held_up_ns = now

    def repeat(self, now: int) -> None:
        """Send once more what is sent on change only."""
        for tpdo in self:
            tpdo.repeat(now)
