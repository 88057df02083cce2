"""NMT, boot-up and heartbeat: CiA 301, 7.2.8 and 7.3.2."""

from kontronik_can_gw.desk.conformance.items import Skipped, require, require_abort
from kontronik_can_gw.desk.conformance.slave import ReceivedFrame, Slave

START = 0x01
STOP = 0x02
ENTER_PRE_OPERATIONAL = 0x80
RESET_NODE = 0x81
RESET_COMMUNICATION = 0x82
OPERATIONAL = 0x05
STOPPED = 0x04
PRE_OPERATIONAL = 0x7F
STATE_NAMES = {OPERATIONAL: "OPERATIONAL", STOPPED: "STOPPED", PRE_OPERATIONAL: "PRE-OPERATIONAL"}
HEARTBEAT_TIME = 0x1017
CONSUMER_HEARTBEAT_TIME = 0x1016
STARTUP = 0x1F80
_GUARD_TIME = 0x100C
_TEST_MS = 50
"""Heartbeat time while states are observed."""


def state_name(state: int) -> str:
    return STATE_NAMES.get(state, f"state {state:02X}h")


def observe_states(slave: Slave) -> None:
    """Make the slave send heartbeats, so that its state can be observed."""
    slave.write_number(HEARTBEAT_TIME, 0, _TEST_MS)


def next_state(slave: Slave) -> int:
    """Return the state in a heartbeat after a pause.

    Some slaves also send a heartbeat at each change of their state, so an earlier one may be old.
    """
    slave.frames_during(2 * _TEST_MS / 1000)
    frame = slave.wait_for(lambda frame: frame.can_id == slave.heartbeat_id)
    return frame.data[0] & 0x7F


def require_state(slave: Slave, state: int) -> str:
    """Return the name of the slave's state. Raises Wrong if it is another one."""
    found = next_state(slave)
    require(found == state, f"heartbeats report {state_name(found)}")
    return f"heartbeats report {state_name(found)}"


def _boot_up_answer(slave: Slave, frames: list[ReceivedFrame]) -> str:
    seen = [frame.data for frame in frames if frame.can_id == slave.heartbeat_id]
    boot_ups = [data for data in seen if data == b"\0"]
    answer = f"{len(boot_ups)} boot-up messages"
    require(len(boot_ups) == 1, answer)
    require(seen[0] == b"\0", f"a heartbeat {seen[0].hex()} before the boot-up message")
    return "one boot-up message"


def nmt_boot_up_after_reset_node(slave: Slave) -> str:
    return _boot_up_answer(slave, slave.restart(RESET_NODE))


def nmt_boot_up_after_reset_communication(slave: Slave) -> str:
    return _boot_up_answer(slave, slave.restart(RESET_COMMUNICATION))


def nmt_state_after_boot_up(slave: Slave) -> str:
    starts_itself = False
    if slave.has(STARTUP):
        starts_itself = slave.number(STARTUP) & 0x0C == 0x08
    slave.waiting_frames()
    slave.nmt(RESET_COMMUNICATION)
    slave.wait_for(lambda frame: frame.can_id == slave.heartbeat_id and frame.data == b"\0")
    observe_states(slave)
    found = next_state(slave)
    allowed = {PRE_OPERATIONAL, OPERATIONAL} if starts_itself else {PRE_OPERATIONAL}
    if slave.has(STARTUP) and slave.number(STARTUP) & 0x04 == 0:
        allowed = {OPERATIONAL}
    require(found in allowed, f"heartbeats report {state_name(found)}")
    return f"heartbeats report {state_name(found)}"


def nmt_start(slave: Slave) -> str:
    observe_states(slave)
    slave.nmt(START)
    return require_state(slave, OPERATIONAL)


def nmt_stop(slave: Slave) -> str:
    observe_states(slave)
    slave.nmt(STOP)
    return require_state(slave, STOPPED)


def nmt_enter_pre_operational(slave: Slave) -> str:
    observe_states(slave)
    answer = ""
    for before in (START, STOP):
        slave.nmt(before)
        slave.nmt(ENTER_PRE_OPERATIONAL)
        answer = require_state(slave, PRE_OPERATIONAL)
    return answer


