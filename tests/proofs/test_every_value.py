"""Every raw value of every field gives the CAN frames that the specification and the DBC demand.

The core in C runs as a whole: bytes in, frames out. The expected frames are computed with exact
fractions, from tables that share nothing with the gateway (specification, every_value.c).
"""

from pathlib import Path

import pytest
from every_value import compare_values
from test_dbc_proof import EVERY_RULE, ONE_ESC

pytestmark = [
    pytest.mark.promise("true"),
    pytest.mark.usefixtures("c_compiler"),
]
QUIET = EVERY_RULE.replace("[can]", "[can]\nquiet_after_s = 60")
"""Two ESCs, multiplexed messages, a code amid values, messages on change, and quiet mode."""
PROTECTED = EVERY_RULE.replace("every_rule.dbc", "protected.dbc")
"""Messages with E2E profiles."""
SMALL = sum(1 << bits for bits in 12 * [8] + 18 * [16])
"""Values of the 30 fields with up to 16 bits."""


def configuration(folder: Path, text: str) -> Path:
    path = folder / "gateway.toml"
    path.write_text(text)
    return path


def test_every_value_of_each_field_is_sent_as_the_shipped_dbc_demands(tmp_path: Path) -> None:
    """In three scenes: V4, legacy with a JIVEPro, and an ESC that sends no information.

    2^20 values of each field with 32 bits.
    """
    found = compare_values(configuration(tmp_path, ONE_ESC), "fields", is_long=True)
    assert found.values > 2 * SMALL + (4 << 20)
    assert found.frames > 10 * found.values


@pytest.mark.parametrize(
    ("text", "least"), [(QUIET, 1_500_000), (PROTECTED, 200_000)], ids=["every rule", "E2E"]
)
def test_every_value_of_each_field_is_sent_as_another_dbc_demands(
    text: str, least: int, tmp_path: Path
) -> None:
    found = compare_values(configuration(tmp_path, text), "fields")
    assert found.values > least
    assert found.frames > 3 * found.values


@pytest.mark.promise("round-once")
def test_every_voltage_with_every_number_of_cells_is_divided_and_rounded_once(
    tmp_path: Path,
) -> None:
    path = configuration(tmp_path, ONE_ESC)
    assert compare_values(path, "cells").values == (256 << 16) + 1
