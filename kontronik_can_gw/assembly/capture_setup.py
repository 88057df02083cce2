"""The gateway's setup in a capture's header: enough to rebuild the same gateway on any machine.

JSON keys of the header (run and recorder add created_ns, run, part, monotonic_ns, wall_ns, devices, state, layout)::

    format, version      "kontronik-can-gw capture", 2
    program              version, python, machine
    configuration        the effective TOML text; file: its path
    escs                 settings of each ESC (gear as "31/4") that were in effect
    ports                their serial ports
    dbc                  file, text (one character a byte), fd, silent_on_loss and the keys of [dbc]; null without it
    canopen              eds (file, text), nodes, stored, escs (settings as configured); null without it
    outputs              further ones by their names: table (as in the configuration), identity, version, seed; not in captures of 0.5.0
"""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

from kontronik_can_gw import __version__
from kontronik_can_gw.capture.format import FORMAT, VERSION, VERSIONS
from kontronik_can_gw.capture.limits import END_OF_TIME, check_state
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.header_parts import (
    HeaderError,
    esc_json,
    esc_of,
    file_bytes,
    reading,
    short_text,
    whole_number,
)
from kontronik_can_gw.core.output_setup import OUTPUTS, Given, OutputSetup, setup_of
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from cantools.database.can import Database

    from kontronik_can_gw.canopen.node_settings import NodeSettings
    from kontronik_can_gw.canopen.nodes import CanopenSetup

Header = Mapping[str, Any]
_LATEST, _SEEDS = 1 << 62, (1 << 64) - 1
_DBC_KEYS = {
    f.name: {"e2e_data_ids": "data_ids", "send_type": "send_types"}.get(f.name, f.name)
    for f in fields(DbcConfig)
    if f.name not in ("enabled", "file", "on_loss")
}
"""Keys of [dbc] to their names in a header."""
_KINDS = {"program": dict, "devices": list, "escs": list, "ports": list, "state": dict}


@dataclass(frozen=True)
class CaptureSetup:
    """Everything that a gateway is built from. ``dbc``: name and bytes of the DBC file, None without DBC output."""

    escs: tuple[EscSettings, ...]
    ports: tuple[str, ...]
    dbc: tuple[str, bytes] | None
    dbc_settings: DbcConfig
    fd: bool
    canopen: "CanopenSetup | None"
    configuration: str = ""
    file: str = ""
    version: int = VERSION
    """Of the capture's format; 1: of 0.5.0."""
    outputs: tuple[OutputSetup, ...] = ()

    def header(self) -> dict[str, Any]:
        """The header's JSON content."""
        dbc = None
        if self.dbc is not None:
            name, data = self.dbc
            dbc = {"file": name, "text": data.decode("latin-1"), "fd": self.fd}
            dbc["silent_on_loss"] = self.dbc_settings.silent_on_loss
            dbc |= {name: getattr(self.dbc_settings, key) for key, name in _DBC_KEYS.items()}
        return {
            "format": FORMAT,
            "version": VERSION,
            "program": {
                "version": __version__,
                "python": platform.python_version(),
                "machine": platform.machine(),
            },
            "configuration": self.configuration,
            "file": self.file,
            "escs": [esc_json(esc) for esc in self.escs],
            "ports": list(self.ports),
            "dbc": dbc,
            "canopen": None if self.canopen is None else _canopen_json(self.canopen),
            "outputs": {setup.name: _output_json(setup.given) for setup in self.outputs},
        }

    @classmethod
    def of(cls, header: Header) -> "CaptureSetup":
        """Read a capture's header. HeaderError with the reason if it is not ours or invalid."""
        if header.get("format") != FORMAT:
            raise HeaderError("the header does not belong to a capture")
        if header.get("version") not in VERSIONS:
            raise HeaderError(
                f"capture version {header.get('version')} is unknown, this program knows versions up to {VERSION}"
            )
        try:
            with reading("the header"):
                _check(header)
                return cls._of(header)
        except (HeaderError, UserError) as error:
            raise HeaderError(f"the header cannot be used: {error}") from None

    @classmethod
    def _of(cls, header: Header) -> "CaptureSetup":
        dbc = header["dbc"]
        settings, file = DbcConfig(), None
        if dbc is not None:
            with reading("dbc"):
                file = (str(dbc["file"]), file_bytes(dbc["text"], "dbc"))
                settings = _dbc_settings(dbc)
        found = header["canopen"]
        with reading("escs"):
            escs = tuple(esc_of(esc) for esc in header["escs"])
        return cls(
            escs,
            tuple(map(str, header["ports"])),
            file,
            settings,
            bool(dbc and dbc["fd"]),
            None if found is None else _canopen(found),
            str(header["configuration"]),
            str(header["file"]),
            header["version"],
            tuple(_output(name, of, escs) for name, of in header.get("outputs", {}).items()),
        )

    def database(self) -> tuple["Database", Layout] | None:
        """The DBC that was sent by and its layout; None without DBC output. UserError if this version refuses it."""
        if self.dbc is None:
            return None
        name, data = self.dbc
        database = parse_database(data, name)
        return database, prepare(database, name, self.escs, self.dbc_settings, self.fd)

    def gateway(self, layout: Layout, now: int) -> Gateway:
        """The gateway in its state before the start."""
        return Gateway(
            *(self.escs, layout, now, self.dbc_settings.silent_on_loss, self.canopen),
            further=[setup.make for setup in self.outputs],
        )


