"""Parameters of one transmit PDO, 180xh and 1A0xh, and the rules by which a master may change them (CiA 301, 7.5.2.37/38)."""

from collections.abc import Sequence

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.bound_values import bits_of
from kontronik_can_gw.canopen.cob_ids import INVALID_BIT, Taken, check_free, restricted
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable, Written
from kontronik_can_gw.esc.telemetry import MS

COMMUNICATION, MAPPING = 0x1800, 0x1A00
MAX_TPDOS = 512
COB_ID, TYPE, INHIBIT, EVENT_TIMER, SYNC_START = 1, 2, 3, 5, 6
EVENT_TYPES = (254, 255)
_FRAME_BIT = 1 << 29
_MAX_BITS = 64


class TpdoParameters:
    """What a master configures of one transmit PDO."""

    def __init__(self, number: int, dictionary: Dictionary, taken: Taken) -> None:
        self.number = number
        self.cob_id = 0
        self.valid = False
        self.type = 255
        """Transmission type."""
        self.inhibit_ns = self.event_ns = 0
        self.sync_start = 0
        self.mapped: list[Variable] = []
        """What is in the PDO; empty where nothing is."""
        self._dictionary = dictionary
        self._taken = taken
        self.indices = COMMUNICATION + number, MAPPING + number

    def bind(self, written: Written) -> None:
        """Check what is written to the objects of this PDO; ``written`` follows."""
        index, mapping = self.indices
        bind = self._dictionary.bind
        bind(index, COB_ID, check=self._check_cob_id, written=written)
        bind(index, TYPE, check=self._check_type, written=written)
        bind(index, INHIBIT, check=self._check_while_invalid, written=written)
        bind(index, EVENT_TIMER, written=written)
        bind(index, SYNC_START, check=self._check_sync_start, written=written)
        bind(mapping, 0, check=self._check_count, written=written)
        for variable in self._dictionary.subs(mapping):
            bind(mapping, variable.entry.sub, check=self._check_entry, written=written)

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
        self.sync_start = number(index, SYNC_START)
        self.mapped = self._resolve_all(number(mapping))

    def check(self) -> None:
        """Whether the parameters as they are make a PDO. SdoAbort if not."""
        _check_length(self.mapped)
        self._check_type(self.type)
        self._check_id(self._dictionary.number(self.indices[0], COB_ID))

    def is_free(self) -> bool:
        """Whether the COB-ID can be used."""
        return not restricted(self.cob_id) and not self._taken(self.cob_id, self)

    def _resolve_all(self, count: int) -> list[Variable]:
        number, mapping = self._dictionary.number, self.indices[1]
        return [self._resolve(number(mapping, sub)) for sub in range(1, count + 1)]

    def _resolve(self, mapping: int) -> Variable:
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
        if 241 <= value <= 253:
            raise SdoAbort(Abort.VALUE)

    def _check_while_invalid(self, _value: int) -> None:
        """Inhibit time and SYNC start value cannot change while the PDO exists: 06090030h."""
        if self.valid:
            raise SdoAbort(Abort.VALUE)

    def _check_sync_start(self, value: int) -> None:
        """A new 180xh:6."""
        self._check_while_invalid(value)
        if value > 240:
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
            self._resolve(mapping)


def _check_length(mapped: Sequence[Variable]) -> None:
    if sum(map(bits_of, mapped)) > _MAX_BITS:
        raise SdoAbort(Abort.PDO_LENGTH)
