"""Which DBC describes frames of ours, and whose values they hold."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.config.keys import Config
from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.expand import copies_of
from kontronik_can_gw.dbc.reader import choose_node, load_database
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.esc.values import VALUES, Group
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from cantools.database.can import Database


@dataclass(frozen=True)
class BusLayout:
    """A DBC as it was read, and its layout. ``config``: where it came from, None for a DBC alone."""

    database: "Database"
    layout: Layout
    escs: Sequence[EscSettings]
    config: Config | None = None

    def copies(self) -> dict[str, Copy]:
        """The file's messages by their names on the bus."""
        layout = self.layout
        settings = self.config.dbc if self.config else DbcConfig(node=layout.node)
        copies = copies_of(self.database, layout.file, self.escs, settings)
        return {copy.name: copy for copy in copies}


def layout_of_dbc(file: Path, known: Sequence[EscSettings] = ()) -> BusLayout:
    """A DBC alone. UserError where a signal means nothing.

    Its ESCs are those that the names of its signals begin with; a DBC of one ESC is made one of all that are ``known``. Pole pairs and gear
    are those of the ``known`` ones, in their order, and 1 otherwise.
    """
    database = load_database(file)
    return _made(database, choose_node(database, None, str(file)), str(file), known)


def shown_by(layout: BusLayout, known: Sequence[EscSettings]) -> BusLayout:
    """A layout that was given for a recording of these ESCs: one of a DBC alone takes their pole pairs and gears.

    UserError where it describes other ESCs than there are.
    """
    if layout.config is None:
        return _made(layout.database, layout.layout.node, layout.layout.file, known)
    if len(layout.escs) != len(known):
        raise UserError(
            f"{layout.config.file}: has {len(layout.escs)} ESCs, the recording {len(known)}"
        )
    return layout


def _made(database: "Database", node: str, file: str, known: Sequence[EscSettings]) -> BusLayout:
    from kontronik_can_gw.dbc.prepare import prepare

    names = esc_names(database, node)
    if names and known and len(names) != len(known):
        raise UserError(f"{file}: describes {len(names)} ESCs, the recording has {len(known)}")
    escs = list(known) or [EscSettings(name) for name in names] or [EscSettings("esc1")]
    if names:
        escs = [replace(esc, name=name) for esc, name in zip(escs, names, strict=True)]
    layout = prepare(database, file, escs, DbcConfig(node=node), fd_allowed=True)
    return BusLayout(database, layout, escs)


def esc_names(database: "Database", node: str) -> list[str]:
    """What stands in front of sources' names in the signals of ours, in the order of the messages; empty for a DBC of one ESC."""
    groups = {normalize(name): value.group for name, value in VALUES.items()}
    known = [name for name, group in groups.items() if group is not Group.GATEWAY]
    counts: dict[str, int] = {}
    for message in database.messages:
        if node not in message.senders:
            continue
        for signal in message.signals:
            key = normalize(signal.name).removesuffix("percent")
            if key in groups:
                continue
            ending = max((name for name in known if key.endswith(name)), key=len, default="")
            name = signal.name.removesuffix("Percent")
            prefix = name[: len(name) - len(ending)].rstrip("_")
            if ending and prefix:
                counts[prefix] = counts.get(prefix, 0) + 1
    return [name for name, count in counts.items() if count > 1]
