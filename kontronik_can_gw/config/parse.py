"""Makes a configuration from TOML.

All mistakes are reported at once, each with its place, a remedy, and the name that was probably
meant.
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from posixpath import normpath
from typing import Any, cast

from kontronik_can_gw.config.conditions import condition
from kontronik_can_gw.config.keys import (
    REMOVED_KEYS,
    TABLES,
    CanConfig,
    Config,
    EscConfig,
    RecordConfig,
    required,
)
from kontronik_can_gw.config.kinds import key_of, shown
from kontronik_can_gw.core.output_setup import OUTPUTS
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.value_names import VALUES_BY_KEY, normalize
from kontronik_can_gw.status import UNCONFIGURED


def load(path: Path) -> Config:
    """Read and check a configuration file. Raises UserError with every mistake."""
    config, problems = examine(path)
    return _require_valid(config, problems)


def parse(tables: Mapping[str, Any], file: str) -> Config:
    """Make a configuration from TOML tables. Raises UserError with every mistake."""
    config, problems = _make_config(tables, file)
    return _require_valid(config, problems)


def _require_valid(config: Config | None, problems: list[str]) -> Config:
    if config is None or problems:
        raise UserError(*problems)
    return config


def examine(path: Path) -> tuple[Config | None, list[str]]:
    """Read a configuration file. Returns the configuration and its mistakes.

    The configuration is None if a table is invalid. It can have mistakes nevertheless, for example
    in rules about several keys. Raises UserError if the file cannot be read.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")  # editors on Windows write a byte order mark
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError)
        advice = " `kontronik-can-gw init` writes an example." if is_missing else ""
        raise UserError(f"{path}: cannot be read: {error.strerror}.{advice}") from None
    except UnicodeDecodeError:
        raise UserError(
            f"{path}: is not a UTF-8 text file, so it cannot be a TOML configuration"
        ) from None
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        # TOMLDecodeError is a ValueError. A number of 5000 digits raises ValueError, and 1000
        # nested brackets raise RecursionError.
        reason = "a number is too long, or the nesting is too deep"
        if isinstance(error, tomllib.TOMLDecodeError):
            reason = str(error)
        raise UserError(f"{path}: is not valid TOML: {reason}") from None
    return _make_config(tables, str(path))


def _make_config(
    tables: Mapping[str, Any],
    file: str,
) -> tuple[Config | None, list[str]]:
    """Return the configuration, or None if a table is invalid, and all mistakes."""
    problems: list[str] = []
    removed: list[str] = []
    for name in tables:
        if name not in TABLES:
            near = did_you_mean(name, TABLES, or_known=True)
            problems.append(f"{key_of(name)}: unknown table.{near}")
    made = {}
    for name in TABLES:
        if name != "esc":
            given = tables.get(name, {})
            made[name] = _make_table(given, name, name, problems, removed)
    listed = tables.get("esc", [])
    is_list = isinstance(listed, list)
    if not is_list or not all(isinstance(entry, dict) for entry in listed):
        problems.append("esc: must be written [[esc]], once for each ESC")
        listed = []
    elif not listed:
        problems.append(
            "esc: at least one [[esc]] with its port is needed. `kontronik-can-gw init` shows one."
        )
    escs: dict[int, EscConfig] = {}
    for number, entry in enumerate(listed, 1):
        named = {"name": f"esc{number}"} | entry
        esc = _make_table(named, "esc", f"esc[{number}]", problems, removed)
        if esc is not None:
            escs[number] = esc
    config = None
    if not problems:
        texts = [*removed, *_without_effect(made["can"], made["record"])]
        warnings = tuple(f"{file}: {text}" for text in texts)
        config = Config(
            **cast(Any, made),
            esc=tuple(escs.values()),
            file=file,
            warnings=warnings,
        )
    problems += _esc_problems(escs)
    if config is not None:
        problems += _output_problems(config)
    return config, [f"{file}: {text}" for text in problems]


def _make_table(
    given: Any,
    name: str,
    place: str,
    problems: list[str],
    removed: list[str],
) -> Any:
    """Return the object of a table, or None if the table is invalid.

    Adds mistakes to ``problems``, and a line for each removed key to ``removed``.
    """
    if not isinstance(given, dict):
        problems.append(f"{place}: must be a table, written [{place}]")
        return None
    before = len(problems)
    kinds = {}
    for row in fields(TABLES[name]):
        kinds[row.name] = row.metadata["kind"]
    values: dict[str, Any] = {}
    for key, value in given.items():
        advice = REMOVED_KEYS.get(f"{name}.{key}")
        if advice is not None:
            removed.append(f"{place}.{key}: was removed and is ignored. {advice}")
        elif key not in kinds:
            near = did_you_mean(key, kinds, or_known=True)
            problems.append(f"{place}.{key_of(key)}: unknown key.{near}")
        else:
            try:
                values[key] = kinds[key].check(value)
            except ValueError as error:
                problems.append(f"{place}.{key}: {error}")
    for row in required(TABLES[name]):
        if row.name not in given:
            problems.append(f"{place}.{row.name}: is required: {row.metadata['doc']}")
    if len(problems) > before:
        return None
    return TABLES[name](**values)


