"""Writes a configuration as TOML."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from kontronik_can_gw.config.keys import TABLES, Config
from kontronik_can_gw.config.kinds import toml_of


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
