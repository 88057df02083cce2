"""States that several rooms share: of the gateway, its CAN controller and its CANopen nodes.

Importing this module loads nothing of ``canopen/``.
"""

from dataclasses import dataclass, replace
from enum import IntEnum

UNCONFIGURED = 0xFF
"""The node-ID of a node that has none."""


def name_in_words(name: str) -> str:
    """Return the name of a constant as people read it, such as "error-passive"."""
    return name.lower().replace("_", "-")


class GatewayState(IntEnum):
    STARTING = 0
    RUNNING = 1
    STOPPING = 2
    REPLAY = 3


class CanState(IntEnum):
    UNKNOWN = 0
    ERROR_ACTIVE = 1
    ERROR_WARNING = 2
    ERROR_PASSIVE = 3
    BUS_OFF = 4
    DOWN = 5


class NmtState(IntEnum):
    """As heartbeats report it. ``INITIALISING`` is also that of a node without a node-ID: LSS only."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


@dataclass(slots=True)
class GatewayStatus:
    """What the gateway knows of itself; the runtime writes the CAN side."""

    state: GatewayState = GatewayState.STARTING
    can_state: CanState = CanState.UNKNOWN
    esc_count: int = 0
    escs_ok: int = 0
    started_ns: int = 0
    sent_frames: int = 0
    replaced_frames: int = 0
    send_failures: int = 0
    received_frames: int = 0
    bus_off_count: int = 0
    dropped_frames: int = 0
    """Frames to be sent in order that were lost: too many waited, or the interface was down."""
    id_conflicts: int = 0
    """Frames of others with ids that only this gateway may send with."""

    def frozen(self) -> "GatewayStatus":
        """What is known now, as a copy that nobody changes: any thread may read it."""
        return replace(self)
