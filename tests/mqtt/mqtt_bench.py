"""A real mosquitto on loopback, clients that are not ours, and the program as a process."""

import contextlib
import os
import pwd
import random
import secrets
import shutil
import signal
import socket
import subprocess
import threading
from pathlib import Path
from typing import NamedTuple, Self

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion
from vcan_tools import wait_for

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/sbin")
PATIENCE = 60.0


def need_mosquitto() -> str:
    """The broker's program; without it the test is skipped, in CI it fails."""
    if MOSQUITTO is not None and shutil.which("mosquitto_sub"):
        return MOSQUITTO
    reason = "mosquitto is missing: sudo apt-get install mosquitto mosquitto-clients"
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def free_port() -> int:
    """A port that nobody listens on, below those that the kernel gives to connections."""
    while True:
        port = random.randrange(20_000, 30_000)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


class Mosquitto:
    """A broker with a configuration of its own, that can be stopped and started again on the same port."""

    def __init__(
        self, folder: Path, lines: str = "allow_anonymous true\n", port: int | None = None
    ) -> None:
        self._program = need_mosquitto()
        self.port = port or free_port()
        self._file = folder / f"mosquitto{self.port}.conf"
        self._file.write_text(
            f"listener {self.port} 127.0.0.1\n{lines}persistence false\nuser {pwd.getpwuid(os.geteuid()).pw_name}\n"
        )
        self._log = folder / f"mosquitto{self.port}.log"
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [self._program, "-v", "-c", str(self._file)], stdout=log, stderr=log
            )
        wait_for(self._listens, self._log.read_text)

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def freeze(self, frozen: bool) -> None:
        """Let it stand still, as one that is overloaded."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP if frozen else signal.SIGCONT)

    def stop(self) -> None:
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
            self._process.wait(PATIENCE)
            self._process = None


class Heard(NamedTuple):
    """A message as a subscriber got it."""

    topic: str
    payload: bytes
    retained: bool


class Subscriber:
    """paho, as somebody else uses it."""

    def __init__(self, port: int, topic: str = "#") -> None:
        self.heard: list[Heard] = []
        self.mark = f"mark/{secrets.token_hex(8)}"
        """A topic of its own, to be published."""
        self.client = paho.Client(CallbackAPIVersion.VERSION2)
        self._subscribed = threading.Event()
        self.client.on_connect = lambda client, *_: client.subscribe([(topic, 1), (self.mark, 1)])
        self.client.on_subscribe = lambda *_: self._subscribed.set()
        self.client.on_message = self._take
        self.client.reconnect_delay_set(1, 1)
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()
        assert self._subscribed.wait(PATIENCE)

    def _take(self, _client: object, _data: object, message: paho.MQTTMessage) -> None:
        self.heard.append(Heard(message.topic, bytes(message.payload), message.retain))

    def wait(self, topic: str, payload: bytes | None = None) -> Heard:
        """The first message of a topic (with this payload), as soon as it has come."""

        def found() -> list[Heard]:
            return [
                h for h in list(self.heard) if h.topic == topic and payload in (None, h.payload)
            ]

        wait_for(found, lambda: f"{topic} {payload!r} in {self.heard}")
        return found()[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.disconnect()
        self.client.loop_stop()


def kept(port: int, topic: str = "#") -> dict[str, bytes]:
    """What the broker keeps: it comes before a message of our own that is sent once the subscription is acknowledged."""
    with Subscriber(port, topic) as heard:
        heard.client.publish(heard.mark, b"x", 1)
        heard.wait(heard.mark)
    return {found.topic: found.payload for found in heard.heard if found.retained}
