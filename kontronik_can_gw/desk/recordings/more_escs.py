"""Whether a log is of more ESCs than its DBC: has it ids of the DBC's messages as ``dbc --esc N`` moves them?"""

from collections.abc import Mapping
from contextlib import suppress

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import EXTENDED

MAX_ESCS = 8


def more_escs(bus: BusLayout, ours: set[int], others: Mapping[int, int]) -> str:
    """A hint for the person, in a line; empty where there is none.

    ``ours``: ids of the layout that came (29 bits with EXTENDED), ``others``: how often each other one came.
    """
    if len(bus.escs) != 1 or not ours or not others:
        return ""
    found, frames = 1, 0
    for count in range(2, MAX_ESCS + 1):
        by_esc: list[set[int]] = []
        with suppress(UserError):  # that many do not fit
            by_esc = _ids(bus, count)
        here = [ids & (others.keys() | ours) for ids in by_esc]
        # half of the messages: some come rarely, or are switched off
        if not by_esc or any(
            2 * len(came) < len(ids) for came, ids in zip(here, by_esc, strict=True)
        ):
            break
        found = count
        frames = sum(others.get(key, 0) for key in set().union(*here))
    if found == 1:
        return ""
    file = bus.layout.file
    source = "" if file == str(shipped("dbc/kontronik_esc.dbc")) else f" --from {file}"
    return (
        f"{frames} frames are not in {file.rpartition('/')[2]}, of one ESC: they look like those of {found} ESCs. "
        f"Give -c, or make their DBC (kontronik-can-gw dbc{source} --esc {found} -o escs.dbc) and give --dbc escs.dbc."
    )


def _ids(bus: BusLayout, count: int) -> list[set[int]]:
    """The ids of each of ``count`` ESCs, as ``dbc`` gives them."""
    from kontronik_can_gw.dbc.expand import expand
    from kontronik_can_gw.dbc.names import esc_prefix

    escs = [EscSettings(f"esc{number}") for number in range(1, count + 1)]
    names = {message.name for message in bus.database.messages}
    made, _ = expand(bus.database, bus.layout.node, escs, bus.layout.file)
    found: list[set[int]] = [set() for _ in escs]
    for message in made.messages:
        if message.name in names:  # it is taken over once
            continue
        for index, esc in enumerate(escs):
            if message.name.startswith(esc_prefix(esc.name)):
                found[index].add(message.frame_id | (EXTENDED if message.is_extended_frame else 0))
    return found if all(found) else []
