"""CAN reception and queued sending on a real socket: kernel filters, full queues, interfaces that go and come back."""

import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import pytest
from raw_bus import EXTENDED, INVERTED, REMOTE, RawBus
from vcan_tools import DELIVERY_MARK, LIMIT_S, ip, wait_for, wait_for_delivery

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik import Layout as UartLayout
from kontronik_can_gw.esc.kontronik import LiveData, encode
from kontronik_can_gw.esc.telemetry import SECOND, EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.gateway_status import CanState
from kontronik_can_gw.runtime.can_port import CanPort
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.runtime.open_can import open_can
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.transmit_queue import Sent


def peer_on(interface: str) -> RawBus:
    """Another participant, that hears all."""
    return RawBus(interface, (INVERTED | DELIVERY_MARK, 0x7FF))


def ask(peer: RawBus, can_id: int, data: bytes) -> tuple[int, bytes] | None:
    """Send a request; the next frame that comes."""
    peer.send(can_id, data)
    return peer.receive(LIMIT_S)


@contextmanager
def port_on(
    interface: str, ids: Sequence[int], fd: bool = False, own: bool = False
) -> Iterator[CanPort]:
    port = open_can(CanConfig("socketcan", interface, fd=fd, options={"receive_own_messages": own}))
    try:
        port.set_receive_ids(frozenset(ids))
        yield port
    finally:
        port.close()


def readable(port: CanPort, interface: str) -> bool:
    """Whether the socket has something to read of what was sent so far."""
    wait_for_delivery(interface)
    return port.waits_to_be_read


def all_of(port: CanPort, interface: str) -> list[CanFrame]:
    """What waits, to the end."""
    frames: list[CanFrame] = []
    while readable(port, interface):
        for frame, at in port.receive():
            assert at is not None, "the kernel tells when a frame came"
            assert 0 <= time.monotonic_ns() - at < 60 * SECOND
            frames.append(frame)
    return frames


# --- the port


def test_exactly_the_wanted_frames_come_and_nothing_else_makes_the_socket_readable(
    vcan: str,
) -> None:
    wanted = (0x000, 0x080, 0x601, 0x7E5)
    with port_on(vcan, wanted) as port, peer_on(vcan) as peer:
        for can_id in range(0x800):
            if can_id not in wanted:
                peer.send(can_id, b"foreign")
        for can_id in wanted:
            peer.send(can_id | EXTENDED, b"29 bit")
            peer.send(can_id | REMOTE)
            peer.send_fd(can_id, b"fd")
        assert not readable(port, vcan)
        for n, can_id in enumerate(wanted):
            peer.send(can_id, bytes((n,)))
        assert all_of(port, vcan) == [
            CanFrame(can_id, bytes((n,))) for n, can_id in enumerate(wanted)
        ]
        port.set_receive_ids(frozenset())
        for can_id in wanted:
            peer.send(can_id)
        assert not readable(port, vcan)


def test_600_ids_are_merged_and_still_exactly_they_come(vcan: str) -> None:
    wanted = set(range(0x081, 0x081 + 3 * 600, 3))
    with port_on(vcan, sorted(wanted)) as port, peer_on(vcan) as peer:
        came: list[int] = []
        for can_id in range(0x800):
            peer.send(can_id)
            peer.send(can_id | EXTENDED)
            peer.send(can_id | REMOTE)
            if can_id % 64 == 63:
                came += [frame.can_id for frame in all_of(port, vcan)]
        assert came == sorted(wanted)
        assert port.overruns == 0


def test_on_a_bus_with_can_fd_frames_are_told_apart(vcan: str) -> None:
    with port_on(vcan, [0x601], fd=True) as port, peer_on(vcan) as peer:
        peer.send_fd(0x601, b"12345678")
        peer.send_fd(0x601, bytes(64))
        peer.send(0x601, b"classic")
        assert all_of(port, vcan) == [
            CanFrame(0x601, b"12345678", fd=True),
            CanFrame(0x601, bytes(64), fd=True),
            CanFrame(0x601, b"classic"),
        ]
        assert port.send(CanFrame(0x581, bytes(64), fd=True)) is Sent.OK


