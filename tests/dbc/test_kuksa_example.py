"""examples/kuksa: the CAN provider of KUKSA accepts the mapping, and it gives true values.

The provider is on no package index. kuksa_mapping.schema.json has the rules of its reader, and
``transformed`` the rules of its transformations. Formulas are computed by the provider's library.
"""

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cantools
import jsonschema
import pytest
from cantools.database.namedsignalvalue import NamedSignalValue

from kontronik_can_gw.config.keys import shipped

pytestmark = pytest.mark.promise("docs")

FOLDER = Path(__file__).resolve().parents[2] / "examples/kuksa"
SCHEMA = Path(__file__).with_name("kuksa_mapping.schema.json")
MAPPING = json.loads((FOLDER / "vss_dbc.json").read_text())
DATABASE: Any = cantools.database.load_file(shipped("dbc/kontronik_esc.dbc"))
VSS = {
    "Vehicle.Powertrain.ElectricMotor.Speed": ("int32", "rpm"),
    "Vehicle.Powertrain.TractionBattery.CurrentVoltage": ("float", "V"),
    "Vehicle.Powertrain.TractionBattery.CurrentCurrent": ("float", "A"),
    "Vehicle.Powertrain.TractionBattery.CurrentPower": ("float", "W"),
}
"""Names of VSS with data type and unit, as in releases 4.0 to 6.0 of the specification."""
PRIVATE = "Vehicle.Private.Esc."
UNITS = {"1/min": "rpm", "degC": "", "%": "percent", "mAh": "Ah", "Wh": "kWh"}
"""Names in VSS for units of the DBC. The name of degree Celsius differs between VSS 5 and 6."""
UNITS_OF_VSS = {
    "rpm": "rotational-speed",
    "V": "voltage",
    "A": "electric-current",
    "W": "power",
    "kWh": "work",
    "Ah": "electric-charge",
    "percent": "relation",
}
"""Units with the same name and quantity in releases 5.0 and 6.0 of VSS."""
OVERLAY = FOLDER / "esc.vspec"


def sensors(children: Any = MAPPING, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, node in children.items():
        if node["type"] == "branch":
            yield from sensors(node["children"], f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", node


SENSORS = dict(sensors())


@cache
def signal_of(name: str) -> tuple[Any, Any]:
    """Return a signal and its message. The name must be unique, as the provider requires."""
    found = [(s, m) for m in DATABASE.messages for s in m.signals if s.name == name]
    assert len(found) == 1, name
    return found[0]


def transformed(node: Any, value: Any) -> Any:
    """Return what the provider passes on for a decoded value. None means nothing."""
    expression = pytest.importorskip("py_expression_eval")
    transform = node["dbc2vss"]["transform"]
    for item in transform.get("mapping", ()):
        if item["from"] == value:
            return item["to"]
    if "math" not in transform:
        return None
    try:
        return expression.Parser().parse(transform["math"]).evaluate({"x": value})
    except Exception:
        return None


def decoded(name: str, raw: int) -> Any:
    """Return the value of a signal with this raw value, as cantools decodes it."""
    _, message = signal_of(name)
    values = {each.name: 0 for each in message.signals}
    data = message.encode({**values, name: raw}, scaling=False, strict=False)
    return message.decode(data)[name]


def test_mapping_is_as_the_provider_requires() -> None:
    schema = json.loads(SCHEMA.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(MAPPING)


def test_every_name_is_of_vss_or_private() -> None:
    public = {name: node for name, node in SENSORS.items() if not name.startswith(PRIVATE)}
    assert {name: (node["datatype"], node["unit"]) for name, node in public.items()} == VSS


def test_units_are_those_of_the_dbc() -> None:
    for name, node in SENSORS.items():
        signal, _ = signal_of(node["dbc2vss"]["signal"])
        unit = UNITS.get(signal.unit, signal.unit) or None
        assert node.get("unit") == unit, name
        assert unit is None or unit in UNITS_OF_VSS


def nodes(children: Any = MAPPING, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all nodes of the mapping with their full names, without their children."""
    for name, node in children.items():
        yield f"{prefix}{name}", {key: entry for key, entry in node.items() if key != "children"}
        yield from nodes(node.get("children", {}), f"{prefix}{name}.")


def test_overlay_has_the_nodes_of_the_mapping() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    assert yaml.safe_load(OVERLAY.read_text()) == dict(nodes())


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_codes_for_not_available_are_not_passed_on_as_numbers(name: str) -> None:
    node = SENSORS[name]
    signal, _ = signal_of(node["dbc2vss"]["signal"])
    for raw, text in (signal.choices or {}).items():
        if str(text) in ("NotAvailable", "Error"):
            value = decoded(signal.name, raw)
            assert isinstance(value, NamedSignalValue)
            found = transformed(node, value)
            if "allowed" in node:
                assert found in ("NOT_AVAILABLE", "ERROR")
            else:
                assert found is None


@pytest.mark.parametrize(
    ("name", "raw", "expected"),
    [
        ("Vehicle.Powertrain.ElectricMotor.Speed", 5644, 5644),
        ("Vehicle.Powertrain.TractionBattery.CurrentVoltage", 2458, 24.58),
        ("Vehicle.Powertrain.TractionBattery.CurrentCurrent", 309, -30.9),
        ("Vehicle.Private.Esc.ConsumedCharge", 1500, 1.5),
        ("Vehicle.Private.Esc.PowerStageTemperature", -5, -5),
        ("Vehicle.Private.Esc.IsUndervoltage", 0, False),
        ("Vehicle.Private.Esc.IsUndervoltage", 1, True),
        ("Vehicle.Private.Esc.EnergyUsed", 100, 0.01),
        ("Vehicle.Private.Esc.LinkState", 4, "LOST"),
    ],
)
def test_value_is_passed_on_in_the_unit_of_vss(name: str, raw: int, expected: object) -> None:
    node = SENSORS[name]
    found = transformed(node, decoded(node["dbc2vss"]["signal"], raw))
    assert found == (pytest.approx(expected) if isinstance(expected, float) else expected)
    if "allowed" in node:
        assert found in node["allowed"]
