"""A real mosquitto on loopback, clients that are not ours, the program as a process, and what a bus carries while ESCs fly."""

import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from kontronik_can_gw.config import parse
from kontronik_can_gw.dbc_output.layout import load_database
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.layouts import BusLayout
from kontronik_can_gw.simulator import EscOptions, SimulatedEsc

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/sbin")
SECOND_NS = 1_000_000_000
STEP_NS = 10_000_000
START_S = 1_790_000_000
PROGRAM = [sys.executable, "-m", "kontronik_can_gw", "mqtt"]


def need_mosquitto() -> str:
    """The broker's program; without it the test is skipped, in CI it fails."""
    if MOSQUITTO is not None and shutil.which("mosquitto_sub"):
        return MOSQUITTO
    reason = "mosquitto is missing: sudo apt-get install mosquitto mosquitto-clients"
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def wait_for(condition: Callable[[], object], seconds: float, what: object) -> float:
    """Wait until something holds; the seconds it took."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            said = what() if callable(what) else what
            raise AssertionError(f"not within {seconds} s: {said}")
        time.sleep(0.005)
    return time.monotonic() - begin


class Mosquitto:
    """A broker with a configuration of its own, that can be stopped and started again on the same port."""

    def __init__(self, folder: Path, lines: str = "allow_anonymous true\n", port: int | None = None) -> None:
        self._program = need_mosquitto()
        self.port = port or free_port()
        self._file = folder / f"mosquitto{self.port}.conf"
        self._file.write_text(f"listener {self.port} 127.0.0.1\n{lines}persistence false\nuser {_user()}\n")
        self._log = folder / f"mosquitto{self.port}.log"
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen([self._program, "-v", "-c", str(self._file)], stdout=log, stderr=log)
        wait_for(self._listens, 10, self._log.read_text)

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
            self._process.wait(10)
            self._process = None


def _user() -> str:
    import pwd

    return pwd.getpwuid(os.geteuid()).pw_name


class Heard(NamedTuple):
    """A message as a subscriber got it."""

    when: float
    topic: str
    payload: bytes
    retained: bool

    @property
    def json(self) -> dict[str, Any]:
        made = json.loads(self.payload)
        assert isinstance(made, dict)
        return made


class Subscriber:
    """paho, as somebody else uses it."""

    def __init__(self, port: int, topic: str = "#") -> None:
        self.heard: list[Heard] = []
        self._client = paho.Client(CallbackAPIVersion.VERSION2)
        self._subscribed = threading.Event()
        self._client.on_connect = lambda client, *_: client.subscribe(topic, 1)
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.on_message = self._take
        self._client.reconnect_delay_set(1, 1)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        assert self._subscribed.wait(10)

    def _take(self, _client: object, _data: object, message: paho.MQTTMessage) -> None:
        self.heard.append(Heard(time.monotonic(), message.topic, bytes(message.payload), message.retain))

    def of(self, topic: str) -> list[Heard]:
        return [heard for heard in list(self.heard) if heard.topic == topic]

    def wait(self, topic: str, payload: bytes | None = None, seconds: float = 10, count: int = 1) -> Heard:
        """Wait for so many messages of a topic (with this payload)."""

        def found() -> list[Heard]:
            return [heard for heard in self.of(topic) if payload is None or heard.payload == payload]

        wait_for(lambda: len(found()) >= count, seconds, lambda: f"{topic} {payload!r} in {self.heard}")
        return found()[count - 1]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()


def kept(port: int, topic: str = "#") -> dict[str, bytes]:
    """What the broker keeps: what comes before a message of our own that is sent once the subscription is acknowledged."""
    mark = f"mark/{time.monotonic_ns()}"
    found: dict[str, bytes] = {}
    done = threading.Event()

    def take(_client: object, _data: object, message: paho.MQTTMessage) -> None:
        if message.topic == mark:
            done.set()
        elif message.retain:
            found[message.topic] = bytes(message.payload)

    def ask(*_: object) -> None:
        client.subscribe([(topic, 1), (mark, 1)])

    def end(*_: object) -> None:
        client.publish(mark, b"x", 1)

    client = paho.Client(CallbackAPIVersion.VERSION2)
    client.on_connect, client.on_subscribe, client.on_message = ask, end, take
    client.connect("127.0.0.1", port)
    client.loop_start()
    try:
        assert done.wait(10)
        return found
    finally:
        client.disconnect()
        client.loop_stop()


def kept_by_mosquitto_sub(port: int, topic: str) -> dict[str, bytes]:
    """The same, by the broker's own tool."""
    command = ["mosquitto_sub", "-h", "127.0.0.1", "-p", str(port), "-t", topic, "--retained-only", "-W", "1"]
    done = subprocess.run([*command, "-F", "%t %p"], capture_output=True, check=False)
    lines = [line.partition(b" ") for line in done.stdout.splitlines()]
    return {name.decode(): payload for name, _, payload in lines}


