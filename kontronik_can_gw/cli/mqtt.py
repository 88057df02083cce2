"""``mqtt``: publishes the values in the gateway's frames to an MQTT broker. It listens to the bus and sends nothing on it."""

import argparse
import logging
import re
import socket
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

from kontronik_can_gw.cli.bus_layout import add_layout_arguments, bus_layout
from kontronik_can_gw.cli.common import logging_to_stderr, say, stopping_on_signals
from kontronik_can_gw.config.keys import CanConfig, MqttConfig
from kontronik_can_gw.config.parse import mqtt_with
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import MS, SECOND

if TYPE_CHECKING:
    from kontronik_can_gw.desk.mqtt.client import Broker
    from kontronik_can_gw.desk.mqtt.messages import Message, Topics
    from kontronik_can_gw.desk.recordings.inputs import Input
    from kontronik_can_gw.desk.recordings.layouts import BusLayout
    from kontronik_can_gw.frames import CanFrame
    from kontronik_can_gw.runtime.systemd import Notifier

log = logging.getLogger("kontronik_can_gw")

_TURN_S = 0.1
"""Maximum delay until a signal is noticed."""
_STOP_S = 0.3
_LAST_S = 2.0
"""Time at the end of a recording to send pending messages."""
_PAUSE_S = 5
"""Pause before the end of a service that cannot start."""
_FILES = ("ca_file", "cert_file", "key_file", "password_file")
_DEFAULT_DISCOVERY = "homeassistant"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        type=Path,
        nargs="?",
        metavar="FILE",
        help="publish a recording, in its own time, instead of the bus",
    )
    add_layout_arguments(parser)
    parser.add_argument(
        "--interface",
        metavar="NAME",
        help="python-can interface (default: can.interface, socketcan)",
    )
    parser.add_argument(
        "--channel", metavar="NAME", help="its channel (default: can.channel, can0)"
    )
    where = parser.add_argument_group("broker (defaults: table [mqtt] of the configuration)")
    where.add_argument(
        "--broker", metavar="HOST[:PORT]", help="the MQTT broker (port 1883, with TLS 8883)"
    )
    where.add_argument(
        "--tls",
        action="store_true",
        default=None,
        help="encrypt, and check the broker's certificate",
    )
    where.add_argument(
        "--ca-file", metavar="FILE", help="certificate of the authority that signed the broker's"
    )
    where.add_argument("--cert-file", metavar="FILE", help="certificate to show to the broker")
    where.add_argument("--key-file", metavar="FILE", help="key of that certificate")
    where.add_argument("--username", metavar="NAME", help="user name at the broker")
    where.add_argument(
        "--password-file", metavar="FILE", help="file with the password on its first line"
    )
    what = parser.add_argument_group("topics")
    what.add_argument(
        "--gateway",
        metavar="NAME",
        help="name of this gateway in the topics (default: the host name)",
    )
    what.add_argument(
        "--topic", metavar="PREFIX", help="what all topics begin with (default kontronik)"
    )
    what.add_argument(
        "--rate",
        type=_number,
        metavar="HZ",
        help="states of each ESC in a second, 0.01 to 20 (default 1)",
    )
    what.add_argument(
        "--retain", action="store_true", default=None, help="let the broker keep the last states"
    )
    what.add_argument(
        "--discovery",
        nargs="?",
        const=_DEFAULT_DISCOVERY,
        metavar="PREFIX",
        help="announce each value to Home Assistant (prefix, default homeassistant)",
    )
    what.add_argument(
        "--remove-discovery",
        action="store_true",
        help="clear the broker's retained discovery of this gateway and end; if the gateway is offline, its own topics too",
    )
    parser.epilog = (
        "The password is never given on the command line, where everybody could read it. A broker that is missing, lost or refuses "
        "the connection is reported once, and tried again for ever. SIGTERM and SIGINT publish 'offline' and end it within half a second. "
        "link_state is the last one on the bus, where it has its own message: after a gap it may still be Lost for up to that message's "
        "cycle while available is already true."
    )


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def main(args: argparse.Namespace) -> int:
    from kontronik_can_gw.runtime.systemd import Notifier

    notifier = Notifier()
    refused: UserError | None = None
    with logging_to_stderr():
        try:
            return _main(args, notifier)
        except UserError as error:
            if not notifier.present:
                raise
            refused = error
            for problem in error.problems:
                log.error("%s", problem)
    # the service manager restarts it: not ten times a second for a mistake that a user has to correct
    notifier.status(f"cannot start: {refused.problems[0]}")
    time.sleep(_PAUSE_S)
    return refused.exit_code


