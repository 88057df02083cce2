"""The client with a broker that sends what no publisher asked for. No broker needs to run."""

import contextlib
import socket
import time
from collections.abc import Iterator

import pytest

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.desk.mqtt import client as mqtt_client
from kontronik_can_gw.desk.mqtt.client import MqttClient

pytestmark = pytest.mark.promise("mqtt")

PATIENCE = 60.0
CONNACK = b"\x20\x02\x00\x00"
PUBLISH_QOS_2 = b"\x34\x07\x00\x03a/b"
"""The begin of a PUBLISH. A number of two bytes follows."""
QUEUE = 1 << 16
"""Size of the sockets' queues. The kernel doubles it."""


def header(command: int, size: int) -> bytes:
    """Return the first byte and the length of a packet."""
    length = bytearray()
    while size >= 128:
        length.append(size % 128 | 128)
        size //= 128
    return bytes([command, *length, size])


class Broker:
    """Accepts connections, and answers each with CONNACK and ``packets``."""

    def __init__(self) -> None:
        self.listener = socket.socket()
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, QUEUE)
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUE)
        self.listener.bind(("127.0.0.1", 0))
        self.listener.listen()
        self.config = MqttConfig(broker=f"127.0.0.1:{self.listener.getsockname()[1]}")

    def flood(self, packets: Iterator[bytes], most: int) -> int:
        """Send packets to the next client until it closes. Return the number of bytes sent.

        At most ``most`` bytes are sent.
        """
        self.listener.settimeout(PATIENCE)
        with self.listener.accept()[0] as connection:
            connection.settimeout(PATIENCE)
            connection.recv(4096)
            sent = 0
            with contextlib.suppress(ConnectionError):
                connection.sendall(CONNACK)
                while sent < most:
                    sent += connection.send(next(packets))
        return sent

    def close(self) -> None:
        self.listener.close()


@pytest.fixture
def broker() -> Iterator[Broker]:
    made = Broker()
    yield made
    made.close()


def large() -> Iterator[bytes]:
    yield header(0x30, 268_435_455)
    while True:
        yield bytes(QUEUE)


def large_answer() -> Iterator[bytes]:
    yield header(0x40, 200_000_000)
    while True:
        yield bytes(QUEUE)


def qos_2() -> Iterator[bytes]:
    number = 0
    while True:
        packets = []
        for _ in range(1000):
            number = number % 65_535 + 1
            packets.append(PUBLISH_QOS_2 + number.to_bytes(2, "big"))
        yield b"".join(packets)


def releases() -> Iterator[bytes]:
    while True:
        yield b"\x62\x02\x00\x01" * 1000


@pytest.mark.parametrize("packets", [large, large_answer, qos_2, releases])
def test_unexpected_packet_ends_the_connection(
    broker: Broker,
    packets: type[Iterator[bytes]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """paho would keep each of these packets in memory, or answer it."""
    monkeypatch.setattr(mqtt_client, "MIN_PAUSE_S", 0.01)
    client = MqttClient(broker.config, "test", "k/test/online")
    client.start()
    try:
        for _ in range(2):  # the client connects again
            assert broker.flood(packets(), 100 * QUEUE) < 100 * QUEUE
        while client.problem is None or "sends packets that no publisher" not in client.problem:
            time.sleep(0.01)
    finally:
        client.stop(0)
