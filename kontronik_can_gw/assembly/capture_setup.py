"""The gateway's setup in a capture's header: enough to make the same gateway on any machine.

JSON keys of the header::

    format, version  "kontronik-can-gw capture", 2
    program          version, python, machine
    numbers of the core by name (core/settings.py: NUMBERS). Missing in captures of 0.5.0
    configuration    the effective TOML text
    file             the path of the configuration
    escs             settings of each ESC that were in effect, with ratios such as "31/4"
    ports            the serial ports of the ESCs
    dbc              file, text (one character a byte), fd, silent_on_loss, likely_data_ids and
                     the keys of [dbc]. null without a DBC. likely_data_ids is true if E2E data IDs
                     of unusual attributes, and of messages without a profile, were used. It is
                     missing in captures of 0.5.0
    canopen          eds (file, text), nodes, stored, escs (settings as configured).
                     null without nodes
    outputs          the other outputs by name, each with table (as in the configuration),
                     identity, version and seed. Missing in captures of 0.5.0

The recorder adds created_ns, run, part, monotonic_ns, wall_ns, devices, state and layout. Since 0.6
it adds clock, the state of the wall clock at the beginning of the part: synchronized (null if
unknown), max_error_s, hardware (the name of the hardware clock, empty without one), steps since the
start of the gateway, and last_step_ns and last_step_by_ns.
"""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from kontronik_can_gw import __version__
from kontronik_can_gw.capture.format import FORMAT, VERSION, VERSIONS
from kontronik_can_gw.capture.limits import check_state
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.core.header_parts import (
    LATEST_NS,
    HeaderError,
    esc_json,
    esc_of,
    file_bytes,
    reading,
    short_text,
    whole_number,
)
from kontronik_can_gw.core.output_setup import OUTPUTS, OutputSetup, setup_module
from kontronik_can_gw.core.settings import NUMBERS, CoreSettings
from kontronik_can_gw.dbc.prepare import prepare
from kontronik_can_gw.dbc.protection import remove_later_data_ids
from kontronik_can_gw.dbc.reader import parse_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import END_OF_TIME

if TYPE_CHECKING:
    from cantools.database.can import Database

Header = Mapping[str, Any]
_MAX_PATH = 4096
_MAX_ESCS = 1000
_IN_HEADER = ("canopen",)
"""Outputs with a key in the header itself, as in captures of 0.5.0. Others are in "outputs"."""
_OTHER_DBC_NAMES = {"e2e_data_ids": "data_ids", "send_type": "send_types"}
_DBC_KEYS = {
    each.name: _OTHER_DBC_NAMES.get(each.name, each.name)
    for each in fields(DbcConfig)
    if each.name not in ("enabled", "file", "on_loss")
}
"""For each key of [dbc], its name in a header."""
_TYPES = {
    "program": dict,
    "devices": list,
    "escs": list,
    "ports": list,
    "state": dict,
    "clock": dict,
}
_JSON_NAMES = {dict: "table", list: "list"}


