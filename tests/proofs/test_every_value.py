"""Every raw value of every field gives the CAN frames that the sheet and the DBC's text demand.

The core in C runs as a whole: bytes in, frames out. The expected values are computed with exact
fractions, by code that shares nothing with the gateway (sheet.py, every_value.c).
"""

from pathlib import Path

import sheet
from every_value import compare_values

WHOLE = 30
"""Fields of which all values are sent. The others have 32 bits."""


def test_every_value_of_each_field_is_sent_as_the_sheet_and_the_dbc_demand(tmp_path: Path) -> None:
    """In three scenes: V4, legacy with a JIVEPro, and an ESC that sends no information."""
    small = [field for field in sheet.FIELDS if field.bits < 32]
    large = [field for field in sheet.FIELDS if field.bits == 32]
    assert len(small) == WHOLE
    least = sum(1 << field.bits for field in small) + (len(large) << 20)
    found = compare_values(tmp_path, "fields")
    assert found.values > 2 * sum(1 << field.bits for field in small) + (len(large) << 20)
    assert found.signals > least * len(sheet.sources())


def test_every_voltage_with_every_number_of_cells_is_divided_and_rounded_once(
    tmp_path: Path,
) -> None:
    assert compare_values(tmp_path, "cells").values == (256 << 16) + 1
