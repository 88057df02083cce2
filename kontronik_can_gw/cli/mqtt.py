"""``mqtt``: publishes the values in the gateway's frames to an MQTT broker. It listens to the bus and sends nothing on it."""

import argparse
import logging
import re
import socket
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.cli.arguments import LAYOUT, option
from kontronik_can_gw.cli.bus_layout import bus_layout, given_layout
from kontronik_can_gw.cli.common import logging_to_stderr, say, stopping_on_signals
from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.config.parse import mqtt_with
from kontronik_can_gw.desk.mqtt.broker import Broker, check
from kontronik_can_gw.desk.mqtt.discovery import is_ours
from kontronik_can_gw.desk.mqtt.messages import Publisher
from kontronik_can_gw.desk.mqtt.topics import OFFLINE, Topics
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.sources import Bus, Recording, Source, can_config
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import MS, SECOND
from kontronik_can_gw.runtime.fault_log import FaultLog
from kontronik_can_gw.runtime.locks import Locks
from kontronik_can_gw.runtime.systemd import Notifier

if TYPE_CHECKING:  # it needs paho-mqtt
    from kontronik_can_gw.desk.mqtt.client import MqttClient

log = logging.getLogger("kontronik_can_gw")

_STOP_S = 0.3
_LAST_S = 2.0
"""Time at the end of a recording to send pending messages."""
_TURN_S = 0.02
"""Maximum time between two turns: delay of what is due, and of a signal."""
_STATUS_NS = 500 * MS
_FILES = ("ca_file", "cert_file", "key_file", "password_file")
_KEYS = ("broker", "tls", *_FILES, "username", "gateway", "topic", "rate", "retain", "discovery")
_DEFAULT_DISCOVERY = "homeassistant"
# fmt: off
OPTIONS = (
    option("FILE", "publish a recording, in its own time, instead of the bus", type=Path, nargs="?"),
    LAYOUT,
    option("--interface NAME", "python-can interface (default: can.interface, socketcan)"),
    option("--channel NAME", "its channel (default: can.channel, can0)"),
    "broker (defaults: table [mqtt] of the configuration)",
    option("--broker HOST[:PORT]", "the MQTT broker (port 1883, with TLS 8883)"),
    option("--tls", "encrypt, and check the broker's certificate", default=None),
    option("--ca-file FILE", "certificate of the authority that signed the broker's"),
    option("--cert-file FILE", "certificate to show to the broker"),
    option("--key-file FILE", "key of that certificate"),
    option("--username NAME", "user name at the broker"),
    option("--password-file FILE", "file with the password on its first line"),
    "topics",
    option("--gateway NAME", "name of this gateway in the topics (default: the host name)"),
    option("--topic PREFIX", "what all topics begin with (default kontronik)"),
    option("--retain", "let the broker keep the last states", default=None),
    option("--rate HZ", "states of each ESC in a second, 0.01 to 20 (default 1)", type=float),
    option("--discovery PREFIX", "announce each value to Home Assistant (prefix, default homeassistant)",
           nargs="?", const=_DEFAULT_DISCOVERY),
    option("--remove-discovery", "clear the broker's retained discovery of this gateway and end; "
                                 "if the gateway is offline, its own topics too"),
)
# fmt: on
EPILOG = (
    "The password is never given on the command line, where everybody could read it. A broker that is missing, lost or refuses "
    "the connection is reported once, and tried again for ever. SIGTERM and SIGINT publish 'offline' and end it within half a second. "
    "link_state is the last one on the bus, where it has its own message: after a gap it may still be Lost for up to that message's "
    "cycle while available is already true."
)


def main(args: argparse.Namespace) -> int:
    with logging_to_stderr():
        return _main(args)


def _main(args: argparse.Namespace) -> int:
    if args.file is None and args.discovery is not None and Path(args.discovery).is_file():
        raise UserError(f"--discovery {args.discovery}: is a file. Give FILE before the options.")
    if args.file is not None and (args.interface or args.channel):
        raise UserError("--interface, --channel: are for the bus, not for a recording")
    bus = bus_layout(args) if args.file is None else given_layout(args)
    settings = _settings(args, bus)
    topics = Topics(settings.topic, settings.gateway or host_name())
    broker = Broker(settings, f"kontronik-can-gw-{topics.gateway}")
    for warning in check(broker):
        log.warning("%s", warning)
    if args.remove_discovery:
        return _remove(broker, topics, settings.discovery or _DEFAULT_DISCOVERY)
    with closing(Locks()) as locks:
        if locks.hold([f"{broker.place}/mqtt/{topics.gateway}"]):
            raise RunError(
                f"another process on this machine publishes as {topics.gateway} to {broker}. End it, or give another --gateway."
            )
        _publish(args, bus, broker, topics)
    return 0


