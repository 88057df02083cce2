"""Transmit PDOs: objects 180xh and 1A0xh, and the rules by which a master may change them.

See CiA 301, 7.2.2 and 7.5.2.37/38, and 7.2.5 for SYNC (1005h, 1019h), which starts PDOs of types 0
to 240. Each PDO is one of the core's slots, and the core sends it. The bytes of a PDO come from a
compiled plan, like the bytes of a DBC message, directly from the ESC's snapshot.

The event of types 254 and 255 is new data of a mapped object: a UART frame, a second, or a
download. A PDO that carries a status object (errors, operating state, link status) is sent when one
of these changes instead. When telemetry is lost, PDOs with live values stop, unless they carry the
link status. These continue, and values that are not available have all bits set (80..0h for signed
types).
"""

from collections.abc import Callable, Sequence

from kontronik_can_gw.canopen.bound_values import bits_of, compile_pdo
from kontronik_can_gw.canopen.cob_ids import INVALID_BIT, SYNC, Taken, check_free
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, Variable, key, only
from kontronik_can_gw.core.slots import Slot, SlotPlan, SlotSettings
from kontronik_can_gw.esc.telemetry import Event
from kontronik_can_gw.signals.plan import EXPECTED_LIVE_HZ
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import MS, NEVER, SECOND

COMMUNICATION = 0x1800
"""Index of the first PDO's communication parameters."""
MAPPING = 0x1A00
"""Index of the first PDO's mapping."""
MAX_TPDOS = 512
COB_ID = 1
TYPE = 2
INHIBIT = 3
EVENT_TIMER = 5
SYNC_START = 6
EVENT_TYPES = (254, 255)
_FRAME_BIT = 1 << 29
_PRODUCER_BIT = 1 << 30
MAX_WAITING = 32
"""Maximum number of frames of one TPDO that wait after several SYNCs were read at once."""
LAST_SYNC_TYPE = 240
_MAX_BITS = 64
_check_type = only((*range(LAST_SYNC_TYPE + 1), *EVENT_TYPES))
"""Refuses a 180xh:2 that is reserved, 252 or 253 (on request by RTR)."""


class SyncTransmission:
    """Counts SYNCs for one TPDO, and sends it.

    ``status`` counts the PDOs that a newer one replaced.

    Several SYNCs may be read in one iteration of the loop, after a delay. With type 1 the newest
    PDO replaces the earlier ones of that iteration. With types 2 to 240 every PDO is sent, one for
    each call of ``advance``, so that each carries the values of its own iteration.
    """

    def __init__(self, slot: Slot, status: GatewayStatus) -> None:
        self.due = NEVER
        """Earliest time at which ``advance`` acts."""
        self._slot = slot
        self._status = status
        self._type = 0
        self._start_value = 0
        self._has_begun = True
        self._count = 0
        self._waiting = 0

    def configure(self, transmission_type: int, start_value: int) -> None:
        """Take over 180xh:2 and 180xh:6. The count of SYNCs continues."""
        if transmission_type != self._type:
            self.stop()
        self._type = transmission_type
        self._start_value = start_value

    def begin(self) -> None:
        """Start the count of SYNCs again."""
        self.stop()
        self._count = 0
        self._has_begun = self._start_value == 0

    def stop(self) -> None:
        """Discard the PDOs that wait for their turn."""
        self._waiting = 0
        self.due = NEVER

    def on_sync(self, counter: int, now: int, is_answered: bool) -> None:
        """Count a SYNC, and send the PDO if it is due.

        ``counter`` is 0 if the SYNC has none. Without ``is_answered`` the SYNC is only counted.
        """
        if self._type > LAST_SYNC_TYPE:
            return
        if not self._has_begun and counter:
            if counter != self._start_value:
                return
            self._has_begun = True  # this SYNC counts as the first
        if self._type == 0:
            if self._slot.is_news and is_answered:
                self._slot.send(now)
            return
        self._count += 1
        if self._count >= self._type:
            self._count = 0
            if is_answered:
                self._send(now)

    def advance(self, now: int) -> None:
        """Send one waiting PDO if the one before it was handed over."""
        if now < self.due or self._slot.is_pending:
            return
        self._waiting -= 1
        self.due = now + 1 if self._waiting else NEVER
        self._slot.send(now)

    def _send(self, now: int) -> None:
        if not self._slot.is_pending and not self._waiting:
            self._slot.send(now)
        elif self._type == 1 or self._waiting >= MAX_WAITING:
            self._status.replaced_frames += 1
        else:
            self._waiting += 1
            self.due = min(self.due, now + 1)


