"""The TOML configuration: frozen objects, checked completely before anything is opened, all mistakes reported at once.

Each key is defined once, below, with its range and its text; validation and the JSON Schema come from that definition.
"""

import difflib
import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from posixpath import normpath
from typing import Any, TypeVar, cast

from kontronik_can_gw.dbc import send_types
from kontronik_can_gw.dbc.compiler import DbcSettings
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.protocols import device_names, protocol_named, protocol_names
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.esc.values import VALUES
from kontronik_can_gw.node_state import UNCONFIGURED
from kontronik_can_gw.signals import units

T = TypeVar("T")
SHIPPED = "shipped"
_OWN_OPTIONS = {"interface", "channel", "bitrate", "fd", "data_bitrate"}
_RATIO = r"[0-9]+(\.[0-9]+)?(/[0-9]+(\.[0-9]+)?)?"
_NOT_BLANK = r"\S"
_TEXT = r"^[^\x00]*[^\x00\s][^\x00]*$"
_PORT = "(6553[0-5]|655[0-2][0-9]|65[0-4][0-9]{2}|6[0-4][0-9]{3}|[1-5][0-9]{4}|[1-9][0-9]{0,3})"
_BROKER = (
    rf"([A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|\[[0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*\])(:{_PORT})?"
)
_TOPIC = r"[^\s\x00+#/$][^\x00-\x1f\x7f+#/]*(/[^\x00-\x1f\x7f+#/]+){0,7}"
_LEVEL = "[A-Za-z0-9_-]{1,64}"
_LONGEST_TOPIC = 200
_FORMS = {
    "broker": (_BROKER, "a broker, as broker.example, 192.168.1.5:1883 or [fe80::1]:1883"),
    "topic": (
        _TOPIC,
        "the beginning of topics, as kontronik or fleet/north: no + and #, no / at the ends",
    ),
    "level": (_LEVEL, "a name of 1 to 64 letters, digits, _ and -"),
}


def _key(doc: str, kind: str, default: Any = MISSING, **limits: Any) -> Any:
    """A configuration key. ``limits``: low, high, choices, pattern, values.

    ``kind``: string, integer, number, boolean, ratio, bindings, ids, meanings, names, broker, topic, level.
    """
    metadata = {"doc": doc, "kind": kind} | limits
    if isinstance(default, dict):
        return field(default_factory=lambda: dict(default), metadata=metadata)
    return (
        field(metadata=metadata)
        if default is MISSING
        else field(default=default, metadata=metadata)
    )


@dataclass(frozen=True)
class CanConfig:
    """The CAN interface."""

    interface: str = _key(
        "python-can interface name: socketcan, virtual, pcan, kvaser, slcan ...",
        "string",
        "socketcan",
    )
    channel: str = _key("channel of that interface, as can0", "string", "can0")
    bitrate: int = _key(
        "bit rate in bit/s; with socketcan it is set by the system and only the bus load is computed from it",
        "integer",
        500_000,
        low=10_000,
        high=1_000_000,
    )
    fd: bool = _key("allow CAN FD messages (longer than 8 bytes)", "boolean", False)
    data_bitrate: int = _key(
        "bit rate of the CAN FD data phase in bit/s",
        "integer",
        2_000_000,
        low=10_000,
        high=8_000_000,
    )

    options: Mapping[str, str | float] = _key(
        "further options of the python-can interface, as host or ttyBaudrate", "options", {}
    )


