"""Kinds of a capture's entries. The C sources get their numbers from here, too."""

from enum import IntEnum


class EntryKind(IntEnum):
    """Kinds of entries. The data of an entry is described in brackets."""

    BYTES = 1
    """Bytes read from an ESC's UART."""
    FRAME = 2
    """A CAN frame that the gateway received (``capture/format.py``, ``frame_data``)."""
    ADVANCE = 3
    """The time advanced. Then the frames to send were taken."""
    START = 4
    """The gateway started. flags 1: the interface was open."""
    STOP = 5
    PORT_OPENED = 6
    PORT_LOST = 7
    CAN_OPENED = 8
    CAN_RETURNED = 9
    CAN_STATE = 10
    """flags: the state (``status.CanState``)."""
    OVERRUN = 11
    SAVED = 12
    """Parameters were stored. flags 1: storing failed (the reason in UTF-8)."""
    DAMAGED = 13
    COUNTERS = 14
    """The runtime changed the gateway's counters (``capture/format.py``, ``RECORDED_COUNTERS``)."""
    LINE_ERRORS = 15
    """The total number of line errors of an ESC's port (u64)."""
    CLOCK = 16
    """The wall clock at this time: Unix time in ns (u64).

    flags: 1 synchronised, 2 not synchronised, 0 unknown, also in captures before 0.6.
    """
    LOST = 17
    """Number of entries that could not be recorded here (u64)."""
    NOT_SENT = 18
    """The frames taken last were discarded, because the interface was down or bus-off."""
    STATE = 19
    """The state with which a replay can begin here (JSON).

    It has energy, run time and losses of the ESCs, and the state of the bus.
    """
    HELD_UP = 20
    """The process was delayed. flags 1: pending measurements were dropped."""
    HOLD = 21
    """No frame leaves the interface. Frames are held, and those of outputs were discarded.

    flags 1: the outputs make no frames except answers, as since the gate to the bus.
    """
    FIRST_FRAME = 22
    """While frames are held, one frame without measurements was sent."""
    RELEASE = 23
    """That frame has left the interface, and the others are sent again."""
    LIMIT = 24
    """flags 1: the bus is slow, so frames are taken by TAKE only. flags 0: it is not.

    flags 3: measurements that waited were also discarded.
    """
    TAKE = 25
    """The frames of outputs and the oldest messages were taken (``flags``: how many)."""


def entries_header() -> str:
    """Return entries.h, which has the number of each kind for the C sources."""
    names = ",\n".join(f"    KCG_ENTRY_{kind.name} = {kind.value}" for kind in EntryKind)
    return (
        "/* Generated from kontronik_can_gw/entry_kinds.py. */\n"
        "#ifndef KCG_ENTRIES_H\n#define KCG_ENTRIES_H\n"
        f"enum {{\n{names}\n}};\n#endif\n"
    )
