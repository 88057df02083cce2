"""The object dictionary: CiA 301, 7.4.7 and 7.5.2, and its description in the EDS."""

from kontronik_can_gw.desk.conformance.items import require
from kontronik_can_gw.desk.conformance.sdo_items import (
    NO_OBJECT,
    is_number,
    is_readable,
    is_writable,
    name_of,
)
from kontronik_can_gw.desk.conformance.slave import AbortedTransfer, Slave, encoded

_NOT_NOW = (0x08000020, 0x08000021, 0x08000022, 0x08000024)
"""Abort codes of an object that exists, but whose value is not available at present."""
_SIGNATURES = (0x1010, 0x1011)
_HISTORY = 0x1003
_COMMUNICATION = range(0x1000, 0x2000)


def od_each_object_can_be_read(slave: Slave) -> str:
    read = 0
    not_now = 0
    wrong = []
    for variable in slave.variables():
        if not is_readable(variable):
            continue
        try:
            data = slave.read(variable.index, variable.subindex)
        except AbortedTransfer as abort:
            not_now += abort.code in _NOT_NOW
            if abort.code not in _NOT_NOW:
                wrong.append(f"{name_of(variable)}: {abort}")
            continue
        read += 1
        if is_number(variable) and 8 * len(data) != len(variable):
            wrong.append(f"{name_of(variable)}: {len(data)} bytes")
    require(not wrong, "; ".join(wrong[:4]))
    return f"{read} read, {not_now} without a value at present"


def od_values_are_the_defaults_of_the_eds(slave: Slave) -> str:
    compared = 0
    wrong = []
    for variable in slave.variables():
        is_parameter = variable.index in _COMMUNICATION and is_writable(variable)
        is_parameter = is_parameter and variable.index not in (*_SIGNATURES, _HISTORY)
        if not (is_parameter or variable.access_type == "const") or not is_number(variable):
            continue
        if variable.default is None or not is_readable(variable):
            continue
        compared += 1
        value = slave.read(variable.index, variable.subindex)
        if value != encoded(variable, variable.default):
            wrong.append(f"{name_of(variable)} = {value[::-1].hex().upper()}h")
    require(not wrong, "; ".join(wrong[:4]))
    return f"{compared} values are equal"


def od_highest_sub_index(slave: Slave) -> str:
    from canopen.objectdictionary import ODVariable

    compared = 0
    wrong = []
    for index in sorted(slave.dictionary):
        entry = slave.dictionary[index]
        is_variable_length = index == _HISTORY or 0x1600 <= index < 0x1800
        is_variable_length = is_variable_length or 0x1A00 <= index < 0x1C00
        if isinstance(entry, ODVariable) or is_variable_length:
            continue
        compared += 1
        highest = slave.number(index, 0)
        if highest != max(entry.subindices):
            wrong.append(f"{index:04X}h: {highest}")
    require(not wrong, "; ".join(wrong[:4]))
    return f"{compared} are right"


def od_no_communication_object_beyond_the_eds(slave: Slave) -> str:
    tried = 0
    wrong = []
    for index in _COMMUNICATION:
        if index in slave.dictionary:
            continue
        tried += 1
        try:
            slave.read(index)
            wrong.append(f"{index:04X}h exists")
        except AbortedTransfer as abort:
            if abort.code != NO_OBJECT:
                wrong.append(f"{index:04X}h: {abort}")
    require(not wrong, "; ".join(wrong[:4]))
    return f"{tried} aborts 06020000h"


def od_identity(slave: Slave) -> str:
    info = slave.dictionary.device_information
    known = {
        1: ("vendor-ID", info.vendor_number),
        2: ("product code", info.product_number),
        3: ("revision", info.revision_number),
    }
    seen = []
    for sub, (name, expected) in known.items():
        if not slave.has(0x1018, sub):
            continue
        value = slave.number(0x1018, sub)
        is_right = expected is None or value == expected
        require(is_right, f"{name} {value:08X}h instead of {expected or 0:08X}h")
        seen.append(f"{name} {value:08X}h")
    return ", ".join(seen)


def od_vendor_id_is_assigned(slave: Slave) -> str:
    value = slave.number(0x1018, 1)
    require(value != 0, "00000000h")
    return f"{value:08X}h"