@dataclass(frozen=True)
class DbcConfig:
    """The DBC output."""

    enabled: bool = _key("send the messages of a DBC", "boolean", True)
    file: str = _key(
        "DBC file, relative to this configuration; 'shipped' is the one of this package",
        "string",
        SHIPPED,
    )
    node: str | None = _key("transmitter node in the DBC whose messages are sent", "string", None)
    messages: Sequence[str] = _key(
        "names of the messages to send, '*' for any characters, as [\"Motor_*\"] (default: all of the node)",
        "names",
        (),
    )
    unbound: str = _key(
        "signals bound to nothing: 'error' refuses them, 'start_value' sends their GenSigStartValue (else NotAvailable, else 0) for ever",
        "string",
        "error",
        choices=("error", "start_value"),
    )
    on_loss: str = _key(
        "without telemetry: 'not_available' sends values marked as such, 'silent' stops messages with an ESC's values",
        "string",
        "not_available",
        choices=("not_available", "silent"),
    )
    flags_on_loss: int | None = _key(
        "what flags without NotAvailable in their value table hold without telemetry (default: their own GenSigStartValue, else 0)",
        "integer",
        None,
        low=0,
        high=1,
    )
    base_id: int | None = _key(
        "move the messages so that the lowest id is this", "integer", None, low=0, high=0x1FFFFFFF
    )
    id_step: int | None = _key(
        "distance of the ids from ESC to ESC when a one-ESC DBC serves several",
        "integer",
        None,
        low=1,
        high=0x1FFFFFFF,
    )
    bind: Mapping[str, str | float] = _key(
        "'Message.Signal' or 'Signal' = a source ('battery_voltage', 'left.battery_voltage') or a constant number",
        "bindings",
        {},
    )
    e2e_data_ids: Mapping[str, int] = _key(
        "message name = AUTOSAR E2E data id", "ids", {}, low=0, high=0xFFFF
    )
    units: Mapping[str, str] = _key(
        "unit text of the DBC = the unit that it means", "meanings", {}, values=units.names()
    )
    send_type: Mapping[str, str] = _key(
        "GenMsgSendType of the DBC = what it means", "meanings", {}, values=tuple(send_types.NAMES)
    )


@dataclass(frozen=True)
class CanopenConfig:
    """The CANopen nodes, one for each ESC."""

    enabled: bool = _key("be a CANopen node for each ESC", "boolean", False)
    node_id: int = _key(
        "node-ID of the first ESC, the others follow; 255: all wait for LSS",
        "integer",
        1,
        low=1,
        high=127,
        also=255,
    )
    eds: str = _key(
        "EDS file the nodes are built from, relative to this configuration; 'shipped' is the one of this package",
        "string",
        SHIPPED,
    )
    vendor_id: int | None = _key(
        "vendor-ID in 1018h:1; only CiA assigns one (default: as the EDS says)",
        "integer",
        None,
        low=0,
        high=0xFFFFFFFF,
    )
    serial: int | None = _key(
        "serial number of the first node in 1018h:4, the others follow (default: made from the machine's id)",
        "integer",
        None,
        low=0,
        high=0xFFFFFFFF,
    )
    self_start: bool = _key(
        "go OPERATIONAL after boot-up without a master (1F80h); otherwise as the EDS says",
        "boolean",
        False,
    )
    read_only: bool = _key("refuse every write over the bus, and LSS", "boolean", False)
    cia402_mirrors: bool = _key(
        "show the objects 6000h..67FFh (speed, DC link voltage, error code) that generic drive tools know",
        "boolean",
        True,
    )
    store: str | None = _key(
        "folder of what masters store (default: the service's state folder; else for root /var/lib/kontronik-can-gw, "
        "for others ~/.local/state/kontronik-can-gw)",
        "string",
        None,
    )


@dataclass(frozen=True)
class EscConfig:
    """One ESC and its serial port."""

    port: str = _key("serial port, best by /dev/serial/by-id/...", "string")
    name: str = _key(
        "short name, prefix of messages and signals with several ESCs (the shipped DBC has room for 6 letters); default esc1, esc2 ...",
        "string",
        "",
        pattern="[A-Za-z][A-Za-z0-9_]{0,11}",
    )
    pole_pairs: int = _key(
        "pole pairs of the motor (half the number of magnets)", "integer", 1, low=1, high=100
    )
    gear: Fraction = _key(
        "motor revolutions per output revolution: a number or 'numerator/denominator'",
        "ratio",
        Fraction(1),
    )
    cell_count: int = _key(
        "cells of the battery; 0: as the ESC reports", "integer", 0, low=0, high=255
    )
    telemetry_timeout_ms: int = _key(
        "live values older than this are not available", "integer", 250, low=20, high=60_000
    )

    node_id: int | None = _key(
        "CANopen node-ID of this ESC; 255: waits for LSS (default: counted on from canopen.node_id)",
        "integer",
        None,
        low=1,
        high=127,
        also=255,
    )
    device: str | None = _key(
        "the device that belongs here; another one is reported (CANopen EMCY 7510h)",
        "string",
        None,
        choices=device_names,
    )
    protocol: str = _key(
        "what the ESC's telemetry line speaks",
        "string",
        "kontronik",
        choices=protocol_names,
    )

    @property
    def settings(self) -> EscSettings:
        return EscSettings(
            self.name,
            self.pole_pairs,
            self.gear,
            self.cell_count,
            timeout_ns=self.telemetry_timeout_ms * MS,
            protocol=self.protocol,
        )

    @property
    def device_number(self) -> int | None:
        """Number of the device that belongs here; None for any."""
        devices = protocol_named(self.protocol).devices
        return next((number for number, text in devices.items() if text == self.device), None)


