"""Publishes through paho, whose own thread connects, sends, and connects again for ever with growing pauses.

Of each topic one message at most is with paho, and the newest waits here: a slow or missing broker makes nothing pile up and delays nobody.
Lasting messages are published again after each reconnection. Everything but paho's callbacks belongs to the thread that calls ``turn``.
"""

import contextlib
import logging
import random
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from kontronik_can_gw.desk.mqtt.broker import (
    Broker,
    failure,
    password,
    refusal,
    show_certificate,
    tls_context,
)
from kontronik_can_gw.desk.mqtt.topics import OFFLINE, ONLINE, Message
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.fault_log import FaultLog

KEEPALIVE_S = 15
"""The broker publishes the last will after 1.5 times this without a packet."""
_CONNECT_S = 5.0
_SEND_BUFFER = 1 << 15
_MIN_PAUSE_S, _MAX_PAUSE_S = 1, 30
"""Time between two attempts to connect; paho doubles it each time."""
_CONFLICT_PAUSE_S = 60
"""Two programs with one client id disconnect each other; the pause keeps this from happening each second."""
SLOW_NS = 2 * SECOND
_SHORT_NS = 5 * SECOND
_MAX_SHORT = 3
"""After this number of connections in a row that the broker ended within ``_SHORT_NS`` a client id conflict is assumed."""
_TIMEOUT = "Keep alive timeout"
"""paho's name for the end of a connection that nothing came over."""
_ANSWER_S = 10.0
_SILENCE_S = 1.0


class MqttClient:
    """Keeps one connection to a broker until ``stop``. ``online_topic`` holds its state: "online", "offline" (retained)."""

    def __init__(self, broker: Broker, online_topic: str) -> None:
        self.broker = broker
        self._lasting = {online_topic: Message(online_topic, ONLINE, True, True)}
        self._waiting: dict[str, Message] = {}
        self._handed: dict[str, Any] = {}
        """paho's record of the newest message of each topic that it was given."""
        self._offline = Message(online_topic, OFFLINE, True, True)
        self._conditions = FaultLog()
        self._stuck_ns: int | None = None
        self._link = _Link(broker)
        self._link.client.will_set(online_topic, OFFLINE, qos=1, retain=True)
        self._served = 0

    def start(self) -> None:
        """Start paho's thread."""
        self._link.begin()

    @property
    def connected(self) -> bool:
        return self._link.problem == ""

    @property
    def problem(self) -> str:
        """One line on the fault of the connection; empty while it is up."""
        return self._conditions.reason("broker")

    @property
    def waiting(self) -> int:
        """Number of messages that are not sent yet."""
        return len(self._waiting) + sum(not _is_done(info) for info in self._handed.values())

    def offer(self, message: Message) -> None:
        """Queue a message; a pending one of the same topic is replaced."""
        if message.lasting:
            self._lasting[message.topic] = message
        self._waiting[message.topic] = message

    def turn(self, now: int) -> None:
        """Hand over what can be sent, and report faults of the connection. To be called often; never waits."""
        problem, link = self._link.problem, self._link
        if problem:
            self._stuck_ns = None
            self._conditions.begin("broker", f"{self.broker}: {problem}", now)
        elif problem == "":
            if self._served != link.connections:
                self._greet(link.connections, now)
            self._hand_over()
            self._watch(now)
            if now - link.since_ns > _SHORT_NS:
                link.lasts()
        self._conditions.advance(now)

    def stop(self, seconds: float) -> None:
        """Publish "offline" and end the connection, within ``seconds``."""
        end = time.monotonic() + seconds
        if self.connected:
            with contextlib.suppress(ValueError, RuntimeError):
                self._link.send(self._offline).wait_for_publish(seconds)
        self._link.end(end - time.monotonic())

    def _greet(self, connections: int, now: int) -> None:
        """Queue all lasting messages before the pending ones."""
        if self._served:
            self._conditions.end("broker", f"{self.broker}: connected", now)
        else:
            self._conditions.forget("broker")
            text = f"{self.broker}: connected as {self.broker.client_id}"
            self._conditions.say(logging.INFO, text)
        self._served = connections
        self._waiting = self._lasting | self._waiting

    def _hand_over(self) -> None:
        for topic in list(self._waiting):
            if topic not in self._handed or _is_done(self._handed[topic]):
                self._handed[topic] = self._link.send(self._waiting.pop(topic))

    def _watch(self, now: int) -> None:
        """Report a broker that takes messages too slowly: one waits for its predecessor, without an end."""
        if not self._waiting:
            self._stuck_ns = None
            self._conditions.end("slow broker", f"{self.broker}: takes messages again", now)
            return
        self._stuck_ns = self._stuck_ns or now
        if now - self._stuck_ns > SLOW_NS:
            text = f"{self.broker}: takes messages too slowly: only the newest are sent"
            self._conditions.begin("slow broker", text, now, since=self._stuck_ns)


