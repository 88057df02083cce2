"""TPDOs and SYNC: CiA 301, 7.2.2 and 7.2.5."""

from functools import partial
from typing import TYPE_CHECKING

from kontronik_can_gw.desk.conformance.items import Skipped, require, require_abort
from kontronik_can_gw.desk.conformance.nmt_items import ENTER_PRE_OPERATIONAL, START, STOP
from kontronik_can_gw.desk.conformance.sdo_items import (
    NO_OBJECT,
    VALUE_RANGE,
    VALUE_TOO_HIGH,
    VALUE_TOO_LOW,
    first,
    is_number,
    is_writable,
)
from kontronik_can_gw.desk.conformance.slave import AbortedTransfer, ReceivedFrame, Slave

if TYPE_CHECKING:
    from canopen.objectdictionary import ODVariable

_COMMUNICATION = 0x1800
_MAPPING = 0x1A00
_INVALID = 1 << 31
_NO_RTR = 1 << 30
_EXTENDED = 1 << 29
_CANNOT_BE_MAPPED = 0x06040041
_TOO_LONG = 0x06040042
_RESERVED_TYPES = (241, 245, 251)
_OTHER_SYNC = 0x0FE
_LIMITS = (VALUE_RANGE, VALUE_TOO_HIGH, VALUE_TOO_LOW)


class FirstTpdo:
    """The first TPDO of the slave, which no other frame on the bus disturbs.

    All other TPDOs are disabled.
    """

    def __init__(self, slave: Slave) -> None:
        for sub in (1, 2):
            variable = slave.variable(_COMMUNICATION, sub)
            if variable is None:
                raise Skipped("the slave has no TPDO")
            if not is_writable(variable):
                raise Skipped(f"1800h:{sub:02X} cannot be written")
        self.slave = slave
        self.cob_id = 0x180 + slave.node_id
        for index in slave.dictionary:
            if not _COMMUNICATION < index < _MAPPING:
                continue
            other = slave.variable(index, 1)
            if other is not None and is_writable(other):
                slave.write_number(index, 1, _INVALID | _NO_RTR | self.cob_id)
        self.disable()

    def disable(self) -> None:
        self.slave.write_number(_COMMUNICATION, 1, _INVALID | _NO_RTR | self.cob_id)

    def enable(self, transmission_type: int) -> None:
        """Enable the TPDO. Without a default mapping, an object is mapped first."""
        if self.slave.number(_MAPPING, 0) == 0:
            self.map_object()
        self.slave.write_number(_COMMUNICATION, 2, transmission_type)
        if self.slave.has(_COMMUNICATION, 5):
            self.slave.write_number(_COMMUNICATION, 5, 0)
        self.slave.write_number(_COMMUNICATION, 1, _NO_RTR | self.cob_id)

    def map_object(self) -> "ODVariable":
        """Map only the first object of the EDS that can be mapped, and return it."""
        self.require_writable_mapping()
        target = first(self.slave, _can_be_mapped, "object that can be mapped")
        self.slave.write_number(_MAPPING, 0, 0)
        entry = target.index << 16 | target.subindex << 8 | len(target)
        self.slave.write_number(_MAPPING, 1, entry)
        self.slave.write_number(_MAPPING, 0, 1)
        return target

    def seen_in(self, frames: list[ReceivedFrame]) -> list[ReceivedFrame]:
        return [frame for frame in frames if frame.can_id == self.cob_id]

    def count_with_syncs(self, count: int) -> int:
        """Return the number of TPDOs after this many SYNCs, which are sent one by one."""
        seen = 0
        for _ in range(count):
            self.slave.sync()
            seen += len(self.seen_in(self.slave.frames_until_answer()))
        return seen + len(self.seen_in(self.slave.frames_until_answer()))

    def length(self) -> int:
        """Return the number of bytes that the mapping has."""
        count = self.slave.number(_MAPPING, 0)
        bits = 0
        for sub in range(1, count + 1):
            bits += self.slave.number(_MAPPING, sub) & 0xFF
        return (bits + 7) // 8

    def require_writable_mapping(self) -> None:
        variable = self.slave.variable(_MAPPING, 0)
        if variable is None or not is_writable(variable):
            raise Skipped("the mapping of the first TPDO cannot be changed")


def _can_be_mapped(variable: "ODVariable") -> bool:
    """Return True if a TPDO may have an entry of the EDS, and the entry has whole bytes."""
    is_sent = variable.access_type not in ("wo", "rww")
    return variable.pdo_mappable and is_sent and is_number(variable)


