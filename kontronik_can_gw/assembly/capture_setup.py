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
from dataclasses import dataclass, fields
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
from kontronik_can_gw.core.output_setup import OUTPUTS, OutputSetup, setup_module
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from cantools.database.can import Database

Header = Mapping[str, Any]
_LATEST = 1 << 62
_IN_HEADER = ("canopen",)
"""Outputs that stand in the header itself, as in captures of 0.5.0. The others are in "outputs"."""
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
        outputs = {setup.name: setup.header() for setup in self.outputs}
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
            **{name: outputs.pop(name, None) for name in _IN_HEADER},
            "outputs": outputs,
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
        with reading("escs"):
            escs = tuple(esc_of(esc) for esc in header["escs"])
        return cls(
            escs,
            tuple(map(str, header["ports"])),
            file,
            settings,
            bool(dbc and dbc["fd"]),
            str(header["configuration"]),
            str(header["file"]),
            header["version"],
            _outputs_of(header, escs),
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
        return Gateway(self.escs, layout, now, self.dbc_settings.silent_on_loss, self.outputs)


def _outputs_of(header: Header, escs: Sequence[EscSettings]) -> tuple[OutputSetup, ...]:
    """Read the outputs of a header."""
    found = dict(header.get("outputs", {}))
    for name in found:
        if name not in OUTPUTS:
            raise HeaderError(f"{str(name)[:40]!r} is no output that this version knows")
    for name in _IN_HEADER:
        if header[name] is not None:
            found[name] = header[name]
    names = [name for name in OUTPUTS if name in found]
    return tuple(setup_module(name).recorded(found[name], escs) for name in names)


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
