"""A gateway with DroneCAN nodes, without a clock; the package ``dronecan`` reads what it sends, and asks."""

from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from typing import Any

from kontronik_can_gw.config.assemble import Loaded, assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.esc.kontronik import Device, InfoData, LiveData, codec, encode
from kontronik_can_gw.esc.kontronik.fields import device_and_variant
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.frames import CanFrame, block_of
from kontronik_can_gw.gateway import Gateway

dronecan: Any = import_module("dronecan")
"""The package; for mypy this folder has its name."""
transport, CANFrame = dronecan.transport, dronecan.driver.common.CANFrame
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
    to: int | None = None

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
        return Transfer(at, found.source_node_id, found.payload, found.dest_node_id)


class Bench:
    """``escs``: number; what they send is ``live`` (None: nothing) every 10 ms."""

    def __init__(self, escs: int = 1, given: Loaded | None = None, **table: Any) -> None:
        self.loaded = given or loaded(escs, **table)
        self.now = START
        self.gateway = Gateway(
            *(self.loaded.escs, self.loaded.layout, START, False, self.loaded.canopen),
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

    def info(self, esc: int, device: Device) -> None:
        """An info frame of this device."""
        self.hear(InfoData(device_and_variant=device_and_variant(device, 1)), esc)

    def hear(self, data: LiveData | InfoData, esc: int = 0) -> None:
        """A frame of an ESC."""
        self.gateway.receive_bytes(esc, encode(data, codec.Layout.V4), self.now, self.now)

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

    def of(self, name: str, source: int | None = None) -> list[Transfer]:
        """Transfers of a type so far."""
        return [each for each in self.read if each.name == name and source in (None, each.source)]

    def intervals(self, name: str, esc: int | None = None) -> list[int]:
        """Between transfers of a type, of one ESC where they have its index."""
        found = [e.at for e in self.of(name) if esc is None or e.payload.esc_index == esc]
        return [after - before for before, after in pairwise(found)]

    def clear(self) -> None:
        self.read.clear()
        self.frames.clear()


class BenchDriver(dronecan.driver.common.AbstractDriver):  # type: ignore[misc]
    """The bus of a bench, for a node of the package ``dronecan``: its frames go to the gateway at once, and come back when it spins."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._bench = bench
        self._seen = 0

    def close(self) -> None:
        pass

    def receive(self, timeout: float | None = None) -> Any:
        frames = self._bench.frames
        while self._seen < len(frames):
            frame = frames[self._seen][1]
            self._seen += 1
            if frame.extended:
                return CANFrame(frame.can_id, frame.data, True)
        return None

    def send(self, message_id: int, message: bytes, extended: bool = False, **_: object) -> None:
        self.send_frame(CANFrame(message_id, message, extended))

    def send_frame(self, frame: Any) -> None:
        self._bench.receive(CanFrame(frame.id, bytes(frame.data), frame.extended))


class Peer:
    """A node of the package ``dronecan`` on the bench's bus."""

    def __init__(self, bench: Bench, node_id: int = 100) -> None:
        self.bench = bench
        self.driver = BenchDriver(bench)
        self.node = dronecan.node.Node(self.driver, node_id=node_id)

    def spin(self) -> None:
        """Take what has come; timers of the package itself run by the wall clock, and do not matter here."""
        for _ in range(3):
            self.node.spin(timeout=0)

    def ask(self, request: Any, to: int) -> Any:
        """The response; None without one."""
        answers: list[Any] = []
        self.node.request(request, to, lambda event: answers.append(event and event.response))
        self.bench.run(0.001)
        self.spin()
        return answers[0] if answers else None


def peers_frames(payload: Any, source: int, to: int | None = None, **more: Any) -> list[CanFrame]:
    """The frames of a transfer as the package makes them."""
    made = transport.Transfer(
        payload=payload,
        source_node_id=source,
        dest_node_id=to,
        transfer_priority=more.get("priority", 24),
        transfer_id=more.get("transfer_id", 1),
        request_not_response=to is not None,
        service_not_message=to is not None,
        discriminator=more.get("discriminator"),
    )
    return [CanFrame(each.message_id, bytes(each.bytes), True) for each in made.to_frames()]
