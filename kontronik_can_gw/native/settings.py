"""What a person knows of an ESC, as the core in C takes it: within limits for which the products of tables.py stay within int64."""

from dataclasses import replace
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.rows import NotInCore, Settings

MAX_POLES = MAX_CELLS = 0xFF
MAX_GEAR = 0xF_FFFF
"""Of numerator and denominator of a gear in its lowest terms: 9.81818 has 490909 and 50000."""


def settings_of(esc: EscSettings) -> Any:
    """The settings of an ESC for the core. NotInCore where they are beyond its limits."""
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