def test_own_frames_do_not_come_back_but_those_of_others_with_the_same_id_do(vcan: str) -> None:
    with (
        port_on(vcan, [0x581], own=True) as port,
        port_on(vcan, [0x581]) as second,
        peer_on(vcan) as peer,
    ):
        assert port.send(CanFrame(0x581, b"own")) is Sent.OK
        peer.send(0x581, b"other")
        assert all_of(port, vcan) == [CanFrame(0x581, b"other")]
        assert all_of(second, vcan) == [CanFrame(0x581, b"own"), CanFrame(0x581, b"other")]
        assert port.send(CanFrame(0x702, b"", remote=True)) is Sent.OK
        assert [peer.receive(LIMIT_S) for _ in range(2)] == [(0x581, b"own"), (0x702 | REMOTE, b"")]


def test_a_block_of_several_clients_fits_into_the_socket_and_an_overrun_is_noticed(
    vcan: str,
) -> None:
    with port_on(vcan, [0x601]) as port, peer_on(vcan) as peer:
        for n in range(508):  # four blocks of 127 segments, more than a socket's usual 278 frames
            peer.send(0x601, n.to_bytes(2, "little"))
        assert [int.from_bytes(frame.data, "little") for frame in all_of(port, vcan)] == list(
            range(508)
        )
        assert port.overruns == 0
        for _ in range(3000):
            peer.send(0x601)
        assert len(all_of(port, vcan)) < 3000
        assert port.overruns == 1
        for _ in range(3000):
            peer.send(0x601)
        wait_for_delivery(vcan)
        port.discard()
        assert not readable(port, vcan)
        peer.send(0x601, b"new")
        assert all_of(port, vcan) == [CanFrame(0x601, b"new")]
        assert port.overruns == 1


# --- the loop


class Node(Gateway):
    """A gateway that answers a frame with an even id by one frame, one with an odd id by a block of 127 and 40 fast PDOs."""

    def __init__(self, *ids: int) -> None:
        super().__init__(
            [EscSettings("esc1", timeout_ns=60 * 10**9)], Layout("x", "Gw", ()), time.monotonic_ns()
        )
        self.ids = frozenset(ids)
        self.waiting: list[CanFrame] = []
        self.opened = 0
        """How often the interface was opened, with its filters set."""

    @property
    def receive_ids(self) -> frozenset[int]:
        return self.ids

    def can_opened(self, now: int) -> None:
        super().can_opened(now)
        self.opened += 1

    def receive_frame(self, frame: CanFrame, now: int, at: int) -> None:
        if frame.can_id % 2 == 0:
            self.waiting.append(CanFrame(frame.can_id - 0x80, frame.data, queued=True))
            return
        self.waiting += [CanFrame(0x581, bytes((n,)), queued=True) for n in range(127)]
        self.waiting += [CanFrame(0x181 + n, b"old") for n in range(40)]
        self.waiting += [CanFrame(0x181 + n, b"new") for n in range(40)]

    @property
    def frames_wait(self) -> bool:
        return bool(self.waiting) or super().frames_wait

    def take_frames(self, now: int) -> list[CanFrame]:
        frames, self.waiting = [*self.waiting, *super().take_frames(now)], []
        return frames


@pytest.fixture
def run_node(vcan: str, esc: PtyEsc) -> Iterator[Callable[[Node], Loop]]:
    """A function that runs a node's loop in a thread."""
    made: list[tuple[Loop, threading.Thread]] = []

    def run(node: Node) -> Loop:
        loop = Loop(node, [esc.path], CanConfig("socketcan", vcan))
        loop.open()
        thread = threading.Thread(target=loop.run, daemon=True)
        thread.start()
        made.append((loop, thread))
        return loop

    yield run
    for loop, thread in made:
        loop.stop()
        thread.join(LIMIT_S)
        assert not thread.is_alive()