class SyncConsumer:
    """The SYNC that a node follows: objects 1005h (COB-ID) and 1019h (counter overflow)."""

    def __init__(self, dictionary: Dictionary, taken: Taken) -> None:
        self._dictionary = dictionary
        self._taken = taken
        dictionary.bind(0x1005, check=self._check_cob_id)
        dictionary.bind(0x1019, check=only((0, *range(2, LAST_SYNC_TYPE + 1))))

    @property
    def cob_id(self) -> int:
        """11 bits of 1005h."""
        return self._dictionary.number(0x1005) & 0x7FF

    def counter(self, data: bytes) -> int | None:
        """Return the counter of a SYNC, or 0 if 1019h sets none. None for a wrong length.

        A SYNC has one byte of data if 1019h sets a counter, and no data otherwise.
        """
        has_counter = self._dictionary.number(0x1019) != 0
        if len(data) != int(has_counter):
            return None
        return data[0] if has_counter else 0

    def _check_cob_id(self, value: int) -> None:
        """Check a new 1005h.

        SdoAbort 06090030h for a SYNC producer, 29-bit ids, reserved bits and restricted ids.
        """
        if value & (_PRODUCER_BIT | _FRAME_BIT | 0x1FFFF800):
            raise SdoAbort(Abort.VALUE)
        check_free(value & 0x7FF, SYNC, self._taken)


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
        self.is_valid = False
        self.type = 255
        """Transmission type."""
        self.inhibit_ns = 0
        self.event_ns = 0
        self.mapped: list[Variable] = []
        """The mapped objects in the order of the frame."""
        self.communication_index = COMMUNICATION + number
        self.mapping_index = MAPPING + number
        self.mappings = list(dictionary.subs(self.mapping_index))
        self._dictionary = dictionary
        self._taken = taken
        self._slot = slot
        self._plan: SlotPlan | None = None
        self._is_started = False
        self.sync = SyncTransmission(slot, status)
        self._bind_objects()

    def _bind_objects(self) -> None:
        bind = self._dictionary.bind
        index = self.communication_index
        mapping = self.mapping_index
        written = self.configure
        bind(index, COB_ID, check=self._check_cob_id, written=written)
        bind(index, TYPE, check=_check_type, written=written)
        bind(index, INHIBIT, check=self._check_while_invalid, written=written)
        bind(index, EVENT_TIMER, written=written)
        bind(index, SYNC_START, check=self._check_sync_start, written=written)
        bind(mapping, check=self._check_count, written=written)
        for variable in self.mappings:
            bind(mapping, variable.entry.sub, check=self._check_entry, written=written)

    @property
    def sent(self) -> int:
        """Number of frames sent so far."""
        return self._slot.sent

    @property
    def is_sent_on_change(self) -> bool:
        """True if the PDO is sent when a status object changes."""
        return self._plan is not None and self._plan.watched != 0

    def rate_hz(self, is_worst: bool) -> float:
        """Return the usual frames per second with the UART at 100 Hz and SYNC at 10 Hz.

        Frames caused by changes of a status object are counted only with ``is_worst``, which means
        that these objects change all the time.
        """
        if self._plan is None or not self.is_valid:
            return 0.0
        if self.type not in EVENT_TYPES:
            return 10.0 / max(1, self.type)
        cycle = SECOND / self.event_ns if self.event_ns else 0.0
        if self.is_sent_on_change and not is_worst:
            return cycle or 1.0
        events = EXPECTED_LIVE_HZ if self._plan.triggers & Event.LIVE else 1.0
        if self.inhibit_ns:
            events = min(events, SECOND / self.inhibit_ns)
        return max(cycle, events)

    # --- parameters

    def read(self) -> None:
        """Take over the parameters. SdoAbort if a mapped object cannot be mapped."""
        number = self._dictionary.number
        index = self.communication_index
        cob_id = number(index, COB_ID)
        self.cob_id = cob_id & 0x7FF
        self.is_valid = not cob_id & INVALID_BIT
        self.type = number(index, TYPE)
        self.inhibit_ns = number(index, INHIBIT) * MS // 10
        self.event_ns = number(index, EVENT_TIMER) * MS
        self.sync.configure(self.type, number(index, SYNC_START))
        self.mapped = self._resolve_all(number(self.mapping_index))

    def check(self) -> None:
        """SdoAbort unless the present parameters make a valid PDO."""
        _check_length(self.mapped)
        _check_type(self.type)
        self._check_id(self._dictionary.number(self.communication_index, COB_ID))

    def configure(self, now: int) -> None:
        """Take over the parameters.

        A PDO that becomes valid in OPERATIONAL begins as if the node had just been started.
        """
        was_running = self._is_running
        self.read()
        self._plan = compile_pdo(self.mapped) if self.mapped else None
        settings = None
        if self.is_valid and self._plan is not None:
            by_event = self.type in EVENT_TYPES
            settings = SlotSettings(
                plan=self._plan,
                can_id=self.cob_id,
                by_event=by_event,
                inhibit_ns=self.inhibit_ns,
                timer_ns=self.event_ns,
            )
        if not was_running:
            self.sync.begin()
        self._slot.configure(settings, now)

    def reset(self, node_id: int, now: int) -> list[int]:
        """Take over the parameters after a reset. Returns the keys of the rejected ones.

        Stored parameters that do not fit this EDS are replaced by the defaults. A PDO whose
        default COB-ID is in use becomes invalid.
        """
        rejected = []
        try:
            self.read()
            self.check()
        except SdoAbort:
            indices = (self.communication_index, self.mapping_index)
            rejected = list(self._dictionary.to_store(indices, node_id))
            self._dictionary.reset(indices, node_id, {})
            self.read()
            cob_id = self._dictionary.get(self.communication_index, COB_ID)
            try:
                self.check()
            except SdoAbort:
                if cob_id is not None and self.is_valid:
                    cob_id.value = int(cob_id.value) | INVALID_BIT
                    rejected.append(key(self.communication_index, COB_ID))
        self.configure(now)
        return rejected

    def _resolve_all(self, count: int) -> list[Variable]:
        number = self._dictionary.number
        mapped = []
        for sub in range(1, count + 1):
            mapping = number(self.mapping_index, sub)
            mapped.append(self.resolve(mapping))
        return mapped

    def resolve(self, mapping: int) -> Variable:
        """Return the object of a mapping entry (index, sub-index, bits).

        SdoAbort 06040041h if it cannot be mapped.
        """
        index = mapping >> 16
        sub = mapping >> 8 & 0xFF
        bits = mapping & 0xFF
        variable = self._dictionary.find(index, sub)
        is_mappable = variable.entry.is_mappable and variable.is_readable
        size = bits_of(variable)
        if not is_mappable or not size or size != bits:
            raise SdoAbort(Abort.NOT_MAPPABLE)
        return variable

    def _check_cob_id(self, value: int) -> None:
        """Check a new 180xh:1.

        SdoAbort 06090030h for 29-bit ids, restricted ids, another id while the PDO is valid, and
        a PDO without mapped objects. SdoAbort 06040043h for an id in use.
        """
        if not value & INVALID_BIT:
            is_other_id = value & 0x7FF != self.cob_id
            if not self.mapped or (self.is_valid and is_other_id):
                raise SdoAbort(Abort.VALUE)
        self._check_id(value)

    def _check_id(self, value: int) -> None:
        # Bit 30 (no RTR) may be 0, because most masters write 0. RTRs are not answered anyway.
        if value & _FRAME_BIT or value & 0x1FFFF800:
            raise SdoAbort(Abort.VALUE)
        if not value & INVALID_BIT:
            check_free(value & 0x7FF, self, self._taken)

    def _check_while_invalid(self, _value: int) -> None:
        """SdoAbort 06090030h for a new inhibit time or SYNC start value while the PDO is valid."""
        if self.is_valid:
            raise SdoAbort(Abort.VALUE)

    def _check_sync_start(self, value: int) -> None:
        """SdoAbort 06090030h for a new 180xh:6 above 240, or while the PDO is valid."""
        self._check_while_invalid(value)
        if value > LAST_SYNC_TYPE:
            raise SdoAbort(Abort.VALUE)

    def _check_count(self, count: int) -> None:
        """Check a new 1A0xh:0.

        SdoAbort 06010000h while the PDO is valid, 06040042h if there are not so many entries or
        if they have more than 64 bits, 06040041h for an object that cannot be mapped.
        """
        if self.is_valid:
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if self._dictionary.get(self.mapping_index, count) is None:
            raise SdoAbort(Abort.PDO_LENGTH)
        _check_length(self._resolve_all(count))

    def _check_entry(self, mapping: int) -> None:
        """SdoAbort 06010000h for a new 1A0xh:1..8 unless the PDO is invalid and 1A0xh:0 is 0."""
        if self.is_valid or self._dictionary.number(self.mapping_index):
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if mapping:
            self.resolve(mapping)

    # --- transmission

    @property
    def _is_running(self) -> bool:
        return self._is_started and self.is_valid and self._plan is not None

    def start(self, now: int) -> None:
        """Start because the node is OPERATIONAL. Event-driven PDOs send their values once."""
        self._is_started = True
        self.sync.begin()
        self._slot.start(now)

    def stop(self) -> None:
        """Send no PDO until ``start``, because the node has left OPERATIONAL."""
        self._is_started = False
        self.sync.stop()
        self._slot.stop()

    def on_download(self, variable: Variable, now: int) -> None:
        """Note new data if this object, written over the bus, is mapped."""
        if any(entry is variable for entry in self.mapped):
            self._slot.news(now)

    def repeat(self, now: int) -> None:
        """Send the PDO again if it is sent on changes only."""
        if self.is_sent_on_change:
            self._slot.news(now)

    def on_sync(self, counter: int, now: int, is_answered: bool) -> None:
        """Count a SYNC, see ``SyncTransmission.on_sync``."""
        if self._is_running:
            self.sync.on_sync(counter, now, is_answered)


