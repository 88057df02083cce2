"""``mqtt``: publishes the values in the gateway's frames to an MQTT broker.

It listens to the bus and sends nothing on it.
"""

import argparse
import logging
import re
import socket
import time
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.cli.arguments import LAYOUT, option
from kontronik_can_gw.cli.common import (
    logging_to_stderr,
    stopping_on_signals,
)
from kontronik_can_gw.cli.desk import bus_layout
from kontronik_can_gw.config.keys import Config, MqttConfig
from kontronik_can_gw.config.kinds import BROKER
from kontronik_can_gw.desk.libraries import missing_library
from kontronik_can_gw.desk.mqtt.messages import Publisher
from kontronik_can_gw.desk.mqtt.published import Topics
from kontronik_can_gw.desk.sources import Bus, can_config
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.runtime.system.sd_notify import Notifier

if TYPE_CHECKING:  # it needs paho-mqtt
    from kontronik_can_gw.desk.mqtt.client import MqttClient

log = logging.getLogger("kontronik_can_gw")

_STOP_S = 0.3
_TURN_S = 0.02
"""Time between two turns. Messages and signals are delayed by at most this time."""
_FILES = {
    "ca_file": "tls",
    "cert_file": "tls",
    "key_file": "cert_file",
    "password_file": "username",
}
"""Keys of [mqtt] that are files, and the key that each of them needs."""
OPTIONS = (
    option("FILE", argparse.SUPPRESS, nargs="?"),
    LAYOUT,
    option("--interface NAME", "python-can interface (default: can.interface, socketcan)"),
    option("--channel NAME", "channel of the interface (default: can.channel, can0)"),
    option(
        "--broker HOST[:PORT]",
        "the MQTT broker (default: mqtt.broker; port 1883, with mqtt.tls 8883)",
    ),
)
EPILOG = (
    "Set topics, rate, TLS, user and Home Assistant's discovery in the table [mqtt] of the "
    "configuration (-c, or gateway.toml). "
    "If the broker is missing, lost or refuses the connection, this is reported once, and mqtt "
    "retries until it is connected. "
    "SIGTERM and SIGINT publish 'offline' and end mqtt. It waits for the broker for at most 0.3 s. "
    "If link_state has its own message on the bus, it "
    "can still be Lost for up to one cycle of that message after a gap, while available is "
    "already true."
)


def main(args: argparse.Namespace) -> int:
    try:
        from kontronik_can_gw.desk.mqtt.client import MqttClient
    except ImportError:
        raise missing_library("MQTT", "mqtt") from None
    if args.file is not None:
        raise UserError(
            f"{args.file}: recordings are no longer published. "
            f"Type kontronik-can-gw replay {args.file} --on can --channel vcan0 "
            f"(for a CAN log: canplayer -I {args.file} vcan0=can0), and at the same time "
            "kontronik-can-gw mqtt --channel vcan0 --broker HOST."
        )
    with logging_to_stderr():
        bus = bus_layout(args)
        settings = _settings(args.broker, bus.config)
        topics = Topics(settings.topic, settings.gateway or host_name())
        try:
            client = MqttClient(settings, f"kontronik-can-gw-{topics.gateway}", topics.of("online"))
        except OSError as error:  # a file of [mqtt]
            raise UserError(str(error)) from None
        can = can_config(bus, args.interface, args.channel)
        with Bus(bus, can, patient=Notifier().is_present) as source:
            publisher = Publisher(bus, topics, settings)
            log.info("publishing %s below %s/", ", ".join(publisher.escs) or "no ESC", topics.of())
            _publish(source, publisher, client)
    return 0


def host_name() -> str:
    """Return the host name without its domain, changed so that it is valid in a topic."""
    name = socket.gethostname().partition(".")[0]
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")
    return name[:64] or "gateway"


def _settings(broker: str | None, config: Config | None) -> MqttConfig:
    """Return the table [mqtt] with absolute file names. Raises UserError with all its mistakes."""
    table = MqttConfig() if config is None else config.mqtt
    if broker is not None:
        try:
            table = replace(table, broker=BROKER.check(broker))
        except ValueError as error:
            raise UserError(f"--broker: {error}") from None
    if table.broker is None:
        raise UserError("no broker. Give --broker HOST, or mqtt.broker in the configuration.")
    folder = Path("" if config is None else config.file).parent
    problems = []
    files: dict[str, Any] = {}
    for name, needed in _FILES.items():
        file = getattr(table, name)
        if not file:
            continue
        files[name] = str(folder / file)
        if not getattr(table, needed):
            problems.append(f"mqtt.{name}: has no effect without mqtt.{needed}")
    if problems:
        raise UserError(*problems)
    return replace(table, **files)


def _publish(source: Bus, publisher: Publisher, client: "MqttClient") -> None:
    """Publish from the bus to the broker until a signal."""
    stop = Event()
    notifier = Notifier()
    faults = FaultLog()
    with stopping_on_signals(stop.set):
        client.start()
        notifier.ready("started")
        try:
            while not stop.is_set():
                due = time.monotonic() + _TURN_S
                while time.monotonic() < due:
                    source.pump(publisher.take, due)
                now = time.monotonic_ns()
                for message in publisher.messages(now, time.time_ns()):
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
        finally:
            notifier.stopping("ending")
            client.stop(_STOP_S)
