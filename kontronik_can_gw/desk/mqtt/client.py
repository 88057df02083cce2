"""The MQTT client: a thread that connects to a broker, publishes, and reconnects for ever.

The queue is bounded: only the newest message of each topic waits, and it is handed to the connection only when that has sent the previous
ones. Lasting messages are published again after each reconnection. Any thread may call ``offer`` and ``stop`` and read the properties;
everything else, including paho's client, belongs to the client's thread. A broker that does not answer blocks only this thread.
"""

import contextlib
import logging
import os
import random
import select
import socket
import ssl
import stat
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.runtime.fault_log import FaultLog
from kontronik_can_gw.runtime.retry import Retry

LONGEST_PAUSE_NS = 30 * SECOND
"""Maximum time between two attempts to connect."""
KEEPALIVE_S = 15
"""The broker publishes the last will after 1.5 times this without a packet."""
CONNECT_S = 5.0
TAKEN_OVER_PAUSE_NS = 60 * SECOND
"""Two programs with one client id disconnect each other; the pause keeps this from happening many times a second."""
SLOW_NS = 2 * SECOND
_SEND_BUFFER = 1 << 15
_MAX_UNACKNOWLEDGED = 10
_SHORT_NS = 5 * SECOND
_MAX_SHORT = 3
"""After this number of connections in a row that the broker ended within ``_SHORT_NS`` a client id conflict is assumed."""
# Reason codes of MQTT 5, to which paho translates those of MQTT 3.
_UNSUPPORTED_VERSION, _BAD_CLIENT_ID, _TAKEN_OVER = 132, 133, 142
_NOT_ALLOWED = (134, 135)
_SAYS_NOTHING = ("Unspecified error", "Normal disconnection", "Success")

log = logging.getLogger("kontronik_can_gw")


@dataclass(frozen=True)
class Broker:
    """Where to connect and how. TLS files and the password file are read at each connection, since they may be renewed."""

    host: str
    port: int
    client_id: str
    tls: bool = False
    ca_file: Path | None = None
    cert_file: Path | None = None
    key_file: Path | None = None
    username: str | None = None
    password_file: Path | None = None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"MQTT broker {host}:{self.port}"


class Offer(NamedTuple):
    """A message to publish."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class _Refused(Exception):
    """The broker or its TLS refuses the connection. The text includes the remedy."""


class _NoAnswer(_Refused):
    """The broker closed the connection instead of answering, as old brokers do with an unknown protocol version."""


class _KnowsOnlyMqtt3(Exception):
    """The broker does not support MQTT 5; the next attempt uses 3.1.1."""


def check(broker: Broker) -> list[str]:
    """Check the library and the files, without connecting. Returns warnings; RunError where it cannot work."""
    try:
        import paho.mqtt.client as paho
    except ImportError:
        paho = None  # type: ignore[assignment]
    if paho is None or not hasattr(paho, "CallbackAPIVersion"):
        raise RunError("needs paho-mqtt 2: pip install 'kontronik-can-gw[mqtt]'")
    warnings = []
    try:
        if broker.tls:
            tls_context(broker)
        if broker.password_file is not None:
            password(broker.password_file)
            if broker.password_file.stat().st_mode & stat.S_IROTH:
                warnings.append(
                    f"{broker.password_file}: can be read by everybody on this machine. Run: chmod o= {broker.password_file}"
                )
    except _Refused as error:
        raise RunError(str(error)) from None
    if broker.password_file is not None and not broker.tls and not _is_loopback(broker.host):
        warnings.append(
            f"{broker}: without TLS the password can be read by all on the way. Use --tls."
        )
    return warnings


def password(file: Path) -> str:
    """The password in the first line of a file."""
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise _Refused(f"{file}: the password cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise _Refused(f"{file}: the password is not text in UTF-8") from None
    line = text.partition("\n")[0].rstrip("\r")
    if not line:
        raise _Refused(f"{file}: has no password on its first line")
    return line


def tls_context(broker: Broker) -> ssl.SSLContext:
    """TLS 1.2 or newer, with the broker's certificate and name checked."""
    for what, file in (
        ("ca_file", broker.ca_file),
        ("cert_file", broker.cert_file),
        ("key_file", broker.key_file),
    ):
        if file is not None and not os.access(file, os.R_OK):
            raise _Refused(f"{file}: mqtt.{what} cannot be read")
    try:
        context = ssl.create_default_context(
            cafile=None if broker.ca_file is None else str(broker.ca_file)
        )
    except (ssl.SSLError, OSError):
        raise _Refused(f"{broker.ca_file}: is not a certificate in PEM form") from None
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    if broker.cert_file is not None:
        try:
            # a key with a passphrase would ask for it on the terminal
            context.load_cert_chain(broker.cert_file, broker.key_file, password=lambda: b"")
        except (ssl.SSLError, OSError):
            both = f"{broker.cert_file}{'' if broker.key_file is None else f', {broker.key_file}'}"
            raise _Refused(
                f"{both}: not a certificate in PEM form with its key (without passphrase)"
            ) from None
    return context


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")


