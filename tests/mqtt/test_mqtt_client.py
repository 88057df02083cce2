"""The connection alone: TLS, take-over, old brokers, brokers that speak rubbish, what waits and what is lasting."""

import contextlib
import random
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mqtt_bench import PATIENCE, Mosquitto, Subscriber
from vcan_tools import wait_for

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.desk.mqtt import client as mqtt_client
from kontronik_can_gw.desk.mqtt.client import MqttClient
from kontronik_can_gw.desk.mqtt.messages import Message

pytestmark = pytest.mark.extended

ONLINE = "k/test/online"


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path_factory.mktemp("broker"))
    yield made
    made.stop()


@pytest.fixture
def own(tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker that may be frozen."""
    made = Mosquitto(tmp_path)
    yield made
    made.stop()


@contextlib.contextmanager
def connecting(broker: MqttConfig, client_id: str = "test") -> Iterator[MqttClient]:
    client = MqttClient(broker, client_id, ONLINE)
    client.start()
    try:
        yield client
    finally:
        client.stop(PATIENCE)


def to(port: int) -> MqttConfig:
    return MqttConfig(broker=f"127.0.0.1:{port}")


def waiting(client: MqttClient) -> int:
    """Number of messages that are not sent yet."""
    handed = sum(not mqtt_client._is_done(info) for info in client._handed.values())
    return len(client._waiting) + handed


def turning(condition: Callable[[], object], *clients: MqttClient) -> None:
    """Call ``turn`` as the command does, until something holds."""

    def holds() -> object:
        for client in clients:
            client.turn(time.monotonic_ns())
        return condition()

    wait_for(holds, lambda: [client.problem for client in clients])


# --- what waits, what is lasting


def test_of_each_topic_the_newest_waits_and_the_lasting_goes_first(broker: Mosquitto) -> None:
    client = MqttClient(to(broker.port), "test", ONLINE)
    for number in range(1000):
        client.offer(Message("k/test/state", b"%d" % number))
        client.offer(Message("k/test/other", b"%d" % number))
    client.offer(Message("k/test/known", b"1", lasting=True, retain=True))
    client.offer(Message("k/test/known", b"2", lasting=True, retain=True))
    assert waiting(client) == 3
    with Subscriber(broker.port, "k/test/#") as heard:
        client.start()
        turning(lambda: client.problem == "" and not waiting(client), client)
        heard.wait("k/test/other", b"999")
        client.stop(PATIENCE)
        wait_for(lambda: heard.heard[-1].payload == b"offline", heard.heard)
    assert [(m.topic, m.payload) for m in heard.heard if not m.retained] == [
        (ONLINE, b"online"),
        ("k/test/known", b"2"),
        ("k/test/state", b"999"),
        ("k/test/other", b"999"),
        (ONLINE, b"offline"),
    ]


def test_a_broker_that_takes_nothing_makes_nothing_pile_up(own: Mosquitto) -> None:
    """It stands still: what waits is replaced, what then comes is new, and the end comes in time."""
    with Subscriber(own.port, "k/test/state") as heard, connecting(to(own.port)) as client:
        turning(lambda: client.problem == "", client)
        sent: list[bytes] = []

        def offer() -> None:
            sent.append(b"%06d" % len(sent) + b"x" * 100_000)
            client.offer(Message("k/test/state", sent[-1]))
            client.turn(time.monotonic_ns())

        own.freeze(True)
        for _ in range(100):
            offer()
        assert waiting(client) <= 3  # "online"; a state is with paho, and the newest waits
        own.freeze(False)
        turning(lambda: not waiting(client), client)
        heard.wait("k/test/state", sent[-1])
        numbers = [int(message.payload[:6]) for message in heard.heard]
        assert numbers == sorted(numbers)
        own.freeze(True)
        for _ in range(100):
            offer()
        client.stop(0.3)  # it returns though nothing is taken
        own.freeze(False)


# --- brokers that end connections


def served(*answers: bytes) -> tuple[socket.socket, int, list[bytes]]:
    """A broker of our own making: what it answers to each connection's first bytes; then it ends it. And what it got."""
    listener = socket.create_server(("127.0.0.1", 0))
    got: list[bytes] = []

    def serve() -> None:
        with contextlib.suppress(OSError):
            for answer in answers:
                connection, _ = listener.accept()
                with connection:
                    got.append(connection.recv(4096))
                    connection.sendall(answer)

    threading.Thread(target=serve, daemon=True).start()
    port: int = listener.getsockname()[1]
    return listener, port, got


def test_rubbish_instead_of_an_answer_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_client, "MIN_PAUSE_S", 0.01)
    monkeypatch.setattr(mqtt_client, "MAX_PAUSE_S", 0.1)
    rng = random.Random(1)
    rubbish = [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\x00" * 100, b"\x20\x7f\x00", bytes(range(256)), b""]  # fmt: skip
    rubbish += [b"\x20" + rng.randbytes(rng.randrange(1, 60)) for _ in range(6)]
    rubbish += [rng.randbytes(rng.randrange(1, 200)) for _ in range(6)]
    for answer in rubbish:
        listener, port, got = served(answer, answer)
        with listener, connecting(to(port)) as client:
            turning(lambda got=got: len(got) == 2, client)  # type: ignore[misc]  # it tries again
            turning(lambda client=client: client.problem, client)  # type: ignore[misc]


# --- TLS


def openssl(*words: object) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True)


