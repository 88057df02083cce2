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


def test_every_message_has_the_place_and_timing_that_its_readers_expect() -> None:
    db = parse(DATA)
    timing = {
        message.name: (
            message.id, message.dlc, db.send_type(message), db.number("GenMsgCycleTime", message),
            db.number("GenMsgDelayTime", message),
        )
        for message in db.messages
    }  # fmt: skip
    assert timing == {
        "EscStatus": (0x680, 8, "CyclicAndOnChange", 100, 10),
        "EscSpeed": (0x688, 8, "Event", 0, 5),
        "EscCurrent": (0x690, 8, "Event", 0, 5),
        "EscShaft": (0x698, 8, "Cyclic", 50, 5),
        "EscBec": (0x6A0, 8, "Cyclic", 100, 10),
        "EscEnergy": (0x6A8, 8, "Cyclic", 100, 10),
        "EscLink": (0x6B0, 8, "Cyclic", 100, 20),
        "EscInfo": (0x6B8, 8, "CyclicAndOnChange", 1000, 500),
        "EscExtremesA": (0x6C0, 8, "CyclicAndOnChange", 1000, 500),
        "EscExtremesB": (0x6C8, 8, "CyclicAndOnChange", 1000, 500),
        "EscExtremesC": (0x6D0, 8, "CyclicAndOnChange", 1000, 500),
        "GatewayStatus": (0x6D8, 8, "CyclicAndOnChange", 1000, 100),
        "GatewayTraffic": (0x6D9, 8, "Cyclic", 1000, 100),
    }


@pytest.mark.parametrize(("escs", "least", "most"), [(1, 0.05, 0.10), (8, 0.5, 0.8)])
def test_one_esc_loads_the_bus_below_ten_percent_and_eight_fit_on_it(
    escs: int, least: float, most: float
) -> None:
    """500 kbit/s, the worst case: 135 bits a frame, each change as often as its delay allows, events with 100 live frames a second."""
    db = parse(DATA)
    hertz = 0.0
    for message in db.messages:
        cycle, delay = db.number("GenMsgCycleTime", message), db.number("GenMsgDelayTime", message)
        each = {"Event": 100.0, "Cyclic": 1000 / (cycle or 1), "CyclicAndOnChange": 1000 / delay}
        hertz += each[db.send_type(message)] * (escs if message.name.startswith("Esc") else 1)
    assert least < hertz * 135 / 500_000 < most
