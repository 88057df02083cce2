"""SDO server and object dictionary: CiA 301, 7.2.4 and 7.5.2."""

from binascii import crc_hqx
from collections.abc import Callable
from typing import TYPE_CHECKING

from kontronik_can_gw.desk.conformance.items import Skipped, require, require_abort
from kontronik_can_gw.desk.conformance.nmt_items import HEARTBEAT_TIME
from kontronik_can_gw.desk.conformance.slave import AbortedTransfer, Slave, encoded, multiplexer

if TYPE_CHECKING:
    from canopen.objectdictionary import ODVariable

TOGGLE = 0x05030000
UNKNOWN_COMMAND = 0x05040001
UNSUPPORTED_ACCESS = 0x06010000
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
WRONG_LENGTH = 0x06070010
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUB_INDEX = 0x06090011
VALUE_RANGE = 0x06090030
VALUE_TOO_HIGH = 0x06090031
VALUE_TOO_LOW = 0x06090032
_EDS_OBJECT = 0x1021
_DEVICE_NAME = 0x1008


def name_of(variable: "ODVariable") -> str:
    return f"{variable.index:04X}h:{variable.subindex:02X}"


def is_writable(variable: "ODVariable") -> bool:
    return "w" in variable.access_type


def is_readable(variable: "ODVariable") -> bool:
    return variable.access_type != "wo"


def is_number(variable: "ODVariable") -> bool:
    from canopen.objectdictionary import datatypes

    return variable.data_type in datatypes.INTEGER_TYPES


def first(slave: Slave, condition: Callable[["ODVariable"], bool], what: str) -> "ODVariable":
    """Return the first entry that meets a condition. Raises Skipped without such an entry."""
    for variable in slave.variables():
        if condition(variable):
            return variable
    raise Skipped(f"the EDS has no {what}")


def _write_to(slave: Slave, variable: "ODVariable", data: bytes) -> None:
    slave.write(variable.index, variable.subindex, data)


def sdo_device_type(slave: Slave) -> str:
    answer = slave.ask(b"\x40" + multiplexer(0x1000, 0), multiplexer(0x1000, 0))
    require(answer[0] in (0x42, 0x43), f"command specifier {answer[0]:02X}h")
    value = int.from_bytes(answer[4:], "little")
    variable = slave.variable(0x1000)
    expected = None if variable is None else variable.default
    if expected is not None:
        require(value == expected, f"{value:08X}h, and {expected:08X}h in the EDS")
    return f"{value:08X}h"


def sdo_no_object(slave: Slave) -> str:
    index = next(index for index in range(0x5FFF, 0x2000, -1) if index not in slave.dictionary)
    return require_abort(lambda: slave.read(index), NO_OBJECT)


def sdo_no_sub_index_of_a_variable(slave: Slave) -> str:
    return require_abort(lambda: slave.read(0x1000, 1), NO_SUB_INDEX)


def sdo_no_sub_index_of_a_record(slave: Slave) -> str:
    highest = max(variable.subindex for variable in slave.variables() if variable.index == 0x1018)
    return require_abort(lambda: slave.read(0x1018, highest + 1), NO_SUB_INDEX)


def sdo_write_to_a_read_only_object(slave: Slave) -> str:
    target = first(slave, lambda v: v.access_type == "ro" and is_number(v), "read-only number")
    return require_abort(lambda: _write_to(slave, target, encoded(target, 0)), READ_ONLY)


def sdo_write_to_a_constant(slave: Slave) -> str:
    def fits(variable: "ODVariable") -> bool:
        return variable.access_type == "const" and is_number(variable) and len(variable) <= 32

    target = first(slave, fits, "constant number")
    return require_abort(lambda: _write_to(slave, target, encoded(target, 0)), READ_ONLY)


def sdo_read_of_a_write_only_object(slave: Slave) -> str:
    target = first(slave, lambda v: v.access_type == "wo", "write-only object")
    return require_abort(lambda: slave.read(target.index, target.subindex), WRITE_ONLY)


def sdo_too_long(slave: Slave) -> str:
    return require_abort(lambda: slave.write(HEARTBEAT_TIME, 0, bytes(4)), TOO_LONG, WRONG_LENGTH)


def sdo_too_short(slave: Slave) -> str:
    return require_abort(lambda: slave.write(HEARTBEAT_TIME, 0, b"\1"), TOO_SHORT, WRONG_LENGTH)


def sdo_value_too_high(slave: Slave) -> str:
    from canopen.objectdictionary import datatypes

    def fits(variable: "ODVariable") -> bool:
        if not (is_writable(variable) and is_number(variable)) or variable.max is None:
            return False
        is_signed = variable.data_type in datatypes.SIGNED_TYPES
        largest = (1 << len(variable) - is_signed) - 1
        return variable.max < largest

    target = first(slave, fits, "writable number with a HighLimit")
    assert target.max is not None
    value = encoded(target, target.max + 1)
    return require_abort(lambda: _write_to(slave, target, value), VALUE_TOO_HIGH, VALUE_RANGE)


def sdo_value_too_low(slave: Slave) -> str:
    def fits(variable: "ODVariable") -> bool:
        is_candidate = is_writable(variable) and is_number(variable)
        return is_candidate and variable.min is not None and variable.min > 0

    target = first(slave, fits, "writable number with a LowLimit")
    assert target.min is not None
    value = encoded(target, target.min - 1)
    return require_abort(lambda: _write_to(slave, target, value), VALUE_TOO_LOW, VALUE_RANGE)


