"""What the compilers of messages and signals share."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.binding import Binder
from kontronik_can_gw.dbc.settings import DbcSettings

if TYPE_CHECKING:
    from cantools.database.can import Database


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
    while_active: list[str] = field(default_factory=list)
    """Messages whose send type means: only while a signal is active."""
    unbound: int = 0
    """Number of signals without a source."""
