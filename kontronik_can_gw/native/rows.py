"""Rows of the tables of the core in C: the structures of core.h for ctypes. A number that does not fit is refused, never cut off."""

import ctypes as c
from typing import Any


class NotInCore(ValueError):
    """The core in C does not have this: the message in words."""


class _Row(c.Structure):
    """A row of a table. A number that its field cannot hold is NotInCore: ctypes would cut it off."""

    def __init__(self, *values: Any, **named: Any) -> None:
        super().__init__()
        for name, value in (
            *zip((field[0] for field in self._fields_), values, strict=False),
            *named.items(),
        ):
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if isinstance(value, int) and getattr(self, name) != value:
            raise NotInCore(f"{name} {value} does not fit")


def _structure(name: str, **types: Any) -> Any:
    return type(name, (_Row,), {"_fields_": list(types.items())})


_u8, _u16, _u32, _u64, _i64 = c.c_uint8, c.c_uint16, c.c_uint32, c.c_uint64, c.c_int64
Piece = _structure("Piece", shift=_u8, width=_u8, at=_u16)
Pair = _structure("Pair", number=_i64, raw=_u64)
Signal = _structure(
    "Signal", kind=_u8, wire=_u8, place=_u8, shift=_u8, flags=_u8, pieces=_u8, page=_u8, esc=_u8, mask=_u32, first_piece=_u32,
    first_pair=_u32, pairs=_u32, divisor=_u8, length=_u8, reserved=_u8 * 6, not_on=_u64, mul=_i64, add=_i64, div=_i64, most=_i64, low=_i64,
    high=_i64, error=_u64, not_available=_u64,
)  # fmt: skip
Message = _structure(
    "Message", id=_u32, length=_u8, words=_u8, flags=_u8, triggers=_u8, pages=_u8, crc_at=_u8, escs=_u8, fd_flags=_u8,
    first_signal=_u16, signals=_u16, data_id=_u16, first_page=_u16, last_alive=_u16, first_word=_u32, first_esc=_u32, cycle=_i64,
    delay=_i64, phase=_i64,
)  # fmt: skip
Settings = _structure(
    "Settings", timeout=_i64, crc_errors=_u32, poles=_u32, gear_numerator=_u32, gear_denominator=_u32, cells=_u8, reserved=_u8 * 7
)  # fmt: skip
COUNTS = (
    "bytes", "live_v4", "live_legacy", "info_v4", "info_legacy", "headers", "crc_errors", "unknown_kinds", "dropped_noise", "dropped_crc",
    "dropped_unknown_kind", "dropped_incomplete", "long_run_bytes", "losses", "late_frames", "suspect_frames",
    "link_state", "layout", "live_frames", "info_frames", "dropped_bytes",
)  # fmt: skip
"""Of kcg_esc.count, in its order; the last ones are states and sums."""
STORED_COUNTS = COUNTS.index("link_state")
GATEWAY = (
    "escs_ok", "gateway_state", "can_state", "esc_count", "sent_frames", "replaced_frames", "send_failures", "received_frames",
    "bus_off_count", "dropped_frames", "id_conflicts", "started_ns",
)  # fmt: skip
"""Of kcg.gateway, in its order."""
