"""The client and ``kontronik-can-gw mqtt`` with a real mosquitto and independent subscribers.

Some brokers here send garbage.
"""

import contextlib
import os
import pwd
import random
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import paho.mqtt.client as paho
import pytest
from command_line import written
from paho.mqtt.enums import CallbackAPIVersion
from vcan_tools import GatewayProcess, wait_for

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.desk.mqtt import client as mqtt_client
from kontronik_can_gw.desk.mqtt.client import MqttClient
from kontronik_can_gw.desk.mqtt.messages import Publication

MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
pytestmark = [
    pytest.mark.promise("mqtt"),
    pytest.mark.extended,
    pytest.mark.skipif(MOSQUITTO is None, reason="sudo apt-get install mosquitto"),
]
PATIENCE = 60.0
ONLINE = "k/test/online"


def free_port() -> int:
    """Return an unused port below the range from which the kernel chooses ports."""
    while True:
        port = random.randrange(20_000, 30_000)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


class Mosquitto:
    """A broker that can be stopped and started again on the same port."""

    def __init__(
        self,
        folder: Path,
        lines: str = "allow_anonymous true\n",
        port: int | None = None,
    ) -> None:
        self.port = port or free_port()
        self.address = f"127.0.0.1:{self.port}"
        user = pwd.getpwuid(os.geteuid()).pw_name
        text = f"listener {self.port} 127.0.0.1\n{lines}persistence false\nuser {user}\n"
        self._file = written(folder / f"mosquitto{self.port}.conf", text)
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen([str(MOSQUITTO), "-c", str(self._file)])
        wait_for(self._listens, "mosquitto")

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def freeze(self, frozen: bool) -> None:
        """Stop or continue the process. A stopped broker is like an overloaded one."""
        self._process.send_signal(signal.SIGSTOP if frozen else signal.SIGCONT)

    def stop(self) -> None:
        self.freeze(False)
        self._process.terminate()
        self._process.wait(PATIENCE)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path)
    yield made
    made.stop()


