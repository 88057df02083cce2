"""What only one gateway may have on a CAN interface: its node-IDs and the ids of its messages."""

import logging

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import ids_in_words
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.runtime.fault_log import FaultLog
from kontronik_can_gw.runtime.locks import Locks


def names_of(gateway: Gateway, channel: str) -> list[str]:
    """The names of the locks on the ids that a gateway has now."""
    conflicts = gateway.conflicts
    names = [
        f"CANopen node {node_id}"
        for node_id, _, _ in gateway.node_states()
        if node_id != UNCONFIGURED
    ]
    if (first := conflicts.first_own_id()) is not None:
        names.append(f"messages from {first:X}h on")
    names += [ids_in_words(block) for block in conflicts.own_blocks()]
    return [f"{channel}: {name}" for name in names]


def in_use(name: str) -> RunError:
    """What is said of a lock that another gateway has."""
    return RunError(
        f"CAN {name}: another gateway on this machine sends this. End it, or change node-ID or dbc.base_id."
    )


class IdLocks:
    """The locks on the ids of a gateway. A virtual interface is in this process only: it needs none."""

    def __init__(self, config: CanConfig, gateway: Gateway, conditions: FaultLog) -> None:
        self._config = config
        self._gateway = gateway
        self._conditions = conditions
        self._locks = Locks(report=lambda text: conditions.say(logging.WARNING, text))
        self._names: list[str] = []

    def lock(self, at_start: bool = False) -> None:
        """Lock what the gateway has now. RunError ``at_start`` where another gateway has it; later that is logged, and tried again."""
        if self._config.interface == "virtual":
            return
        names = names_of(self._gateway, self._config.channel)
        if names == self._names:
            return
        all_taken = self._locks.hold(names)
        self._names = [] if all_taken else names
        for taken in all_taken:
            if at_start:
                raise in_use(taken)
            self._conditions.say(logging.ERROR, str(in_use(taken)))

    def close(self) -> None:
        """Release them."""
        self._locks.close()