def test_4000_foreign_frames_do_not_reach_a_process_that_receives(
    vcan: str, run_node: Callable[[Node], Loop]
) -> None:
    node = Node(0x000, 0x080, 0x602)
    run_node(node)
    with peer_on(vcan) as peer:
        for options in (["-I", "123"], ["-I", "602", "-e"], ["-I", "602", "-R"]):
            subprocess.run(["cangen", vcan, "-g", "0", "-n", "4000", "-i", *options], check=True)
            assert len([peer.receive(LIMIT_S) for _ in range(4000)]) == 4000
        assert ask(peer, 0x602, b"x") == (0x582, b"x")
        assert node.status.received_frames == 1


def test_a_block_of_127_and_pdos_share_a_bus_that_is_full(
    vcan: str, run_node: Callable[[Node], Loop]
) -> None:
    """Some 200 frames/s, with room for ten: the kernel says ENOBUFS again and again."""
    shaper = f"tc qdisc add dev {vcan} root tbf rate 25kbit burst 160 limit 160"
    subprocess.run(shaper.split(), check=True)
    node = Node(0x601)
    run_node(node)
    with peer_on(vcan) as peer:
        peer.send(0x601)
        came: list[tuple[int, bytes]] = []
        while len(came) < 167 and (frame := peer.receive(LIMIT_S)) is not None:
            came.append(frame)
        assert peer.receive(0.2) is None
    block = [data[0] for can_id, data in came if can_id == 0x581]
    assert block == list(range(127)), "all of the block, in order"
    pdos = [frame for frame in came if frame[0] != 0x581]
    assert pdos == [(0x181 + n, b"new") for n in range(40)], "of each PDO the newest"
    assert [can_id == 0x581 for can_id, _ in came[:80]] == [True, False] * 40, "in turns"
    status = node.status
    assert (status.sent_frames, status.dropped_frames, status.replaced_frames) == (167, 0, 40)
    assert status.send_failures > 0, "the queue was full"


def test_a_node_hears_again_when_its_interface_was_down_or_removed(
    vcan: str, run_node: Callable[[Node], Loop]
) -> None:
    node = Node(0x602)
    run_node(node)
    up = ("set", vcan, "up")
    down, removed = [("set", vcan, "down"), up], [("del", vcan), ("add", vcan, "type", "vcan"), up]
    for away, *back in (down, removed, down, removed):
        with peer_on(vcan) as peer:
            assert ask(peer, 0x602, b"before") == (0x582, b"before")
        opened = node.opened
        ip("link", *away)
        wait_for(lambda: node.status.can_state is CanState.DOWN, "down, though nothing was sent")
        for words in back:
            ip("link", *words)
        wait_for(lambda opened=opened: node.opened > opened, "open again")  # type: ignore[misc]
        with peer_on(vcan) as peer:
            peer.send(0x603)
            assert ask(peer, 0x602, b"again") == (0x582, b"again")
        wait_for(lambda: node.status.can_state is CanState.ERROR_ACTIVE, "error active")
    assert node.status.received_frames == 8


def test_a_flood_of_wanted_frames_does_not_starve_the_uart(
    vcan: str, esc: PtyEsc, run_node: Callable[[Node], Loop]
) -> None:
    """Frame after frame of the ESC is taken while the flood lasts."""
    node = Node(0x602)
    run_node(node)
    state = node.escs[0]
    flood = subprocess.Popen(["cangen", vcan, "-g", "0", "-I", "602", "-L", "8", "-i"])
    try:
        wait_for(lambda: node.status.received_frames > 100, "the flood")
        for n in range(100):
            before, flooded = state.counters.live, node.status.received_frames
            esc.write(encode(LiveData(electrical_speed=n), UartLayout.V4))
            wait_for(
                lambda before=before: state.counters.live > before or flood.poll() is not None,  # type: ignore[misc]
                f"live frame {n}",
            )
            wait_for(
                lambda flooded=flooded: node.status.received_frames > flooded,  # type: ignore[misc]
                "the flood goes on",
            )
        assert flood.poll() is None, "to the end"
        assert state.counters.live == 100
    finally:
        flood.terminate()
        flood.wait()
