"""The table of recorded calls. Recording and replay follow from it.

Each call of the gateway that changes what it sends has a row. A call that is missing here would be
missing in a replay (``tests/capture/test_recorded_calls.py``).
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from kontronik_can_gw.capture.format import Entry, frame_data, read_frame
from kontronik_can_gw.entry_kinds import EntryKind
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gate_table import UNLIMITED
from kontronik_can_gw.status import CanState


class Recorded(NamedTuple):
    """The arguments of a call as the fields of an entry."""

    now: int
    esc: int = 0
    data: bytes = b""
    flags: int = 0
    came: int | None = None


class Encoding(NamedTuple):
    """Converts between the arguments of a call and an entry."""

    write: Callable[..., Recorded | None]
    """Maps the arguments to the fields of an entry. None: this call is not of this kind."""
    read: Callable[[Entry], tuple[Any, ...]]
    """Maps an entry to the arguments."""


class RecordedCall(NamedTuple):
    """A row of the table."""

    kind: EntryKind
    method: str
    """The name of the gateway's method."""
    encoding: Encoding
    takes_frames: bool = False
    """True if the frames to send are taken after the call."""
    follows_line_errors: bool = False
    """True if changed line errors of the ports are recorded before the call."""


def _write_port(esc: int, is_open: bool, now: int) -> Recorded | None:
    return Recorded(now, esc) if is_open else None


def _write_lost_port(esc: int, is_open: bool, now: int) -> Recorded | None:
    return None if is_open else Recorded(now, esc)


def _write_bytes(esc: int, data: bytes, now: int, since: int) -> Recorded:
    return Recorded(now, esc, data, came=since)


def _read_bytes(entry: Entry) -> tuple[int, bytes, int, int]:
    return entry.esc, entry.data, entry.time_ns, _arrival(entry)


def _write_frame(frame: CanFrame, now: int, at: int) -> Recorded:
    return Recorded(now, data=frame_data(frame), came=at)


def _read_frame(entry: Entry) -> tuple[CanFrame, int, int]:
    return read_frame(entry.data), entry.time_ns, _arrival(entry)


def _arrival(entry: Entry) -> int:
    return entry.time_ns if entry.came_ns is None else entry.came_ns


def _write_advance(now: int, with_core: bool = True) -> Recorded | None:
    return Recorded(now) if with_core else None  # iterations in C record their own calls


def _write_flag(now: int, flag: bool = True) -> Recorded:
    return Recorded(now, flags=int(flag))


def _write_state(state: CanState, now: int) -> Recorded:
    return Recorded(now, flags=int(state))


def _write_saved(esc: int, error: str | None, now: int) -> Recorded:
    has_failed = error is not None
    return Recorded(now, esc, (error or "").encode(), int(has_failed))


def _read_saved(entry: Entry) -> tuple[int, str | None, int]:
    error = entry.data.decode("utf-8", "replace") if entry.flags else None
    return entry.esc, error, entry.time_ns


def _write_hold(now: int, is_earlier: bool = False) -> Recorded:
    return Recorded(now, flags=int(not is_earlier))


def _write_limit(is_limited: bool, has_discarded: bool, now: int) -> Recorded:
    return Recorded(now, flags=is_limited | has_discarded << 1)


def _read_limit(entry: Entry) -> tuple[bool, bool, int]:
    return bool(entry.flags & 1), bool(entry.flags & 2), entry.time_ns


def _write_number(number: int, now: int) -> Recorded:
    return Recorded(now, flags=number)


_BYTES = Encoding(_write_bytes, _read_bytes)
_FRAME = Encoding(_write_frame, _read_frame)
_TIME = Encoding(Recorded, lambda entry: (entry.time_ns,))
_ADVANCE = Encoding(_write_advance, _TIME.read)
_FLAG = Encoding(_write_flag, lambda entry: (entry.time_ns, bool(entry.flags)))
_STATE = Encoding(_write_state, lambda entry: (CanState(entry.flags), entry.time_ns))
_ESC = Encoding(lambda esc, now: Recorded(now, esc), lambda entry: (entry.esc, entry.time_ns))
_PORT = Encoding(_write_port, lambda entry: (entry.esc, True, entry.time_ns))
_LOST_PORT = Encoding(_write_lost_port, lambda entry: (entry.esc, False, entry.time_ns))
_SAVED = Encoding(_write_saved, _read_saved)
_HOLD = Encoding(_write_hold, lambda entry: (entry.time_ns, not entry.flags))
_LIMIT = Encoding(_write_limit, _read_limit)
_TAKE = Encoding(_write_number, lambda entry: (min(entry.flags, UNLIMITED), entry.time_ns))

CALLS = (
    RecordedCall(EntryKind.BYTES, "receive_bytes", _BYTES),
    RecordedCall(EntryKind.FRAME, "receive_frame", _FRAME, follows_line_errors=True),
    RecordedCall(
        EntryKind.ADVANCE,
        "advance",
        _ADVANCE,
        takes_frames=True,
        follows_line_errors=True,
    ),
    RecordedCall(EntryKind.START, "start", _FLAG, takes_frames=True),
    RecordedCall(EntryKind.STOP, "stop", _TIME, takes_frames=True),
    RecordedCall(EntryKind.PORT_OPENED, "port", _PORT),
    RecordedCall(EntryKind.PORT_LOST, "port", _LOST_PORT),
    RecordedCall(EntryKind.CAN_OPENED, "can_opened", _TIME),
    RecordedCall(EntryKind.CAN_RETURNED, "can_returned", _TIME),
    RecordedCall(EntryKind.CAN_STATE, "set_can_state", _STATE),
    RecordedCall(EntryKind.OVERRUN, "receive_overrun", _TIME),
    RecordedCall(EntryKind.SAVED, "saved", _SAVED),
    RecordedCall(EntryKind.DAMAGED, "parameters_damaged", _ESC),
    RecordedCall(EntryKind.HELD_UP, "held_up", _FLAG),
    RecordedCall(EntryKind.HOLD, "hold", _HOLD),
    RecordedCall(EntryKind.FIRST_FRAME, "first_frame", _TIME),
    RecordedCall(EntryKind.RELEASE, "release", _TIME),
    RecordedCall(EntryKind.LIMIT, "limit", _LIMIT),
    RecordedCall(EntryKind.TAKE, "take_some", _TAKE),
)
CALL_OF = {call.kind: call for call in CALLS}
"""The row of each kind. The other kinds of entries are notes of the recorder."""


def calls_by_method() -> Iterator[tuple[str, list[RecordedCall]]]:
    """Yield each recorded method with its rows, of which one fits a call."""
    for method in dict.fromkeys(call.method for call in CALLS):
        yield method, [call for call in CALLS if call.method == method]
