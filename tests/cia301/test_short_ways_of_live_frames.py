"""The short ways of nodes behind a live frame do what the general ways do: every frame, in its order, and every deadline."""

import random
from collections.abc import Sequence

import pytest
from dialogue import Bench, default, info, live
from script import MS

from kontronik_can_gw import gateway as gateway_module
from kontronik_can_gw.cia301 import node as node_module
from kontronik_can_gw.cia301 import nodes as nodes_module
from kontronik_can_gw.cia301.node import Node
from kontronik_can_gw.cia301.nodes import Nodes
from kontronik_can_gw.cia301.pdo import Tpdo
from kontronik_can_gw.frames import IMAGE, CanFrame, frame_of
from kontronik_can_gw.sources import CanState


class LongTpdo(Tpdo):
    """Packs everything to see whether its status has changed, and looks at each event."""

    def on_event(self, now: int) -> None:
        if not self._started or not self._running:
            return
        if self.pending:
            self._request(now)
            return
        if self._status_mask:
            assert self._pack is not None
            status = self._pack((self._esc,), self._gateway, now, 0, 0) & self._status_mask
            if status == self._last_status:
                return
            self._last_status = status
        self._news(now)


class LongNode(Node):
    def on_live(self, now: int) -> bool:
        return False

    def _set_due(self) -> None:
        super()._set_due()
        self._other_due = 0


class LongNodes(Nodes):
    def advance(self, now: int) -> None:
        for node in self.nodes:
            node.advance(now)
        self._after(now)

    def send_pdo(self, image: int, length: int, bits: int) -> None:
        self.send(frame_of(IMAGE.pack(image, length, bits)))


NODES = 3
STARTING = default(0x1F80, 0, 0)


def long_bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    with monkeypatch.context() as patch:
        patch.setattr(node_module, "Tpdo", LongTpdo)
        patch.setattr(nodes_module, "Node", LongNode)
        patch.setattr(gateway_module, "Nodes", LongNodes)
        return Bench(NODES, STARTING)


def download(node_id: int, index: int, sub: int, value: int, size: int) -> CanFrame:
    head = bytes((0x23 | (4 - size) << 2, index & 0xFF, index >> 8, sub))
    return CanFrame(0x600 + node_id, head + value.to_bytes(size, "little").ljust(4, b"\0"))


def pdo_changes(source: random.Random) -> list[CanFrame]:
    """Other parameters of a PDO, sometimes another mapping of the spare ones."""
    node_id, number = source.randint(1, NODES), source.randrange(6)
    cob_id = 0x40000000 | 0x180 + 0x100 * number + node_id if number < 4 else 0x40000000 | 0x200 + 8 * number + node_id
    index = 0x1800 + number
    frames = [download(node_id, index, 1, 0x80000000 | cob_id, 4)]
    frames.append(download(node_id, index, 2, source.choice([0, 1, 3, 254, 255, 255]), 1))
    frames.append(download(node_id, index, 3, source.choice([0, 0, 1, 50, 200, 500]), 2))
    frames.append(download(node_id, index, 5, source.choice([0, 0, 7, 30, 500]), 2))
    if number > 3:
        mapped = source.sample([0x20000120, 0x20000210, 0x20000E20, 0x20010220, 0x20200108, 0x603F0010, 0x20200208], 2)
        frames.append(download(node_id, index + 0x200, 0, 0, 1))
        frames += [download(node_id, index + 0x200, sub, entry, 4) for sub, entry in enumerate(mapped, 1)]
        frames.append(download(node_id, index + 0x200, 0, len(mapped), 1))
    return [*frames, download(node_id, index, 1, cob_id, 4)]


def happen(source: random.Random, benches: Sequence[Bench], now: int) -> None:
    """Something, to each of them."""
    esc, choice = source.randrange(NODES), source.random()
    fields = {
        "electrical_speed": source.randrange(5000),
        "battery_voltage": source.randrange(5000),
        "operating_errors": 1 << source.randrange(20) if source.random() < 0.03 else 0,
        "operating_state": source.choice([5, 5, 5, 5, 6]),
    }
    data = live(**fields)
    if source.random() < 0.05:
        data += live(electrical_speed=source.randrange(9))
    if source.random() < 0.02:
        data = info(cell_count=source.randrange(14))
    frames: list[CanFrame] = []
    if 0.8 <= choice < 0.83:
        frames = pdo_changes(source)
    elif choice < 0.86:
        frames = [CanFrame(0x80, b"")]
    elif choice < 0.88:
        command = source.choice([1, 1, 1, 1, 2, 0x80, 0x81, 0x82])
        frames = [CanFrame(0, bytes((command, source.randint(0, NODES))))]
    state = source.choice([CanState.ERROR_ACTIVE, CanState.ERROR_PASSIVE, CanState.BUS_OFF])
    for bench in benches:
        gateway = bench.gateway
        if choice < 0.8:
            gateway.receive_bytes(esc, data, now, now)
        for frame in frames:
            gateway.receive_frame(frame, now, now)
        if 0.88 <= choice < 0.885:
            gateway.port_lost(esc, now)
        elif 0.88 <= choice < 0.9:
            gateway.port_opened(esc, now)
        elif 0.9 <= choice < 0.905:
            gateway.set_can_state(state, now)
        elif 0.9 <= choice < 0.91:
            gateway.can_returned(now)


@pytest.mark.parametrize("seed", range(20))
def test_the_nodes_send_the_same(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    source = random.Random(seed)
    short, long = Bench(NODES, STARTING), long_bench(monkeypatch)
    assert type(short.nodes[0]) is Node
    assert type(long.nodes[0]) is LongNode
    assert type(long.nodes[0].tpdos[0]) is LongTpdo
    images, twice, now = 0, 0, short.now
    for _ in range(1200):
        wanted = now + source.choice([0, 1, 2, 3, 5, 10, 10, 40, 300]) * MS
        now = wanted if source.random() < 0.5 else min(wanted, max(now, short.gateway.next_deadline()))
        happen(source, (short, long), now)
        if source.random() < 0.9:
            for bench in (short, long):
                bench.gateway.advance(now)
            ready = short.gateway.take_ready()
            assert [frame_of(frame) for frame in ready] == long.gateway.take_frames()
            of_images = [frame_of(frame).can_id for frame in ready if isinstance(frame, bytes)]
            others = {frame.can_id for frame in ready if isinstance(frame, CanFrame)}
            assert len(set(of_images)) == len(of_images), "an image is the only frame with its id"
            assert not others.intersection(of_images)
            images += len(of_images)
            plain = [frame.can_id for frame in ready if isinstance(frame, CanFrame) and not frame.queued]
            twice += len(plain) - len(set(plain))
        assert short.gateway.next_deadline() == long.gateway.next_deadline()
        assert short.gateway.receive_ids == long.gateway.receive_ids
        assert short.gateway.node_states() == long.gateway.node_states()
    assert images > 300
    assert seed or twice, "a PDO that is sent twice in one turn"
