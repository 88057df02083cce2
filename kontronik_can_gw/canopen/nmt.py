"""Network management, slave side: states and commands (CiA 301, 7.2.8.2 and 7.3.2)."""

from enum import IntEnum

COB_ID = 0


class NmtState(IntEnum):
    """As heartbeats tell it. ``INITIALISING`` is also that of a node without a node-ID: LSS only."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Command(IntEnum):
    """Command specifiers of the NMT message."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


STATE_AFTER = {
    Command.START: NmtState.OPERATIONAL,
    Command.STOP: NmtState.STOPPED,
    Command.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


def command(data: bytes, node_id: int) -> Command | None:
    """The command that an NMT message holds for this node: byte 0 command, byte 1 node-ID or 0 for all.

    None for what is meant for others, unknown, or not exactly two bytes long.
    """
    if len(data) != 2 or data[1] not in (0, node_id) or data[0] not in Command._value2member_map_:
        return None
    return Command(data[0])


def is_reset_of_all(data: bytes) -> bool:
    """True for a reset of every node on the bus."""
    return (
        len(data) == 2
        and data[1] == 0
        and data[0] in (Command.RESET_NODE, Command.RESET_COMMUNICATION)
    )
