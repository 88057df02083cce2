"""Makes a configuration of TOML: every mistake in it is reported at once, with its place, a remedy and what was meant."""

import tomllib
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, cast

from kontronik_can_gw.config.keys import (
    REMOVED_KEYS,
    TABLES,
    Config,
    EscConfig,
    MqttConfig,
    required,
)
from kontronik_can_gw.config.rules import esc_problems, mqtt_problems, output_problems
from kontronik_can_gw.errors import UserError, did_you_mean


def load(path: Path) -> Config:
    """Read and check a configuration file. UserError with every mistake, each with file, key and remedy."""
    return _valid(*examine(path))


def parse(tables: Mapping[str, Any], file: str) -> Config:
    """A configuration from TOML tables. UserError with every mistake."""
    return _valid(*_Parser(file).config(tables))


def _valid(config: Config | None, problems: list[str]) -> Config:
    if config is None or problems:
        raise UserError(*problems)
    return config


def examine(path: Path) -> tuple[Config | None, list[str]]:
    """A configuration and its mistakes; None where too little is valid to go on. UserError where the file cannot be read."""
    try:
        text = path.read_bytes().decode("utf-8-sig")  # editors on Windows write a byte order mark
    except FileNotFoundError as error:
        raise UserError(
            f"{path}: cannot be read: {error.strerror}. `kontronik-can-gw init` writes an example."
        ) from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not a text file in UTF-8, so no TOML configuration") from None
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # besides TOMLDecodeError: numbers of 5000 digits, 1000 nested brackets
        raise UserError(f"{path}: is not valid TOML: {error}") from None
    return _Parser(str(path)).config(tables)


def mqtt_with(config: MqttConfig, given: Mapping[str, Any]) -> MqttConfig:
    """The table with some values replaced, each checked as in a file. UserError names a key as an option."""
    kinds = {f.name: f.metadata["kind"] for f in fields(MqttConfig)}
    problems: list[str] = []
    values: dict[str, Any] = {}
    for name, value in given.items():
        try:
            values[name] = kinds[name].check(value)
        except ValueError as error:
            problems.append(f"--{name.replace('_', '-')}: {error}")
    if not problems:
        made = replace(config, **values)
        problems = [f"mqtt.{problem}" for problem in mqtt_problems(made)]
        if not problems:
            return made
    raise UserError(*problems)


class _Parser:
    """Tables of a file; ``problems`` and ``warnings`` collect what is to be said about them."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.problems: list[str] = []
        self.warnings: list[str] = []

    def config(self, tables: Mapping[str, Any]) -> tuple[Config | None, list[str]]:
        """The configuration, None where a table is invalid, and all mistakes."""
        for name in tables:
            if name not in TABLES:
                near = did_you_mean(name, TABLES, 0.5, or_known=True)
                self._problem(f"{name}: unknown table.{near}")
        made = {
            name: self._table(tables.get(name, {}), name, name) for name in TABLES if name != "esc"
        }
        escs = self._escs(tables.get("esc", []))
        is_valid = not self.problems
        self._problem(*esc_problems(escs))
        if not is_valid:
            return None, self.problems
        config = Config(
            **cast(Any, made),
            esc=tuple(escs.values()),
            file=self.file,
            warnings=tuple(self.warnings),
        )
        self._problem(*output_problems(config))
        return config, self.problems

    def _problem(self, *texts: str) -> None:
        self.problems += [f"{self.file}: {text}" for text in texts]

    def _escs(self, listed: Any) -> dict[int, EscConfig]:
        """The valid ESCs by their number in the file."""
        if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
            self._problem("esc: is written [[esc]], once for each ESC")
            return {}
        if not listed:
            self._problem(
                "esc: at least one [[esc]] with its port is needed. `kontronik-can-gw init` shows one."
            )
        escs = {
            number: self._table({"name": f"esc{number}"} | entry, "esc", f"esc[{number}]")
            for number, entry in enumerate(listed, 1)
        }
        return {number: esc for number, esc in escs.items() if esc is not None}

    def _table(self, given: Any, name: str, place: str) -> Any:
        """The object of a table; None where it is invalid."""
        if not isinstance(given, dict):
            return self._problem(f"{place}: is a table, written [{place}]")
        before = len(self.problems)
        table = TABLES[name]
        kinds = {f.name: f.metadata["kind"] for f in fields(table)}
        values: dict[str, Any] = {}
        for key, value in given.items():
            if advice := REMOVED_KEYS.get(f"{name}.{key}"):
                self.warnings.append(
                    f"{self.file}: {place}.{key}: was removed and is ignored. {advice}"
                )
            elif key not in kinds:
                near = did_you_mean(key, kinds, 0.5, or_known=True)
                self._problem(f"{place}.{key}: unknown key.{near}")
            else:
                try:
                    values[key] = kinds[key].check(value)
                except ValueError as error:
                    self._problem(f"{place}.{key}: {error}")
        for f in required(table):
            if f.name not in given:
                self._problem(f"{place}.{f.name}: is required: {f.metadata['doc']}")
        return table(**values) if len(self.problems) == before else None