class _Client(paho.Client):
    """paho's client, whose thread outlives the errors that paho raises for malformed packets."""

    def __init__(self, client_id: str, on_malformed: Callable[[Exception], None]) -> None:
        super().__init__(CallbackAPIVersion.VERSION2, client_id)
        self.on_malformed = on_malformed
        self.ended = threading.Event()

    def loop_forever(
        self, timeout: float = 1.0, retry_first_connection: bool = False
    ) -> MQTTErrorCode:
        """Connect and serve until ``disconnect``."""
        while True:
            try:
                code = super().loop_forever(timeout, retry_first_connection)
                self.ended.set()
                return code
            except Exception as error:
                self.on_malformed(error)
                if (sock := self.socket()) is not None:
                    with contextlib.suppress(OSError):
                        sock.close()  # paho's loop notices it, and connects again
                time.sleep(_MIN_PAUSE_S)


class _Link:
    """paho's client and thread; what its callbacks find out is left in attributes for the owner to read.

    MQTT 3.1.1, which every broker understands.
    """

    def __init__(self, broker: Broker) -> None:
        self.client = client = _Client(broker.client_id, self._malformed)
        self.problem: str | None = None
        """Why there is no connection; empty while there is one, None before the first result."""
        self.connections = 0
        self.since_ns = 0
        """Beginning of the newest connection."""
        self._broker = broker
        self._answered: bool | None = None
        """True once the broker has answered CONNECT; None without a connection."""
        self._short = 0
        self._stopping = False
        self._context = tls_context(broker.config) if broker.config.tls else None
        if self._context is not None:
            client.tls_set_context(self._context)
        client.connect_timeout = _CONNECT_S
        client.on_pre_connect = self._prepare
        client.on_socket_open = self._opened
        client.on_connect = self._connected
        client.on_connect_fail = self._not_connected
        client.on_disconnect = self._disconnected
        self._set_pauses(_MIN_PAUSE_S, _MAX_PAUSE_S)

    def begin(self) -> None:
        """Start paho's thread, which connects."""
        self.client.connect_async(*self._broker.address, KEEPALIVE_S)
        self.client.loop_start()

    def send(self, message: Message) -> paho.MQTTMessageInfo:
        """Hand a message to paho, which queues it."""
        qos = 1 if message.lasting else 0
        return self.client.publish(message.topic, message.payload, qos, message.retain)

    def lasts(self) -> None:
        """The connection is one that holds: no other program has our client id."""
        if self._short:
            self._short = 0
            self._set_pauses(_MIN_PAUSE_S, _MAX_PAUSE_S)

    def end(self, seconds: float) -> None:
        """Send DISCONNECT, so that the broker publishes no last will, and wait for that."""
        self._stopping, self.problem = True, None
        if self.client.disconnect() == MQTTErrorCode.MQTT_ERR_SUCCESS:
            self.client.ended.wait(max(0, seconds))

    # --- paho's thread

    def _prepare(self, *_: object) -> None:
        """Before each connection: password and certificate may be others now."""
        config = self._broker.config
        if config.username is not None:
            file = config.password_file
            self.client.username_pw_set(config.username, None if file is None else password(file))
        if self._context is not None:
            if config.ca_file is not None:
                self._context.load_verify_locations(config.ca_file)
            show_certificate(config, self._context)

    def _opened(self, _client: object, _data: object, sock: Any) -> None:
        self._answered = False
        # a small buffer in the kernel, since data in it cannot be replaced by newer, and no delay
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _connected(
        self, _client: object, _data: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        self._answered = True
        if reason.is_failure:
            self.problem = refusal(self._broker, reason)
            return
        self.connections += 1
        self.since_ns = time.monotonic_ns()
        self.problem = ""
        if self._stopping:
            self.client.disconnect()

    def _malformed(self, error: Exception) -> None:
        self.problem = f"its answer is not MQTT: {error!r}"

    def _not_connected(self, *_: object) -> None:
        self.problem = failure(sys.exc_info()[1])

    def _disconnected(
        self, _client: object, _data: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        answered, self._answered = self._answered, None
        if answered is None:  # paho says it twice where a ping has no answer
            return
        is_silent = str(reason) == _TIMEOUT
        if not answered:
            closed = "closed the connection instead of answering. Does it want TLS (--tls)?"
            silent = "does not answer. Is this the port of an MQTT broker?"
            self.problem = silent if is_silent else closed
        elif self.problem == "":
            self._lost(": nothing came any more" if is_silent else "")

    def _lost(self, reason: str) -> None:
        """Handle a connection that the broker or the network ended."""
        lasted = time.monotonic_ns() - self.since_ns
        self._short = self._short + 1 if lasted < _SHORT_NS else 0
        if self._short < _MAX_SHORT:
            self.problem = f"the connection was lost{reason}"
            return
        self.problem = (
            "ends each connection at once: maybe another program uses the client id "
            f"{self._broker.client_id!r}. Give each gateway a name of its own (--gateway)."
        )
        self._set_pauses(_CONFLICT_PAUSE_S // 2, _CONFLICT_PAUSE_S)

    def _set_pauses(self, low: float, high: float) -> None:
        """Set the first and the longest pause between attempts; that is random, for the sake of a broker of many gateways."""
        longest = random.uniform(max(low, high / 2), high)
        self.client.reconnect_delay_set(low, longest)  # type: ignore[arg-type]


def _is_done(info: paho.MQTTMessageInfo) -> bool:
    """True once paho has sent a message (QoS 1: once the broker has it), or has given it up."""
    try:
        return info.is_published()
    except (ValueError, RuntimeError):  # it could not be queued, or the connection was lost
        return True


def remove(
    broker: Broker, filters: Iterable[str], wanted: Callable[[str, bytes], bool]
) -> list[str]:
    """Clear the retained messages that match ``filters`` and are ``wanted``; return their topics. RunError on failure."""
    link = _Link(broker)
    found: dict[str, bytes] = {}
    news, answered = threading.Event(), threading.Event()

    def take(_client: object, _data: object, message: paho.MQTTMessage) -> None:
        if message.retain:
            found[message.topic] = bytes(message.payload)
            news.set()

    link.client.on_message = take
    link.client.on_subscribe = lambda *_: answered.set()
    link.begin()
    try:
        _wait(broker, link, lambda: link.problem == "")
        link.client.subscribe([(topic, 1) for topic in filters])
        _wait(broker, link, answered.is_set)
        while news.wait(_SILENCE_S):
            news.clear()
        topics = sorted(t for t, payload in found.items() if payload and wanted(t, payload))
        sent = [link.send(Message(topic, b"", True, True)) for topic in topics]
        _wait(broker, link, lambda: all(map(_is_done, sent)))
    finally:
        link.end(_SILENCE_S)
    return topics


def _wait(broker: Broker, link: _Link, condition: Callable[[], bool]) -> None:
    """RunError if the condition does not come, with what is known of the connection."""
    end = time.monotonic() + _ANSWER_S
    while not condition():
        if link.problem not in (None, "") or time.monotonic() > end:
            raise RunError(f"{broker}: {link.problem or 'does not answer'}")
        time.sleep(0.01)
