"""Layer setting services: CiA 305."""

from kontronik_can_gw.desk.conformance.eds_file import section_of
from kontronik_can_gw.desk.conformance.items import Skipped, Wrong, require
from kontronik_can_gw.desk.conformance.nmt_items import RESET_COMMUNICATION, RESET_NODE
from kontronik_can_gw.desk.conformance.slave import RESET_S, NoAnswer, ReceivedFrame, Slave

_TO_SLAVE = 0x7E5
_FROM_SLAVE = 0x7E4
_SWITCH_GLOBAL = 0x04
_CONFIGURE_NODE_ID = 0x11
_CONFIGURE_BIT_TIMING = 0x13
_STORE = 0x17
_SWITCH_SELECTIVE = 0x40
_SELECTED = 0x44
_IDENTIFY = 0x46
_IDENTIFIED = 0x4F
_FASTSCAN = 0x51
_INQUIRE = 0x5A
_INQUIRE_NODE_ID = 0x5E
_WAITING = 0
_CONFIGURATION = 1
_UNCONFIGURED = 0xFF


def require_lss(slave: Slave) -> None:
    """Raise Skipped if the slave has no LSS, or if LSS would also reach other slaves."""
    if not section_of(slave.eds, "DeviceInfo").number("LSS_Supported"):
        raise Skipped("LSS_Supported=0 in the EDS")
    if slave.other_nodes:
        others = ", ".join(map(str, sorted(slave.other_nodes)))
        raise Skipped(f"other nodes are on the bus: {others}")


def _send(slave: Slave, command: int, data: bytes = b"") -> None:
    slave.send(_TO_SLAVE, bytes((command,)) + data.ljust(7, b"\0"))


def _switch(slave: Slave, mode: int) -> None:
    _send(slave, _SWITCH_GLOBAL, bytes((mode,)))


def _ask(slave: Slave, command: int, data: bytes = b"") -> bytes:
    _send(slave, command, data)
    return _answer(slave).data


def _answer(slave: Slave) -> ReceivedFrame:
    return slave.wait_for(lambda frame: frame.can_id == _FROM_SLAVE)


def _answers_until_sdo(slave: Slave) -> list[ReceivedFrame]:
    return [frame for frame in slave.frames_until_answer() if frame.can_id == _FROM_SLAVE]


def _identity(slave: Slave) -> list[int]:
    return [slave.number(0x1018, sub) for sub in range(1, 5)]


def _bytes(value: int) -> bytes:
    return value.to_bytes(4, "little")


def lss_switch_global(slave: Slave) -> str:
    _switch(slave, _CONFIGURATION)
    answers = _answers_until_sdo(slave)
    _switch(slave, _WAITING)
    require(not answers, "it was answered")
    return "no answer"


def lss_inquire_identity(slave: Slave) -> str:
    identity = _identity(slave)
    _switch(slave, _CONFIGURATION)
    for number, expected in enumerate(identity):
        answer = _ask(slave, _INQUIRE + number)
        require(answer[0] == _INQUIRE + number, f"answer {answer.hex(' ').upper()}")
        found = int.from_bytes(answer[1:5], "little")
        require(found == expected, f"{found:08X}h instead of {expected:08X}h")
    _switch(slave, _WAITING)
    return ", ".join(f"{value:08X}h" for value in identity)


def lss_inquire_node_id(slave: Slave) -> str:
    _switch(slave, _CONFIGURATION)
    answer = _ask(slave, _INQUIRE_NODE_ID)
    _switch(slave, _WAITING)
    require(answer[:2] == bytes((_INQUIRE_NODE_ID, slave.node_id)), answer.hex(" ").upper())
    return str(answer[1])


def lss_silent_while_waiting(slave: Slave) -> str:
    _send(slave, _INQUIRE_NODE_ID)
    require(not _answers_until_sdo(slave), "it was answered")
    return "no answer"


def _select(slave: Slave, identity: list[int]) -> None:
    for number, value in enumerate(identity):
        _send(slave, _SWITCH_SELECTIVE + number, _bytes(value))


def lss_switch_selective(slave: Slave) -> str:
    identity = _identity(slave)
    _select(slave, identity)
    answer = _answer(slave).data
    _switch(slave, _WAITING)
    require(answer[0] == _SELECTED, answer.hex(" ").upper())
    return "44h"


def lss_switch_selective_of_another_slave(slave: Slave) -> str:
    identity = _identity(slave)
    identity[3] ^= 1
    _select(slave, identity)
    _send(slave, _INQUIRE_NODE_ID)
    require(not _answers_until_sdo(slave), "it was answered")
    return "no answer"


def lss_identify(slave: Slave) -> str:
    vendor, product, revision, serial = _identity(slave)

    def identify(low: int, high: int) -> None:
        values = (vendor, product, revision, revision, low, high)
        for number, value in enumerate(values):
            _send(slave, _IDENTIFY + number, _bytes(value))

    identify(max(serial - 1, 0), min(serial + 1, 0xFFFFFFFF))
    answer = _answer(slave).data
    require(answer[0] == _IDENTIFIED, answer.hex(" ").upper())
    other = serial + 1 if serial < 0xFFFFFFFF else serial - 1
    identify(other, other)
    require(not _answers_until_sdo(slave), "it was also answered out of the range")
    return "4Fh, no answer"


