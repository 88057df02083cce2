"""Log lines about others on the bus that send with our ids."""

from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.id_conflicts import Conflict
from kontronik_can_gw.runtime.fault_log import FaultLog


def log_conflicts(gateway: Gateway, conditions: FaultLog, channel: str, now: int) -> None:
    """Log which conflicts have begun, and which are over."""
    for conflict in gateway.conflicts.take():
        _log(conflict, conditions, channel, now)


def _log(conflict: Conflict, conditions: FaultLog, channel: str, now: int) -> None:
    bits = "29-bit id" if conflict.is_extended else "id"
    which = f"CAN {channel}: {bits} {conflict.can_id:X}h"
    if conflict.over:
        conditions.end(
            which, f"{which}: nobody else sends with it", now, f"; {conflict.count} frames"
        )
        return
    remedy = (
        "Two nodes with one node-ID?"
        if conflict.node is not None
        else "Change one, as by dbc.base_id."
    )
    conditions.begin(
        which,
        f"{which}: somebody else sends with it too; here it is {conflict.whose}. {remedy}",
        now,
    )
