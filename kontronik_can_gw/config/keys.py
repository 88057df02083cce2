"""The keys of the TOML configuration: a row for each key with its kind, default and meaning.

parse.py checks a configuration by these rows. export.py and the docs are made from them. The
docstring of a table's class is its description in the docs and in the JSON Schema.
"""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

from kontronik_can_gw.config.conditions import CONDITIONS, ERRORS
from kontronik_can_gw.config.kinds import (
    BOOLEAN,
    BROKER,
    ESC_NAME,
    LEVEL,
    RATIO,
    TEXT,
    TOPIC,
    choice_of,
    integer,
    key,
    number,
    options,
)
from kontronik_can_gw.config.output_keys import (
    NODE_ID,
    SHIPPED,
    CanopenConfig,
    DbcConfig,
    DronecanConfig,
)
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.protocols import PROTOCOLS, device_names, protocol_named, protocol_names
from kontronik_can_gw.esc.telemetry import CELL_COUNTS, POLE_PAIRS, TIMEOUTS_MS, EscSettings
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import UNCONFIGURED
from kontronik_can_gw.times import MS, SECOND

REQUIRED = MISSING
"""Default of a key that must be given."""
REMOVED_KEYS: dict[str, str] = {
    "statistics.prometheus": "Use `kontronik-can-gw metrics`, which serves /metrics: "
    "`sudo systemctl enable --now kontronik-can-gw-metrics`.",
    "record.can_log": "Use `kontronik-can-gw convert CAPTURE flight.log`, "
    "which makes the log from a capture.",
}
"""For removed keys, as "record.can_log", a sentence about the replacement.

A removed key is ignored with a warning for a year, because a gateway must not fall silent after an
upgrade.
"""

_OF_CAN = frozenset(
    {"interface", "channel", "bitrate", "fd", "data_bitrate", "restart_after_s", "quiet_after_s"}
)


# fmt: off
@dataclass(frozen=True)
class CanConfig:
    """The CAN interface."""

    interface: str = key(TEXT, "socketcan",
        "interface of python-can: socketcan, virtual, pcan, kvaser, slcan ...")
    channel: str = key(TEXT, "can0", "channel of that interface, for example can0")
    bitrate: int = key(integer(10_000, 1_000_000, "bit/s"), 500_000,
        "bit rate in bit/s. "
        "With socketcan the system sets it, and the gateway only computes the bus load from it")
    fd: bool = key(BOOLEAN, False, "allow CAN FD, that is messages of more than 8 bytes")
    data_bitrate: int = key(integer(10_000, 8_000_000, "bit/s"), 2_000_000,
        "bit rate of CAN FD's data phase in bit/s")
    restart_after_s: float = key(number(0.3, 3600, "s", also=0), 0.0,
        "restart a SocketCAN interface from which no frame has left for this time in seconds, "
        "which discards old frames. It needs the unit kontronik-can-gw-restart@.path. "
        "0 never restarts it")
    options: Mapping[str, str | float] = key(options("can", _OF_CAN), {},
        "more options of the python-can interface, for example host or ttyBaudrate. "
        "SocketCAN has none")
    quiet_after_s: int = key(integer(0, 604_800, "s"), 0,
        "seconds without telemetry after which the gateway only answers requests, "
        "until telemetry returns. 0: never")

    @property
    def quiet_after_ns(self) -> int:
        return self.quiet_after_s * SECOND

    @property
    def restart_after_ns(self) -> int:
        """Time after which a restart is requested. 0: never, as for all but SocketCAN."""
        is_socketcan = self.interface == "socketcan"
        return round(self.restart_after_s * SECOND) if is_socketcan else 0


@dataclass(frozen=True)
class RunConfig:
    """How the gateway runs."""

    wait_for_devices: bool = key(BOOLEAN, False,
        "at start, wait for missing ports and interfaces instead of ending with an error")
    realtime_priority: int | None = key(integer(1, 99), None,
        "real-time priority (SCHED_FIFO). It also locks the memory, so that other programs' load "
        "delays no frame (default: normal priority)")


