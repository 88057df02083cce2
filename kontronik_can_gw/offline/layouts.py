"""Which DBC describes frames of ours, and whose values they hold."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.config import Config
from kontronik_can_gw.dbc_output.layout import DbcSettings, Layout, choose_node, load_database, normalize
from kontronik_can_gw.sources import Group, sources
from kontronik_can_gw.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database


@dataclass(frozen=True)
class BusLayout:
    """A DBC in use. ``config``: where it came from, None for a DBC alone."""

    database: "Database"
    layout: Layout
    escs: Sequence[EscSettings]
    config: Config | None = None


def layout_of_dbc(file: Path) -> BusLayout:
    """A DBC alone: its ESCs are those that the names of its signals begin with. UserError where a signal means nothing."""
    from kontronik_can_gw.dbc_output.prepare import prepare

    database = load_database(file)
    node = choose_node(database, None, str(file))
    escs = [EscSettings(name) for name in esc_names(database, node)] or [EscSettings("esc1")]
    database, layout = prepare(database, str(file), escs, DbcSettings(node=node), fd_allowed=True)
    return BusLayout(database, layout, escs)


def esc_names(database: "Database", node: str) -> list[str]:
    """What stands in front of sources' names in the signals of ours, in the order of the messages; empty for a DBC of one ESC."""
    known = {
        normalize(name): source for name, source in sources(EscSettings()).items() if source.group is not Group.GATEWAY
    }
    of_gateway = {normalize(name) for name, source in sources(EscSettings()).items() if source.group is Group.GATEWAY}
    counts: dict[str, int] = {}
    for message in database.messages:
        if node not in message.senders:
            continue
        for signal in message.signals:
            key = normalize(signal.name).removesuffix("percent")
            if key in known or key in of_gateway:
                continue
            ending = max((name for name in known if key.endswith(name)), key=len, default="")
            prefix = signal.name[: len(signal.name.removesuffix("Percent")) - len(ending)].rstrip("_")
            if ending and prefix:
                counts[prefix] = counts.get(prefix, 0) + 1
    return [name for name, count in counts.items() if count > 1]
