"""Emergencies and the error history: CiA 301, 7.2.7.

The items provoke a communication error: a heartbeat that the slave monitors stays away.
"""

from kontronik_can_gw.desk.conformance.items import Skipped, Wrong, require, require_abort
from kontronik_can_gw.desk.conformance.nmt_items import (
    CONSUMER_HEARTBEAT_TIME,
    ENTER_PRE_OPERATIONAL,
    OPERATIONAL,
    PRE_OPERATIONAL,
    START,
    STATE_NAMES,
    STOP,
    STOPPED,
    next_state,
    observe_states,
    state_name,
)
from kontronik_can_gw.desk.conformance.sdo_items import VALUE_RANGE
from kontronik_can_gw.desk.conformance.slave import AbortedTransfer, NoAnswer, ReceivedFrame, Slave

_HISTORY = 0x1003
_ERROR_REGISTER = 0x1001
_COB_ID = 0x1014
_INHIBIT_TIME = 0x1015
_ERROR_BEHAVIOUR = 0x1029
_LOST_HEARTBEAT = 0x8130
_COMMUNICATION_ERROR = 1 << 4
"""Bit of the error register."""
_MONITORED_NODE = 0x7E
_MONITOR_MS = 100
_NO_DATA = (0x08000024, 0x08000000)


def _cob_id(slave: Slave) -> int:
    if slave.has(_COB_ID):
        return slave.number(_COB_ID) & 0x7FF
    return 0x80 + slave.node_id


def _monitor(slave: Slave) -> None:
    """Make the slave monitor a node that is not there. Raises Skipped if it cannot."""
    if not slave.has(CONSUMER_HEARTBEAT_TIME, 1):
        raise Skipped("the EDS does not have 1016h, so no emergency can be provoked")
    slave.write_number(CONSUMER_HEARTBEAT_TIME, 1, _MONITORED_NODE << 16 | _MONITOR_MS)


def _heartbeat_of_monitored_node(slave: Slave) -> None:
    slave.send(0x700 + _MONITORED_NODE, bytes((OPERATIONAL,)))


def _lose_heartbeat(slave: Slave) -> ReceivedFrame:
    """Provoke a lost heartbeat. Return the emergency."""
    cob_id = _cob_id(slave)
    _monitor(slave)
    _heartbeat_of_monitored_node(slave)
    try:
        return slave.wait_for(lambda f: f.can_id == cob_id and f.data[:2] != b"\0\0")
    except NoAnswer:
        raise Wrong("no emergency") from None


def _code(frame: ReceivedFrame) -> int:
    return int.from_bytes(frame.data[:2], "little")


def emcy_lost_heartbeat(slave: Slave) -> str:
    frame = _lose_heartbeat(slave)
    shown = frame.data.hex(" ").upper()
    require(len(frame.data) == 8, f"{len(frame.data)} bytes")
    require(_code(frame) == _LOST_HEARTBEAT, shown)
    register = slave.number(_ERROR_REGISTER)
    is_right = frame.data[2] == register and bool(register & _COMMUNICATION_ERROR)
    require(is_right, f"{shown}, and 1001h = {register:02X}h")
    return shown


def emcy_monitoring_begins_with_the_first_heartbeat(slave: Slave) -> str:
    cob_id = _cob_id(slave)
    _monitor(slave)
    frames = slave.frames_during(4 * _MONITOR_MS / 1000)
    seen = [f for f in frames if f.can_id == cob_id and _code(f) == _LOST_HEARTBEAT]
    require(not seen, "an emergency")
    return "no emergency"


def emcy_error_reset(slave: Slave) -> str:
    _lose_heartbeat(slave)
    cob_id = _cob_id(slave)
    until_s = slave.clock() + slave.limit_s
    while slave.clock() < until_s:
        _heartbeat_of_monitored_node(slave)
        frames = slave.frames_during(_MONITOR_MS / 4 / 1000)
        found = [f for f in frames if f.can_id == cob_id and _code(f) == 0]
        if found:
            is_cleared = not found[0].data[2] & _COMMUNICATION_ERROR
            shown = found[0].data.hex(" ").upper()
            require(is_cleared, f"{shown}: bit 4 of the error register is still 1")
            return shown
    raise Wrong("no emergency with code 0000h")


def emcy_history(slave: Slave) -> str:
    frame = _lose_heartbeat(slave)
    count = slave.number(_HISTORY, 0)
    require(count >= 1, "1003h:0 is 0")
    newest = slave.number(_HISTORY, 1)
    require(newest & 0xFFFF == _code(frame), f"1003h:1 = {newest:08X}h")
    return f"1003h:1 = {newest:08X}h"


def emcy_history_is_cleared(slave: Slave) -> str:
    _lose_heartbeat(slave)
    slave.write(_HISTORY, 0, b"\0")
    count = slave.number(_HISTORY, 0)
    require(count == 0, f"1003h:0 = {count}")
    return "1003h:0 = 0, 1003h:1: " + require_abort(lambda: slave.read(_HISTORY, 1), *_NO_DATA)


def emcy_history_cannot_be_set(slave: Slave) -> str:
    return require_abort(lambda: slave.write(_HISTORY, 0, b"\1"), VALUE_RANGE, 0x06090031)


def emcy_disabled(slave: Slave) -> str:
    cob_id = _cob_id(slave)
    try:
        slave.write_number(_COB_ID, 0, 1 << 31 | cob_id)
    except AbortedTransfer as abort:
        raise Skipped(f"1014h cannot be disabled ({abort})") from None
    _monitor(slave)
    _heartbeat_of_monitored_node(slave)
    frames = slave.frames_during(4 * _MONITOR_MS / 1000)
    seen = [frame for frame in frames if frame.can_id == cob_id]
    require(not seen, "an emergency")
    return "no emergency"


def emcy_cob_id_change_while_valid(slave: Slave) -> str:
    return require_abort(lambda: slave.write_number(_COB_ID, 0, 0x0F0))


def emcy_none_while_stopped(slave: Slave) -> str:
    cob_id = _cob_id(slave)
    _monitor(slave)
    _heartbeat_of_monitored_node(slave)
    slave.nmt(STOP)
    frames = slave.frames_during(4 * _MONITOR_MS / 1000)
    seen = [frame for frame in frames if frame.can_id == cob_id]
    slave.nmt(ENTER_PRE_OPERATIONAL)
    require(not seen, "an emergency")
    return "no emergency"


def emcy_error_behaviour(slave: Slave) -> str:
    seen = []
    for behaviour, expected in ((0, PRE_OPERATIONAL), (1, OPERATIONAL), (2, STOPPED)):
        slave.restart(0x82)
        slave.write_number(_ERROR_BEHAVIOUR, 1, behaviour)
        observe_states(slave)
        slave.nmt(START)
        if expected == STOPPED:  # no emergency while STOPPED
            _monitor(slave)
            _heartbeat_of_monitored_node(slave)
            slave.frames_during(4 * _MONITOR_MS / 1000)
        else:
            _lose_heartbeat(slave)
        found = next_state(slave)
        require(found == expected, f"{behaviour}: {state_name(found)}")
        seen.append(STATE_NAMES[found])
    return ", ".join(seen)


def emcy_inhibit_time(slave: Slave) -> str:
    slave.write_number(_INHIBIT_TIME, 0, 100)
    found = slave.number(_INHIBIT_TIME)
    require(found == 100, str(found))
    return "10 ms"