@dataclass(frozen=True)
class StatisticsConfig:
    """Statistics for `kontronik-can-gw status` and `kontronik-can-gw metrics`."""

    file: str | None = key(TEXT, None,
        "JSON file that is replaced each second, relative to the configuration's folder "
        "(default: a file in the runtime folder, where `status` finds it)")


@dataclass(frozen=True)
class RecordConfig:
    """Captures: recordings of all input, to replay and convert later."""

    directory: str | None = key(TEXT, None,
        "folder for captures, relative to the configuration's folder. "
        "'state' is the folder captures in the service's state folder "
        "(default: only `run --record` records)")
    part_mb: int = key(integer(1, 4000, "MB"), 64, "begin a new file at this size in megabytes")
    part_minutes: int = key(integer(1, 10_000, "min"), 60,
        "begin a new file after this time in minutes")
    keep_mb: int = key(integer(0, 10_000_000, "MB"), 0,
        "remove the oldest captures while the folder's captures exceed this number of megabytes. "
        "0 removes none")
    min_free_mb: int = key(integer(0, 10_000_000, "MB"), 100,
        "pause recording while the file system has less free space, in megabytes")
    on_event: bool = key(BOOLEAN, False,
        "keep the input in memory, and write a capture only around an event: an error bit, "
        "a condition of `when`, a loss of telemetry, or the signal USR1")
    before_s: int = key(integer(1, 600, "s"), 30,
        "on_event: seconds before the first event that a capture has")
    after_s: int = key(integer(1, 3600, "s"), 30,
        "on_event: seconds after the last event that a capture has")
    errors: tuple[str, ...] = key(ERRORS, ("error", "warning"),
        "on_event: error bits that are events, by class or by name")
    when: tuple[str, ...] = key(CONDITIONS, (),
        "on_event: conditions that are events, for example \"battery_voltage < 20\" or "
        "\"esc1.battery_current > 150 A\"")


@dataclass(frozen=True)
class MqttConfig:
    """Broker, topics and rate of `kontronik-can-gw mqtt`."""

    broker: str | None = key(BROKER, None,
        "MQTT broker, for example broker.example or 192.168.1.5:1883 "
        "(default port: 1883, with TLS 8883)")
    tls: bool = key(BOOLEAN, False,
        "encrypt the connection, and check the broker's certificate and name")
    ca_file: str | None = key(TEXT, None,
        "certificate of the authority that signed the broker's certificate, relative to the "
        "configuration's folder (default: the system's authorities)")
    cert_file: str | None = key(TEXT, None,
        "client certificate, relative to the configuration's folder, "
        "for a broker that requires one")
    key_file: str | None = key(TEXT, None,
        "key of the client certificate, relative to the configuration's folder")
    username: str | None = key(TEXT, None, "user name at the broker")
    password_file: str | None = key(TEXT, None,
        "file whose first line is the password, relative to the configuration's folder")
    gateway: str | None = key(LEVEL, None,
        "name of this gateway in the topics (default: the host name)")
    topic: str = key(TOPIC, "kontronik", "first part of all topics")
    rate: float = key(number(0.01, 20, "Hz"), 1.0, "state messages per second for each ESC")
    retain: bool = key(BOOLEAN, False, "ask the broker to keep the last state message of each ESC")
    discovery: str | None = key(TOPIC, None,
        "topic prefix of Home Assistant's discovery, usually 'homeassistant' "
        "(default: no discovery)")

    @property
    def address(self) -> tuple[str, int] | None:
        """Host and port of the broker. None if no broker is configured."""
        if self.broker is None:
            return None
        host, colon, port = self.broker.rpartition(":")
        if not colon or self.broker.endswith("]"):
            host = self.broker
            port = "8883" if self.tls else "1883"
        return host.strip("[]"), int(port)


