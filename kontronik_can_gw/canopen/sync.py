"""The consumer of SYNC: the SYNC that a node follows, and its TPDOs of types 0 to 240.

See CiA 301, 7.2.5.
"""

from kontronik_can_gw.canopen.cob_ids import SYNC, Taken, check_free
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort
from kontronik_can_gw.core.slots import Slot
from kontronik_can_gw.status import GatewayStatus
from kontronik_can_gw.times import NEVER

MAX_WAITING = 32
"""Maximum number of frames of one TPDO that wait after several SYNCs were read at once."""
LAST_SYNC_TYPE = 240
_FRAME_BIT = 1 << 29
_PRODUCER_BIT = 1 << 30


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

    def on_sync(self, counter: int, now: int, answer: bool) -> None:
        """Count a SYNC, and send the PDO if it is due.

        ``counter`` is 0 if the SYNC has none. Without ``answer`` the SYNC is only counted.
        """
        if self._type > LAST_SYNC_TYPE:
            return
        if not self._has_begun and counter:
            if counter != self._start_value:
                return
            self._has_begun = True  # this SYNC counts as the first
        if self._type == 0:
            if self._slot.is_news and answer:
                self._slot.send(now)
            return
        self._count += 1
        if self._count >= self._type:
            self._count = 0
            if answer:
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
        dictionary.bind(0x1019, check=_check_overflow)

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


def _check_overflow(value: int) -> None:
    """SdoAbort 06090030h unless a new 1019h is 0 (no counter) or 2 to 240."""
    if value == 1 or value > 240:
        raise SdoAbort(Abort.VALUE)
