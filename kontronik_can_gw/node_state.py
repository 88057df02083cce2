"""What others show of a CANopen node: its NMT state, and the node-ID of one that has none. Importing it loads nothing of `canopen/`."""

from enum import IntEnum

UNCONFIGURED = 0xFF
"""The node-ID of a node that has none."""


class NmtState(IntEnum):
    """As heartbeats report it. ``INITIALISING`` is also that of a node without a node-ID: LSS only."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127
