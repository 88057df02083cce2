"""Publishes through paho, whose own thread connects, sends, and connects again for ever with growing pauses.

Of each topic one message at most is with paho, and the newest waits here: a slow or missing broker makes nothing pile up and delays
nobody. Lasting messages are published again after each reconnection. MQTT 3.1.1, which every broker understands.
"""

import contextlib
import logging
import random
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.desk.mqtt.messages import OFFLINE, ONLINE, Publication
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.runtime.fault_log import FaultLog

KEEPALIVE_S = 15
"""The broker publishes the last will after 1.5 times this without a packet."""
MIN_PAUSE_S, MAX_PAUSE_S = 1, 30
"""Time between two attempts to connect; paho doubles it each time."""


def password(file: str) -> str:
    """The password in the first line of a file. OSError with the remedy where there is none."""
    try:
        line = Path(file).read_text(encoding="utf-8").partition("\n")[0].rstrip("\r")
    except OSError as error:
        raise OSError(f"{file}: the password cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise OSError(f"{file}: the password is no text in UTF-8") from None
    if not line:
        raise OSError(f"{file}: has no password on its first line")
    return line


class _Client(paho.Client):
    """paho's client, whose thread outlives the errors that paho raises for malformed packets."""

    on_malformed: Callable[[], None]

    def loop_forever(
        self, timeout: float = 1.0, retry_first_connection: bool = False
    ) -> MQTTErrorCode:
        """Connect and serve until ``disconnect``."""
        while True:
            try:
                return super().loop_forever(timeout, retry_first_connection)
            except Exception:
                self.on_malformed()
                if (sock := self.socket()) is not None:
                    with contextlib.suppress(OSError):
                        sock.close()  # paho's loop notices it, and connects again
                time.sleep(MIN_PAUSE_S)


class MqttClient:
    """Keeps one connection to a broker from ``start`` to ``stop``. ``online``: the topic of its state, "online" or "offline" (retained).

    OSError where a file is missing or damaged. All but paho's callbacks belongs to the thread that calls ``turn``.
    """

    def __init__(self, config: MqttConfig, client_id: str, online: str) -> None:
        assert config.address is not None
        self.address, self._config, self._client_id = config.address, config, client_id
        self.problem: str | None = None
        """Why there is no connection; empty while there is one, None before the first result."""
        self._connections = self._greeted = 0
        self._answered = False
        self._ended = threading.Event()
        self._offline = Publication(online, OFFLINE, True, True)
        self._lasting = {online: Publication(online, ONLINE, True, True)}
        self._waiting: dict[str, Publication] = {}
        self._handed: dict[str, paho.MQTTMessageInfo] = {}
        """paho's record of the newest message of each topic that it was given."""
        self._faults = FaultLog()
        self._client = client = _Client(CallbackAPIVersion.VERSION2, client_id)
        client.on_malformed = self._malformed
        client.on_pre_connect, client.on_socket_open = self._prepare, self._opened
        client.on_connect, client.on_connect_fail = self._connected, self._not_connected
        client.on_disconnect = self._disconnected
        client.will_set(online, OFFLINE, qos=1, retain=True)
        if config.tls:
            files = config.ca_file, config.cert_file, config.key_file
            try:
                # a key with a passphrase would ask for it on the terminal
                client.tls_set(*files, keyfile_password="")
            except (OSError, ValueError) as error:
                why = "cannot be used for TLS"  # the text of a library's error is of no use
                if isinstance(error, OSError) and not isinstance(error, ssl.SSLError):
                    why = f"cannot be read: {error.strerror}"
                raise OSError(
                    f"{', '.join(filter(None, files))}: {why}. Certificates must be in PEM form, keys without passphrase."
                ) from None
        if config.password_file is not None:
            password(config.password_file)
        # random, for the sake of a broker of many gateways
        longest = random.uniform(MAX_PAUSE_S / 2, MAX_PAUSE_S)
        client.reconnect_delay_set(MIN_PAUSE_S, longest)  # type: ignore[arg-type]

    def __str__(self) -> str:
        host, port = self.address
        return f"MQTT broker [{host}]:{port}" if ":" in host else f"MQTT broker {host}:{port}"

    def start(self) -> None:
        """Start paho's thread, which connects. RunError with the remedy where 127.0.0.1, by which paho wakes it, does not work."""
        self._client.connect_async(*self.address, KEEPALIVE_S)
        try:
            self._client.loop_start()
        except OSError as error:
            raise RunError(
                f"127.0.0.1: {error.strerror or error}. MQTT needs this machine's own network: sudo ip link set lo up"
            ) from None

    def offer(self, message: Publication) -> None:
        """Queue a message; a pending one of the same topic is replaced."""
        if message.lasting:
            self._lasting[message.topic] = message
        self._waiting[message.topic] = message

    def turn(self, now: int) -> None:
        """Hand over what can be sent, and report faults of the connection. To be called often; never waits."""
        if self.problem:
            self._faults.begin("broker", f"{self}: {self.problem}", now)
        elif self.problem == "":
            if self._greeted != self._connections:
                if self._greeted == 0:
                    self._faults.forget("broker")
                    self._faults.say(logging.INFO, f"{self}: connected as {self._client_id}")
                self._faults.end("broker", f"{self}: connected", now)
                self._greeted = self._connections
                self._waiting = self._lasting | self._waiting
            for topic in list(self._waiting):
                if topic not in self._handed or _is_done(self._handed[topic]):
                    self._handed[topic] = self._send(self._waiting.pop(topic))
        self._faults.advance(now)

    def stop(self, seconds: float) -> None:
        """Publish "offline" and end the connection, within ``seconds``."""
        end = time.monotonic() + seconds
        if self.problem == "":
            with contextlib.suppress(ValueError, RuntimeError):
                self._send(self._offline).wait_for_publish(seconds)
        if self._client.disconnect() == MQTTErrorCode.MQTT_ERR_SUCCESS:
            self._ended.wait(max(0.0, end - time.monotonic()))

    def _send(self, message: Publication) -> paho.MQTTMessageInfo:
        qos = 1 if message.lasting else 0
        return self._client.publish(message.topic, message.payload, qos, message.retain)

    # --- paho's thread

    def _prepare(self, *_: object) -> None:
        """Before each connection: the password may be another now."""
        self._answered = False
        if (user := self._config.username) is not None:
            file = self._config.password_file
            self._client.username_pw_set(user, None if file is None else password(file))

    def _opened(self, _client: object, _data: object, sock: Any) -> None:
        # a small buffer in the kernel, since data in it cannot be replaced by newer
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 15)

    def _connected(self, _client: object, _data: object, _flags: object, reason: Any, *_: object) -> None:  # fmt: skip
        self._answered = True
        if reason.is_failure:
            text = str(reason).lower()
            self.problem = f"refuses the connection: {text}. Check username, password_file and gateway of [mqtt]."
            return
        self._connections += 1
        self._ended.clear()
        self.problem = ""

    def _malformed(self) -> None:
        self.problem = "its answer is not MQTT. Is this the port of an MQTT broker?"

    def _not_connected(self, *_: object) -> None:
        error = sys.exc_info()[1]
        self.problem = f"cannot be reached: {getattr(error, 'strerror', None) or error}"

    def _disconnected(self, *_: object) -> None:
        if self.problem == "":
            self.problem = (
                "the connection was lost. If that goes on: does another program use the client id "
                f"{self._client_id!r} (mqtt.gateway)?"
            )
        elif not self._answered:
            self.problem = (
                "does not answer as an MQTT broker. Is the port right, does it want mqtt.tls?"
            )
        self._ended.set()


def _is_done(info: paho.MQTTMessageInfo) -> bool:
    """True once paho has sent a message (QoS 1: once the broker has it), or has given it up."""
    try:
        return info.is_published()
    except (ValueError, RuntimeError):  # it could not be queued, or the connection was lost
        return True