def sdo_written_value_is_read_back(slave: Slave) -> str:
    slave.write_number(HEARTBEAT_TIME, 0, 12_345)
    found = slave.number(HEARTBEAT_TIME)
    require(found == 12_345, str(found))
    return str(found)


def sdo_unknown_command(slave: Slave) -> str:
    return require_abort(lambda: slave.ask(b"\xe0", None), UNKNOWN_COMMAND)


def sdo_segment_without_a_transfer(slave: Slave) -> str:
    return require_abort(lambda: slave.ask(b"\x60", None), UNKNOWN_COMMAND)


def _segmented(slave: Slave) -> int:
    """Return the index of a variable with more than seven bytes. Raises Skipped."""
    for index in (_DEVICE_NAME, 0x1009, 0x100A, _EDS_OBJECT):
        if slave.has(index) and len(slave.read(index)) > 7:
            return index
    raise Skipped("the slave has no text that needs a segmented upload")


def sdo_segmented_upload(slave: Slave) -> str:
    index = _segmented(slave)
    where = multiplexer(index, 0)
    data = slave.read(index)
    begin = slave.ask(b"\x40" + where, where)
    require(begin[0] & 0xFE == 0x40, f"command specifier {begin[0]:02X}h")
    announced = int.from_bytes(begin[4:], "little")
    slave.send_request(b"\x80" + where + bytes(4))
    if begin[0] & 1:
        require(announced == len(data), f"{announced} announced, {len(data)} received")
    return f"{len(data)} bytes"


def sdo_toggle_bit(slave: Slave) -> str:
    index = _segmented(slave)
    where = multiplexer(index, 0)
    slave.ask(b"\x40" + where, where)
    return require_abort(lambda: slave.ask(b"\x70", where), TOGGLE)


def sdo_abort_by_the_client(slave: Slave) -> str:
    index = _segmented(slave)
    where = multiplexer(index, 0)
    slave.ask(b"\x40" + where, where)
    slave.send_request(b"\x80" + where + b"\0\0\0\x08")
    answers = slave.answers_until_answer()
    require(not answers, "the abort was answered")
    return "only the upload was answered"


def sdo_new_transfer_replaces_the_old_one(slave: Slave) -> str:
    index = _segmented(slave)
    where = multiplexer(index, 0)
    slave.ask(b"\x40" + where, where)
    slave.read(0x1000)
    return "it was answered"


def sdo_segmented_download(slave: Slave) -> str:
    where = multiplexer(HEARTBEAT_TIME, 0)
    slave.ask(b"\x21" + where + b"\2\0\0\0", where)
    answer = slave.ask(b"\x0b" + (4321).to_bytes(2, "little"), where)
    require(answer[0] == 0x20, f"command specifier {answer[0]:02X}h")
    found = slave.number(HEARTBEAT_TIME)
    require(found == 4321, str(found))
    return str(found)


def sdo_block_upload(slave: Slave) -> str:
    index = _segmented(slave)
    where = multiplexer(index, 0)
    plain = slave.read(index)
    try:
        begin = slave.ask(b"\xa4" + where + b"\x7f", where)
    except AbortedTransfer as abort:
        if abort.code in (UNKNOWN_COMMAND, UNSUPPORTED_ACCESS):
            raise Skipped(f"no block transfer ({abort})") from None
        raise
    require(begin[0] & 0xF9 == 0xC0, f"command specifier {begin[0]:02X}h instead of a block upload")
    data = b""
    slave.send_request(b"\xa3")
    while True:
        number = 0
        while number < 0x7F:
            part = slave.wait_for(slave.is_answer).data
            number += 1
            require(part[0] & 0x7F == number, f"segment {part[0] & 0x7F} instead of {number}")
            data += part[1:]
            if part[0] & 0x80:
                break
        confirmation = bytes((0xA2, number, 0x7F))
        if part[0] & 0x80:
            break
        slave.send_request(confirmation)
    end = slave.ask(confirmation, where)
    require(end[0] & 0xE3 == 0xC1, f"command specifier {end[0]:02X}h at the end")
    unused = end[0] >> 2 & 7
    data = data[: len(data) - unused]
    slave.send_request(b"\xa1")
    require(data == plain, f"{len(data)} bytes, which differ from the segmented upload")
    if begin[0] & 4:
        crc = int.from_bytes(end[1:3], "little")
        computed = crc_hqx(data, 0)  # polynomial 1021h, start value 0 (CiA 301, 7.2.4.3.16)
        require(crc == computed, f"CRC {crc:04X}h instead of {computed:04X}h")
    return f"{len(data)} equal bytes" + (", CRC right" if begin[0] & 4 else ", without CRC")


def sdo_short_request(slave: Slave) -> str:
    whole = b"\x40" + multiplexer(0x1001, 0) + bytes(3)
    for size in range(8):
        slave.send(0x600 + slave.node_id, whole[:size])
    answers = slave.answers_until_answer()
    good = [frame for frame in answers if frame.data[:1] == b"\x80"]
    require(answers == good, f"{len(answers) - len(good)} were answered like whole requests")
    return f"{len(good)} aborts, {8 - len(good)} ignored, the upload was answered"


def sdo_extended_frame_is_ignored(slave: Slave) -> str:
    request = b"\x40" + multiplexer(0x1001, 0) + bytes(4)
    slave.send(0x600 + slave.node_id, request, extended=True)
    answers = slave.answers_until_answer()
    require(not answers, "it was answered")
    return "no answer"