def pdo_each_sync(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.enable(1)
    slave.nmt(START)
    slave.sync()
    frame = slave.wait_for(lambda frame: frame.can_id == tpdo.cob_id)
    require(len(frame.data) == tpdo.length(), f"{len(frame.data)} bytes, not {tpdo.length()}")
    count = 1 + tpdo.count_with_syncs(9)
    require(count == 10, f"{count} TPDOs")
    return f"10 TPDOs of {len(frame.data)} bytes"


def pdo_each_third_sync(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.enable(3)
    slave.nmt(START)
    count = tpdo.count_with_syncs(12)
    require(count == 4, f"{count} TPDOs")
    return "4 TPDOs"


def pdo_acyclic(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.enable(0)
    slave.nmt(START)
    without = len(tpdo.seen_in(slave.frames_during(0.2)))
    require(without == 0, f"{without} TPDOs without a SYNC")
    count = tpdo.count_with_syncs(5)
    require(count <= 5, f"{count} TPDOs after 5 SYNCs")
    return f"{count} TPDOs after 5 SYNCs; only a changed value needs one"


def pdo_disabled(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.enable(1)
    tpdo.disable()
    slave.nmt(START)
    count = tpdo.count_with_syncs(3)
    require(count == 0, f"{count} TPDOs")
    return "no TPDO"


def pdo_none_in_pre_operational(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.enable(1)
    slave.nmt(ENTER_PRE_OPERATIONAL)
    count = tpdo.count_with_syncs(3)
    require(count == 0, f"{count} TPDOs")
    return "no TPDO"


def pdo_none_while_stopped(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.enable(1)
    slave.nmt(START)
    slave.frames_until_answer()
    slave.nmt(STOP)
    for _ in range(3):
        slave.sync()
    slave.nmt(ENTER_PRE_OPERATIONAL)
    count = len(tpdo.seen_in(slave.frames_until_answer()))
    require(count == 0, f"{count} TPDOs")
    return "no TPDO"


def pdo_event_timer(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    if not slave.has(_COMMUNICATION, 5):
        raise Skipped("the EDS does not have 1800h:5")
    tpdo.enable(254)
    slave.write_number(_COMMUNICATION, 5, 100)
    slave.nmt(START)
    count = len(tpdo.seen_in(slave.frames_during(1.0)))
    require(count >= 8, f"{count} TPDOs")
    return f"{count} TPDOs in a second"


def pdo_cob_id_change_while_valid(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.enable(1)
    answer = require_abort(lambda: slave.write_number(_COMMUNICATION, 1, _NO_RTR | 0x1FF))
    found = slave.number(_COMMUNICATION, 1) & 0x7FF
    require(found == tpdo.cob_id, f"the COB-ID is {found:03X}h now")
    return answer


def pdo_restricted_cob_ids(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    answer = ""
    for cob_id in (0x000, 0x001, 0x580 + slave.node_id, 0x6E0, 0x7FF):
        tpdo.disable()
        new = _NO_RTR | cob_id
        answer = require_abort(partial(slave.write_number, _COMMUNICATION, 1, new), *_LIMITS)
    return f"{answer} each"


def pdo_extended_cob_id(slave: Slave) -> str:
    FirstTpdo(slave)
    new = _INVALID | _NO_RTR | _EXTENDED | 0x12345
    try:
        return require_abort(lambda: slave.write_number(_COMMUNICATION, 1, new), *_LIMITS)
    finally:
        if slave.number(_COMMUNICATION, 1) == new:
            raise Skipped("the slave supports 29-bit COB-IDs")


def pdo_reserved_types(slave: Slave) -> str:
    FirstTpdo(slave)
    answer = ""
    for number in _RESERVED_TYPES:
        answer = require_abort(partial(slave.write_number, _COMMUNICATION, 2, number), *_LIMITS)
    return f"{answer} each"


def pdo_remote_types(slave: Slave) -> str:
    FirstTpdo(slave)
    answers = []
    for number in (252, 253):
        try:
            slave.write_number(_COMMUNICATION, 2, number)
        except AbortedTransfer as abort:
            answers.append(str(abort))
            require(abort.code in _LIMITS, str(abort))
        else:
            answers.append("accepted")
    return f"252: {answers[0]}, 253: {answers[1]}"


def pdo_inhibit_time(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    if not (slave.has(_COMMUNICATION, 3) and slave.has(_COMMUNICATION, 5)):
        raise Skipped("the EDS does not have 1800h:3 and 1800h:5")
    slave.write_number(_COMMUNICATION, 3, 1000)
    tpdo.enable(254)
    slave.write_number(_COMMUNICATION, 5, 20)
    slave.nmt(START)
    count = len(tpdo.seen_in(slave.frames_during(1.0)))
    require(count <= 12, f"{count} TPDOs")
    return f"{count} TPDOs in a second"


def pdo_inhibit_time_while_valid(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    if not slave.has(_COMMUNICATION, 3):
        raise Skipped("the EDS does not have 1800h:3")
    tpdo.enable(254)
    return require_abort(lambda: slave.write_number(_COMMUNICATION, 3, 50))


def pdo_mapping_while_active(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.require_writable_mapping()
    if slave.number(_MAPPING, 0) == 0:
        tpdo.map_object()
    before = slave.number(_MAPPING, 1)
    answer = require_abort(lambda: slave.write_number(_MAPPING, 1, before))
    require(slave.number(_MAPPING, 1) == before, "the mapping has changed")
    return answer


def pdo_mapping_procedure(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    target = tpdo.map_object()
    tpdo.enable(1)
    slave.nmt(START)
    slave.sync()
    frame = slave.wait_for(lambda frame: frame.can_id == tpdo.cob_id)
    require(8 * len(frame.data) == len(target), f"{len(frame.data)} bytes")
    return f"{len(frame.data)} bytes of {target.index:04X}h:{target.subindex:02X}"


def _refused_entry(slave: Slave, entry: int, *codes: int) -> str:
    """Map an entry. Both the entry and the number of entries may be refused."""
    tpdo = FirstTpdo(slave)
    tpdo.require_writable_mapping()
    slave.write_number(_MAPPING, 0, 0)

    def map_it() -> None:
        slave.write_number(_MAPPING, 1, entry)
        slave.write_number(_MAPPING, 0, 1)

    return require_abort(map_it, *codes)


def pdo_mapping_of_no_object(slave: Slave) -> str:
    index = next(index for index in range(0x5FFF, 0x2000, -1) if index not in slave.dictionary)
    return _refused_entry(
        slave,
        index << 16 | 0x08,
        NO_OBJECT,
        _CANNOT_BE_MAPPED,
    )


def pdo_mapping_of_an_unmappable_object(slave: Slave) -> str:
    return _refused_entry(slave, 0x1000_00_20, _CANNOT_BE_MAPPED)


def pdo_mapping_too_long(slave: Slave) -> str:
    tpdo = FirstTpdo(slave)
    tpdo.require_writable_mapping()
    wide = first(
        slave, lambda v: _can_be_mapped(v) and len(v) == 32, "object of 32 bits that can be mapped"
    )
    entry = wide.index << 16 | wide.subindex << 8 | 32
    if not slave.has(_MAPPING, 3):
        raise Skipped("the mapping has fewer than three entries")
    slave.write_number(_MAPPING, 0, 0)

    def map_three() -> None:
        for sub in (1, 2, 3):
            slave.write_number(_MAPPING, sub, entry)
        slave.write_number(_MAPPING, 0, 3)

    return require_abort(map_three, _TOO_LONG)


def sync_counter_range(slave: Slave) -> str:
    answer = ""
    for value in (1, 241):
        answer = require_abort(partial(slave.write_number, 0x1019, 0, value), *_LIMITS)
    return f"{answer} each"


def sync_producer_is_refused(slave: Slave) -> str:
    if slave.has(0x1006):
        raise Skipped("the slave can produce SYNC (1006h)")
    return require_abort(lambda: slave.write_number(0x1005, 0, _NO_RTR | 0x80))


def sync_cob_id(slave: Slave) -> str:
    variable = slave.variable(0x1005)
    if variable is None or not is_writable(variable):
        raise Skipped("1005h cannot be written")
    tpdo = FirstTpdo(slave)
    tpdo.enable(1)
    slave.write_number(0x1005, 0, _OTHER_SYNC)
    slave.nmt(START)
    slave.sync()
    old = len(tpdo.seen_in(slave.frames_until_answer()))
    slave.send(_OTHER_SYNC, b"")
    slave.wait_for(lambda frame: frame.can_id == tpdo.cob_id)
    require(old == 0, "a TPDO also after the old SYNC")
    return "a TPDO"