class Subscriber:
    """A subscriber that uses paho directly."""

    def __init__(self, port: int, topic: str) -> None:
        self.heard: list[paho.MQTTMessage] = []
        self.client = paho.Client(CallbackAPIVersion.VERSION2)
        subscribed = threading.Event()
        self.client.on_connect = lambda client, *_: client.subscribe(topic, 1)
        self.client.on_subscribe = lambda *_: subscribed.set()
        self.client.on_message = lambda *message: self.heard.append(message[2])
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()
        assert subscribed.wait(PATIENCE)

    def wait(self, topic: str, payload: bytes | None = None) -> paho.MQTTMessage:
        """Wait for the first message of a topic, with this payload if given, and return it."""

        def found() -> list[paho.MQTTMessage]:
            heard = [message for message in list(self.heard) if message.topic == topic]
            return [message for message in heard if payload in (None, message.payload)]

        wait_for(found, lambda: f"{topic} {payload!r} in {[m.payload for m in self.heard]}")
        return found()[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()
        self.client.loop_stop()


# --- the client


@contextlib.contextmanager
def connecting(broker: MqttConfig) -> Iterator[MqttClient]:
    client = MqttClient(broker, "test", ONLINE)
    client.start()
    try:
        yield client
    finally:
        begin = time.monotonic()
        client.stop(PATIENCE)
        assert time.monotonic() - begin < PATIENCE, "its thread did not report the end"


def to(port: int) -> MqttConfig:
    return MqttConfig(broker=f"127.0.0.1:{port}")


def waiting(client: MqttClient) -> int:
    """Return the number of messages that are not sent yet."""
    handed = sum(not mqtt_client._is_done(info) for info in client._handed.values())
    return len(client._waiting) + handed


def turning(client: MqttClient, condition: Callable[[], object]) -> None:
    """Call ``turn`` as the command does, until the condition is true."""

    def holds() -> object:
        client.turn(time.monotonic_ns())
        return condition()

    wait_for(holds, lambda: client.problem)


def test_only_the_newest_message_of_a_topic_waits_and_retained_go_first(broker: Mosquitto) -> None:
    client = MqttClient(to(broker.port), "test", ONLINE)
    for number in range(1000):
        client.offer(Publication("k/test/state", b"%d" % number))
        client.offer(Publication("k/test/other", b"%d" % number))
    client.offer(Publication("k/test/known", b"1", is_lasting=True, retain=True))
    client.offer(Publication("k/test/known", b"2", is_lasting=True, retain=True))
    assert waiting(client) == 3
    with Subscriber(broker.port, "k/test/#") as heard:
        client.start()
        turning(client, lambda: client.problem == "" and not waiting(client))
        heard.wait("k/test/other", b"999")
        client.stop(PATIENCE)
        heard.wait(ONLINE, b"offline")
    assert [(m.topic, m.payload) for m in heard.heard if not m.retain] == [
        (ONLINE, b"online"),
        ("k/test/known", b"2"),
        ("k/test/state", b"999"),
        ("k/test/other", b"999"),
        (ONLINE, b"offline"),
    ]


def test_memory_is_bounded_while_the_broker_accepts_nothing(broker: Mosquitto) -> None:
    """While the broker is stopped, waiting messages are replaced. The client ends in time."""
    sent: list[bytes] = []
    client = MqttClient(to(broker.port), "test", ONLINE)
    with Subscriber(broker.port, "k/test/state") as heard:
        client.start()
        turning(client, lambda: client.problem == "")

        def offer() -> None:
            sent.append(b"%06d" % len(sent) + b"x" * 100_000)
            client.offer(Publication("k/test/state", sent[-1]))
            client.turn(time.monotonic_ns())

        broker.freeze(True)
        for _ in range(100):
            offer()
        assert waiting(client) <= 3  # "online", one state with paho, the newest waiting
        broker.freeze(False)
        turning(client, lambda: not waiting(client))
        heard.wait("k/test/state", sent[-1])
        numbers = [int(message.payload[:6]) for message in heard.heard]
        assert numbers == sorted(numbers)
        broker.freeze(True)
        for _ in range(100):
            offer()
        client.stop(0.3)  # returns although the broker accepts nothing
        broker.freeze(False)


def test_client_continues_after_an_answer_that_is_garbage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_client, "MIN_PAUSE_S", 0.01)
    monkeypatch.setattr(mqtt_client, "MAX_PAUSE_S", 0.1)
    rng = random.Random(1)
    rubbish = [
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        b"\x00" * 100,
        b"\x20\x7f\x00",
        bytes(range(256)),
        b"",
    ]
    rubbish += [b"\x20" + rng.randbytes(rng.randrange(1, 60)) for _ in range(6)]
    rubbish += [rng.randbytes(rng.randrange(1, 200)) for _ in range(6)]
    for answer in rubbish:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            listener.settimeout(PATIENCE)
            with connecting(to(listener.getsockname()[1])) as client:
                for _ in range(2):  # the client tries again
                    with listener.accept()[0] as connection:
                        connection.recv(4096)
                        connection.sendall(answer)
                turning(client, lambda: client.problem)


def openssl(*words: object) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True)


def test_tls_accepts_an_own_authority_and_refuses_wrong_certificates(tmp_path: Path) -> None:
    authority = tmp_path / "authority.pem"
    secret = tmp_path / "authority.key"
    new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    openssl("req", "-x509", *new, "-subj", "/CN=authority", "-keyout", secret, "-out", authority)
    for name in ("localhost", "boat"):
        key, request, made = (tmp_path / f"{name}.{end}" for end in ("key", "csr", "pem"))
        more = written(tmp_path / "extension", f"subjectAltName=DNS:{name}\n")
        openssl("req", *new, "-subj", f"/CN={name}", "-keyout", key, "-out", request)
        signing = ("-CA", authority, "-CAkey", secret, "-CAcreateserial", "-extfile", more)
        openssl("x509", "-req", "-in", request, *signing, "-out", made)
    lines = f"allow_anonymous true\nrequire_certificate true\ncafile {authority}\n"
    lines += f"certfile {tmp_path}/localhost.pem\nkeyfile {tmp_path}/localhost.key\n"
    broker = Mosquitto(tmp_path, lines)
    right = replace(to(0), broker=f"localhost:{broker.port}", tls=True, ca_file=str(authority))
    right = replace(right, cert_file=f"{tmp_path}/boat.pem", key_file=f"{tmp_path}/boat.key")
    try:
        with connecting(right) as client:
            turning(client, lambda: client.problem == "")
            # larger than a TLS record, and than the kernel accepts at once
            client.offer(Publication("k/tls/big", b"x" * 300_000, is_lasting=True))
            turning(client, lambda: not waiting(client))
        wrong: list[tuple[dict[str, Any], str]] = [
            ({"ca_file": None}, "CERTIFICATE_VERIFY_FAILED"),
            ({"broker": broker.address}, "not valid for '127.0.0.1'"),
            ({"cert_file": None, "key_file": None}, ""),
        ]
        for change, said in wrong:
            with connecting(replace(right, **change)) as client:
                turning(client, lambda: client.problem)
                assert said in (client.problem or "")
    finally:
        broker.stop()


