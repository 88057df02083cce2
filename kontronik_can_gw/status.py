"""States that several rooms share: of the gateway, its CAN controller and its CANopen nodes.

Importing this module loads nothing of ``canopen/``.
"""

from dataclasses import dataclass, replace
from enum import IntEnum

UNCONFIGURED = 0xFF
"""The node-ID of an unconfigured node (CiA 305)."""


def name_in_words(name: str) -> str:
    """Return the name of a constant as people read it, such as "error-passive"."""
    return name.lower().replace("_", "-")


class GatewayState(IntEnum):
    STARTING = 0
    RUNNING = 1
    STOPPING = 2
    REPLAY = 3
    QUIET = 4
    """No ESC has been heard for the configured time. Only requests are answered."""


class CanState(IntEnum):
    UNKNOWN = 0
    ERROR_ACTIVE = 1
    ERROR_WARNING = 2
    ERROR_PASSIVE = 3
    BUS_OFF = 4
    DOWN = 5


class NmtState(IntEnum):
    """The NMT state in heartbeats (CiA 301).

    A node without a node-ID stays in ``INITIALISING`` and answers only LSS.
    """

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


COUNTERS = (
    "sent_frames",
    "replaced_frames",
    "send_failures",
    "received_frames",
    "bus_off_count",
    "dropped_frames",
    "id_conflicts",
    "can_restarts",
)
"""The counters of GatewayStatus. Each is a published value."""


@dataclass(slots=True)
class GatewayStatus:
    """The gateway's own state and its COUNTERS. The runtime writes those of the CAN interface."""

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
    """Frames in a fixed order that were lost: too many waited, or the interface was down."""
    id_conflicts: int = 0
    """Received frames with an id that only this gateway may use."""
    can_restarts: int = 0
    """Restarts of the CAN interface that were requested because no frame left it."""
    heard_ns: int = 0
    """Time of the last live data, or of the start. Only updated when all data have expired."""
    is_quiet: bool = False
    """True in quiet mode. The core writes this and ``heard_ns``."""

    def frozen(self) -> "GatewayStatus":
        """Return a copy, which other threads may read."""
        return replace(self)