class _Link:
    """One connection, used by one thread. An error that paho raises for malformed packets ends the connection."""

    def __init__(self, broker: Broker, version: int, will_topic: str | None) -> None:
        import paho.mqtt.client as paho
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

        self.end: Any = None
        """Reason code of the end of the connection."""
        self.unacknowledged: set[int] = set()
        self.received: deque[tuple[str, bytes]] = deque()
        """Topic and payload of received retained messages."""
        self._broker = broker
        self._answer: Any = None
        protocol = MQTTProtocolVersion.MQTTv5 if version == 5 else MQTTProtocolVersion.MQTTv311
        self._client = client = paho.Client(
            CallbackAPIVersion.VERSION2,
            broker.client_id,
            protocol=protocol,
            reconnect_on_failure=False,
        )
        client.connect_timeout = CONNECT_S
        client.on_connect = self._connected
        client.on_disconnect = self._disconnected
        client.on_publish = lambda _client, _data, mid, _reason, _properties: (
            self.unacknowledged.discard(mid)
        )
        client.on_subscribe = lambda _client, _data, mid, _reasons, _properties: (
            self.unacknowledged.discard(mid)
        )
        client.on_message = self._message
        client.on_socket_open = lambda _client, _data, sock: _limit_buffer(sock)
        if will_topic is not None:
            client.will_set(will_topic, b"offline", qos=1, retain=True)

    def open(self, stopping: threading.Event, wake: socket.socket | None = None) -> bool:
        """Connect. False if the process ends meanwhile; raises _Refused, _KnowsOnlyMqtt3, OSError or ValueError on failure."""
        broker, client = self._broker, self._client
        if broker.username is not None:
            client.username_pw_set(
                broker.username,
                None if broker.password_file is None else password(broker.password_file),
            )
        if broker.tls:
            client.tls_set_context(tls_context(broker))
        client.connect(broker.host, broker.port, KEEPALIVE_S)
        end = time.monotonic() + CONNECT_S
        while self._answer is None:
            if stopping.is_set():
                return False
            if not self.turn(0.1, wake):
                break
            if time.monotonic() > end:
                raise _Refused("does not answer. Is this the port of an MQTT broker?")
        if self._answer is None:
            raise _NoAnswer("closed the connection instead of answering. Does it want TLS (--tls)?")
        if self._answer.is_failure:
            raise self._refusal(str(self._answer).lower(), self._answer.value)
        return True

    def turn(self, seconds: float, wake: socket.socket | None = None) -> bool:
        """Wait at most ``seconds`` for the broker, ``wake`` or room to send; do what is due. False if the connection has ended."""
        client = self._client
        sock = client.socket()
        if sock is None or self.end is not None:
            return False
        pending = isinstance(sock, ssl.SSLSocket) and sock.pending() > 0
        readers = [sock] if wake is None else [sock, wake]
        try:
            readable, writable, _ = select.select(
                readers, [sock] if client.want_write() else [], [], 0 if pending else seconds
            )
            if wake in readable and wake is not None:
                with contextlib.suppress(OSError):
                    wake.recv(4096)
            if sock in readable or pending:
                client.loop_read()
            if sock in writable:
                client.loop_write()
            client.loop_misc()
        except Exception as error:
            log.debug("%s: %r", self._broker, error)
            return False
        return client.socket() is not None and self.end is None

    @property
    def has_room(self) -> bool:
        """True if a message would be sent at once, without waiting for others."""
        return (
            self._client.socket() is not None
            and not self._client.want_write()
            and len(self.unacknowledged) < _MAX_UNACKNOWLEDGED
        )

    @property
    def is_stuck(self) -> bool:
        """True while the connection accepts no data."""
        return self._client.want_write()

    def publish(self, offer: Offer) -> None:
        """Hand a message to the connection."""
        info = self._client.publish(offer.topic, offer.payload, offer.qos, offer.retain)
        if offer.qos:
            # ``info`` is not asked: it raises if the connection was lost meanwhile
            self.unacknowledged.add(info.mid)

    def subscribe(self, topic: str) -> None:
        """Subscribe to a topic, to get its retained messages."""
        _, mid = self._client.subscribe(topic, 1)
        if mid is not None:
            self.unacknowledged.add(mid)

    def part(self) -> None:
        """Send DISCONNECT, so that the broker publishes no last will."""
        self._client.disconnect()
        while self._client.want_write() and self.turn(0.05):
            pass

    def close(self) -> None:
        """Close the connection without DISCONNECT."""
        if (sock := self._client.socket()) is not None:
            with contextlib.suppress(OSError):
                sock.close()

    def _connected(
        self, _client: object, _data: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        self._answer = reason

    def _disconnected(
        self, _client: object, _data: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        self.end = reason

    def _message(self, _client: object, _data: object, message: Any) -> None:
        if message.retain:
            self.received.append((message.topic, message.payload))

    def _refusal(self, text: str, number: int) -> Exception:
        broker = self._broker
        if number == _UNSUPPORTED_VERSION:
            return _KnowsOnlyMqtt3()
        if number in _NOT_ALLOWED:
            who = f"user {broker.username!r}" if broker.username else "us without a user name"
            what = "user name and password" if broker.username else "--username, --password-file"
            return _Refused(f"refuses {who}: {text}. Check {what}.")
        if number == _BAD_CLIENT_ID:
            return _Refused(
                f"refuses the client id {broker.client_id!r}. Choose another name with --gateway."
            )
        return _Refused(f"refuses the connection: {text}")


class MqttClient:
    """Keeps one connection to a broker until ``stop``. ``online_topic`` holds its state: "online", "offline" (retained)."""

    def __init__(self, broker: Broker, online_topic: str) -> None:
        self.broker = broker
        self.connected = False
        self.published = 0
        self.replaced = 0
        """Number of messages that were replaced by a newer one of the same topic before they were sent."""
        self.failure: BaseException | None = None
        """The unexpected error that ended the thread."""
        self._online_topic = online_topic
        self._conditions = FaultLog()
        self._lock = threading.Lock()
        self._waiting: OrderedDict[str, Offer] = OrderedDict()
        self._lasting: OrderedDict[str, Offer] = OrderedDict()
        self._retry = Retry(LONGEST_PAUSE_NS)
        self._stopping = threading.Event()
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._version, self._knows_only_3 = 5, False
        self._short = 0
        self._greeted = False
        self._thread = threading.Thread(target=self._work, name="mqtt", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def offer(
        self, topic: str, payload: bytes, *, lasting: bool = False, retain: bool = False
    ) -> None:
        """Queue a message; a pending one of the same topic is replaced. ``lasting``: publish it again after each reconnection."""
        offer = Offer(topic, payload, 1 if lasting else 0, retain)
        with self._lock:
            if lasting:
                self._lasting[topic] = offer
            if self._waiting.pop(topic, None) is not None:
                self.replaced += 1
            self._waiting[topic] = offer
        with contextlib.suppress(OSError):  # full: it is awake already
            self._wake_in.send(b"x")

    @property
    def alive(self) -> bool:
        """False once the thread has ended."""
        return self._thread.is_alive()

    @property
    def problem(self) -> str:
        """One line on the fault of the connection; empty while it is up."""
        return self._conditions.reason("broker")

    @property
    def waiting(self) -> int:
        """Number of pending messages."""
        return len(self._waiting)

    def stop(self, seconds: float) -> None:
        """Publish "offline" and end the connection, within ``seconds``."""
        self._stopping.set()
        with contextlib.suppress(OSError):
            self._wake_in.send(b"x")
        if self._thread.ident is not None:
            self._thread.join(seconds)

    # --- the thread

    def _work(self) -> None:
        try:
            while not self._stopping.is_set():
                self._connection()
                self._pause()
        except BaseException as error:  # the main thread reports it
            self.failure = error

    def _pause(self) -> None:
        while not self._stopping.is_set():
            now = time.monotonic_ns()
            self._conditions.advance(now)
            if self._retry.due is None or now >= self._retry.due:
                return
            self._stopping.wait(min((self._retry.due - now) / SECOND, 1))

    def _connection(self) -> None:
        """Open and serve one connection until its end."""
        # a new object, so that nothing of the previous connection is sent again
        link = _Link(self.broker, self._version, self._online_topic)
        try:
            if not link.open(self._stopping, self._wake_out):
                return
            began = time.monotonic_ns()
            self._after_connect()
            self._run(link)
            if self._stopping.is_set():
                self._part(link)
            else:
                self._ended(link.end, time.monotonic_ns() - began)
        except _KnowsOnlyMqtt3:
            if self._knows_only_3:
                self._failed("refuses the connection: it knows neither MQTT 5 nor MQTT 3.1.1")
            self._version, self._knows_only_3 = 3, True
        except (_Refused, OSError, ValueError) as error:
            self._failed(_reason(error))
            if isinstance(error, _NoAnswer) and not self._knows_only_3:
                self._version = 3 if self._version == 5 else 5
        finally:
            self.connected = False
            link.close()

    def _after_connect(self) -> None:
        """Queue all lasting messages before the pending ones."""
        now = time.monotonic_ns()
        self.connected = True
        if self._greeted:
            self._conditions.end("broker", f"{self.broker}: connected", now)
        else:
            self._conditions.forget("broker")
            self._conditions.say(
                logging.INFO, f"{self.broker}: connected as {self.broker.client_id}"
            )
        self._greeted = True
        with self._lock:
            first = OrderedDict({self._online_topic: Offer(self._online_topic, b"online", 1, True)})
            first.update(self._lasting)
            first.update(self._waiting)
            self._waiting = first

    def _run(self, link: _Link) -> None:
        """Publish until the connection or the process ends."""
        began = time.monotonic_ns()
        stuck: int | None = None
        while not self._stopping.is_set():
            while link.has_room and (offer := self._next()) is not None:
                link.publish(offer)
                self.published += 1
            if not link.turn(0.5, self._wake_out):
                return
            now = time.monotonic_ns()
            if now - began > _SHORT_NS:
                self._retry.succeeded()
                self._short = 0
            stuck = (stuck or now) if link.is_stuck else None
            if stuck is None:
                self._conditions.end("slow broker", f"{self.broker}: takes messages again", now)
            elif now - stuck > SLOW_NS:
                text = f"{self.broker}: takes messages too slowly: only the newest are sent"
                self._conditions.begin("slow broker", text, now, since=stuck)
            self._conditions.advance(now)

    def _next(self) -> Offer | None:
        with self._lock:
            return self._waiting.popitem(last=False)[1] if self._waiting else None

    def _part(self, link: _Link) -> None:
        """Publish "offline" and disconnect; ``stop`` limits the time."""
        link.unacknowledged.clear()
        link.publish(Offer(self._online_topic, b"offline", 1, True))
        while link.unacknowledged and link.turn(0.05):
            pass
        link.part()

    # --- lost and failed connections

    def _ended(self, end: Any, lasted: int) -> None:
        """Handle a connection that the broker or the network ended."""
        if not self._knows_only_3:
            self._version = 5
        if end is not None and end.value == _TAKEN_OVER:
            self._taken_over(f"another program took over the client id {self.broker.client_id!r}")
            return
        self._short = self._short + 1 if lasted < _SHORT_NS else 0
        if self._short >= _MAX_SHORT:
            who = f"maybe another program uses the client id {self.broker.client_id!r}"
            self._taken_over(f"ends each connection at once: {who}")
            return
        known = "" if end is None or str(end) in _SAYS_NOTHING else f": {str(end).lower()}"
        self._failed(f"the connection was lost{known}")

    def _taken_over(self, what: str) -> None:
        self._failed(f"{what}. Give each gateway a name of its own (--gateway).")
        self._retry.due = time.monotonic_ns() + random.randrange(
            TAKEN_OVER_PAUSE_NS // 2, TAKEN_OVER_PAUSE_NS
        )

    def _failed(self, reason: str) -> None:
        now = time.monotonic_ns()
        pause = self._retry.failed(now) - now
        # random, so that the gateways of a fleet do not reconnect at the same time
        self._retry.due = now + random.randrange(pause * 3 // 4, pause * 5 // 4)
        if not self._stopping.is_set():
            self._conditions.begin("broker", f"{self.broker}: {reason}", now)


def remove(
    broker: Broker, filters: Iterable[str], wanted: Callable[[str, bytes], bool]
) -> list[str]:
    """Clear the retained messages that match ``filters`` and are ``wanted``; return their topics. RunError on failure."""
    link = _Link(broker, 5, None)
    try:
        try:
            link.open(threading.Event())
        except _KnowsOnlyMqtt3:
            link = _Link(broker, 3, None)
            link.open(threading.Event())
        for topic in filters:
            link.subscribe(topic)
        _settle(link)
        found = sorted(
            topic for topic, payload in set(link.received) if payload and wanted(topic, payload)
        )
        for topic in found:
            while not link.has_room and link.turn(0.05):
                pass
            link.publish(Offer(topic, b"", 1, True))
        _settle(link, 0)
        link.part()
    except (_Refused, OSError, ValueError) as error:
        raise RunError(f"{broker}: {_reason(error)}") from None
    finally:
        link.close()
    return found


def _settle(link: _Link, silence_s: float = 0.5) -> None:
    """Wait until everything is acknowledged and no message has come for a while."""
    end = time.monotonic() + 2 * CONNECT_S
    quiet, known = time.monotonic(), len(link.received)
    while link.unacknowledged or time.monotonic() - quiet < silence_s:
        if not link.turn(0.05) or time.monotonic() > end:
            raise _Refused("the connection was lost" if link.end is not None else "does not answer")
        if link.unacknowledged or len(link.received) != known:
            quiet, known = time.monotonic(), len(link.received)


def _reason(error: Exception) -> str:
    """Why connecting failed, with the remedy."""
    if isinstance(error, _Refused):
        return str(error)
    if isinstance(error, ssl.SSLCertVerificationError):
        what = (error.verify_message or "it cannot be checked").rstrip(".")
        return f"its certificate is not accepted: {what}. Check --ca-file, and that --broker is the name in the certificate."
    if isinstance(error, ssl.SSLError):
        return f"TLS failed: {(error.reason or str(error)).lower().replace('_', ' ')}. Is this the port for TLS?"
    if isinstance(error, socket.gaierror):
        return "the host's name is not known. Check --broker and the network."
    if isinstance(error, TimeoutError):
        return "does not answer. Check --broker, the network and firewalls."
    if isinstance(error, ConnectionRefusedError):
        return "connection refused. Does it run, and is the port right?"
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return text[:1].lower() + text[1:]


def _limit_buffer(sock: Any) -> None:
    """Keep the kernel's buffer small, since data in it cannot be replaced by newer, and send without delay."""
    with contextlib.suppress(OSError, AttributeError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
