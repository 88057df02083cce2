"""The rows of the core's tables, and what it counts, by their names in core.h."""

import ctypes as c
from collections.abc import Iterator
from typing import Any

from kontronik_can_gw.native.header import NotInCore as NotInCore
from kontronik_can_gw.native.header import enumeration, structure

Piece, Pair = structure("kcg_piece"), structure("kcg_pair")
Signal, Message = structure("kcg_signal"), structure("kcg_message")
Settings = structure("kcg_settings")
COUNTS = enumeration("KCG_N_BYTES", "KCG_N_")
"""Of kcg_esc.count, in its order; the last ones, from ``link_state`` on, are states and sums."""
GATEWAY = enumeration("KCG_ESCS_OK")[:-1]
"""Of kcg.gateway, in its order."""


class Rows:
    """Rows of a table as the core has them, one after the other in ``data``: the memory of thousands of objects would not come back."""

    def __init__(self, kind: Any) -> None:
        self.data = bytearray()
        self._kind, self._size = kind, c.sizeof(kind)

    def append(self, row: Any) -> None:
        self.data += row

    def __len__(self) -> int:
        return len(self.data) // self._size

    def __getitem__(self, place: int) -> Any:
        return self._kind.from_buffer_copy(self.data, range(len(self))[place] * self._size)

    def __iter__(self) -> Iterator[Any]:
        return (self[place] for place in range(len(self)))
