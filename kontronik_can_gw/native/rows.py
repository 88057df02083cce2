"""The rows of the core's tables, an ESC's settings as one of them, and what it counts, by their names in core.h."""

import ctypes as c
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.header import KCG, enumeration, structure
from kontronik_can_gw.native.header import NotInCore as NotInCore

Piece, Pair = structure("kcg_piece"), structure("kcg_pair")
Signal, Message = structure("kcg_signal"), structure("kcg_message")
Settings, SlotRow = structure("kcg_settings"), structure("kcg_slot_row")
COUNTS = enumeration("KCG_N_BYTES", "KCG_N_")
"""Of kcg_esc.count, in its order; the last ones, from ``link_state`` on, are states and sums."""
GATEWAY = enumeration("KCG_ESCS_OK")[:-1]
"""Of kcg.gateway, in its order."""
WIRE_TYPES = {"B": KCG.U8, "b": KCG.I8, "H": KCG.U16, "h": KCG.I16, "I": KCG.U32}
"""Maps the struct code of a wire type to its number in wire.h."""
_MASK_BITS = 32
"""Of kcg_signal.mask."""
MAX_POLES = MAX_CELLS = 0xFF
MAX_GEAR = 0xF_FFFF
"""Of numerator and denominator of a gear in its lowest terms: 9.81818 has 490909 and 50000."""


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


def bind_direction(
    row: Any, negative_in: tuple[int, frozenset[int]], places: list[tuple[int, int]]
) -> None:
    """Makes a row of live data negative in some states: the word of the state, and these states.

    ``places``: offset and wire type of each word. NotInCore for a state that has no bit.
    """
    word, states = negative_in
    if row.kind != KCG.OF_LIVE or max(states) >= _MASK_BITS or row.mask:
        raise NotInCore("a sign by a state of this number")
    row.kind = KCG.OF_DIRECTED
    row.state_place = places[word][0]
    row.negative_states = sum(1 << state for state in states)


def settings_of(esc: EscSettings) -> Any:
    """What a person knows of an ESC, for the core. NotInCore beyond the limits for which the products of tables.py stay within int64."""
    numerator, denominator = esc.gear.numerator, esc.gear.denominator
    if max(numerator, denominator) > MAX_GEAR:
        raise NotInCore(f"{esc.name}: gear {esc.gear}: parts above {MAX_GEAR}")
    if esc.pole_pairs > MAX_POLES or esc.cell_count > MAX_CELLS:
        raise NotInCore(f"{esc.name}: {esc.pole_pairs} pole pairs, {esc.cell_count} cells")
    timeout, errors = esc.timeout_ns, min(esc.crc_error_threshold, 0xFFFF_FFFF)
    return Settings(timeout, errors, esc.pole_pairs, numerator, denominator, esc.cell_count)


def held_settings(esc: EscSettings) -> Any:
    """As ``settings_of``, of settings that come later. Beyond the limits the speeds that they divide are not available."""
    poles = esc.pole_pairs if esc.pole_pairs <= MAX_POLES else 1
    is_held = max(esc.gear.numerator, esc.gear.denominator) <= MAX_GEAR
    row = settings_of(replace(esc, pole_pairs=poles, gear=esc.gear if is_held else Fraction(1)))
    if poles != esc.pole_pairs:
        row.poles = 0
    if not is_held:
        row.gear_numerator = 0
    return row
