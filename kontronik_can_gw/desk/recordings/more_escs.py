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
    from kontronik_can_gw.dbc.expand import expand
    from kontronik_can_gw.dbc.names import esc_prefix

    if len(bus.escs) != 1 or not ours or not others:
        return ""
    file = bus.layout.file
    found, frames = 1, 0
    with suppress(UserError):  # that many do not fit
        for count in range(2, MAX_ESCS + 1):
            names = [f"esc{number}" for number in range(1, count + 1)]
            escs = [EscSettings(name) for name in names]
            made, _ = expand(bus.database, bus.layout.node, escs, file)
            keys = {
                message.name: message.frame_id | (EXTENDED if message.is_extended_frame else 0)
                for message in made.messages
            }
            by_esc = [
                {key for name, key in keys.items() if name.startswith(esc_prefix(esc))}
                for esc in names
            ]
            # half of the messages: some come rarely, or are switched off
            if any(2 * len(ids & (others.keys() | ours)) < max(1, len(ids)) for ids in by_esc):
                break
            found, frames = count, sum(others.get(key, 0) for key in set().union(*by_esc))
    if found == 1:
        return ""
    source = "" if file == str(shipped("dbc/kontronik_esc.dbc")) else f" --from {file}"
    return (
        f"{frames} frames are not in {file.rpartition('/')[2]}, of one ESC: they look like those of {found} ESCs. "
        f"Give -c, or make their DBC (kontronik-can-gw dbc{source} --esc {found} -o escs.dbc) and give --dbc escs.dbc."
    )
