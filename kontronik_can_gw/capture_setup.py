"""What a capture's header holds of the gateway that was recorded: enough to make the same gateway again, on any machine.

JSON keys of the header (beside those that run and recorder add: created_ns, run, part, monotonic_ns, wall_ns, devices, state)::

    format, version      "kontronik-can-gw capture", 1
    program              version, python, machine
    configuration        the effective TOML text; file: where it stood
    escs                 settings of each ESC (gear as "31/4"), as they held
    ports                their serial ports
    dbc                  file, text (one character a byte), node, bind, base_id, id_step, data_ids, fd, silent_on_loss; null without it
    canopen              eds (file, text), nodes, stored, escs (settings as configured); null without it
"""

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from kontronik_can_gw import __version__
from kontronik_can_gw.capture import FORMAT, VERSION
from kontronik_can_gw.cia301.eds import load as eds_of
from kontronik_can_gw.cia301.node import NodeSettings
from kontronik_can_gw.cia301.nodes import CanopenSetup
from kontronik_can_gw.cia301.storage import Stored, decode, encode
from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout, parse_database
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.protocol.states import Device
from kontronik_can_gw.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database

Header = Mapping[str, Any]


@dataclass(frozen=True)
class CaptureSetup:
    """A gateway's making. ``dbc``: name and bytes of the DBC file, None without DBC output."""

    escs: tuple[EscSettings, ...]
    ports: tuple[str, ...]
    dbc: tuple[str, bytes] | None
    dbc_settings: DbcSettings
    fd: bool
    silent_on_loss: bool
    canopen: CanopenSetup | None
    configuration: str = ""
    file: str = ""

    def header(self) -> dict[str, Any]:
        """As it stands in a capture."""
        dbc: dict[str, Any] | None = None
        if self.dbc is not None:
            name, data = self.dbc
            dbc = {"file": name, "text": data.decode("latin-1"), "fd": self.fd, "silent_on_loss": self.silent_on_loss}
            dbc |= asdict(self.dbc_settings)
        canopen: dict[str, Any] | None = None
        if self.canopen is not None:
            setup = self.canopen
            canopen = {
                "eds": {"file": setup.eds.name, "text": setup.eds.data.decode("latin-1")},
                "nodes": [asdict(node) | {"device": node.device and int(node.device)} for node in setup.settings],
                "stored": [encode(stored).decode("ascii") for stored in setup.stored],
                "escs": [_esc_json(esc) for esc in setup.escs],
            }
        return {
            "format": FORMAT,
            "version": VERSION,
            "program": {"version": __version__, "python": platform.python_version(), "machine": platform.machine()},
            "configuration": self.configuration,
            "file": self.file,
            "escs": [_esc_json(esc) for esc in self.escs],
            "ports": list(self.ports),
            "dbc": dbc,
            "canopen": canopen,
        }

    @classmethod
    def of(cls, header: Header) -> "CaptureSetup":
        """From a capture's header. ValueError, with the reason, for what is none of ours."""
        if header.get("format") != FORMAT:
            raise ValueError("the header is not that of a capture")
        if header.get("version") != VERSION:
            raise ValueError(
                f"capture version {header.get('version')} is unknown, this program knows version {VERSION}"
            )
        try:
            return cls._of(header)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"the header cannot be used: {error!r}") from None

    @classmethod
    def _of(cls, header: Header) -> "CaptureSetup":
        dbc = header["dbc"]
        settings, file = DbcSettings(), None
        if dbc is not None:
            file = (str(dbc["file"]), dbc["text"].encode("latin-1"))
            settings = DbcSettings(dbc["bind"], dbc["node"], dbc["base_id"], dbc["id_step"], dbc["data_ids"])
        found = header["canopen"]
        canopen = None
        if found is not None:
            canopen = CanopenSetup(
                eds_of(found["eds"]["text"].encode("latin-1"), found["eds"]["file"]),
                tuple(_node(node) for node in found["nodes"]),
                tuple(_stored(text) for text in found["stored"]),
                tuple(_esc(esc) for esc in found["escs"]),
            )
        return cls(
            tuple(_esc(esc) for esc in header["escs"]),
            tuple(map(str, header["ports"])),
            file,
            settings,
            bool(dbc and dbc["fd"]),
            bool(dbc and dbc["silent_on_loss"]),
            canopen,
            str(header["configuration"]),
            str(header["file"]),
        )

    def database(self) -> tuple["Database", Layout] | None:
        """The database of what was sent, and its layout; None without DBC output. UserError if this version refuses it."""
        if self.dbc is None:
            return None
        name, data = self.dbc
        return prepare(parse_database(data, name), name, self.escs, self.dbc_settings, self.fd)

    def gateway(self, layout: Layout, now: int) -> Gateway:
        """The gateway, as it was before its start."""
        return Gateway(self.escs, layout, now, self.silent_on_loss, self.canopen)


def _esc_json(esc: EscSettings) -> dict[str, Any]:
    return asdict(esc) | {"gear": str(esc.gear)}


def _esc(found: Mapping[str, Any]) -> EscSettings:
    return EscSettings(**(dict(found) | {"gear": Fraction(found["gear"])}))


def _node(found: Mapping[str, Any]) -> NodeSettings:
    device = found["device"]
    return NodeSettings(**(dict(found) | {"device": None if device is None else Device(device)}))


def _stored(text: str) -> Stored:
    return decode(text.encode("ascii"))
