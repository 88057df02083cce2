"""``schema``: prints the JSON Schema of the configuration, for editors."""

import argparse
import json
from dataclasses import MISSING, Field, fields
from fractions import Fraction
from typing import Any

from kontronik_can_gw.cli.arguments import OUTPUT
from kontronik_can_gw.cli.output import write_output
from kontronik_can_gw.config.keys import REMOVED_KEYS, TABLES, required

OPTIONS = OUTPUT
EPILOG = (
    "Editors with TOML support (taplo, Even Better TOML) use it to check and complete "
    "gateway.toml. "
    "Exit codes: 0 done, 1 the file cannot be written, 2 wrong usage."
)


def main(args: argparse.Namespace) -> int:
    text = json.dumps(schema(), indent=2)
    write_output(args.output, text + "\n", force=args.force)
    return 0


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of the configuration, for editors."""
    properties = {name: _schema_of_table(name, kind) for name, kind in TABLES.items()}
    properties["esc"] = {"type": "array", "minItems": 1, "items": properties["esc"]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "kontronik-can-gw configuration",
        "type": "object",
        "additionalProperties": False,
        "required": ["esc"],
        "properties": properties,
    }


def _schema_of_table(name: str, kind: Any) -> dict[str, Any]:
    removed = {
        key.removeprefix(f"{name}."): {"description": f"removed: {advice}", "deprecated": True}
        for key, advice in REMOVED_KEYS.items()
        if key.startswith(f"{name}.")
    }
    table: dict[str, Any] = {
        "type": "object",
        "description": kind.__doc__,
        "additionalProperties": False,
        "properties": {row.name: _schema_of_key(row) for row in fields(kind)} | removed,
    }
    required_names = [row.name for row in required(kind)]
    if required_names:
        table["required"] = required_names
    return table


def _schema_of_key(row: Field[Any]) -> dict[str, Any]:
    entry = {"description": row.metadata["doc"], **row.metadata["kind"].schema}
    default = row.default
    if isinstance(default, Fraction):
        default = float(default)
    elif isinstance(default, tuple):
        default = list(default)
    if default not in (MISSING, None, "", []):
        entry["default"] = default
    return entry