def _check_length(mapped: Sequence[Variable]) -> None:
    """SdoAbort 06040042h for more than 64 bits."""
    if sum(map(bits_of, mapped)) > _MAX_BITS:
        raise SdoAbort(Abort.PDO_LENGTH)


class Tpdos(list[Tpdo]):
    """All transmit PDOs of the EDS in ascending order.

    ``slot`` is called once for each PDO, and returns a slot of the core.
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
        """A time not later than the first one at which ``advance`` has something to do."""

    def release_ids(self) -> None:
        """Make all COB-IDs of PDOs available to others."""
        for tpdo in self:
            tpdo.is_valid = False

    def stop(self) -> None:
        """Stop all PDOs, because the node has left OPERATIONAL."""
        for tpdo in self:
            tpdo.stop()

    def on_sync(self, counter: int, now: int, at: int) -> None:
        """Count a SYNC that arrived ``at``. A SYNC from before a hold-up is not answered."""
        is_answered = at > self._held_up_ns
        for tpdo in self:
            tpdo.on_sync(counter, now, is_answered)
            self.due = min(self.due, tpdo.sync.due)

    def advance(self, now: int) -> None:
        """Send the PDOs that wait for their turn after several SYNCs were read at once."""
        if now < self.due:
            return
        for tpdo in self:
            tpdo.sync.advance(now)
        self.due = min((tpdo.sync.due for tpdo in self), default=NEVER)

    def held_up(self, now: int) -> None:
        """Note that the process was held up until ``now``."""
        self._held_up_ns = now

    def repeat(self, now: int) -> None:
        """Send again the PDOs that are sent on changes only."""
        for tpdo in self:
            tpdo.repeat(now)
