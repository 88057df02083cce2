"""The bench of the end-to-end tests: ESCs, a gateway process, witnesses of the bus, a master.

No test here passes or fails by how fast the machine is. It waits for an event, with a limit that no working machine reaches, and
judges order, values and counts. A ``Chain`` sends an ESC's next frame when the bus has shown the one before; what has to be shown
to not happen is followed by something that has to.
"""

import itertools
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Self, cast

import canopen
from bus_watch import SECOND, BusWatch
from encoding import Identity
from feeder import CURRENT, SPEED
from harness import LoggedProcess, PtyPort
from raw_bus import RawBus
from signals import table_sent

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk import pty
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Sent, SimulatedEsc

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
LIMIT_S = 60.0
NEVER_STALE = "telemetry_timeout_ms = 60000"
"""For an [[esc]]: a machine that stands still for a while makes no telemetry loss."""


NO_LIMIT_NS = 3600 * 10**9
"""The judge of a chain looks at what a value is and in which order it comes, not at its age."""


def ip(*words: str) -> None:
    """``ip`` with these words."""
    subprocess.run(["ip", *words], check=True)


def wait_for(condition: Callable[[], object], what: object) -> None:
    """Wait until something holds. AssertionError when it does not come; ``what`` may be a function that says what is there instead."""
    end = time.monotonic() + LIMIT_S
    while not condition():
        if time.monotonic() > end:
            raise AssertionError(f"{what() if callable(what) else what}: not within {LIMIT_S:g} s")
        time.sleep(0.005)


class GatewayProcess(LoggedProcess):
    """``kontronik-can-gw run``, or another of its commands, as its own process."""

    def __init__(self, config: Path | None, *options: object, command: str = "run") -> None:
        words = [*PROGRAM, command, *([] if config is None else ["-c", config]), *options]
        super().__init__([str(word) for word in words], keep_out=command != "run")

    def wait_for_line(self, text: str) -> None:
        """Wait until a log line holds ``text``."""

        def seen() -> bool:
            if self.process.poll() is not None:
                code = self.wait()
                assert text in self.log, f"the gateway ended with {code}:\n{self.log}"
            return text in self.log

        wait_for(seen, lambda: f"log line {text!r} in:\n{self.log}")

    def end(self, signal_number: int = 15) -> int:
        """Send a signal and wait for the exit code."""
        self.process.send_signal(signal_number)
        return self.wait()


def program(*words: object) -> subprocess.CompletedProcess[str]:
    """A command that ends by itself."""
    command = [*PROGRAM, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=2 * LIMIT_S, check=False)


class Recorded(NamedTuple):
    """A frame, and when the kernel had it."""

    time: float
    can_id: int
    data: bytes


MARK = 0x7F2
"""An id of nobody: what was sent before it has been recorded when it has."""


DELIVERY_MARK = 0x7F3
_delivery_marks = itertools.count(1)


def send_mark(interface: str, number: int, can_id: int = MARK) -> None:
    with RawBus(interface) as bus:
        bus.send(can_id, number.to_bytes(4, "little"))


def wait_for_delivery(interface: str) -> None:
    """Wait until every socket on this interface has what was sent so far."""
    with RawBus(interface, (DELIVERY_MARK, 0x7FF)) as witness:
        number = next(_delivery_marks)
        send_mark(interface, number, DELIVERY_MARK)
        expected = DELIVERY_MARK, number.to_bytes(4, "little")
        wait_for(lambda: witness.receive(1) == expected, "the mark")