def _main(args: argparse.Namespace, notifier: "Notifier") -> int:
    from kontronik_can_gw.desk.mqtt.client import check
    from kontronik_can_gw.desk.mqtt.messages import Topics
    from kontronik_can_gw.runtime.locks import Locks

    if args.file is None and args.discovery is not None and Path(args.discovery).is_file():
        raise UserError(f"--discovery {args.discovery}: is a file. Give FILE before the options.")
    if args.file is not None and (args.interface or args.channel):
        raise UserError("--interface, --channel: are for the bus, not for a recording")
    given = (
        bus_layout(args.config, args.dbc) if args.file is None or args.config or args.dbc else None
    )
    settings = _settings(args, given)
    topics = Topics(settings.topic, settings.gateway or host_name())
    broker = _broker(settings, topics)
    for warning in check(broker):
        log.warning("%s", warning)
    if args.remove_discovery:
        return _remove(broker, topics, settings.discovery or _DEFAULT_DISCOVERY)
    locks = Locks()
    if locks.hold([f"{broker.host}:{broker.port}/mqtt/{topics.gateway}"]):
        raise RunError(
            f"another process on this machine publishes as {topics.gateway} to {broker}. End it, or give another --gateway."
        )
    try:
        with _source(args, given) as source:
            _Run(source, settings, topics, broker, notifier).run()
    finally:
        locks.close()
    return 0


