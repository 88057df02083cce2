"""How a DBC is used: the part of the configuration that the compiler needs, and what it finds with that."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.binding import Binder

if TYPE_CHECKING:
    from cantools.database.can import Database


@dataclass(frozen=True)
class DbcSettings:
    """How a DBC is used. ``bind``: "Message.Signal" or "Signal" to a source name (``name`` or ``esc.name``) or a constant."""

    bind: Mapping[str, str | float] = field(default_factory=dict)
    node: str | None = None
    """The transmitter node whose messages we send; None: the only one that sends."""
    base_id: int | None = None
    id_step: int | None = None
    data_ids: Mapping[str, int] = field(default_factory=dict)
    """Message name to E2E data id; otherwise the CAN id's low 16 bits."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit text of the DBC to the unit that it means."""
    send_types: Mapping[str, str] = field(default_factory=dict)
    """GenMsgSendType to the entry of ``timing.SEND_TYPES`` that it means."""
    messages: tuple[str, ...] = ()
    """Patterns that select our messages by name (used by ``prepare``); empty: all."""
    unbound: str = "error"
    """For a signal without a source: "error", or always send its "start_value"."""
    flags_on_loss: int | None = None
    """Value without telemetry of a flag that has no code for it; None: its own start value, else 0."""


class UnfitSignal(Exception):
    """Why a signal cannot be sent, as it follows the signal's place in an error."""


@dataclass
class Compilation:
    """A DBC with its settings, and what is found while it is compiled."""

    database: "Database"
    file: str
    settings: DbcSettings
    binder: Binder
    fd_allowed: bool
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    units: set[str] = field(default_factory=set)
    """Unit texts of our signals."""
    send_types: set[str] = field(default_factory=set)
    unbound: set[str] = field(default_factory=set)
    """Signals without a source."""
