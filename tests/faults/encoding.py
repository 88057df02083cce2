"""Telemetry that betrays itself: every field of frame n follows from n and the ESC by a fixed mixing function.

So whoever sees a value knows which frames may have carried it, and a value that is wrong, old or put together from two frames is
recognised. All values are inside the sheet's ranges and differ from the DBC's codes for "not available" and "error".
"""

import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[1]))

from esc import sheet

from kontronik_can_gw.esc.kontronik.codec import Layout
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, device_and_variant
from kontronik_can_gw.esc.kontronik.states import Device

_MASK = 0xFFFFFFFF
POLE_PAIRS = 7
GEAR = 9.8
PROGRAMMING_ALLOWED = 1 << 17
"""Set in every recorded idle frame, and no alarm."""


class Identity(NamedTuple):
    """Who is on the line: another ESC has another ``salt``, so that its values are different ones."""

    salt: int = 1
    layout: Layout = Layout.V4
    device: Device = Device.KOSMIK
    cells: int = 6
    alarms: bool = False
    """Let alarm bits come and go, a change each 128 frames."""


def mix(n: int, salt: int) -> int:
    """32 bits that depend on all bits of both."""
    x = (n * 0x9E3779B1 + salt * 0x85EBCA77 + 0x7F4A7C15) & _MASK
    x = ((x ^ x >> 16) * 0x21F0AAAD) & _MASK
    x = ((x ^ x >> 15) * 0x735A2D97) & _MASK
    return x ^ x >> 15


def live(identity: Identity, n: int) -> LiveData:
    """The live frame number n of an ESC."""
    a, b, c, d = (mix(n, identity.salt * 8 + i) for i in range(4))
    errors = PROGRAMMING_ALLOWED
    if identity.alarms and n >> 7 & 1:
        errors |= 1 << (n >> 8) % 12
    return LiveData(
        electrical_speed=10_000 + a % 200_000,
        battery_voltage=2_000 + b % 3_000,
        battery_current=-500 + (b >> 12) % 3_500,
        motor_current=-800 + c % 5_000,
        peak_current=(c >> 13) % 6_000,
        consumed_charge=n % 65_000,
        bec_current=100 + d % 5_000,
        bec_voltage=5_000 + (d >> 13) % 3_400,
        pwm_input=1_000 + (a >> 18) % 1_000,
        throttle=-100 + (a >> 8) % 201,
        output_opening=(b >> 24) % 101,
        power_stage_temperature=-20 + (c >> 3) % 120,
        bec_temperature=-20 + (d >> 5) % 120,
        operating_errors=errors,
        operating_state=18 + (d >> 24) % 9,
        timing=(a >> 4) % 250,
    )


def info(identity: Identity, m: int) -> InfoData:
    """The info frame number m of an ESC."""
    a, b, c = (mix(m, identity.salt * 8 + 4 + i) for i in range(3))
    return InfoData(
        device_and_variant=device_and_variant(identity.device, 100 + identity.salt % 900),
        firmware_word=(identity.salt % 250) << 8 | 14,
        selftest_errors=0,
        cell_count=identity.cells,
        max_electrical_speed=200_000 + a % 50_000,
        min_battery_voltage=1_000 + b % 1_000,
        max_battery_voltage=5_000 + (b >> 12) % 1_000,
        max_battery_current=c % 6_000,
        max_motor_current=(c >> 12) % 6_000,
        max_peak_current=m % 10_000,
        max_bec_current=1 + (a >> 12) % 6_000,
        min_bec_voltage=4_000 + (a >> 16) % 1_000,
        max_throttle=(b >> 20) % 101,
        max_output_opening=(b >> 24) % 101,
        min_power_stage_temperature=-30 + (c >> 20) % 10,
        max_power_stage_temperature=100 + (c >> 24) % 20,
        min_bec_temperature=-30 + (a >> 20) % 10,
        max_bec_temperature=100 + (a >> 24) % 20,
    )


def physical(data: Any, fields: Sequence[sheet.Field]) -> dict[str, float]:
    return {field.name: getattr(data, field.name) / field.steps for field in fields}


@lru_cache(1024)
def live_values(identity: Identity, n: int) -> dict[str, float]:
    """Physical values of a live frame by the names that the DBC's signals have in snake case, and its error bits as "flags"."""
    data = live(identity, n)
    values = physical(data, sheet.LIVE_FIELDS)
    speed, voltage = values["electrical_speed"], values["battery_voltage"]
    return {
        **values,
        "flags": data.operating_errors & 0xFFFFFF,
        "operating_state_raw": data.operating_state,
        "motor_speed": speed / POLE_PAIRS,
        "output_speed": speed / POLE_PAIRS / GEAR,
        "mean_cell_voltage": voltage / identity.cells,
        "battery_power": voltage * values["battery_current"],
    }


@lru_cache(1024)
def info_values(identity: Identity, m: int) -> dict[str, float]:
    """The same of an info frame."""
    data = info(identity, m)
    return {
        **physical(data, sheet.INFO_FIELDS),
        "flags": data.selftest_errors,
        "variant": data.device_and_variant & 1023,
        "firmware_main": data.firmware_word >> 8,
        "firmware_sub": data.firmware_word & 255,
        "device": data.device_and_variant >> 10,
        "device_raw": data.device_and_variant >> 10,
    }
