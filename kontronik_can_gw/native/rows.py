"""Rows of the core's tables, and the names of its counters and of the gateway's values (core.h)."""

import ctypes as c
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.header import KCG, enumeration, structure
from kontronik_can_gw.native.header import NotInCore as NotInCore
from kontronik_can_gw.signals.e2e import Protection

Piece = structure("kcg_piece")
Pair = structure("kcg_pair")
Signal = structure("kcg_signal")
Message = structure("kcg_message")
E2e = structure("kcg_e2e")
Settings = structure("kcg_settings")
SlotRow = structure("kcg_slot_row")
COUNTS = enumeration("KCG_N_BYTES", "KCG_N_")
"""Names of the arguments of kcg_count. From ``link_state`` on they are states and sums."""
GATEWAY = enumeration("KCG_ESCS_OK")[:-1]
"""Names of the values in kcg.gateway."""
WIRE_TYPES = {
    "B": KCG.U8,
    "b": KCG.I8,
    "H": KCG.U16,
    "h": KCG.I16,
    "I": KCG.U32,
}
"""Maps the struct code of a wire type to its number in wire.h."""
_MASK_BITS = 32
"""Number of bits of kcg_signal.negative_states."""
MAX_POLES = MAX_CELLS = 0xFF
MAX_GEAR = 0xF_FFFF
"""Limit of both parts of a gear in lowest terms. For example, 9.81818 is 490909/50000."""


class TableRows:
    """Rows of a table, stored one after the other in ``data`` as the core reads them.

    Thousands of objects would leave memory behind that is never returned to the system.
    """

    def __init__(self, kind: Any) -> None:
        self.data = bytearray()
        self._kind = kind
        self._size = c.sizeof(kind)

    def append(self, row: Any) -> None:
        self.data += row

    def __len__(self) -> int:
        return len(self.data) // self._size

    def __getitem__(self, place: int) -> Any:
        number = range(len(self))[place]
        return self._kind.from_buffer_copy(self.data, number * self._size)

    def __iter__(self) -> Iterator[Any]:
        return (self[place] for place in range(len(self)))


def e2e_row(protection: Protection) -> Any:
    """Return the numbers of a protected message. Those of a CRC of 8 bits are shifted."""
    profile = protection.profile
    shift = 16 - profile.crc_bits
    row = E2e(
        polynomial=profile.polynomial << shift,
        start=profile.start << shift,
        final_xor=profile.final_xor << shift,
        crc_bytes=profile.crc_bytes,
        id_bytes=profile.mode.id_bytes,
        is_id_last=int(profile.mode.is_id_last),
    )
    row.data_id[:] = protection.ids_by_counter
    return row


def bind_direction(
    row: Any,
    negative_in: tuple[int, frozenset[int]],
    places: list[tuple[int, int]],
) -> None:
    """Make a row of live data negative in some states.

    ``negative_in`` is the index of the word with the state, and these states. ``places`` has the
    offset and the wire type of each word. Raises NotInCore for a state without a bit.
    """
    word, states = negative_in
    if row.kind != KCG.OF_LIVE or max(states) >= _MASK_BITS or row.mask:
        raise NotInCore(f"a sign that depends on states up to {max(states)}")
    row.kind = KCG.OF_DIRECTED
    row.state_place = places[word][0]
    row.negative_states = sum(1 << state for state in states)


def settings_of(esc: EscSettings) -> Any:
    """Return the settings of an ESC for the core.

    Raises NotInCore beyond the limits within which all products of tables.py fit into int64.
    """
    numerator = esc.gear.numerator
    denominator = esc.gear.denominator
    if max(numerator, denominator) > MAX_GEAR:
        raise NotInCore(f"{esc.name}: gear {esc.gear} has a number above {MAX_GEAR}")
    if esc.pole_pairs > MAX_POLES or esc.cell_count > MAX_CELLS:
        raise NotInCore(
            f"{esc.name}: too many pole pairs ({esc.pole_pairs}) or cells ({esc.cell_count})"
        )
    return Settings(
        timeout=esc.timeout_ns,
        crc_errors=min(esc.crc_error_threshold, 0xFFFF_FFFF),
        poles=esc.pole_pairs,
        gear_numerator=numerator,
        gear_denominator=denominator,
        cells=esc.cell_count,
    )


def held_settings(esc: EscSettings) -> Any:
    """Return settings that were changed at run time, as ``settings_of`` does.

    A CANopen master can write settings beyond the limits to object 2100h. Then the speeds that they
    divide are not available.
    """
    has_too_many_poles = esc.pole_pairs > MAX_POLES
    has_too_fine_gear = max(esc.gear.numerator, esc.gear.denominator) > MAX_GEAR
    within_limits = replace(
        esc,
        pole_pairs=1 if has_too_many_poles else esc.pole_pairs,
        gear=Fraction(1) if has_too_fine_gear else esc.gear,
    )
    row = settings_of(within_limits)
    if has_too_many_poles:
        row.poles = 0
    if has_too_fine_gear:
        row.gear_numerator = 0
    return row