def host_name() -> str:
    """The host name without its domain, made valid for a topic."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", socket.gethostname().partition(".")[0]).strip("-")
    return name[:64] or "gateway"


def _settings(args: argparse.Namespace, bus: BusLayout | None) -> MqttConfig:
    """The [mqtt] table with absolute file names, overridden by the options. UserError with every mistake."""
    table = MqttConfig()
    if bus is not None and bus.config is not None:
        table, folder = bus.config.mqtt, Path(bus.config.file).parent
        given = {name: getattr(table, name) for name in _FILES}
        files: dict[str, Any] = {n: str(folder / file) for n, file in given.items() if file}
        table = replace(table, **files)
    options = {name: getattr(args, name) for name in _KEYS}
    settings = mqtt_with(table, {n: value for n, value in options.items() if value is not None})
    if settings.broker is None:
        raise UserError(
            "no broker is given: --broker HOST, or broker in the table [mqtt] of the configuration"
        )
    return settings


def _remove(broker: Broker, topics: Topics, discovery: str) -> int:
    """Clear the retained discovery, and all other retained topics of a gateway that is not online."""
    from kontronik_can_gw.desk.mqtt.client import remove

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


def _publish(
    args: argparse.Namespace, bus: BusLayout | None, broker: Broker, topics: Topics
) -> None:
    """Publish the bus, or the recording, until a signal or its end."""
    from kontronik_can_gw.desk.mqtt.client import MqttClient

    def publisher(bus: BusLayout) -> Publisher:
        how, is_replay = broker.config, args.file is not None
        return Publisher(
            bus, topics, how.rate, retain=how.retain, discovery=how.discovery, replay=is_replay
        )

    notifier, client = Notifier(), MqttClient(broker, topics.online)
    if args.file is None:
        assert bus is not None
        can = can_config(bus, args.interface, args.channel)
        with Bus(bus, can, notifier.present) as live:
            _Run(live, publisher(bus), client, notifier).run()
        return
    with open_input(args.file, bus) as recorded:
        recording = Recording(recorded, 1.0)
        if recording.ended:
            raise RunError(f"{recorded.name}: has no frames of the gateway")
        _Run(recording, publisher(recorded.bus), client, notifier).run()
        for line in recorded.damage:
            log.warning("%s: %s", recorded.name, line)


class _Run:
    """Publishes from the source to the broker, until a signal or the end of the source."""

    def __init__(
        self, source: Source, publisher: Publisher, client: "MqttClient", notifier: Notifier
    ) -> None:
        self._source, self._publisher = source, publisher
        self._client, self._notifier = client, notifier
        self._conditions = FaultLog()
        self._stopping = Event()
        self._due_ns = self._status_ns = 0

    def run(self) -> None:
        with stopping_on_signals(self._stopping.set):
            names = ", ".join(self._publisher.escs) or "no ESC"
            log.info("publishing %s below %s/", names, self._publisher.topics.base)
            self._client.start()
            self._notifier.ready("started")
            try:
                while not self._source.ended:
                    if self._stopping.is_set():
                        return
                    self._source.pump(self._publisher.take, time.monotonic() + _TURN_S)
                    self._turn()
                self._finish()
            finally:
                self._notifier.stopping("ending")
                self._client.stop(_STOP_S)

    def _turn(self) -> None:
        """Publish due messages, report faults, feed the watchdog."""
        now, source = time.monotonic_ns(), self._source
        if now < self._due_ns:
            return
        self._due_ns = now + round(_TURN_S * SECOND)
        wall = source.wall_ns()
        messages = self._publisher.messages(source.now(), time.time_ns() if wall is None else wall)
        for message in messages:
            self._client.offer(message)
        self._client.turn(now)
        if source.problem:
            self._conditions.begin("CAN", source.problem, now)
        else:
            self._conditions.end("CAN", "the CAN interface works", now)
        self._conditions.advance(now)
        self._notifier.watchdog()
        if now - self._status_ns > _STATUS_NS:
            self._status_ns = now
            state = "connected" if self._client.connected else self._client.problem or "connecting"
            self._notifier.status(f"{state}; CAN: {source.problem or 'ok'}")

    def _finish(self) -> None:
        """Send what is pending at the end of a recording. RunError if the broker does not take it."""
        end = time.monotonic() + _LAST_S
        while self._client.waiting and not self._stopping.is_set() and time.monotonic() < end:
            self._client.turn(time.monotonic_ns())
            time.sleep(0.01)
        if self._client.waiting and not self._stopping.is_set():
            why = self._client.problem or f"{self._client.broker}: not fast enough"
            raise RunError(f"the end of the recording was not published. {why}")