class Process:
    """``kontronik-can-gw mqtt`` as its own process."""

    def __init__(self, *words: object, environment: dict[str, str] | None = None) -> None:
        command = [*PROGRAM, *map(str, words)]
        paths = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | paths | (environment or {}),
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            self.lines.append(line.rstrip())

    @property
    def log(self) -> str:
        return "\n".join(self.lines)

    def wait_for_line(self, text: str, seconds: float = 20, count: int = 1) -> float:
        return wait_for(lambda: self.log.count(text) >= count, seconds, lambda: f"{text!r} in:\n{self.log}")

    def end(self, number: int = signal.SIGTERM) -> tuple[int, float]:
        """Send a signal; the exit code, and the seconds until the end."""
        begin = time.monotonic()
        self.process.send_signal(number)
        code = self.process.wait(10)
        lasted = time.monotonic() - begin
        self._reader.join(2)
        return code, lasted

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join(2)
        for stream in (self.process.stdout, self.process.stderr):
            if stream:
                stream.close()


# --- what a bus carries

Timed = list[tuple[int, CanFrame]]


@cache
def layout_of(*names: str) -> BusLayout:
    """The shipped DBC for these ESCs."""
    config = parse({"esc": [{"port": f"p{name}", "name": name, "pole_pairs": 7} for name in names]}, "test.toml")
    database, layout = prepare(load_database(config.dbc_path), "test.dbc", config.escs, config.dbc_settings)
    return BusLayout(database, layout, config.escs, config)


def flight(bus: BusLayout, seconds: float, *options: EscOptions, silent_from: float = 1e9) -> Timed:
    """What the gateway sends while ESCs fly; ``silent_from``: from then on (s) no ESC says anything."""
    given = [*options, *[EscOptions()] * (len(bus.escs) - len(options))]
    simulated = [SimulatedEsc(each, seed=index) for index, each in enumerate(given)]
    gateway = Gateway(bus.escs, bus.layout, 0)
    for index in range(len(simulated)):
        gateway.port_opened(index, 0)
    gateway.start(0)
    frames: Timed = []
    for now in range(0, round(seconds * SECOND_NS), STEP_NS):
        for index, esc in enumerate(simulated):
            for sent in esc.frames_until(now):
                if now < silent_from * SECOND_NS:
                    gateway.receive_bytes(index, sent.wire, now, now)
        gateway.advance(now)
        frames += [(now, frame) for frame in gateway.take_frames()]
    return frames


def write_log(path: Path, frames: Timed) -> Path:
    """A candump log, that began at ``START_S``."""
    lines = [
        f"({START_S + now // SECOND_NS}.{now % SECOND_NS // 1000:06d}) can0 {frame.can_id:03X}#{frame.data.hex().upper()}\n"
        for now, frame in frames
    ]
    path.write_text("".join(lines))
    return path


class Slcan:
    """A CAN adapter of the slcan kind on a pseudo terminal: what is put on its bus is received; what is sent is remembered."""

    def __init__(self, folder: Path) -> None:
        import tty

        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self.configuration = folder / "slcan.toml"
        """Of a gateway on this bus. python-can would wait for two seconds with a real adapter."""
        self.configuration.write_text(
            f'[can]\ninterface = "slcan"\nchannel = "{self.path}"\n[can.options]\nsleep_after_open = 0\n'
            '[[esc]]\nport = "/dev/ttyS0"\npole_pairs = 7\n'
        )
        self.commands = b""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._stop.is_set():
            if select.select([self._master], [], [], 0.1)[0]:
                self.commands += os.read(self._master, 4096)

    @property
    def is_open(self) -> bool:
        return b"O\r" in self.commands

    @property
    def sent(self) -> list[bytes]:
        """Frames that somebody sent."""
        return [command for command in self.commands.split(b"\r") if command[:1] in (b"t", b"T", b"r", b"R")]

    def put(self, frame: CanFrame) -> None:
        os.write(self._master, f"t{frame.can_id:03X}{len(frame.data)}{frame.data.hex().upper()}\r".encode())

    def close(self) -> None:
        self._stop.set()
        self._thread.join(2)
        os.close(self._master)
        os.close(self._slave)


@contextmanager
def slcan(folder: Path) -> Iterator[Slcan]:
    made = Slcan(folder)
    try:
        yield made
    finally:
        made.close()


class Traffic:
    """Puts frames onto a bus in their time, from a thread."""

    def __init__(self, bus: Slcan, frames: Sequence[tuple[int, CanFrame]]) -> None:
        self.put: list[tuple[float, CanFrame]] = []
        self._bus, self._frames = bus, frames
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def _work(self) -> None:
        begin = time.monotonic()
        for when, frame in self._frames:
            if self._stop.wait(max(0, begin + when / SECOND_NS - time.monotonic())):
                return
            self._bus.put(frame)
            self.put.append((time.monotonic(), frame))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5)