def _canopen_json(setup: "CanopenSetup") -> dict[str, Any]:
    from kontronik_can_gw.canopen.storage import encode

    return {
        "eds": {"file": setup.eds.name, "text": setup.eds.data.decode("latin-1")},
        "nodes": [asdict(node) for node in setup.settings],
        "stored": [encode(stored).decode("ascii") for stored in setup.stored],
        "escs": [esc_json(esc) for esc in setup.escs],
    }


def _canopen(found: Mapping[str, Any]) -> "CanopenSetup":
    from kontronik_can_gw.canopen.eds import load as eds_of
    from kontronik_can_gw.canopen.nodes import CanopenSetup
    from kontronik_can_gw.canopen.storage import decode

    with reading("canopen"):
        eds = eds_of(file_bytes(found["eds"]["text"], "canopen.eds"), found["eds"]["file"])
    with reading("canopen.nodes"):
        nodes = tuple(_node(node) for node in found["nodes"])
    with reading("canopen.stored"):
        stored = tuple(decode(text.encode("ascii")) for text in found["stored"])
    with reading("canopen.escs"):
        return CanopenSetup(eds, nodes, stored, tuple(esc_of(esc) for esc in found["escs"]))


def _output_json(given: Given) -> dict[str, Any]:
    return given._asdict() | {"table": asdict(given.table), "identity": given.identity.hex()}


def _output(name: str, found: Mapping[str, Any], escs: Sequence[EscSettings]) -> OutputSetup:
    """Settings checked like those of a configuration."""
    if name not in OUTPUTS:
        raise HeaderError(f"{str(name)[:40]!r} is no output that this version knows")
    with reading(f"outputs.{name}"):
        table = getattr(parse({name: found["table"], "esc": [{"port": "-"}]}, "the capture"), name)
        identity = bytes.fromhex(found["identity"])
        seed = whole_number(found["seed"], 0, _SEEDS)
        major, minor = (whole_number(each, 0, 255) for each in found["version"])
        return setup_of(name, Given(table, identity, (major, minor), seed), escs)


def _dbc_settings(found: Mapping[str, Any]) -> DbcConfig:
    """Settings checked like those of a configuration. Captures of 0.5.0 have fewer."""
    keys = {key: found.get(name) for key, name in _DBC_KEYS.items()}
    given = {key: value for key, value in keys.items() if value not in (None, {}, [])}
    given |= {key: found[_DBC_KEYS[key]] for key in ("bind", "e2e_data_ids")}
    given["on_loss"] = "silent" if found["silent_on_loss"] else "not_available"
    return parse({"dbc": given, "esc": [{"port": "-"}]}, "the capture").dbc


def _check(header: Header) -> None:
    """Check the parts that readers use unchanged. HeaderError for what a recorder never writes."""
    for name, latest in (
        ("monotonic_ns", END_OF_TIME - 1),
        ("created_ns", END_OF_TIME - 1),
        ("wall_ns", _LATEST),
    ):
        if header.get(name) is not None:
            whole_number(header[name], 0, latest)
    for name in ("run", "file"):
        short_text(header.get(name, ""), 4096)
    whole_number(header.get("part", 0), 0, 1 << 32)
    for name, kind in _KINDS.items():
        if not isinstance(header.get(name, kind()), kind):
            raise HeaderError(f"{name} is not as a recorder writes it")
    if not 1 <= len(header["escs"]) <= 1000 or not isinstance(header["configuration"], str):
        raise HeaderError("escs or configuration is not as a recorder writes it")
    check_state(header.get("state", {}))


def _node(found: Mapping[str, Any]) -> "NodeSettings":
    from kontronik_can_gw.canopen.node_settings import NodeSettings

    device, vendor = found["device"], found["vendor_id"]
    return NodeSettings(
        whole_number(found["node_id"], 1, 255),
        whole_number(found["serial"], 0, 0xFFFF_FFFF),
        None if vendor is None else whole_number(vendor, 0, 0xFFFF_FFFF),
        bool(found["self_start"]),
        bool(found["read_only"]),
        whole_number(found["bitrate"], 1, 100_000_000),
        whole_number(found["segment_ns"], 0, _LATEST),
        short_text(found["version"], 100),
        None if device is None else whole_number(device, 0, 0xFFFF),
    )
