"""Network management, slave side: states and commands (CiA 301, 7.2.8.2 and 7.3.2), objects 1029h and 1F80h."""

from collections.abc import Callable
from enum import IntEnum

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.dictionary import Dictionary
from kontronik_can_gw.node_state import NmtState

_SELF_START_OFF = 4


class Command(IntEnum):
    """Command specifiers of the NMT message."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


RESETS = (Command.RESET_NODE, Command.RESET_COMMUNICATION)
ALL_NODES = 0
"""The node-ID in a command to every node on the bus."""
STATE_AFTER = {
    Command.START: NmtState.OPERATIONAL,
    Command.STOP: NmtState.STOPPED,
    Command.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


def command(data: bytes, node_id: int) -> Command | None:
    """The command that an NMT message holds for this node: byte 0 command, byte 1 node-ID or ALL_NODES.

    None for commands to other nodes, unknown, or not exactly two bytes long.
    """
    if (
        len(data) != 2
        or data[1] not in (ALL_NODES, node_id)
        or data[0] not in Command._value2member_map_
    ):
        return None
    return Command(data[0])


class Nmt:
    """The state machine of one node. ``entered`` is called with the time after each change of state by ``enter``."""

    def __init__(
        self, dictionary: Dictionary, self_start: bool, entered: Callable[[int], None]
    ) -> None:
        self.state = NmtState.INITIALISING
        self._dictionary = dictionary
        self._self_start = self_start
        self._entered = entered
        dictionary.bind(0x1F80, check=_check_startup)

    @property
    def starts_itself(self) -> bool:
        """Whether the node enters OPERATIONAL without a command: bit 2 of 1F80h is 0."""
        otherwise = 0 if self._self_start else None
        return not self._dictionary.number(0x1F80, otherwise=otherwise) & _SELF_START_OFF

    @property
    def communicates(self) -> bool:
        """Whether SDO, SYNC and EMCY work: PRE-OPERATIONAL or OPERATIONAL."""
        return self.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)

    @property
    def boots_after_outage(self) -> bool:
        """1029h:1 = 0."""
        return self._dictionary.number(0x1029, 1) == 0

    def enter(self, state: NmtState, now: int) -> None:
        if state is not self.state:
            self.state = state
            self._entered(now)

    def behave(self, error: int, now: int) -> None:
        """Follow 1029h: sub-index 1 communication error, 2 telemetry lost. 0 PRE-OPERATIONAL (if OPERATIONAL), 1 no change, 2 STOPPED."""
        behaviour = self._dictionary.number(0x1029, error)
        if behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self.enter(NmtState.PRE_OPERATIONAL, now)
        elif behaviour == 2 and self.communicates:
            self.enter(NmtState.STOPPED, now)


def _check_startup(value: int) -> None:
    """A new 1F80h of a slave: only the bits about starting by itself (2) and starting others (3, without meaning here)."""
    if value & ~0x0C:
        raise SdoAbort(Abort.VALUE)