def lss_invalid_node_id(slave: Slave) -> str:
    _switch(slave, _CONFIGURATION)
    answers = [_ask(slave, _CONFIGURE_NODE_ID, bytes((number,))) for number in (0, 128)]
    _switch(slave, _WAITING)
    require(all(answer[1] == 1 for answer in answers), f"error codes {[a[1] for a in answers]}")
    return "error code 1 twice"


def lss_invalid_bit_timing(slave: Slave) -> str:
    _switch(slave, _CONFIGURATION)
    answer = _ask(slave, _CONFIGURE_BIT_TIMING, bytes((0, 200)))
    _switch(slave, _WAITING)
    is_right = answer[0] == _CONFIGURE_BIT_TIMING and answer[1] != 0
    require(is_right, answer.hex(" ").upper())
    return f"error code {answer[1]}"


def lss_configure_node_id(slave: Slave) -> str:
    old = slave.node_id
    new = old % 0x7F + 1
    for number in (new, old):
        _switch(slave, _CONFIGURATION)
        answer = _ask(slave, _CONFIGURE_NODE_ID, bytes((number,)))
        require(answer[1] == 0, f"error code {answer[1]}")
        _switch(slave, _WAITING)
        slave.nmt(RESET_COMMUNICATION)
        slave.node_id = number
        try:
            slave.wait_for(lambda f: f.can_id == slave.heartbeat_id and f.data == b"\0")
        except NoAnswer:
            slave.node_id = old
            raise Wrong(f"no boot-up message of node {number}") from None
    slave.other_nodes.discard(new)
    return f"boot-up of node {new}, then of node {old}"


def lss_fastscan(slave: Slave) -> str:
    identity = _identity(slave)
    _switch(slave, _CONFIGURATION)
    answer = _ask(slave, _CONFIGURE_NODE_ID, bytes((_UNCONFIGURED,)))
    require(answer[1] == 0, f"error code {answer[1]}")
    _switch(slave, _WAITING)
    slave.nmt(RESET_COMMUNICATION)
    try:
        found = _scan(slave)
    finally:
        _give_back_node_id(slave)
    require(found == identity, ", ".join(f"{value:08X}h" for value in found))
    return "the identity of 1018h, then the boot-up message"


def _scan(slave: Slave) -> list[int]:
    """Return the identity that fastscan finds, bit by bit. The slave is in configuration then."""
    _begin_scan(slave)
    found = []
    for part in range(4):
        value = 0
        for bit in range(31, -1, -1):
            # the slave answers if its upper bits are these, with a 0 at this bit
            _send(slave, _FASTSCAN, _bytes(value) + bytes((bit, part, part)))
            if not _was_answered(slave):
                value |= 1 << bit
        _send(slave, _FASTSCAN, _bytes(value) + bytes((0, part, (part + 1) % 4)))
        require(_was_answered(slave), f"part {part + 1}: no answer to the whole number")
        found.append(value)
    return found


def _begin_scan(slave: Slave) -> None:
    """Send the first step of fastscan until it is answered.

    An unconfigured slave sends no boot-up message, so the end of its reset is not visible.
    """
    slave.frames_during(RESET_S)
    until_s = slave.clock() + slave.limit_s
    while slave.clock() < until_s:
        _send(slave, _FASTSCAN, bytes(4) + b"\x80")
        if _was_answered(slave):
            return
    raise Wrong("no slave answers to fastscan")


def _was_answered(slave: Slave) -> bool:
    """Return True if the slave answers to a step of fastscan.

    An unconfigured slave answers no SDO request, so the answer can only be waited for.
    """
    try:
        answer = slave.wait_for(lambda frame: frame.can_id == _FROM_SLAVE, slave.limit_s / 10)
    except NoAnswer:
        return False
    require(answer.data[0] == _IDENTIFIED, f"answer {answer.data.hex(' ').upper()}")
    return True


def _give_back_node_id(slave: Slave) -> None:
    _switch(slave, _CONFIGURATION)
    answer = _ask(slave, _CONFIGURE_NODE_ID, bytes((slave.node_id,)))
    require(answer[1] == 0, f"error code {answer[1]} for the old node-ID")
    slave.waiting_frames()
    _switch(slave, _WAITING)
    try:
        slave.wait_for(lambda f: f.can_id == slave.heartbeat_id and f.data == b"\0")
    except NoAnswer:
        slave.restart(RESET_NODE)
        raise Wrong("no boot-up message after the node-ID was configured") from None


def lss_store(slave: Slave) -> str:
    """Require that the slave confirms the service.

    A reset does not show whether a node-ID is stored, because the slave may keep it in its RAM.
    """
    _switch(slave, _CONFIGURATION)
    answer = _ask(slave, _STORE)
    _switch(slave, _WAITING)
    require(answer[0] == _STORE and answer[1] in (0, 1), answer.hex(" ").upper())
    return "cannot store (error code 1)" if answer[1] else "confirmed (error code 0)"
