"""The shipped DBC keeps every rule of a DBC that every tool reads, field by field of the sheet."""

from decimal import Decimal
from pathlib import Path

import pytest
from dbc_rules import findings, parse
from esc import sheet
from packer_oracle import pascal

SHIPPED = Path(__file__).parents[2] / "dbc" / "kontronik_esc.dbc"
DATA = SHIPPED.read_bytes()


def test_the_shipped_dbc_keeps_the_rules() -> None:
    assert findings(DATA) == []


FIELDS = [
    field
    for field in (*sheet.LIVE_FIELDS, *sheet.INFO_FIELDS)
    if not field.name.endswith(("_errors", "_state", "_variant", "_word"))
]


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: field.name)
def test_a_field_of_the_sheet_fits_its_signal_step_by_step(field: sheet.Field) -> None:
    name = pascal(field.name) + ("Percent" if field.unit == "%" else "")
    found = next(signal for signal in parse(DATA).signals if signal.name == name)
    step = Decimal(1) / field.steps
    assert found.unit == field.unit.replace("µ", "u").replace("°", "deg")
    assert (found.factor, found.offset) == (step, Decimal(0))
    codes = 2 if found.signed else 0
    low, high = sheet.TYPE_RANGES[field.code]
    if field.code == "I":
        high = 1_000_000  # no motor turns faster
    low, high = sheet.STATED_RANGES.get(field.name, (low + codes, high - 2 + codes))
    assert found.minimum <= low * step
    assert high * step <= found.maximum
