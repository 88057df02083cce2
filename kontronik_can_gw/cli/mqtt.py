"""``mqtt``: publishes the values in the gateway's frames to an MQTT broker. It listens to the bus and sends nothing on it."""

import argparse
import logging
import re
import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.cli.arguments import LAYOUT, option
from kontronik_can_gw.cli.bus_layout import bus_layout, given_layout
from kontronik_can_gw.cli.common import logging_to_stderr, stopping_on_signals
from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.config.parse import mqtt_with
from kontronik_can_gw.desk.mqtt.messages import Publisher, Topics
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.sources import Bus, Recording, Source, can_config
from kontronik_can_gw.errors import RunError, UserError
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
"""Time between two turns: delay of what is due, and of a signal."""
_FILES = ("ca_file", "cert_file", "key_file", "password_file")
_KEYS = ("broker", "tls", *_FILES, "username", "gateway", "topic", "rate", "retain", "discovery")
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
           nargs="?", const="homeassistant"),
)
# fmt: on
EPILOG = (
    "The password is never given on the command line, where everybody could read it. A broker that is missing, lost or refuses "
    "the connection is reported once, and tried again for ever. SIGTERM and SIGINT publish 'offline' and end it within half a second. "
    "link_state is the last one on the bus, where it has its own message: after a gap it may still be Lost for up to that message's "
    "cycle while available is already true."
)


def main(args: argparse.Namespace) -> int:
    try:
        from kontronik_can_gw.desk.mqtt.client import MqttClient
    except ImportError:
        raise RunError("needs paho-mqtt 2: pip install 'kontronik-can-gw[mqtt]'") from None
    if args.file is None and args.discovery is not None and Path(args.discovery).is_file():
        raise UserError(f"--discovery {args.discovery}: is a file. Give FILE before the options.")
    if args.file is not None and (args.interface or args.channel):
        raise UserError("--interface, --channel: are for the bus, not for a recording")
    with logging_to_stderr(), closing(Locks()) as locks:
        bus = bus_layout(args) if args.file is None else given_layout(args)
        settings = _settings(args, bus)
        topics = Topics(settings.topic, settings.gateway or host_name())
        try:
            client = MqttClient(settings, f"kontronik-can-gw-{topics.gateway}", topics.of("online"))
        except OSError as error:
            raise RunError(str(error)) from None
        if locks.hold([f"{settings.address}/mqtt/{topics.gateway}"]):
            raise RunError(
                f"another process on this machine publishes as {topics.gateway} to {client}. End it, or give another --gateway."
            )
        with _source_of(args, bus) as source:
            publisher = Publisher(source.bus, topics, settings, is_replay=source.is_file)
            log.info("publishing %s below %s/", ", ".join(publisher.escs) or "no ESC", topics.of())
            _publish(source, publisher, client)
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


@contextmanager
def _source_of(args: argparse.Namespace, bus: BusLayout | None) -> Iterator[Source]:
    """The bus, or the recording."""
    if args.file is None:
        assert bus is not None
        can = can_config(bus, args.interface, args.channel)
        with Bus(bus, can, patient=Notifier().present) as live:
            yield live
        return
    with open_input(args.file, bus) as recorded:
        recording = Recording(recorded, 1.0)
        if recording.ended:
            raise RunError(f"{recorded.name}: has no frames of the gateway")
        yield recording
        for line in recorded.damage:
            log.warning("%s: %s", recorded.name, line)


def _publish(source: Source, publisher: Publisher, client: "MqttClient") -> None:
    """Publish from the source to the broker, until a signal or the end of the source."""
    stop, notifier, faults = Event(), Notifier(), FaultLog()
    with stopping_on_signals(stop.set):
        client.start()
        notifier.ready("started")
        try:
            while not source.ended and not stop.is_set():
                due = time.monotonic() + _TURN_S
                while not source.ended and time.monotonic() < due:
                    source.pump(publisher.take, due)
                now, wall = time.monotonic_ns(), source.wall_ns()
                for message in publisher.messages(source.now(), wall or time.time_ns()):
                    client.offer(message)
                client.turn(now)
                if source.problem:
                    faults.begin("CAN", source.problem, now)
                else:
                    faults.end("CAN", "the CAN interface works", now)
                faults.advance(now)
                notifier.watchdog()
                state = "connected" if client.problem == "" else client.problem or "connecting"
                notifier.status(f"{state}; CAN: {source.problem or 'ok'}")
            end = time.monotonic() + _LAST_S
            while client.waiting and not stop.is_set() and time.monotonic() < end:
                client.turn(time.monotonic_ns())
                time.sleep(_TURN_S)
            if client.waiting and not stop.is_set():
                why = client.problem or "not fast enough"
                raise RunError(f"the end of the recording was not published: {client}: {why}")
        finally:
            notifier.stopping("ending")
            client.stop(_STOP_S)
