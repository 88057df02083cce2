"""Storing and restoring parameters: CiA 301, objects 1010h and 1011h."""

from kontronik_can_gw.desk.conformance.items import Skipped, require, require_abort
from kontronik_can_gw.desk.conformance.nmt_items import (
    HEARTBEAT_TIME,
    RESET_NODE,
)
from kontronik_can_gw.desk.conformance.slave import Slave

_STORE = 0x1010
_RESTORE = 0x1011
_WRONG_SIGNATURE = (0x08000020, 0x08000021, 0x08000022)


def _require_store(slave: Slave) -> int:
    """Return 1010h:1. Skips the item if the slave states that it does not store."""
    value = slave.number(_STORE, 1)
    if value == 0:
        raise Skipped("1010h:1 is 0: the slave stores nothing, for example on a read-only disk")
    return value


def store_capability(slave: Slave) -> str:
    value = _require_store(slave)
    require(value & 3 != 0 and value < 4, f"{value:08X}h")
    return f"{value:08X}h"


def store_wrong_signature(slave: Slave) -> str:
    return require_abort(lambda: slave.write(_STORE, 1, b"SAVE"), *_WRONG_SIGNATURE)


def restore_wrong_signature(slave: Slave) -> str:
    return require_abort(lambda: slave.write(_RESTORE, 1, b"LOAD"), *_WRONG_SIGNATURE)


def store_and_restore(slave: Slave) -> str:
    _require_store(slave)
    variable = slave.variable(HEARTBEAT_TIME)
    slave.write_number(HEARTBEAT_TIME, 0, 777)
    slave.write(_STORE, 1, b"save")
    slave.restart(RESET_NODE)
    stored = slave.number(HEARTBEAT_TIME)
    slave.write(_RESTORE, 1, b"load")
    slave.restart(RESET_NODE)
    restored = slave.number(HEARTBEAT_TIME)
    require(stored == 777, f"{stored} ms after save")
    default = None if variable is None else variable.default
    is_restored = restored != stored if default is None else restored == default
    require(is_restored, f"{restored} ms after load")
    return f"{stored} ms, {restored} ms"
