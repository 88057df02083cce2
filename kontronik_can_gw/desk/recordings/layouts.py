"""The DBC that describes a gateway's frames, and the ESCs whose values they contain."""

from collections import Counter
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
from kontronik_can_gw.esc.value_names import VALUES_BY_KEY, normalize
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.signals.plan import MessageLayout

if TYPE_CHECKING:
    from cantools.database.can import Database


@dataclass(frozen=True)
class BusLayout:
    """A DBC as it was read, and the layout compiled from it."""

    database: "Database"
    layout: MessageLayout
    escs: Sequence[EscSettings]
    config: Config | None = None
    """The configuration that names the DBC. None if the DBC was given alone."""

    def copies(self) -> dict[str, Copy]:
        """Return the file's messages by their names on the bus."""
        layout = self.layout
        settings = DbcConfig(node=layout.node)
        if self.config is not None:
            settings = self.config.dbc
        copies = copies_of(self.database, layout.file, self.escs, settings)
        return {copy.name: copy for copy in copies}


def layout_of_dbc(file: Path, known: Sequence[EscSettings] = ()) -> BusLayout:
    """Return the layout of a DBC that was given without a configuration.

    The names of its signals begin with the names of its ESCs. A DBC of one ESC is expanded to all
    ``known`` ESCs. Pole pairs and gears are taken from the ``known`` ESCs in their order, and are 1
    without them. Raises UserError if a signal has no known meaning.
    """
    database = load_database(file)
    node = choose_node(database, None, str(file))
    return _compile_layout(database, node, str(file), known)


def shown_by(layout: BusLayout, known: Sequence[EscSettings]) -> BusLayout:
    """Return the layout in which a recording of the ``known`` ESCs is shown.

    A DBC without a configuration takes their pole pairs and gears. Raises UserError if the layout
    describes another number of ESCs.
    """
    if layout.config is None:
        own = layout.layout
        return _compile_layout(layout.database, own.node, own.file, known)
    if len(layout.escs) != len(known):
        raise UserError(
            f"{layout.config.file}: has {len(layout.escs)} ESCs, but the recording has {len(known)}"
        )
    return layout


def _compile_layout(
    database: "Database",
    node: str,
    file: str,
    known: Sequence[EscSettings],
) -> BusLayout:
    from kontronik_can_gw.dbc.prepare import prepare

    names = esc_names(database, node)
    if names and known and len(names) != len(known):
        raise UserError(f"{file}: describes {len(names)} ESCs, but the recording has {len(known)}")
    escs = list(known)
    if names and known:
        escs = [replace(esc, name=name) for esc, name in zip(known, names, strict=True)]
    elif not known:
        escs = [EscSettings(name) for name in names or ["esc1"]]
    layout = prepare(
        database,
        file,
        escs,
        DbcConfig(node=node),
        is_fd_allowed=True,
    )
    return BusLayout(database, layout, escs)


def esc_names(database: "Database", node: str) -> list[str]:
    """Return the ESCs' names, which precede the values' names in the signals of ``node``.

    They have the order of the messages. Empty for a DBC of one ESC.
    """
    values_of_escs = [
        name for name, value in VALUES_BY_KEY.items() if value.group is not Group.GATEWAY
    ]
    counts: Counter[str] = Counter()
    for message in database.messages:
        if node not in message.senders:
            continue
        for signal in message.signals:
            key = normalize(signal.name).removesuffix("percent")
            if key in VALUES_BY_KEY:
                continue
            endings = [name for name in values_of_escs if key.endswith(name)]
            ending = max(endings, key=len, default="")
            name = signal.name.removesuffix("Percent")
            prefix = name[: len(name) - len(ending)].rstrip("_")
            if ending and prefix:
                counts[prefix] += 1
    return [name for name, count in counts.items() if count > 1]