@dataclass(frozen=True)
class RunConfig:
    """How the gateway runs."""

    wait_for_devices: bool = _key(
        "at start: wait for ports and interfaces that are missing instead of ending with an error",
        "boolean",
        False,
    )
    realtime_priority: int | None = _key(
        "real-time priority (SCHED_FIFO) and locked memory, so that the load of other programs delays no frame "
        "(default: normal priority)",
        "integer",
        None,
        low=1,
        high=99,
    )


@dataclass(frozen=True)
class StatisticsConfig:
    """Statistics for ``kontronik-can-gw status`` and ``kontronik-can-gw metrics``."""

    file: str | None = _key(
        "JSON file that is replaced each second, relative to this configuration (default: status.json in the service's runtime folder; "
        "without one none)",
        "string",
        None,
    )


@dataclass(frozen=True)
class MqttConfig:
    """What ``kontronik-can-gw mqtt`` publishes, and where."""

    broker: str | None = _key(
        "MQTT broker, as broker.example or 192.168.1.5:1883 (default port 1883, with TLS 8883)",
        "broker",
        None,
    )
    tls: bool = _key("encrypt, and check the broker's certificate and name", "boolean", False)
    ca_file: str | None = _key(
        "certificate of the authority that signed the broker's, relative to this configuration (default: those of the system)",
        "string",
        None,
    )
    cert_file: str | None = _key(
        "certificate to show to the broker, relative to this configuration", "string", None
    )
    key_file: str | None = _key(
        "key of that certificate, relative to this configuration", "string", None
    )
    username: str | None = _key("user name at the broker", "string", None)
    password_file: str | None = _key(
        "file with the password on its first line, relative to this configuration", "string", None
    )
    gateway: str | None = _key(
        "name of this gateway in the topics (default: the host name)", "level", None
    )
    topic: str = _key("what all topics begin with", "topic", "kontronik")
    rate: float = _key("state messages of each ESC in a second", "number", 1.0, low=0.01, high=20)
    retain: bool = _key("let the broker keep the last state message of each ESC", "boolean", False)
    discovery: str | None = _key(
        "topic prefix of Home Assistant's discovery, there mostly 'homeassistant' (default: no discovery)",
        "topic",
        None,
    )

    @property
    def address(self) -> tuple[str, int] | None:
        """Host and port of the broker."""
        if self.broker is None:
            return None
        found = re.fullmatch(_BROKER, self.broker)
        assert found is not None
        return found[1].strip("[]"), int(found[4] or (8883 if self.tls else 1883))


@dataclass(frozen=True)
class RecordConfig:
    """Captures of all input, to be replayed and converted later."""

    directory: str | None = _key(
        "folder of the captures, relative to this configuration; 'state' is a folder captures in the service's state folder "
        "(default: nothing is recorded but by `run --record`)",
        "string",
        None,
    )
    part_mb: int = _key(
        "begin another file at this size in megabytes", "integer", 64, low=1, high=4000
    )
    part_minutes: int = _key(
        "begin another file after this time in minutes", "integer", 60, low=1, high=10_000
    )
    keep_mb: int = _key(
        "remove the oldest captures of the folder when all together have more megabytes; 0: remove nothing",
        "integer",
        0,
        low=0,
        high=10_000_000,
    )
    min_free_mb: int = _key(
        "record nothing while fewer megabytes are free on the file system",
        "integer",
        100,
        low=0,
        high=10_000_000,
    )


