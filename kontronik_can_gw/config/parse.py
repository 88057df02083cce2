"""Makes a configuration of TOML: every mistake in it is reported at once, with its place, a remedy and what was meant."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from posixpath import normpath
from typing import Any, cast

from kontronik_can_gw.config.keys import (
    REMOVED_KEYS,
    TABLES,
    Config,
    EscConfig,
    required,
)
from kontronik_can_gw.dbc.binding import VALUES_BY_KEY
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.outputs import OUTPUTS


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
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        advice = " `kontronik-can-gw init` writes an example." if missing else ""
        raise UserError(f"{path}: cannot be read: {error.strerror}.{advice}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not a text file in UTF-8, so no TOML configuration") from None
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # besides TOMLDecodeError: numbers of 5000 digits, 1000 nested brackets
        raise UserError(f"{path}: is not valid TOML: {error}") from None
    return _Parser(str(path)).config(tables)


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
        self._problem(*_esc_problems(escs))
        if not is_valid:
            return None, self.problems
        config = Config(
            **cast(Any, made),
            esc=tuple(escs.values()),
            file=self.file,
            warnings=tuple(self.warnings),
        )
        self._problem(*_output_problems(config))
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


# --- rules about several keys


def _esc_problems(escs: Mapping[int, EscConfig]) -> Iterator[str]:
    """Names and ports that are taken, names that are ambiguous. ``escs``: the valid ones, by their number in the file."""
    names = {number: normalize(esc.name) for number, esc in escs.items()}
    for number, other in _taken(names):
        yield f"esc[{number}].name: {escs[number].name!r} is also that of esc[{other}]"
    for number, other in _taken({number: esc.port for number, esc in escs.items()}):
        yield f"esc[{number}].port: {escs[number].port!r} is also that of esc[{other}]"
    for number, esc in escs.items():
        if esc.device is not None and esc.device_number is None:
            yield f"esc[{number}].device: {esc.device!r} is no device of the protocol {esc.protocol}"
    for number, esc in escs.items():
        if _is_ambiguous(names[number], {"", *names.values()}):
            yield (
                f"esc[{number}].name: {esc.name!r} makes signal names ambiguous. "
                "Choose another name."
            )


def _taken(values: Mapping[int, object]) -> Iterator[tuple[int, int]]:
    """Each number whose value an earlier one has, and that one."""
    seen: dict[object, int] = {}
    for number, value in values.items():
        if (other := seen.setdefault(value, number)) != number:
            yield number, other


def _is_ambiguous(name: str, starts: set[str]) -> bool:
    """True where a name, after one of ``starts``, and a value's name make another value's name.

    "max" and "electrical_speed" give "max_electrical_speed", which is a value; "a" and "a_max" clash too.
    """
    rests = [name.removeprefix(start) for start in starts if name.startswith(start)]
    return any(
        value.startswith(rest) and value.removeprefix(rest) in VALUES_BY_KEY
        for rest in filter(None, rests)
        for value in VALUES_BY_KEY
    )


def _output_problems(config: Config) -> Iterator[str]:
    """Outputs that are all off, a statistics file that is read elsewhere, node-IDs that clash."""
    files = {
        "the configuration": Path(config.file),
        "the DBC": config.dbc_path,
        "the EDS": config.eds_path,
    }
    if (path := config.statistics_path) is not None:
        for what, other in files.items():
            if normpath(path) == normpath(other):
                yield f"statistics.file: {str(path)!r} is {what}, which would be overwritten"
    if config.canopen.enabled:
        yield from _node_id_problems(config)
    elif not config.dbc.enabled and not any(getattr(config, name).enabled for name in OUTPUTS):
        names = ", ".join(f"{name}.enabled" for name in ("dbc", "canopen", *OUTPUTS))
        yield f"{names}: all are false, so nothing would be sent. Enable one."


def _node_id_problems(config: Config) -> Iterator[str]:
    ids = dict(enumerate(config.node_ids, 1))
    taken = dict(_taken(ids))
    for number, node_id in ids.items():
        if node_id == UNCONFIGURED:
            if config.canopen.read_only:
                yield (
                    f"esc[{number}]: waits for a node-ID by LSS, which canopen.read_only = true refuses. "
                    "Give it a node_id."
                )
        elif not 1 <= node_id <= 127:
            yield (
                f"esc[{number}]: its node-ID would be {node_id}. "
                "Choose a smaller canopen.node_id, or a node_id for it."
            )
        elif number in taken:
            yield f"esc[{number}].node_id: {node_id} is also that of esc[{taken[number]}]"