@dataclass(frozen=True)
class EscConfig:
    """One ESC and its serial port."""

    port: str = key(TEXT, REQUIRED, "serial port, preferably a name below /dev/serial/by-id")
    name: str = key(ESC_NAME, "",
        "short name, which becomes a prefix of messages and signals if there are several ESCs. "
        "The shipped DBC has room for 6 letters (default: esc1, esc2 ...)")
    pole_pairs: int = key(integer(*POLE_PAIRS), 1,
        "pole pairs of the motor (half the number of magnets)")
    gear: Fraction = key(RATIO, Fraction(1),
        "motor revolutions per revolution of the gear's output: "
        "a number or 'numerator/denominator'")
    cell_count: int = key(integer(*CELL_COUNTS), 0,
        "cells of the battery. 0: the number that the ESC reports")
    telemetry_timeout_ms: int = key(integer(*TIMEOUTS_MS, "ms"), 250,
        "age in milliseconds above which live values are not available")
    node_id: int | None = key(NODE_ID, None,
        "CANopen node-ID of this ESC. "
        "255: the node waits for LSS (default: counted up from canopen.node_id)")
    device: str | None = key(choice_of(device_names), None,
        "expected device. Any other device on this port is reported (CANopen EMCY 7510h)")
    protocol: str = key(choice_of(protocol_names), PROTOCOLS[0].name,
        "protocol of the ESC's telemetry")

    @property
    def settings(self) -> EscSettings:
        """The settings for the core."""
        return EscSettings(
            name=self.name,
            pole_pairs=self.pole_pairs,
            gear=self.gear,
            cell_count=self.cell_count,
            timeout_ns=self.telemetry_timeout_ms * MS,
            protocol=self.protocol,
        )

    @property
    def device_number(self) -> int | None:
        """Number of the configured device. None if none is configured or the protocol has none."""
        devices = protocol_named(self.protocol).devices
        return next((number for number, text in devices.items() if text == self.device), None)
# fmt: on


@dataclass(frozen=True)
class Config:
    """The whole configuration."""

    can: CanConfig
    dbc: DbcConfig
    canopen: CanopenConfig
    dronecan: DronecanConfig
    run: RunConfig
    statistics: StatisticsConfig
    record: RecordConfig
    mqtt: MqttConfig
    esc: tuple[EscConfig, ...]
    file: str
    """Path of the configuration file. Paths in it are relative to its folder."""
    warnings: tuple[str, ...] = ()
    """One line for each removed key that the file contains."""

    @cached_property
    def escs(self) -> list[EscSettings]:
        return [esc.settings for esc in self.esc]

    def core_settings(self, escs: Sequence[EscSettings], layout: MessageLayout) -> CoreSettings:
        """Return the settings of the core."""
        return CoreSettings(escs, layout, self.dbc.silent_on_loss, self.can.quiet_after_ns)

    @property
    def dbc_path(self) -> Path:
        """Path of the DBC file."""
        return self._path(self.dbc.file, "dbc/kontronik_esc.dbc")

    @property
    def eds_path(self) -> Path:
        """Path of the EDS file."""
        return self._path(self.canopen.eds, "eds/kontronik_esc.eds")

    def _path(self, name: str, shipped_name: str) -> Path:
        if name == SHIPPED:
            return shipped(shipped_name)
        return Path(self.file).parent / name

    @property
    def statistics_path(self) -> Path | None:
        """Path of the statistics file. None if it is not configured."""
        if self.statistics.file is None:
            return None
        return Path(self.file).parent / self.statistics.file

    @property
    def node_ids(self) -> list[int]:
        """CANopen node-IDs of the ESCs, in their order. They may be greater than 127, or clash."""
        base = self.canopen.node_id
        ids = []
        for index, esc in enumerate(self.esc):
            if esc.node_id is not None:
                ids.append(esc.node_id)
            elif base == UNCONFIGURED:
                ids.append(UNCONFIGURED)
            else:
                ids.append(base + index)
        return ids


TABLES: Mapping[str, Any] = {
    table.name: table.type for table in fields(Config) if is_dataclass(table.type)
} | {"esc": EscConfig}
"""Classes of the tables by name. ``[[esc]]`` is the last."""


def required(table: Any) -> list[Field[Any]]:
    """Return the rows of a table's keys that have no default."""
    return [
        row for row in fields(table) if row.default is REQUIRED and row.default_factory is MISSING
    ]


def shipped(name: str) -> Path:
    """Return the path of a file that is shipped with the package.

    It is inside the package if that is installed, or next to it in a checkout.
    """
    package = Path(__file__).parent.parent
    installed = package / "shipped" / name
    return installed if installed.exists() else package.parent / name