class Candump:
    """``candump -L`` of an interface, from the first frame that is sent in its block to the last."""

    def __init__(self, interface: str) -> None:
        command = ["candump", "-D", "-L", "-r", "4194304", f"{interface},0:0,#FFFFFFFF"]
        self.frames: list[Recorded] = []
        self._interface = interface
        self._marks = 0
        self._mark = 0
        self._process = subprocess.Popen(
            ["stdbuf", "-oL", *command], stdout=subprocess.PIPE, text=True
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            found = re.match(r"\((\d+\.\d+)\) \S+ ([0-9A-F]+)#(#\d)?([0-9A-F]*)", line)
            assert found, line
            frame = Recorded(float(found[1]), int(found[2], 16), bytes.fromhex(found[4]))
            if frame.can_id == MARK:
                self._mark = int.from_bytes(frame.data, "little")
            else:
                self.frames.append(frame)

    def of(self, can_id: int) -> list[Recorded]:
        return [frame for frame in list(self.frames) if frame.can_id == can_id]

    def catch_up(self) -> None:
        """Wait until all that was sent so far is recorded."""
        self._marks += 1
        send_mark(self._interface, self._marks)
        wait_for(lambda: self._mark >= self._marks, "candump")

    def __enter__(self) -> Self:
        while not self._mark:  # until it listens
            self._marks += 1
            send_mark(self._interface, self._marks)
            time.sleep(0.02)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.catch_up()
        self._process.terminate()
        self._process.wait()
        self._thread.join(LIMIT_S)
        if self._process.stdout:
            self._process.stdout.close()


def configuration(
    interface: str, ports: Sequence[str], dbc: str = "", esc: str = NEVER_STALE
) -> str:
    """A configuration text for these ports."""
    parts = [f'[can]\ninterface = "socketcan"\nchannel = "{interface}"\nbitrate = 1000000\n{dbc}\n']
    parts += [f'[[esc]]\nport = "{port}"\npole_pairs = 7\ngear = 9.8\n{esc}\n' for port in ports]
    return "\n".join(parts)


# --- ESCs whose frames are sent one by one


class Witness(BusWatch):
    """Judges all values on a bus (tests/faults/bus_watch.py), and keeps the frames."""

    recorded: list[Recorded]

    def take(self, can_id: int, data: bytes, at_ns: int) -> None:
        self.recorded.append(Recorded(at_ns / SECOND, can_id, data))
        super().take(can_id, data, at_ns)

    def of(self, can_id: int) -> list[Recorded]:
        return [frame for frame in list(self.recorded) if frame.can_id == can_id]


class Chain:
    """ESCs that say what is expected of them, the gateway, and a judge of each value on the bus."""

    def __init__(
        self,
        interface: str,
        folder: Path,
        identities: Sequence[Identity],
        toml: str = "",
        esc: str = NEVER_STALE,
    ) -> None:
        self.interface = interface
        self.escs = [
            PtyPort(folder / f"port{i + 1}", identity) for i, identity in enumerate(identities)
        ]
        for fed in self.escs:
            fed.info_every = 10
        self.config = folder / "gateway.toml"
        ports = [esc.path for esc in self.escs]
        self.config.write_text(configuration(interface, ports, toml, esc))
        table = table_sent(["-c", str(self.config)], "[canopen]" in toml, len(identities))
        self.watch = Witness(interface, table, self.escs, slack_ns=NO_LIMIT_NS, ignore_local=False)
        self.watch.recorded = []
        self.watch.start()
        self.gateway: GatewayProcess | None = None

    @contextmanager
    def running(self, *options: str) -> Iterator[GatewayProcess]:
        """A gateway that has opened everything, killed at the end if it still runs."""
        self.gateway = GatewayProcess(self.config, *options)
        try:
            self.gateway.wait_for_line(f"esc{len(self.escs)}: /")
            self.gateway.wait_for_line("CAN socketcan")
            yield self.gateway
        finally:
            self.gateway.kill()

    @property
    def held_up(self) -> int:
        """How often the gateway said that it stood still: then it may throw frames away."""
        assert self.gateway is not None
        return self.gateway.log.count("suspended")

    def feed(self, *escs: int, times: int = 1) -> None:
        """The next live frame of these ESCs, of all unless given, each time as soon as the bus has shown the ones before."""
        chosen = [self.escs[esc] for esc in escs] or self.escs
        for _ in range(times):
            numbers = [len(fed.sent) for fed in chosen]
            held_up = self.held_up
            for fed, number in zip(chosen, numbers, strict=True):
                while len(fed.sent) == number:  # an info frame now and then
                    fed.send_one()

            def shown(numbers: Sequence[int] = numbers, held_up: int = held_up) -> bool:
                seen = all(
                    fed.seen[n] == SPEED | CURRENT for fed, n in zip(chosen, numbers, strict=True)
                )
                return seen or self.held_up > held_up

            wait_for(shown, f"frames {numbers} on the bus")

    def signal(self, message: str, signal: str) -> int | None:
        """The newest raw value of a signal of the gateway's own messages."""
        return self.watch.value(message, signal)

    def catch_up(self) -> None:
        """Wait until all that was sent so far has been judged."""
        begin = len(self.watch.recorded)
        send_mark(self.interface, begin)
        wait_for(lambda: any(f.can_id == MARK for f in self.watch.recorded[begin:]), "the mark")

    def check(self) -> None:
        """No value was wrong, and nothing was sent to an ESC."""
        self.catch_up()
        self.watch.settle(lambda _begin, _end: 0)
        assert not self.watch.wrong, self.watch.wrong
        assert not any(esc.received() for esc in self.escs), "something was sent to an ESC"

    def close(self) -> None:
        self.watch.close()
        for esc in self.escs:
            esc.close()


@contextmanager
def chain(
    interface: str, folder: Path, *identities: Identity, toml: str = "", esc: str = NEVER_STALE
) -> Iterator[Chain]:
    """A chain, whose values are checked when all went well."""
    made = Chain(interface, folder, identities, toml, esc)
    try:
        yield made
        made.check()
    finally:
        made.close()


# --- simulated ESCs in real time


class NotedEsc(SimulatedEsc):
    """A simulated ESC that notes each frame before anybody can have it: a value that came from an ESC is in a list read after it came."""

    def __init__(self, options: EscOptions, seed: int, noted: list[Sent]) -> None:
        super().__init__(options, seed=seed)
        self._noted = noted

    def frames_until(self, now_ns: int) -> list[Sent]:
        frames = super().frames_until(now_ns)
        self._noted.extend(frames)
        return frames


class Bench:
    """Simulated ESCs on ptys, sending in real time in a thread, with a record of what was sent."""

    def __init__(self, escs: Sequence[EscOptions]) -> None:
        self.ports = [pty.PtyEsc() for _ in escs]
        self.sent: list[list[Sent]] = [[] for _ in escs]
        self._options = escs
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        self._stop.clear()
        escs = [NotedEsc(each, 1 + i, self.sent[i]) for i, each in enumerate(self._options)]
        self._thread = threading.Thread(
            target=pty.run,
            args=(list(zip(escs, self.ports, strict=True)),),
            kwargs={"stop": self._stop.is_set},
            daemon=True,
        )
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread:
            self._thread.join(LIMIT_S)

    def live(self, index: int) -> list[LiveData]:
        return [sent.data for sent in self.sent[index] if isinstance(sent.data, LiveData)]

    def info(self, index: int) -> list[InfoData]:
        return [sent.data for sent in self.sent[index] if isinstance(sent.data, InfoData)]


@contextmanager
def bench(*escs: EscOptions) -> Iterator[Bench]:
    """A bench that also checks, at its end, that nothing was ever transmitted to an ESC."""
    made = Bench(escs)
    try:
        yield made
    finally:
        made.stop()
        for port in made.ports:
            port.check()
            port.close()
    assert not any(port.received for port in made.ports), "something was transmitted to an ESC"


# --- CANopen

EDS = shipped("eds/kontronik_esc.eds")
SERIAL = 0x00100200


def canopen_table(store: Path, node_id: int = 1, more: str = "") -> str:
    """The table of a configuration that makes each ESC a node, from ``node_id`` on."""
    return f'[canopen]\nenabled = true\nnode_id = {node_id}\nserial = {SERIAL}\nstore = "{store}"\n{more}\n'


class Master:
    """The canopen library as the master of a bus: its network and remote nodes made from the shipped EDS."""

    def __init__(self, interface: str) -> None:
        self.network = canopen.Network()
        self.network.connect(interface="socketcan", channel=interface)
        self._objects = canopen.import_od(str(EDS))

    def node(self, node_id: int) -> canopen.RemoteNode:
        """The node with this ID, from now on or since an earlier call."""
        if node_id in self.network:
            return cast(canopen.RemoteNode, self.network[node_id])
        node = canopen.RemoteNode(node_id, self._objects)
        node.sdo.RESPONSE_TIMEOUT = LIMIT_S
        self.network.add_node(node)
        return node

    def upload(self, node_id: int, index: int, sub: int = 0) -> bytes:
        return bytes(self.node(node_id).sdo.upload(index, sub))

    def number(self, node_id: int, index: int, sub: int = 0) -> int:
        """A whole number by SDO, without sign."""
        return int.from_bytes(self.upload(node_id, index, sub), "little")

    def write(self, node_id: int, index: int, sub: int, value: int, size: int) -> None:
        self.node(node_id).sdo.download(index, sub, value.to_bytes(size, "little"))

    def refusal(self, act: Callable[[], object]) -> int:
        """The code of the abort that an act ends with."""
        try:
            act()
        except canopen.SdoAbortedError as error:
            return int(error.code)
        raise AssertionError("it was not refused")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.network.disconnect()
