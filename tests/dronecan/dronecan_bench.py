"""A gateway with DroneCAN nodes, without a clock; the package ``dronecan`` reads what it sends, and asks."""

from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from typing import Any

from kontronik_can_gw.assembly.assemble import Loaded, assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.frames import CanFrame, block_of
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.times import MS, SECOND

dronecan: Any = import_module("dronecan")
"""The package; for mypy this folder has its name."""
transport = dronecan.transport
START = 777 * SECOND + 5
LIVE = LiveData(
    electrical_speed=42_000,
    battery_voltage=2423,
    battery_current=473,
    output_opening=42,
    throttle=-55,
    power_stage_temperature=30,
    bec_voltage=5981,
    bec_current=1250,
    bec_temperature=41,
    operating_errors=1 << 17,
)


def loaded(escs: int = 1, dbc: bool = False, canopen: bool = False, **table: Any) -> Loaded:
    """A configuration with these keys of [dronecan]."""
    return assemble(
        parse(
            {
                "can": {"interface": "virtual", "bitrate": 1_000_000},
                "dbc": {"enabled": dbc},
                "canopen": {"enabled": canopen, "self_start": True, "store": "/nonexistent/store"},
                "dronecan": {"enabled": True, "node_id": 42} | table,
                "esc": [
                    {"port": f"/dev/ttyUSB{n}", "name": f"e{n}", "pole_pairs": 7, "gear": "10"}
                    for n in range(escs)
                ],
            },
            "bench.toml",
        )
    )


@dataclass(frozen=True)
class Transfer:
    """A transfer as the package ``dronecan`` reads it. ``payload``: a message, a request or a response."""

    at: int
    source: int
    payload: Any
    to: int | None
    number: int
    """Its transfer id."""

    @property
    def name(self) -> str:
        return str(dronecan.get_dronecan_data_type(self.payload)).rpartition(".")[2]


class Reader:
    """What the package makes of frames."""

    def __init__(self) -> None:
        self._begun: dict[int, list[Any]] = {}
        self._numbers: dict[int, int] = {}

    def read(self, at: int, frame: CanFrame) -> Transfer | None:
        """The transfer that this frame completes; AssertionError where it is invalid."""
        assert frame.extended
        assert not frame.fd
        frames = self._begun.setdefault(frame.can_id, [])
        if frame.data[-1] & 0x80:
            frames.clear()
            number = frame.data[-1] & 0x1F
            # of a node's message: with the same one it would be taken for one that comes twice
            if frame.can_id & 0x7F and not frame.can_id & 0x80:
                assert number != self._numbers.get(frame.can_id)
            self._numbers[frame.can_id] = number
        frames.append(transport.Frame(frame.can_id, frame.data, ts_monotonic=1.0))
        if not frame.data[-1] & 0x40:
            return None
        found = transport.Transfer()
        found.from_frames(self._begun.pop(frame.can_id))  # checks order, toggle and CRC
        of = found.source_node_id, found.payload, found.dest_node_id, found.transfer_id
        return Transfer(at, *of)


class Bench:
    """``escs``: number; what they send is ``live`` (None: nothing) every 10 ms."""

    def __init__(self, escs: int = 1, given: Loaded | None = None, **table: Any) -> None:
        self.loaded = given or loaded(escs, **table)
        self.now = START
        self.gateway = Gateway(
            self.loaded.escs,
            self.loaded.layout,
            START,
            False,
            self.loaded.canopen,
            further=[setup.make for setup in self.loaded.outputs],
        )
        self.live: list[LiveData | None] = [LIVE] * escs
        self.frames: list[tuple[int, CanFrame]] = []
        self.read: list[Transfer] = []
        self._reader = Reader()
        for esc in range(escs):
            self.gateway.port(esc, True, self.now)
        self.gateway.start(self.now)
        self.take()

    @property
    def output(self) -> Any:
        return next(each for each in self.gateway.outputs if each.name == "dronecan")

    @property
    def nodes(self) -> list[Any]:
        """What is reported of each node."""
        found: list[Any] = self.output.facts()["nodes"]
        return found

    def hear(self, data: LiveData | InfoData, esc: int = 0) -> None:
        """A frame of an ESC."""
        self.gateway.receive_bytes(esc, encode(data, Layout.V4), self.now, self.now)

    def take(self) -> None:
        for frame in self.gateway.take_frames(self.now):
            self.frames.append((self.now, frame))
            if frame.extended and (found := self._reader.read(self.now, frame)) is not None:
                self.read.append(found)

    def run(self, seconds: float) -> "Bench":
        """Let time pass."""
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            following = min(end, START + ((self.now - START) // (10 * MS) + 1) * 10 * MS)
            while (due := self.gateway.next_deadline()) < following:
                self.now = max(self.now, due)
                self.gateway.advance(self.now)
                self.take()
            self.now = following
            for esc, live in enumerate(self.live):
                if live is not None and following % (10 * MS) == START % (10 * MS):
                    self.hear(live, esc)
            self.gateway.advance(self.now)
            self.take()
        return self

    def receive(self, *frames: CanFrame) -> None:
        """Frames of others, if our filters let them through."""
        for frame in frames:
            ids = self.gateway.receive_ids
            if frame.key in ids or block_of(frame.key, ids) is not None:
                self.gateway.receive_frame(frame, self.now, self.now)
        self.gateway.advance(self.now)
        self.take()

    def ask(self, request: Any, to: int = 42) -> Any:
        """The answer to a foreign node's request; None for none."""
        self.receive(*peers_frames(request, 100, to, transfer_id=7))
        answers = [each for each in self.read if each.to == 100]
        self.read = [each for each in self.read if each.to != 100]
        assert {each.number for each in answers} <= {7}
        return answers[-1].payload if answers else None

    def of(self, name: str, source: int | None = None) -> list[Transfer]:
        """Transfers of a type so far."""
        return [each for each in self.read if each.name == name and source in (None, each.source)]

    def intervals(self, name: str) -> set[int]:
        """Between transfers of a type."""
        return {after.at - before.at for before, after in pairwise(self.of(name))}

    def clear(self) -> None:
        self.read.clear()
        self.frames.clear()


def peers_frames(payload: Any, source: int, to: int | None = None, **more: Any) -> list[CanFrame]:
    """The frames of a transfer as the package makes them."""
    is_service = to is not None
    made = transport.Transfer(
        payload=payload,
        source_node_id=source,
        dest_node_id=to,
        request_not_response=is_service,
        service_not_message=is_service,
        **{"transfer_priority": 24, "transfer_id": 1} | more,
    )
    return [CanFrame(each.message_id, bytes(each.bytes), True) for each in made.to_frames()]