# --- rules about several keys


def _esc_problems(escs: Mapping[int, EscConfig]) -> Iterator[str]:
    """Yield mistakes in the names, ports and devices of ESCs, given by their number in the file."""
    names = {number: normalize(esc.name) for number, esc in escs.items()}
    ports = {number: esc.port for number, esc in escs.items()}
    for number, other in _duplicates(names):
        yield f"esc[{number}].name: {shown(escs[number].name)} is already used by esc[{other}]"
    for number, other in _duplicates(ports):
        yield f"esc[{number}].port: {shown(escs[number].port)} is already used by esc[{other}]"
    for number, esc in escs.items():
        if esc.device is not None and esc.device_number is None:
            problem = f"{shown(esc.device)} is not a device of the protocol {esc.protocol}"
            yield f"esc[{number}].device: {problem}"
    for number, esc in escs.items():
        if _is_ambiguous(names[number], {"", *names.values()}):
            yield (
                f"esc[{number}].name: {shown(esc.name)} makes signal names ambiguous. "
                "Choose another name."
            )


def _duplicates(values: Mapping[int, object]) -> Iterator[tuple[int, int]]:
    """Yield each number with the value of an earlier number, and that earlier number."""
    first: dict[object, int] = {}
    for number, value in values.items():
        other = first.setdefault(value, number)
        if other != number:
            yield number, other


def _is_ambiguous(name: str, starts: set[str]) -> bool:
    """Return True if an ESC's name can be mistaken for a part of a value's name.

    Signals are named by the ESC's name and the value's name. An ESC called "max" is ambiguous:
    "max_electrical_speed" is also a value. ESCs called "a" and "a_max" are ambiguous, too, so
    ``starts`` has the names of all ESCs and "".
    """
    rests = [name.removeprefix(start) for start in starts if name.startswith(start)]
    return any(
        value.startswith(rest) and value.removeprefix(rest) in VALUES_BY_KEY
        for rest in filter(None, rests)
        for value in VALUES_BY_KEY
    )


def _without_effect(can: CanConfig, record: RecordConfig) -> Iterator[str]:
    """Yield a line for each key that has no effect because of another key."""
    if can.restart_after_s and not can.restart_after_ns:
        yield (
            f"can.restart_after_s: has no effect with the interface {can.interface}, because only "
            "SocketCAN interfaces can be restarted"
        )
    default = RecordConfig()
    for name in ("before_s", "after_s", "errors", "when"):
        if not record.on_event and getattr(record, name) != getattr(default, name):
            yield f"record.{name}: has no effect without record.on_event = true"
    if record.on_event and record.directory is None:
        yield "record.on_event: record.directory is not set, so only `run --record DIR` records"


def _output_problems(config: Config) -> Iterator[str]:
    """Yield mistakes in the outputs: a statistics file that would overwrite an input, invalid
    node-IDs, or only disabled outputs.
    """
    files = {
        "the configuration": Path(config.file),
        "the DBC": config.dbc_path,
        "the EDS": config.eds_path,
    }
    path = config.statistics_path
    if path is not None:
        for what, other in files.items():
            if normpath(path) == normpath(other):
                yield f"statistics.file: {shown(str(path))} is {what}, which would be overwritten"
    if config.canopen.enabled:
        yield from _node_id_problems(config)
    yield from _condition_problems(config)
    senders = ("dbc", *OUTPUTS)
    if not any(getattr(config, name).enabled for name in senders):
        names = ", ".join(f"{name}.enabled" for name in senders)
        yield f"{names}: all are false, so nothing would be sent. Enable one."


def _condition_problems(config: Config) -> Iterator[str]:
    known = {normalize(esc.name): esc.name for esc in config.esc}
    for text in config.record.when:
        name = condition(text).esc
        if name and name not in known:
            names = ", ".join(known.values())
            yield f"record.when: {shown(text)}: there is no ESC of this name. Known: {names}."


def _node_id_problems(config: Config) -> Iterator[str]:
    ids = dict(enumerate(config.node_ids, 1))
    duplicates = dict(_duplicates(ids))
    for number, node_id in ids.items():
        if node_id == UNCONFIGURED:
            if config.canopen.read_only:
                yield (
                    f"esc[{number}]: would wait for a node-ID by LSS, "
                    "which canopen.read_only = true refuses. Set its node_id."
                )
        elif not 1 <= node_id <= 127:
            yield (
                f"esc[{number}]: its node-ID would be {node_id}. "
                "Choose a smaller canopen.node_id, or set its node_id."
            )
        elif number in duplicates:
            yield f"esc[{number}].node_id: {node_id} is already used by esc[{duplicates[number]}]"