def host_name() -> str:
    """The host name without its domain, made valid for a topic."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", socket.gethostname().partition(".")[0]).strip("-")
    return name[:64] or "gateway"


def _settings(args: argparse.Namespace, bus: "BusLayout | None") -> MqttConfig:
    """The [mqtt] table with absolute file names, overridden by the options. UserError with every mistake."""
    table = MqttConfig()
    if bus is not None and bus.config is not None:
        table = bus.config.mqtt
        folder = Path(bus.config.file).parent
        files: dict[str, Any] = {
            name: str(folder / value)
            for name in _FILES
            if (value := getattr(table, name)) is not None
        }
        table = replace(table, **files)
    given = {f.name: getattr(args, f.name) for f in fields(MqttConfig)}
    options = {name: value for name, value in given.items() if value is not None}
    settings = mqtt_with(table, options)
    if settings.broker is None:
        raise UserError(
            "no broker is given: --broker HOST, or broker in the table [mqtt] of the configuration"
        )
    return settings


def _broker(settings: MqttConfig, topics: "Topics") -> "Broker":
    from kontronik_can_gw.desk.mqtt.client import Broker

    assert settings.address is not None
    host, port = settings.address
    files = {
        name: None if (value := getattr(settings, name)) is None else Path(value) for name in _FILES
    }
    return Broker(
        host,
        port,
        f"kontronik-can-gw-{topics.gateway}",
        tls=settings.tls,
        username=settings.username,
        **files,
    )


def _remove(broker: "Broker", topics: "Topics", discovery: str) -> int:
    """Clear the retained discovery, and all other retained topics of a gateway that is not online."""
    from kontronik_can_gw.desk.mqtt.client import remove
    from kontronik_can_gw.desk.mqtt.messages import OFFLINE, is_ours

    kept: dict[str, bytes] = {}

    def wanted(topic: str, payload: bytes) -> bool:
        kept[topic] = payload
        return topic.startswith(f"{discovery}/") and is_ours(payload, topics)

    # its own client id, so that no other client is disconnected
    by_hand = replace(broker, client_id=f"{broker.client_id}-remove")
    removed = remove(by_hand, [f"{discovery}/device/+/config", f"{topics.base}/#"], wanted)
    if kept.get(topics.online) == OFFLINE:
        removed += remove(by_hand, [f"{topics.base}/#"], lambda _topic, _payload: True)
    elif topics.online in kept:
        say(f"{topics.gateway} is online: only its discovery was cleared")
    for topic in removed:
        say(f"{topic}: cleared")
    if not removed:
        say(f"{broker} keeps nothing of {topics.gateway}")
    return 0


class _Source(Protocol):
    """A source of frames."""

    is_replay: bool

    @property
    def problem(self) -> str:
        """One line on its fault, else empty."""

    @property
    def bus(self) -> "BusLayout": ...

    def begin(self, keys: frozenset[int], wait: bool) -> bool:
        """Open it; False: try again later."""

    def receive(self, seconds: float) -> "tuple[int, list[tuple[int, CanFrame]]] | None":
        """The present time, and frames with their times; waits at most ``seconds``. None at the end."""

    def wall_ns(self, now: int) -> int: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


def _source(args: argparse.Namespace, bus: "BusLayout | None") -> _Source:
    if args.file is not None:
        from kontronik_can_gw.desk.recordings.inputs import open_input

        return _Recording(open_input(args.file, bus))
    assert bus is not None
    can = bus.config.can if bus.config is not None else CanConfig()
    given = {
        name: getattr(args, name)
        for name in ("interface", "channel")
        if getattr(args, name) is not None
    }
    can = replace(can, **given)
    from kontronik_can_gw.runtime.open_can import check_interface

    check_interface(can)
    return _Bus(bus, can)


class _Bus:
    """Frames from the CAN bus."""

    is_replay = False

    def __init__(self, bus: "BusLayout", can: CanConfig) -> None:
        from kontronik_can_gw.runtime.bus_listener import BusListener

        self._bus = bus
        self._can = can
        self._listener: BusListener | None = None
        self._keys: frozenset[int] = frozenset()
        self._problem = ""
        self._look_ns = 0

    def begin(self, keys: frozenset[int], wait: bool) -> bool:
        from kontronik_can_gw.runtime.bus_listener import BusListener

        self._keys = keys
        try:
            self._listener = BusListener(self._can, keys)
        except RunError as error:
            if not wait:
                raise
            self._problem = error.problems[0]
            return False
        return True

    @property
    def bus(self) -> "BusLayout":
        return self._bus

    @property
    def problem(self) -> str:
        return self._problem if self._listener is None else self._listener.problem

    def receive(self, seconds: float) -> "tuple[int, list[tuple[int, CanFrame]]] | None":
        if self._listener is None:
            time.sleep(seconds)
            now = time.monotonic_ns()
            if now >= self._look_ns:
                self._look_ns = now + SECOND
                self.begin(self._keys, True)
            return now, []
        frames = self._listener.receive(seconds)
        now = time.monotonic_ns()
        return now, [(now, frame) for frame in frames]

    def wall_ns(self, now: int) -> int:
        del now
        return time.time_ns()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._listener is not None:
            self._listener.close()


class _Recording:
    """Frames from a recording in real time; ``now`` is on the recording's clock."""

    is_replay = True
    problem = ""

    def __init__(self, recorded: "Input") -> None:
        self._input = recorded
        self._frames: Iterator[tuple[int, CanFrame]] = (
            (entry.time_ns, entry.frame) for entry in recorded.frames()
        )
        self._next: tuple[int, CanFrame] | None = None
        self._ahead = 0
        """Offset of the recording's clock to ours."""

    @property
    def bus(self) -> "BusLayout":
        return self._input.bus

    def begin(self, keys: frozenset[int], wait: bool) -> bool:
        del keys, wait
        self._next = next(self._frames, None)
        if self._next is None:
            raise RunError(f"{self._input.name}: has no frames of the gateway")
        self._ahead = self._next[0] - time.monotonic_ns()
        return True

    def receive(self, seconds: float) -> "tuple[int, list[tuple[int, CanFrame]]] | None":
        if self._next is None:
            return None
        now = time.monotonic_ns() + self._ahead
        time.sleep(min(max(0, self._next[0] - now) / SECOND, seconds))
        now = time.monotonic_ns() + self._ahead
        frames = []
        while self._next is not None and self._next[0] <= now:
            frames.append(self._next)
            self._next = next(self._frames, None)
        return now, frames

    def wall_ns(self, now: int) -> int:
        wall = self._input.wall_ns(now)
        return time.time_ns() if wall is None else wall

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._input.close()
        for line in self._input.damage:
            log.warning("%s: %s", self._input.name, line)