@dataclass(frozen=True)
class CaptureSetup:
    """Everything from which a gateway is made."""

    escs: tuple[EscSettings, ...]
    """The settings in effect."""
    ports: tuple[str, ...]
    dbc: tuple[str, bytes] | None
    """Name and content of the DBC file. None without a DBC."""
    dbc_settings: DbcConfig
    fd: bool
    """True if the interface allows CAN FD."""
    configuration: str = ""
    """The effective TOML text."""
    file: str = ""
    """The path of the configuration."""
    version: int = VERSION
    """The version of the capture's format. 0.5.0 wrote version 1."""
    outputs: tuple[OutputSetup, ...] = ()
    core_numbers: Mapping[str, int] = field(default_factory=dict)
    """The settings of the core that are one number (``core/settings.py``: NUMBERS)."""
    has_likely_data_ids: bool = True
    """False if the run did not use E2E data IDs that 0.5.0 did not use either."""

    def header(self) -> dict[str, Any]:
        """Return the header's JSON content."""
        outputs = {setup.name: setup.header() for setup in self.outputs}
        in_header = {name: outputs.pop(name, None) for name in _IN_HEADER}
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
            "dbc": self._dbc_json(),
            **self.core_numbers,
            **in_header,
            "outputs": outputs,
        }

    def _dbc_json(self) -> dict[str, Any] | None:
        if self.dbc is None:
            return None
        file, data = self.dbc
        settings = self.dbc_settings
        found = {"file": file, "text": data.decode("latin-1"), "fd": self.fd}
        found["silent_on_loss"] = settings.silent_on_loss
        found["likely_data_ids"] = self.has_likely_data_ids
        for key, name in _DBC_KEYS.items():
            found[name] = getattr(settings, key)
        return found

    @classmethod
    def of(cls, header: Header) -> "CaptureSetup":
        """Read a capture's header. Raises HeaderError with the reason if it cannot be used."""
        if header.get("format") != FORMAT:
            raise HeaderError("the header does not belong to a capture")
        version = header.get("version")
        if version not in VERSIONS:
            raise HeaderError(
                f"capture version {version} is not supported, only versions up to {VERSION}"
            )
        try:
            with reading("a part"):
                _check(header)
                return cls._of(header)
        except (HeaderError, UserError) as error:
            raise HeaderError(f"the header cannot be used: {error}") from None

    @classmethod
    def _of(cls, header: Header) -> "CaptureSetup":
        dbc = header["dbc"]
        settings = DbcConfig()
        dbc_file = None
        if dbc is not None:
            with reading("dbc"):
                dbc_file = (str(dbc["file"]), file_bytes(dbc["text"], "dbc"))
                settings = _dbc_settings(dbc)
        with reading("escs"):
            escs = tuple(esc_of(esc) for esc in header["escs"])
        core_numbers = {}
        for name, high in NUMBERS.items():
            number = header.get(name, getattr(CoreSettings, name))
            core_numbers[name] = whole_number(number, 0, high)
        return cls(
            escs=escs,
            ports=tuple(map(str, header["ports"])),
            dbc=dbc_file,
            dbc_settings=settings,
            fd=bool(dbc and dbc["fd"]),
            configuration=str(header["configuration"]),
            file=str(header["file"]),
            version=header["version"],
            outputs=_outputs_of(header, escs),
            core_numbers=core_numbers,
            has_likely_data_ids=bool(dbc and dbc.get("likely_data_ids")),
        )

    def database(self) -> tuple["Database", MessageLayout] | None:
        """Return the recorded DBC and its layout, or None. UserError if this version refuses it."""
        if self.dbc is None:
            return None
        name, data = self.dbc
        database = parse_database(data, name)
        if not self.has_likely_data_ids:
            remove_later_data_ids(database, self.dbc_settings)
        return database, prepare(database, name, self.escs, self.dbc_settings, self.fd)

    def gateway(self, layout: MessageLayout, now: int) -> Gateway:
        """Return the gateway in its state before the start."""
        is_silent = self.dbc_settings.silent_on_loss
        settings = CoreSettings(self.escs, layout, is_silent, **self.core_numbers)
        return Gateway(settings, now, self.outputs)


def _outputs_of(header: Header, escs: Sequence[EscSettings]) -> tuple[OutputSetup, ...]:
    """Read the outputs of a header."""
    found = dict(header.get("outputs", {}))
    for name in found:
        if name not in OUTPUTS or name in _IN_HEADER:
            raise HeaderError(f"{str(name)[:40]!r} is not an output of this version")
    for name in _IN_HEADER:
        if header[name] is not None:
            found[name] = header[name]
    names = [name for name in OUTPUTS if name in found]
    return tuple(setup_module(name).recorded(found[name], escs) for name in names)


def _dbc_settings(found: Mapping[str, Any]) -> DbcConfig:
    """Read the keys of [dbc], and check them as in a configuration.

    Captures of 0.5.0 have fewer keys. Two of them are always there.
    """
    given = {}
    for key, name in _DBC_KEYS.items():
        value = found.get(name)
        if value not in (None, {}, []):
            given[key] = value
    for key in ("bind", "e2e_data_ids"):
        given[key] = found[_DBC_KEYS[key]]
    given["on_loss"] = "silent" if found["silent_on_loss"] else "not_available"
    return parse({"dbc": given, "esc": [{"port": "-"}]}, "the capture").dbc


def _check(header: Header) -> None:
    """Check the parts that readers use unchanged. HeaderError if no recorder writes them so."""
    for name, latest in (
        ("monotonic_ns", END_OF_TIME - 1),
        ("created_ns", END_OF_TIME - 1),
        ("wall_ns", LATEST_NS),
    ):
        if header.get(name) is not None:
            with reading(name):
                whole_number(header[name], 0, latest)
    for name in ("run", "file"):
        with reading(name):
            short_text(header.get(name, ""), _MAX_PATH)
    with reading("part"):
        whole_number(header.get("part", 0), 0, 1 << 32)
    for name, part_type in _TYPES.items():
        if not isinstance(header.get(name, part_type()), part_type):
            raise HeaderError(f'"{name}" is not a {_JSON_NAMES[part_type]}')
    if not 1 <= len(header["escs"]) <= _MAX_ESCS:
        raise HeaderError(f'"escs" does not have 1 to {_MAX_ESCS} entries')
    if not isinstance(header["configuration"], str):
        raise HeaderError('"configuration" is not a text')
    with reading("state"):
        check_state(header.get("state", {}))
