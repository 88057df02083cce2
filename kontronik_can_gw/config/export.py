"""Writes a configuration as TOML, and its keys as a JSON Schema."""

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from fractions import Fraction
from typing import Any

from kontronik_can_gw.config.keys import REMOVED_KEYS, TABLES, Config, required
from kontronik_can_gw.config.kinds import toml_of


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


def as_toml(config: Config) -> str:
    """Return the effective configuration as TOML, including defaults."""
    lines: list[str] = []
    for name in TABLES:
        table = getattr(config, name)
        if isinstance(table, tuple):
            for entry in table:
                lines += _toml_table(f"[[{name}]]", entry)
        else:
            lines += _toml_table(f"[{name}]", table)
    return "\n".join(lines).strip() + "\n"


def _toml_table(head: str, table: Any) -> list[str]:
    lines = [head]
    for row in fields(table):
        value = getattr(table, row.name)
        if isinstance(value, Mapping):
            lines += [
                f"{row.name}.{toml_of(key)} = {toml_of(entry)}" for key, entry in value.items()
            ]
        elif value is not None:
            lines.append(f"{row.name} = {toml_of(value)}")
    lines.append("")
    return lines
