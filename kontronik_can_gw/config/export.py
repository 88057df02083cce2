"""Writes a configuration as TOML, and its keys as a JSON Schema."""

import json
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from fractions import Fraction
from typing import Any

from kontronik_can_gw.config.keys import REMOVED_KEYS, TABLES, Config, required


def schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of the configuration, for editors."""
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
        "properties": {f.name: _schema_of_key(f) for f in fields(kind)} | removed,
    }
    if needed := [f.name for f in required(kind)]:
        table["required"] = needed
    return table


def _schema_of_key(f: Field[Any]) -> dict[str, Any]:
    entry = {"description": f.metadata["doc"], **f.metadata["kind"].schema}
    if f.default not in (MISSING, None, "", ()):
        entry["default"] = float(f.default) if isinstance(f.default, Fraction) else f.default
    return entry


def as_toml(config: Config) -> str:
    """The effective configuration as TOML, including defaults."""
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
    for f in fields(table):
        value = getattr(table, f.name)
        if isinstance(value, Mapping):
            lines += [f"{f.name}.{_toml(key)} = {_toml(entry)}" for key, entry in value.items()]
        elif value is not None:
            lines.append(f"{f.name} = {_toml(value)}")
    return [*lines, ""]


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Fraction):
        return repr(float(value)) if Fraction(repr(float(value))) == value else f'"{value}"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