@dataclass(frozen=True)
class Config:
    """The whole configuration; ``file`` is where it came from."""

    can: CanConfig
    dbc: DbcConfig
    canopen: CanopenConfig
    run: RunConfig
    esc: tuple[EscConfig, ...]
    file: str = "(built-in)"
    statistics: StatisticsConfig = StatisticsConfig()
    record: RecordConfig = RecordConfig()
    mqtt: MqttConfig = MqttConfig()
    warnings: tuple[str, ...] = ()
    """One line for each key that was removed."""

    @cached_property
    def escs(self) -> list[EscSettings]:
        return [esc.settings for esc in self.esc]

    @property
    def dbc_settings(self) -> DbcSettings:
        dbc = self.dbc
        return DbcSettings(
            bind=dict(dbc.bind),
            node=dbc.node,
            base_id=dbc.base_id,
            id_step=dbc.id_step,
            data_ids=dict(dbc.e2e_data_ids),
            units=dict(dbc.units),
            send_types=dict(dbc.send_type),
            messages=tuple(dbc.messages),
            unbound=dbc.unbound,
            flags_on_loss=dbc.flags_on_loss,
        )

    @property
    def dbc_path(self) -> Path:
        """The DBC file, the shipped one or relative to the configuration."""
        if self.dbc.file == SHIPPED:
            return shipped("dbc/kontronik_esc.dbc")
        return Path(self.file).parent / self.dbc.file

    @property
    def eds_path(self) -> Path:
        """The EDS file, the shipped one or relative to the configuration."""
        if self.canopen.eds == SHIPPED:
            return shipped("eds/kontronik_esc.eds")
        return Path(self.file).parent / self.canopen.eds

    @property
    def statistics_path(self) -> Path | None:
        """The statistics file, relative to the configuration; None where it does not say."""
        return (
            None if self.statistics.file is None else Path(self.file).parent / self.statistics.file
        )

    @property
    def node_ids(self) -> list[int]:
        """CANopen node-IDs of the ESCs, in their order."""
        base = self.canopen.node_id
        counted = [
            base if base == UNCONFIGURED else base + number for number in range(len(self.esc))
        ]
        return [
            own if esc.node_id is None else esc.node_id
            for esc, own in zip(self.esc, counted, strict=True)
        ]


_TABLES: dict[str, type[Any]] = {
    "can": CanConfig,
    "dbc": DbcConfig,
    "canopen": CanopenConfig,
    "run": RunConfig,
    "statistics": StatisticsConfig,
    "record": RecordConfig,
    "mqtt": MqttConfig,
    "esc": EscConfig,
}
REMOVED_KEYS: dict[str, str] = {
    "statistics.prometheus": "`kontronik-can-gw metrics` serves /metrics, as a service too: `service install --metrics`.",
    "record.can_log": "`kontronik-can-gw convert CAPTURE flight.log` makes the log from a capture.",
}
"""Table and key of earlier versions, as "record.can_log", and what to do instead, as a sentence.

For a year each is ignored with a warning: a gateway must not fall silent after an upgrade.
"""


def shipped(name: str) -> Path:
    """Path of a file shipped with the package: inside it when installed, next to it in a checkout."""
    package = Path(__file__).parent.parent
    installed = package / "shipped" / name
    return installed if installed.exists() else package.parent / name


def load(path: Path) -> Config:
    """Read and check a configuration file. UserError with every mistake, each with file, key and remedy."""
    config, problems = examine(path)
    if config is None or problems:
        raise UserError(*problems)
    return config


def examine(path: Path) -> tuple[Config | None, list[str]]:
    """A configuration and its mistakes; None where too little is valid to go on. UserError where the file cannot be read."""
    try:
        text = path.read_bytes().decode("utf-8-sig")  # editors on Windows write a byte order mark
    except OSError as error:
        advice = (
            " `kontronik-can-gw init` writes an example."
            if isinstance(error, FileNotFoundError)
            else ""
        )
        raise UserError(f"{path}: cannot be read: {error.strerror}.{advice}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not a text file in UTF-8, so no TOML configuration") from None
    try:
        tables = tomllib.loads(text)
    except (
        ValueError,
        RecursionError,
    ) as error:
        # besides TOMLDecodeError: numbers of 5000 digits, 1000 nested brackets
        raise UserError(f"{path}: is not valid TOML: {error}") from None
    return _parsed(tables, str(path))