def nmt_broadcast(slave: Slave) -> str:
    observe_states(slave)
    slave.nmt(START, 0)
    return require_state(slave, OPERATIONAL)


def nmt_other_node_is_ignored(slave: Slave) -> str:
    observe_states(slave)
    slave.nmt(START, slave.node_id % 0x7F + 1)
    return require_state(slave, PRE_OPERATIONAL)


def nmt_unknown_command_is_ignored(slave: Slave) -> str:
    observe_states(slave)
    slave.nmt(0x42)
    return require_state(slave, PRE_OPERATIONAL)


def nmt_wrong_length_is_ignored(slave: Slave) -> str:
    observe_states(slave)
    command = bytes((START, slave.node_id))
    for data in (command[:1], command + b"\0", command.ljust(8, b"\0")):
        slave.send(0, data)
    return require_state(slave, PRE_OPERATIONAL)


def nmt_extended_frame_is_ignored(slave: Slave) -> str:
    observe_states(slave)
    slave.send(0, bytes((START, slave.node_id)), extended=True)
    return require_state(slave, PRE_OPERATIONAL)


def nmt_no_sdo_while_stopped(slave: Slave) -> str:
    slave.nmt(STOP)
    slave.send_request(b"\x40\x01\x10\x00")
    slave.nmt(ENTER_PRE_OPERATIONAL)
    answers = slave.answers_until_answer()
    require(not answers, "it answered")
    return "no answer"


def nmt_sdo_in_operational(slave: Slave) -> str:
    slave.nmt(START)
    slave.read(0x1000)
    return "an answer"


def nmt_reset_communication_restores_parameters(slave: Slave) -> str:
    before = slave.number(HEARTBEAT_TIME)
    slave.write_number(HEARTBEAT_TIME, 0, before + 77)
    slave.restart(RESET_COMMUNICATION)
    after = slave.number(HEARTBEAT_TIME)
    require(after == before, f"{after} ms instead of {before} ms")
    return f"{after} ms"


def nmt_node_guarding(slave: Slave) -> str:
    if slave.has(_GUARD_TIME):
        raise Skipped("the slave supports node guarding (100Ch)")
    if slave.has(HEARTBEAT_TIME):
        slave.write_number(HEARTBEAT_TIME, 0, 0)
    slave.send(slave.heartbeat_id, b"\0", remote=True)
    seen = [frame for frame in slave.frames_until_answer() if frame.can_id == slave.heartbeat_id]
    require(not seen, "it answered")
    return "no answer"


def heartbeat_period(slave: Slave) -> str:
    slave.write_number(HEARTBEAT_TIME, 0, 100)
    count = 20
    frames = [slave.wait_for(lambda f: f.can_id == slave.heartbeat_id) for _ in range(count + 1)]
    mean_ms = (frames[-1].time_s - frames[0].time_s) / count * 1000
    require(all(len(frame.data) == 1 for frame in frames), "a heartbeat with several bytes")
    require(80 <= mean_ms <= 120, f"every {mean_ms:.0f} ms")
    return f"every {mean_ms:.0f} ms"


def heartbeat_off(slave: Slave) -> str:
    observe_states(slave)
    slave.write_number(HEARTBEAT_TIME, 0, 0)
    frames = slave.frames_during(4 * _TEST_MS / 1000)
    seen = [frame for frame in frames if frame.can_id == slave.heartbeat_id]
    require(not seen, f"{len(seen)} heartbeats")
    return "no heartbeat"


def heartbeat_consumer_refuses_a_node_twice(slave: Slave) -> str:
    entry = (slave.node_id % 0x7F + 1) << 16 | 500
    slave.write_number(CONSUMER_HEARTBEAT_TIME, 1, entry)
    return require_abort(
        lambda: slave.write_number(CONSUMER_HEARTBEAT_TIME, 2, entry), 0x06040043, 0x06090030
    )
