"""Streams of one ESC to be read in bulk, and layouts of all kinds to read them by."""

import random
from collections.abc import Sequence

import cantools.database
from cantools.database.can import Database
from packer_oracle import LayoutMaker, Msg, bindings, dbc_text

from kontronik_can_gw.config import shipped
from kontronik_can_gw.dbc_output.layout import DbcSettings
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.offline.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.protocol import InfoData, LiveData, encode
from kontronik_can_gw.protocol.codec import Layout
from kontronik_can_gw.protocol.fields import device_and_variant, rows
from kontronik_can_gw.telemetry import EscSettings

SHIPPED = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))


class Wandering:
    """An ESC whose values wander: each field changes with a frame by a probability of its own, and may take any value of its type."""

    def __init__(self, source: random.Random, layout: Layout = Layout.V4, device: int = 1) -> None:
        self.random = source
        self.layout = layout
        self.device = device
        self.live = LiveData(battery_voltage=2400, battery_current=100, operating_state=12)
        self.info = InfoData(device_and_variant(device, 120), 0x0110, 0, 6, max_battery_voltage=2500)
        self.restless = {
            name: source.choice([0, 0.002, 0.02, 0.3, 1]) for name in (*LiveData._fields, *InfoData._fields)
        }

    def frames(self, count: int, info_each: int = 100, infos: int = 1) -> bytes:
        """Live frames, with info frames behind each so many."""
        parts = []
        for number in range(1, count + 1):
            self.live = self.live._replace(**self._changes(LiveData))
            parts.append(encode(self.live, self.layout))
            if info_each and number % info_each == 0:
                for _ in range(infos):
                    changes = self._changes(InfoData)
                    changes.pop("device_and_variant", None)
                    self.info = self.info._replace(**changes)
                    parts.append(encode(self.info, self.layout))
        return b"".join(parts)

    def becomes(self, device: int, variant: int = 7) -> None:
        """Another device tells of itself with the next info frame."""
        self.info = self.info._replace(device_and_variant=device_and_variant(device, variant))

    def _changes(self, data: type[LiveData] | type[InfoData]) -> dict[str, int]:
        source = self.random
        changes = {}
        for name, row in rows(data).items():
            if source.random() < self.restless[name]:
                low, high = row.type_range
                changes[name] = source.choice([low, high, 0, 1, source.randint(low, high), source.randint(low, high)])
        return changes


def random_layout(source: random.Random, messages: int) -> BusLayout:
    """Signals of all sources, types, places, texts and codes; multiplexed, of both id lengths, of CAN FD; sent in every way."""
    esc = EscSettings("esc1", pole_pairs=source.choice([1, 7]), cell_count=source.choice([0, 0, 12]))
    maker = LayoutMaker(source, [esc])
    return bus_layout([maker.message() for _ in range(messages)], esc, source)


def bus_layout(messages: Sequence[Msg], esc: EscSettings, source: random.Random) -> BusLayout:
    """A DBC of these messages."""
    more = "\n".join(
        f'BA_ "GenMsgSendType" BO_ {message.dbc_id} {source.randrange(5)};\n'
        f'BA_ "GenMsgCycleTime" BO_ {message.dbc_id} {source.choice([10, 33, 100])};'
        for message in messages
    )
    database = cantools.database.load_string(dbc_text(list(messages), more), "dbc")
    assert isinstance(database, Database)
    bound = DbcSettings(bindings(list(messages)))
    database, layout = prepare(database, "my.dbc", [esc], bound, fd_allowed=True)
    return BusLayout(database, layout, [esc])