def parse(tables: Mapping[str, Any], file: str) -> Config:
    """A configuration from TOML tables. UserError with every mistake."""
    config, problems = _parsed(tables, file)
    if config is None or problems:
        raise UserError(*problems)
    return config


def _parsed(tables: Mapping[str, Any], file: str) -> tuple[Config | None, list[str]]:
    problems: list[str] = []
    warnings: list[str] = []
    tables = _without_removed_keys(tables, file, warnings)
    for name in tables:
        if name not in _TABLES:
            problems.append(f"{file}: {name}: unknown table.{_nearest(name, _TABLES)}")
    made = {
        name: _table(tables.get(name, {}), kind, name, file, problems)
        for name, kind in _TABLES.items()
        if name != "esc"
    }
    listed = tables.get("esc", [])
    if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
        problems.append(f"{file}: esc: is written [[esc]], once for each ESC")
        listed = []
    elif not listed:
        problems.append(
            f"{file}: esc: at least one [[esc]] with its port is needed. `kontronik-can-gw init` shows one."
        )
    escs: dict[int, EscConfig] = {}
    for number, entry in enumerate(listed, 1):
        named = {"name": f"esc{number}"} | entry
        if (esc := _table(named, EscConfig, f"esc[{number}]", file, problems)) is not None:
            escs[number] = esc
    is_whole = not problems
    _check_escs(escs, file, problems)
    if not is_whole:
        return None, problems
    config = Config(
        **cast(Any, made), esc=tuple(escs.values()), file=file, warnings=tuple(warnings)
    )
    _check_outputs(config, problems)
    return config, problems


def _without_removed_keys(
    tables: Mapping[str, Any], file: str, warnings: list[str]
) -> dict[str, Any]:
    """The tables without keys in ``REMOVED_KEYS``; each of those adds a warning."""

    def kept(name: str, place: str, table: Any) -> Any:
        if not isinstance(table, dict):
            return table
        removed = [key for key in table if f"{name}.{key}" in REMOVED_KEYS]
        for key in removed:
            warnings.append(
                f"{file}: {place}.{key}: was removed and is ignored. {REMOVED_KEYS[f'{name}.{key}']}"
            )
        return {key: value for key, value in table.items() if key not in removed}

    found = {name: kept(name, name, table) for name, table in tables.items()}
    if isinstance(found.get("esc"), list):
        found["esc"] = [
            kept("esc", f"esc[{number}]", entry) for number, entry in enumerate(found["esc"], 1)
        ]
    return found


def schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of the configuration, for editors."""
    properties: dict[str, Any] = {}
    for name, kind in _TABLES.items():
        required = [
            f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING
        ]
        removed = {
            key.removeprefix(f"{name}."): {"description": f"removed: {advice}", "deprecated": True}
            for key, advice in REMOVED_KEYS.items()
            if key.startswith(f"{name}.")
        }
        table: dict[str, Any] = {
            "type": "object",
            "description": (kind.__doc__ or "").strip(),
            "additionalProperties": False,
            "properties": {f.name: _schema_of(f) for f in fields(kind)} | removed,
        }
        if required:
            table["required"] = required
        properties[name] = (
            {"type": "array", "minItems": 1, "items": table} if name == "esc" else table
        )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "kontronik-can-gw configuration",
        "type": "object",
        "additionalProperties": False,
        "required": ["esc"],
        "properties": properties,
    }


def as_toml(config: Config) -> str:
    """The effective configuration as TOML, including defaults."""
    lines: list[str] = []
    for name in ("can", "dbc", "canopen", "run", "statistics", "record", "mqtt"):
        lines += _toml_table(f"[{name}]", getattr(config, name))
    for esc in config.esc:
        lines += _toml_table("[[esc]]", esc)
    return "\n".join(lines).strip() + "\n"


def _table(given: Any, kind: type[T], path: str, file: str, problems: list[str]) -> T | None:
    before = len(problems)
    if not isinstance(given, dict):
        problems.append(f"{file}: {path}: is a table, written [{path}]")
        return None
    known = {f.name: f for f in fields(cast(Any, kind))}
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name not in known:
            problems.append(f"{file}: {path}.{name}: unknown key.{_nearest(name, known)}")
            continue
        try:
            values[name] = _value(value, known[name])
        except ValueError as error:
            problems.append(f"{file}: {path}.{name}: {error}")
    for name, f in known.items():
        if name not in given and f.default is MISSING and f.default_factory is MISSING:
            problems.append(f"{file}: {path}.{name}: is required: {f.metadata['doc']}")
    return kind(**values) if len(problems) == before else None


def _value(value: Any, f: Field[Any]) -> Any:
    limits = f.metadata
    match limits["kind"]:
        case "boolean":
            if not isinstance(value, bool):
                raise ValueError(f"{value!r} is not true or false")
            return value
        case "integer":
            return _integer(value, limits)
        case "number":
            return _number(value, limits)
        case "ratio":
            return _ratio(value)
        case "bindings" | "ids" | "meanings":
            if not isinstance(value, dict):
                raise ValueError(f"{value!r} is not a table")
            flat = _flat(value) if limits["kind"] == "bindings" else value
            return {name: _entry(name, entry, limits) for name, entry in flat.items()}
        case "names":
            if not isinstance(value, list) or not all(
                isinstance(entry, str) and entry.strip() for entry in value
            ):
                raise ValueError(f'{value!r} is not a list of names, as ["Motor_*"]')
            return tuple(value)
        case "options":
            if not isinstance(value, dict) or not all(
                isinstance(entry, (str, int, float)) for entry in value.values()
            ):
                raise ValueError(f"{value!r} is not a table of texts, numbers and booleans")
            if own := sorted(_OWN_OPTIONS & set(value)):
                raise ValueError(f"{own[0]} has its own key: can.{own[0]}")
            return dict(value)
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise ValueError(f"{value!r} is not a text")
    listed = choices(limits)
    if listed and value not in listed:
        raise ValueError(f"{value!r} is none of {', '.join(listed)}.{_nearest(value, listed)}")
    if limits["kind"] in _FORMS:
        shape, form = _FORMS[limits["kind"]]
        if len(value) > _LONGEST_TOPIC or not re.fullmatch(shape, value):
            raise ValueError(f"{value!r} is not {form}")
    pattern = limits.get("pattern")
    if pattern and not re.fullmatch(pattern, value):
        raise ValueError(
            f"{value!r} is not a name of 1 to 12 letters, digits and underscores that begins with a letter"
        )
    return value


def choices(limits: Mapping[str, Any]) -> tuple[str, ...]:
    """The values that a key can have; empty for any."""
    found = limits.get("choices", ())
    return tuple(found() if callable(found) else found)


def _flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """Keys joined by dots: ``Message.Signal = x`` without quotes is a nested table in TOML."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        found |= (
            {f"{name}.{key}": inner for key, inner in value.items()}
            if isinstance(value, dict)
            else {name: value}
        )
    return found


def _entry(name: str, value: Any, limits: Mapping[str, Any]) -> Any:
    if limits["kind"] == "meanings":
        if value not in limits["values"]:
            near = _nearest(str(value), limits["values"])
            raise ValueError(f"{name}: {value!r} is none of those known here.{near}")
        return value
    if limits["kind"] == "ids":
        try:
            return _integer(value, limits)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    a_text, a_number = (
        isinstance(value, str) and value.strip(),
        isinstance(value, (int, float)) and value not in (math.inf, -math.inf),
    )
    if isinstance(value, bool) or value != value or not (a_text or a_number):  # value != value: NaN
        raise ValueError(f"{name}: {value!r} is neither the name of a source nor a number")
    return value


def _integer(value: Any, limits: Mapping[str, Any]) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{value!r} is not a whole number")
    if not limits["low"] <= value <= limits["high"] and value != limits.get("also"):
        also = f" and not {limits['also']}" if "also" in limits else ""
        raise ValueError(f"{value} is outside {limits['low']}..{limits['high']}{also}")
    return value


