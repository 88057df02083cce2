"""A gateway with DroneCAN nodes and without a clock.

The package ``dronecan`` reads its frames and sends requests.
"""

from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from typing import Any

from kontronik_can_gw.assembly.assemble import Loaded, assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.frames import CanFrame, block_of
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.times import MS, SECOND

dronecan: Any = import_module("dronecan")
"""The package. mypy would take this folder for it, which has the same name."""
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


def loaded(
    escs: int = 1,
    dbc: bool = False,
    canopen: bool = False,
    **table: Any,
) -> Loaded:
    """Return a loaded configuration with these keys of [dronecan]."""
    tables: dict[str, Any] = {
        "can": {"interface": "virtual", "bitrate": 1_000_000},
        "dbc": {"enabled": dbc},
        "canopen": {"enabled": canopen, "self_start": True, "store": "/nonexistent/store"},
        "dronecan": {"enabled": True, "node_id": 42} | table,
        "esc": [],
    }
    for number in range(escs):
        port = f"/dev/ttyUSB{number}"
        esc = {"port": port, "name": f"e{number}", "pole_pairs": 7, "gear": "10"}
        tables["esc"].append(esc)
    return assemble(parse(tables, "bench.toml"))


@dataclass(frozen=True)
class Transfer:
    """A transfer that the package ``dronecan`` has read.

    Its payload is a message, a request or a response.
    """

    at: int
    source: int
    payload: Any
    to: int | None
    number: int
    """The transfer id."""

    @property
    def name(self) -> str:
        return str(dronecan.get_dronecan_data_type(self.payload)).rpartition(".")[2]


class Reader:
    """Reads frames with the package."""

    def __init__(self) -> None:
        self._begun: dict[int, list[Any]] = {}
        self._numbers: dict[int, int] = {}

    def read(self, at: int, frame: CanFrame) -> Transfer | None:
        """Return the transfer that this frame completes, or None.

        Raise AssertionError if the transfer is invalid.
        """
        assert frame.extended
        assert not frame.fd
        frames = self._begun.setdefault(frame.can_id, [])
        if frame.data[-1] & 0x80:
            frames.clear()
            number = frame.data[-1] & 0x1F
            # A message of a node with the previous transfer id would be taken for a repetition.
            if frame.can_id & 0x7F and not frame.can_id & 0x80:
                assert number != self._numbers.get(frame.can_id)
            self._numbers[frame.can_id] = number
        frames.append(transport.Frame(frame.can_id, frame.data, ts_monotonic=1.0))
        if not frame.data[-1] & 0x40:
            return None
        found = transport.Transfer()
        found.from_frames(self._begun.pop(frame.can_id))  # checks order, toggle and CRC
        return Transfer(
            at,
            found.source_node_id,
            found.payload,
            found.dest_node_id,
            found.transfer_id,
        )


class Bench:
    """A gateway with this number of ESCs.

    Every 10 ms each ESC sends its frame of ``live``, unless that is None.
    """

    def __init__(
        self,
        escs: int = 1,
        given: Loaded | None = None,
        **table: Any,
    ) -> None:
        self.loaded = given or loaded(escs, **table)
        self.now = START
        self.gateway = Gateway(self.loaded.core_settings, START, outputs=self.loaded.outputs)
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
        """The reported facts of each node."""
        found: list[Any] = self.output.facts()["nodes"]
        return found

    def hear(self, data: LiveData | InfoData, esc: int = 0) -> None:
        """Receive a frame of an ESC."""
        self.gateway.receive_bytes(esc, encode(data, WireLayout.V4), self.now, self.now)

    def take(self) -> None:
        for frame in self.gateway.take_frames(self.now):
            self.frames.append((self.now, frame))
            if frame.extended:
                found = self._reader.read(self.now, frame)
                if found is not None:
                    self.read.append(found)

    def run(self, seconds: float) -> "Bench":
        """Let time pass."""
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            periods = (self.now - START) // (10 * MS) + 1
            following = min(end, START + periods * 10 * MS)
            due = self.gateway.next_deadline()
            while due < following:
                self.now = max(self.now, due)
                self.gateway.advance(self.now)
                self.take()
                due = self.gateway.next_deadline()
            self.now = following
            for esc, live in enumerate(self.live):
                if live is not None and following % (10 * MS) == START % (10 * MS):
                    self.hear(live, esc)
            self.gateway.advance(self.now)
            self.take()
        return self

    def receive(self, *frames: CanFrame) -> None:
        """Receive frames of other nodes that pass our filters."""
        for frame in frames:
            ids = self.gateway.receive_ids
            if frame.key in ids or block_of(frame.key, ids) is not None:
                self.gateway.receive_frame(frame, self.now, self.now)
        self.gateway.advance(self.now)
        self.take()

    def ask(self, request: Any, to: int = 42) -> Any:
        """Return the answer to a foreign node's request, or None without an answer."""
        self.receive(*peers_frames(request, 100, to, transfer_id=7))
        answers = [each for each in self.read if each.to == 100]
        self.read = [each for each in self.read if each.to != 100]
        assert {each.number for each in answers} <= {7}
        return answers[-1].payload if answers else None

    def of(self, name: str, source: int | None = None) -> list[Transfer]:
        """Return all transfers of a type so far."""
        return [each for each in self.read if each.name == name and source in (None, each.source)]

    def intervals(self, name: str) -> set[int]:
        """Return the times between transfers of a type."""
        return {after.at - before.at for before, after in pairwise(self.of(name))}

    def clear(self) -> None:
        self.read.clear()
        self.frames.clear()


def peers_frames(
    payload: Any,
    source: int,
    to: int | None = None,
    **more: Any,
) -> list[CanFrame]:
    """Return the frames of a transfer, created by the package."""
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
