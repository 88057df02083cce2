"""Publishes to an MQTT broker through paho.

paho's thread connects and sends. After a loss it tries again for ever, with growing pauses. For
each topic, paho has at most one message that is not sent yet, and the newest further message is
kept here. So memory stays bounded and callers are not delayed if the broker is slow or missing.
Lasting messages are published again after each reconnection. The version is MQTT 3.1.1, which every
broker supports.
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
from kontronik_can_gw.runtime.system.fault_log import FaultLog

KEEPALIVE_S = 15
"""After 1.5 times this without a packet, the broker publishes the last will."""
MIN_PAUSE_S = 1
MAX_PAUSE_S = 30
"""Limits of the time between two attempts to connect. paho doubles it after each attempt."""


def password(file: str) -> str:
    """Return the password in the first line of a file. Raises OSError if there is no password."""
    try:
        line = Path(file).read_text(encoding="utf-8").partition("\n")[0].rstrip("\r")
    except OSError as error:
        raise OSError(f"{file}: the password cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise OSError(f"{file}: the password is not UTF-8 text") from None
    if not line:
        raise OSError(f"{file}: has no password on its first line")
    return line


_EXPECTED = (0x20, 0x40, 0xD0)
"""First bytes of the packets that a publisher receives: CONNACK, PUBACK and PINGRESP."""
_LARGEST_BODY = 2
"""Bytes after the length of such a packet."""


class _Unexpected(Exception):
    """Raised if the broker begins a packet that no publisher receives."""


class _Client(paho.Client):
    """paho's client. Its thread continues after the exceptions of malformed packets.

    It has no subscription, so a broker only answers. paho would accept a packet of any size up to
    256 MB, and would answer a flood of others before anything else.
    """

    on_malformed: Callable[[str], None]
    on_end: Callable[[], None]
    """Called when the thread ends. paho does not call ``on_disconnect`` after each problem."""

    def _sock_recv(self, size: int) -> bytes:
        """Receive at most ``size`` bytes of one packet: its first byte, its length, its body."""
        command = self._in_packet["command"]
        if size > _LARGEST_BODY or (command and command not in _EXPECTED):
            raise _Unexpected
        return super()._sock_recv(size)

    def loop_forever(
        self, timeout: float = 1.0, retry_first_connection: bool = False
    ) -> MQTTErrorCode:
        """Connect and serve until ``disconnect``."""
        while True:
            try:
                code = super().loop_forever(timeout, retry_first_connection)
                self.on_end()
                return code
            except Exception as error:
                if isinstance(error, _Unexpected):
                    problem = "sends packets that no publisher expects"
                else:
                    problem = "its answer is not MQTT"
                self.on_malformed(f"{problem}. Is this the port of an MQTT broker?")
                sock = self.socket()
                if sock is not None:
                    with contextlib.suppress(OSError):
                        sock.close()  # so that paho's loop connects again
                time.sleep(MIN_PAUSE_S)


class MqttClient:
    """Keeps one connection to a broker from ``start`` to ``stop``.

    ``online`` is the topic of the connection's state, "online" or "offline" (retained). All methods
    except paho's callbacks must be called by one thread. Raises OSError if a file is missing or
    damaged.
    """

    def __init__(self, config: MqttConfig, client_id: str, online: str) -> None:
        assert config.address is not None
        self.address = config.address
        self._config = config
        self._client_id = client_id
        self.problem: str | None = None
        """The reason why there is no connection.

        Empty while there is a connection. None before the result of the first attempt.
        """
        self._connections = 0
        """Number of connections that the broker has accepted."""
        self._reported_connections = 0
        """Number of connections that ``turn`` has reported."""
        self._has_answered = False
        """True if the broker has answered the present attempt."""
        self._ended = threading.Event()
        self._offline = Publication(online, OFFLINE, True, True)
        self._lasting = {online: Publication(online, ONLINE, True, True)}
        self._waiting: dict[str, Publication] = {}
        """The newest message of each topic that paho does not have yet."""
        self._handed: dict[str, paho.MQTTMessageInfo] = {}
        """paho's record of the last message of each topic that it received."""
        self._faults = FaultLog()
        client = _Client(CallbackAPIVersion.VERSION2, client_id)
        client.on_malformed = self._on_malformed
        client.on_end = self._ended.set
        client.on_pre_connect = self._on_pre_connect
        client.on_socket_open = self._on_socket_open
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        client.will_set(
            online,
            OFFLINE,
            qos=1,
            retain=True,
        )
        self._client = client
        if config.tls:
            self._use_tls()
        if config.password_file is not None:
            password(config.password_file)
        # A random limit, so that many gateways do not all reconnect to a broker at the same time.
        longest = random.uniform(MAX_PAUSE_S / 2, MAX_PAUSE_S)
        client.reconnect_delay_set(MIN_PAUSE_S, longest)  # type: ignore[arg-type]

    def _use_tls(self) -> None:
        """Use the certificates of the configuration.

        OSError, with the names of the files, if they cannot be used.
        """
        config = self._config
        files = (config.ca_file, config.cert_file, config.key_file)
        try:
            # Without this password, a key with a passphrase would ask for it on the terminal.
            self._client.tls_set(*files, keyfile_password="")
        except (OSError, ValueError) as error:
            # The text of a library's own error does not help a user.
            problem = "cannot be used for TLS"
            if isinstance(error, OSError) and not isinstance(error, ssl.SSLError):
                problem = f"cannot be read: {error.strerror}"
            names = ", ".join(file for file in files if file)
            raise OSError(
                f"{names}: {problem}. Certificates must be in PEM form, keys without passphrase."
            ) from None

    def __str__(self) -> str:
        host, port = self.address
        if ":" in host:
            host = f"[{host}]"
        return f"MQTT broker {host}:{port}"

    def start(self) -> None:
        """Start paho's thread, which connects.

        Raises RunError if 127.0.0.1 is not available. paho needs it to wake its thread.
        """
        self._client.connect_async(*self.address, KEEPALIVE_S)
        try:
            self._client.loop_start()
        except OSError as error:
            raise RunError(
                f"127.0.0.1: {error.strerror or error}. "
                "MQTT needs the loopback interface: sudo ip link set lo up"
            ) from None

    def offer(self, message: Publication) -> None:
        """Queue a message. It replaces a waiting message of the same topic."""
        if message.is_lasting:
            self._lasting[message.topic] = message
        self._waiting[message.topic] = message

    def turn(self, now: int) -> None:
        """Pass messages to paho, and log faults of the connection.

        Never waits. Messages are delayed until the next call, so call it several times a second.
        """
        if self.problem:
            self._faults.begin("broker", f"{self}: {self.problem}", now)
        elif self.problem == "":
            if self._reported_connections != self._connections:
                if self._reported_connections == 0:
                    self._faults.forget("broker")
                    self._faults.log(logging.INFO, f"{self}: connected as {self._client_id}")
                self._faults.end("broker", f"{self}: connected", now)
                self._reported_connections = self._connections
                self._waiting = self._lasting | self._waiting
            for topic in list(self._waiting):
                if topic not in self._handed or _is_done(self._handed[topic]):
                    self._handed[topic] = self._send(self._waiting.pop(topic))
        self._faults.advance(now)

    def stop(self, seconds: float) -> None:
        """Publish "offline" and end the connection. Returns after ``seconds`` at the latest."""
        end = time.monotonic() + seconds
        if self.problem == "":
            with contextlib.suppress(ValueError, RuntimeError):
                self._send(self._offline).wait_for_publish(seconds)
        if self._client.disconnect() == MQTTErrorCode.MQTT_ERR_SUCCESS:
            self._ended.wait(max(0.0, end - time.monotonic()))

    def _send(self, message: Publication) -> paho.MQTTMessageInfo:
        qos = 1 if message.is_lasting else 0
        return self._client.publish(message.topic, message.payload, qos, message.retain)

    # --- paho's thread

    def _on_pre_connect(self, *_: object) -> None:
        """Read the password again before each connection, because the file may have changed."""
        self._has_answered = False
        user = self._config.username
        if user is not None:
            file = self._config.password_file
            self._client.username_pw_set(user, None if file is None else password(file))

    def _on_socket_open(self, _client: object, _data: object, sock: Any) -> None:
        # The kernel's buffer is small, because newer data cannot replace the data in it.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 15)

    def _on_connect(
        self,
        _client: object,
        _data: object,
        _flags: object,
        reason: Any,
        *_: object,
    ) -> None:
        self._has_answered = True
        if reason.is_failure:
            text = str(reason).lower()
            self.problem = (
                f"refuses the connection: {text}. "
                "Check username, password_file and gateway of [mqtt]."
            )
            return
        self._connections += 1
        self.problem = ""

    def _on_malformed(self, problem: str) -> None:
        self.problem = problem

    def _on_connect_fail(self, *_: object) -> None:
        error = sys.exc_info()[1]
        self.problem = f"cannot be reached: {getattr(error, 'strerror', None) or error}"

    def _on_disconnect(self, *_: object) -> None:
        if self.problem == "":
            self.problem = (
                "the connection was lost. If this repeats, another program may use the client id "
                f"{self._client_id!r} (mqtt.gateway)."
            )
        elif not self._has_answered:
            self.problem = (
                "does not answer like an MQTT broker. Is the port right? Does it need mqtt.tls?"
            )


def _is_done(info: paho.MQTTMessageInfo) -> bool:
    """Return True if paho has sent a message or has given it up.

    A message with QoS 1 is sent when the broker has confirmed it.
    """
    try:
        return info.is_published()
    except (ValueError, RuntimeError):  # not queued, or the connection was lost
        return True