def _number(value: Any, limits: Mapping[str, Any]) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{value!r} is not a number")
    if not limits["low"] <= value <= limits["high"]:
        raise ValueError(f"{value} is outside {limits['low']}..{limits['high']}")
    return float(value)


def _ratio(value: Any) -> Fraction:
    try:
        if isinstance(value, str):
            if not re.fullmatch(_RATIO, value):
                raise ValueError
            numerator, _, denominator = value.partition("/")
            ratio = Fraction(numerator) / Fraction(denominator or 1)
        elif isinstance(value, bool):
            raise ValueError
        else:
            ratio = Fraction(repr(value))
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"{value!r} is neither a number nor 'numerator/denominator'") from None
    if not Fraction(1, 1000) <= ratio <= 1000:
        raise ValueError(f"{value} is outside 0.001..1000")
    return ratio


def _check_escs(escs: Mapping[int, EscConfig], file: str, problems: list[str]) -> None:
    """Check names, ports and ambiguity. ``escs`` by their number in the file, without those that are invalid themselves."""
    names = {normalize(name) for name in VALUES}
    for what in ("name", "port"):
        seen: dict[str, int] = {}
        for number, esc in escs.items():
            text = getattr(esc, what)
            key = normalize(text) if what == "name" else text
            if key in seen:
                problems.append(
                    f"{file}: esc[{number}].{what}: {text!r} is also that of esc[{seen[key]}]"
                )
            seen.setdefault(key, number)
    for number, esc in escs.items():
        key = normalize(esc.name)
        # "max" and "electrical_speed" give "max_electrical_speed", which is a source; "a" and "a_max" clash too
        starts = {"", *(normalize(other.name) for other in escs.values())}
        rests = {
            key.removeprefix(start) for start in starts if key.startswith(start) and key != start
        }
        if any(
            other.startswith(rest) and other.removeprefix(rest) in names
            for rest in rests
            for other in names
        ):
            problems.append(
                f"{file}: esc[{number}].name: {esc.name!r} makes signal names ambiguous. Choose another name."
            )


def mqtt_with(config: MqttConfig, given: Mapping[str, Any]) -> MqttConfig:
    """The table with some values replaced, each checked as in a file. UserError names a key as an option."""
    known = {f.name: f for f in fields(MqttConfig)}
    problems: list[str] = []
    values: dict[str, Any] = {}
    for name, value in given.items():
        try:
            values[name] = _value(value, known[name])
        except ValueError as error:
            problems.append(f"--{name.replace('_', '-')}: {error}")
    if not problems:
        made = replace(config, **values)
        problems += [f"mqtt.{problem}" for problem in _mqtt_problems(made)]
        if not problems:
            return made
    raise UserError(*problems)


def _mqtt_problems(mqtt: MqttConfig) -> list[str]:
    problems = []
    for name in ("ca_file", "cert_file", "key_file"):
        if getattr(mqtt, name) is not None and not mqtt.tls:
            problems.append(f"{name}: is for TLS, which is off. Switch mqtt.tls on (--tls).")
    if mqtt.key_file is not None and mqtt.cert_file is None:
        problems.append(
            "key_file: needs the certificate that it belongs to. Set mqtt.cert_file (--cert-file)."
        )
    if mqtt.password_file is not None and mqtt.username is None:
        problems.append("password_file: needs a user name. Set mqtt.username (--username).")
    return problems