class _Run:
    """Publishes from the source to the broker, until a signal or the end of the source."""

    def __init__(
        self,
        source: _Source,
        settings: MqttConfig,
        topics: "Topics",
        broker: "Broker",
        notifier: "Notifier",
    ) -> None:
        from kontronik_can_gw.desk.mqtt.client import MqttClient
        from kontronik_can_gw.desk.mqtt.messages import Publisher
        from kontronik_can_gw.runtime.fault_log import FaultLog

        self._source, self._notifier = source, notifier
        self._publisher: Publisher = Publisher(
            source.bus,
            topics,
            settings.rate,
            retain=settings.retain,
            discovery=settings.discovery,
            replay=source.is_replay,
        )
        self._client: MqttClient = MqttClient(broker, topics.online)
        self._conditions = FaultLog()
        self._topics = topics
        self._stopping = False
        self._status_ns = 0
        self._now: int | None = None

    def run(self) -> None:
        with stopping_on_signals(self._stop):
            self._source.begin(self._publisher.view.reader.keys, self._notifier.present)
            escs = ", ".join(self._publisher.escs) or "no ESC"
            log.info("publishing %s below %s/", escs, self._topics.base)
            self._client.start()
            self._notifier.ready("started")
            try:
                while not self._stopping and self._turn():
                    pass
                end = time.monotonic() + _LAST_S
                while self._client.waiting and not self._stopping and time.monotonic() < end:
                    time.sleep(0.01)
                if self._client.waiting and not self._stopping:
                    why = self._client.problem or f"{self._client.broker}: not fast enough"
                    raise RunError(f"the end of the recording was not published. {why}")
            finally:
                self._notifier.stopping("ending")
                self._client.stop(_STOP_S)

    def _stop(self) -> None:
        self._stopping = True

    def _turn(self) -> bool:
        """Receive frames, publish due messages. False at the end of the source."""
        publisher, source = self._publisher, self._source
        came = source.receive(self._wait_s())
        if came is None:
            return False
        now, frames = came
        for when, frame in frames:
            publisher.take(frame.key, frame.data, when)
        self._now = now
        for message in publisher.messages(now, source.wall_ns(now)):
            self._offer(message)
        self._supervise()
        return True

    def _wait_s(self) -> float:
        if self._now is None:
            return 0
        return min(max(0, self._publisher.due(self._now) - self._now) / SECOND, _TURN_S)

    def _offer(self, message: "Message") -> None:
        self._client.offer(
            message.topic, message.payload, lasting=message.lasting, retain=message.retain
        )

    def _supervise(self) -> None:
        """Report faults of the bus, feed the watchdog, and check that the client's thread is alive."""
        now = time.monotonic_ns()
        if problem := self._source.problem:
            self._conditions.begin("CAN", problem, now)
        else:
            self._conditions.end("CAN", "the CAN interface works", now)
        self._conditions.advance(now)
        if not self._client.alive:
            raise RunError(f"the connection's thread has ended: {self._client.failure!r}")
        self._notifier.watchdog()
        if now - self._status_ns > 500 * MS:
            self._status_ns = now
            state = "connected" if self._client.connected else self._client.problem or "connecting"
            self._notifier.status(f"{state}; CAN: {self._source.problem or 'ok'}")
