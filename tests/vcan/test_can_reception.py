"""A CAN port on a real socket: filters, own frames, CAN FD, and an overrun.

The fault programme tests full queues, floods and lost interfaces.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest
from raw_bus import EXTENDED, INVERTED, REMOTE, RawBus
from vcan_tools import LIMIT_S, MARK, ip, wait_for_delivery

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.can.can_port import CanPort
from kontronik_can_gw.runtime.can.open_can import open_can
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("filters")


def peer_on(interface: str) -> RawBus:
    """Return another participant, which receives all frames except marks."""
    return RawBus(interface, (INVERTED | MARK, 0x7FF))


@contextmanager
def port_on(
    interface: str,
    ids: Sequence[int],
    fd: bool = False,
) -> Iterator[CanPort]:
    port = open_can(CanConfig("socketcan", interface, fd=fd))
    try:
        port.set_receive_ids(frozenset(ids))
        yield port
    finally:
        port.close()


def readable(port: CanPort, interface: str) -> bool:
    """Return whether the socket has a frame to read after all sent frames were delivered."""
    wait_for_delivery(interface)
    return port.waits_to_be_read


def all_of(port: CanPort, interface: str) -> list[CanFrame]:
    """Receive all waiting frames."""
    frames: list[CanFrame] = []
    while readable(port, interface):
        for frame, at in port.receive():
            assert at is not None, "the kernel reports the time of a frame"
            assert 0 <= time.monotonic_ns() - at < 60 * SECOND
            frames.append(frame)
    return frames


def test_600_ids_are_merged_and_only_their_plain_frames_are_received(vcan: str) -> None:
    wanted = [0, 0x080, *range(0x081, 0x081 + 3 * 600, 3), 0x7E5]
    with port_on(vcan, wanted) as port, peer_on(vcan) as peer:
        came: list[CanFrame] = []
        for can_id in range(0x800):
            peer.send(can_id | EXTENDED, b"29 bit")
            peer.send(can_id | REMOTE)
            peer.send_fd(can_id, b"fd")
            peer.send(can_id, b"plain")
            if can_id % 32 == 31:
                came += all_of(port, vcan)
        assert came == [CanFrame(can_id, b"plain") for can_id in wanted]
        assert port.overruns == 0
        port.set_receive_ids(frozenset())
        for can_id in wanted:
            peer.send(can_id)
        assert not readable(port, vcan), "unwanted frames do not wake the process"


def test_own_frames_are_not_received_but_others_with_the_same_id_are(vcan: str) -> None:
    with (
        port_on(vcan, [0x581]) as port,
        port_on(vcan, [0x581]) as second,
        peer_on(vcan) as peer,
    ):
        assert port.send(CanFrame(0x581, b"own")) is Sent.OK
        peer.send(0x581, b"other")
        assert all_of(port, vcan) == [CanFrame(0x581, b"other")]
        assert all_of(second, vcan) == [CanFrame(0x581, b"own"), CanFrame(0x581, b"other")]
        assert port.send(CanFrame(0x702, b"", remote=True)) is Sent.OK
        assert [peer.receive(LIMIT_S) for _ in range(2)] == [(0x581, b"own"), (0x702 | REMOTE, b"")]


def test_long_frames_are_sent_and_received_as_can_fd(vcan: str) -> None:
    long = CanFrame(0x123456, bytes(range(64)), True, fd=True)
    short = CanFrame(0x10, b"short")
    with port_on(vcan, [], fd=True) as port, port_on(vcan, [long.key, 0x10], fd=True) as other:
        assert [port.send(frame) for frame in (long, short)] == [Sent.OK, Sent.OK]
        assert all_of(other, vcan) == [long, short]


def test_interface_without_can_fd_is_refused_with_the_remedy(vcan: str) -> None:
    ip("link", "set", vcan, "down")
    ip("link", "set", vcan, "mtu", "16")
    with pytest.raises(RunError, match=f"ip link set {vcan} mtu 72"), port_on(vcan, [], fd=True):
        pass


def test_interface_that_is_down_is_refused_with_a_working_command(
    vcan: str,
) -> None:
    ip("link", "set", vcan, "down")
    with pytest.raises(RunError) as refused, port_on(vcan, []):
        pass
    command = f"sudo ip link set {vcan} up"
    assert str(refused.value).endswith(f"is down. Start it: {command}.")
    ip(*command.split()[2:])
    with port_on(vcan, []) as port:
        assert port.send(CanFrame(0x10, b"short")) is Sent.OK


def test_blocks_of_several_clients_fit_and_an_overrun_is_noticed(
    vcan: str,
) -> None:
    with port_on(vcan, [0x601]) as port, peer_on(vcan) as peer:
        for n in range(381):  # three blocks of 127 segments; a socket usually holds 278 frames
            peer.send(0x601, n.to_bytes(2, "little"))
        numbers = [int.from_bytes(frame.data, "little") for frame in all_of(port, vcan)]
        assert numbers == list(range(381))
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