def _check_outputs(config: Config, problems: list[str]) -> None:
    file, canopen = config.file, config.canopen
    if (path := config.statistics_path) is not None:
        read = {
            "the configuration": Path(file),
            "the DBC": config.dbc_path,
            "the EDS": config.eds_path,
        }
        for what, other in read.items():
            if normpath(path) == normpath(other):
                problems.append(
                    f"{file}: statistics.file: {str(path)!r} is {what}, which would be overwritten"
                )
    if not config.dbc.enabled and not canopen.enabled:
        problems.append(
            f"{file}: dbc.enabled, canopen.enabled: both are false, so nothing would be sent. Enable one."
        )
    if not canopen.enabled:
        return
    seen: dict[int, int] = {}
    for number, node_id in enumerate(config.node_ids, 1):
        if node_id == UNCONFIGURED:
            if canopen.read_only:
                problems.append(
                    f"{file}: esc[{number}]: waits for a node-ID by LSS, which canopen.read_only = true refuses. Give it a node_id."
                )
            continue
        if not 1 <= node_id <= 127:
            problems.append(
                f"{file}: esc[{number}]: its node-ID would be {node_id}. Choose a smaller canopen.node_id, or a node_id for it."
            )
        elif node_id in seen:
            problems.append(
                f"{file}: esc[{number}].node_id: {node_id} is also that of esc[{seen[node_id]}]"
            )
        seen.setdefault(node_id, number)


def name_problem(names: Sequence[str]) -> str | None:
    """Why these ESC names are ambiguous; None where they are not."""
    problems: list[str] = []
    _check_escs(
        {n: EscConfig(port=str(n), name=name) for n, name in enumerate(names, 1)}, "", problems
    )
    return problems[0].partition(".name: ")[2] if problems else None


def _nearest(name: str, names: Any, known: bool = True) -> str:
    near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.5)
    if near:
        return f" Did you mean {near[0]}?"
    return f" Known: {', '.join(names)}." if known else ""


def _schema_of(f: Field[Any]) -> dict[str, Any]:
    limits = f.metadata
    entry: dict[str, Any] = {"description": limits["doc"]}
    match limits["kind"]:
        case "integer":
            entry |= {
                "type": "integer",
                "minimum": limits["low"],
                "maximum": limits.get("also", limits["high"]),
            }
            if "also" in limits:
                entry["not"] = {
                    "exclusiveMinimum": limits["high"],
                    "exclusiveMaximum": limits["also"],
                }
        case "ratio":
            entry |= {
                "anyOf": [
                    {"type": "number", "minimum": 0.001, "maximum": 1000},
                    {"type": "string", "pattern": f"^{_RATIO}$"},
                ]
            }
        case "bindings":
            value = {"anyOf": [{"type": "string", "pattern": _NOT_BLANK}, {"type": "number"}]}
            entry |= {
                "type": "object",
                "additionalProperties": {
                    "anyOf": [value, {"type": "object", "additionalProperties": value}]
                },
            }
        case "options":
            scalar = {"type": ["string", "number", "boolean"]}
            names = {"not": {"enum": sorted(_OWN_OPTIONS)}}
            entry |= {"type": "object", "propertyNames": names, "additionalProperties": scalar}
        case "names":
            entry |= {"type": "array", "items": {"type": "string", "pattern": _NOT_BLANK}}
        case "meanings":
            entry |= {"type": "object", "additionalProperties": {"enum": list(limits["values"])}}
        case "ids":
            number = {"type": "integer", "minimum": limits["low"], "maximum": limits["high"]}
            entry |= {"type": "object", "additionalProperties": number}
        case "number":
            entry |= {"type": "number", "minimum": limits["low"], "maximum": limits["high"]}
        case "broker" | "topic" | "level" as kind:
            entry |= {
                "type": "string",
                "pattern": f"^{_FORMS[kind][0]}$",
                "maxLength": _LONGEST_TOPIC,
            }
        case kind:
            entry["type"] = kind
            if kind == "string":
                entry["pattern"] = _TEXT
    if "choices" in limits:
        entry["enum"] = list(choices(limits))
    if "pattern" in limits:
        entry["pattern"] = f"^{limits['pattern']}$"
    if f.default not in (MISSING, None, "", ()):
        entry["default"] = float(f.default) if isinstance(f.default, Fraction) else f.default
    return entry


def _toml_table(head: str, table: Any) -> list[str]:
    lines = [head]
    nested: list[str] = []
    for f in fields(table):
        value = getattr(table, f.name)
        if isinstance(value, Mapping):
            if value:
                nested += [
                    "",
                    f"{head[:-1]}.{f.name}]",
                    *(f"{_toml(k)} = {_toml(v)}" for k, v in value.items()),
                ]
        elif value is not None:
            lines.append(f"{f.name} = {_toml(value)}")
    return [*lines, *nested, ""]


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