NEW_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Mosquitto, MqttConfig]]:
    """A broker that wants TLS and a certificate of an authority of our own, and how to connect to it."""
    folder = tmp_path_factory.mktemp("tls")
    authority, secret = folder / "authority.pem", folder / "authority.key"
    openssl(
        "req", "-x509", *NEW_KEY, "-subj", "/CN=authority", "-keyout", secret, "-out", authority
    )
    for name in ("localhost", "boat"):
        key, request, made, more = (
            folder / f"{name}.{end}" for end in ("key", "csr", "pem", "ext")
        )
        more.write_text(f"subjectAltName=DNS:{name}\n")
        openssl("req", *NEW_KEY, "-subj", f"/CN={name}", "-keyout", key, "-out", request)
        signing = ("-CA", authority, "-CAkey", secret, "-CAcreateserial", "-extfile", more)
        openssl("x509", "-req", "-in", request, *signing, "-out", made)
    lines = f"allow_anonymous true\nrequire_certificate true\ncafile {authority}\n"
    lines += f"certfile {folder}/localhost.pem\nkeyfile {folder}/localhost.key\n"
    broker = Mosquitto(folder, lines)
    boat = {"cert_file": f"{folder}/boat.pem", "key_file": f"{folder}/boat.key"}
    address = f"localhost:{broker.port}"
    yield broker, MqttConfig(broker=address, tls=True, ca_file=str(authority), **boat)  # type: ignore[arg-type]
    broker.stop()


def test_tls_with_an_authority_of_ones_own(encrypted: tuple[Mosquitto, MqttConfig]) -> None:
    with connecting(encrypted[1]) as client:
        turning(lambda: client.problem == "", client)
        # more than a record of TLS, and than the kernel takes at once
        client.offer(Message("k/tls/big", b"x" * 300_000, lasting=True))
        turning(lambda: not waiting(client), client)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"ca_file": None}, "CERTIFICATE_VERIFY_FAILED"),
        ({"broker": "127.0.0.1"}, "not valid for '127.0.0.1'"),
        ({"cert_file": None, "key_file": None}, ""),
    ],
)
def test_a_certificate_that_does_not_fit_ends_in_a_problem_and_no_connection(
    encrypted: tuple[Mosquitto, MqttConfig], change: dict[str, Any], said: str
) -> None:
    broker, right = encrypted
    if change.get("broker"):
        change = {"broker": f"127.0.0.1:{broker.port}"}
    with connecting(replace(right, **change)) as client:
        turning(lambda: client.problem, client)
        assert said in (client.problem or "")
        assert client.problem