# --- the command, on a bus without frames

Live = Callable[..., GatewayProcess]


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    """Return a function that starts the program for a gateway with this name."""
    started = []

    def start(name: str, address: str, more: str = "") -> GatewayProcess:
        text = '[can]\ninterface = "virtual"\nchannel = "mqtt"\n[[esc]]\nport = "/dev/ttyS0"\n'
        text += f'[mqtt]\nbroker = "{address}"\ngateway = "{name}"\nrate = 20.0\n{more}'
        started.append(GatewayProcess(written(tmp_path / "gateway.toml", text), command="mqtt"))
        return started[-1]

    yield start
    for each in started:
        each.kill()


def test_state_is_retained_and_reported_to_the_service_manager(
    live: Live,
    broker: Mosquitto,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said = ""
    state = "kontronik/sd/online"
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "1000000")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE)
        program = live("sd", broker.address)
        while "STATUS=connected" not in said or said.count("WATCHDOG=1") < 5:
            said += manager.recv(4096).decode()
        with Subscriber(broker.port, state) as heard:
            assert heard.wait(state, b"online").retain
        assert program.end() == 0
        with Subscriber(broker.port, state) as heard:
            assert heard.wait(state, b"offline").retain
        while "STOPPING=1" not in said:
            said += manager.recv(4096).decode()
    assert said.startswith("READY=1")


def test_last_will_is_offline_after_a_kill(live: Live, broker: Mosquitto) -> None:
    state = "kontronik/killed/online"
    program = live("killed", broker.address)
    with Subscriber(broker.port, state) as heard:
        heard.wait(state, b"online")
        program.end(signal.SIGKILL)
        heard.wait(state, b"offline")
    with Subscriber(broker.port, state) as heard:
        assert heard.wait(state, b"offline").retain


def test_broker_that_starts_late_stops_and_starts_again(live: Live, tmp_path: Path) -> None:
    port = free_port()
    program = live("late", f"127.0.0.1:{port}")
    program.wait_for_line(f"MQTT broker 127.0.0.1:{port}: cannot be reached: Connection refused")
    broker = Mosquitto(tmp_path, port=port)
    try:
        program.wait_for_line("connected as kontronik-can-gw-late")
        broker.stop()
        program.wait_for_line("the connection was lost")
        broker.start()
        with Subscriber(port, "kontronik/late/#") as heard:
            heard.wait("kontronik/late/online", b"online")
            heard.wait(
                "kontronik/late/esc1/available", b"offline"
            )  # the broker lost its retained messages
            heard.wait("kontronik/late/esc1/state")
        program.wait_for_line(": connected, after")
        assert program.log.count("Connection refused") <= 3  # not a line for each attempt
        assert program.end() == 0
    finally:
        broker.stop()
    assert "Traceback" not in program.log


def test_wrong_password_is_logged_once_and_a_new_one_is_used(live: Live, tmp_path: Path) -> None:
    users = tmp_path / "users"
    secret = written(tmp_path / "password", "wrong donkey\nmore\n")
    command = ["mosquitto_passwd", "-b", "-c", str(users), "boat", "right horse"]
    subprocess.run(command, check=True, capture_output=True)
    broker = Mosquitto(tmp_path, f"allow_anonymous false\npassword_file {users}\n")
    try:
        program = live("pw", broker.address, 'username = "boat"\npassword_file = "password"\n')
        refusal = "refuses the connection: not authorized. Check username, password_file"
        program.wait_for_line(refusal)
        secret.write_text("right horse\n")
        program.wait_for_line(f"MQTT broker {broker.address}: connected")
        shown = Path(f"/proc/{program.process.pid}/cmdline").read_text()
        assert program.end() == 0
        assert program.log.count("refuses the connection") == 1
        for text in ("donkey", "horse"):
            assert text not in program.log + shown
    finally:
        broker.stop()
