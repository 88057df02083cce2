"""The bench of the end-to-end tests: ESCs, a gateway process, witnesses of the bus, a master.

No test here passes or fails by how fast the machine is. It waits for an event, with a limit that no working machine reaches, and
judges order, values and counts. A ``Chain`` sends an ESC's next frame when the bus has shown the one before; what has to be shown
to not happen is followed by something that has to.
"""

import itertools
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from bus_watch import SECOND, BusWatch
from feeder import CURRENT, SPEED, Feeder, Identity
from harness import LoggedProcess, PtyPort
from raw_bus import RawBus
from signals import Table, table_sent

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.esc.kontronik.fields import LiveData

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


class Recorded(NamedTuple):
    """A frame, and when the kernel had it."""

    time: float
    can_id: int
    data: bytes


MARK = 0x7F2
"""An id of nobody: what was sent before it has been recorded when it has."""
_marks = itertools.count(1)


def send_mark(interface: str) -> bytes:
    """Send a mark; its data, which no other mark has."""
    data = next(_marks).to_bytes(4, "little")
    with RawBus(interface) as bus:
        bus.send(MARK, data)
    return data


def wait_for_delivery(interface: str) -> None:
    """Wait until every socket on this interface has what was sent so far."""
    with RawBus(interface, (MARK, 0x7FF)) as witness:
        expected = MARK, send_mark(interface)
        wait_for(lambda: witness.receive(1) == expected, "the mark")


class Witness(BusWatch):
    """Keeps the frames of a bus, and judges their values where it is given ESCs (tests/faults/bus_watch.py)."""

    def __init__(self, interface: str, table: Table, escs: Sequence[PtyPort]) -> None:
        super().__init__(interface, table, escs, slack_ns=NO_LIMIT_NS, ignore_local=False)
        self.recorded: list[Recorded] = []
        self._mark = b""
        self.start()

    def take(self, can_id: int, data: bytes, at_ns: int) -> None:
        if can_id == MARK:
            self._mark = data
            return
        self.recorded.append(Recorded(at_ns / SECOND, can_id, data))
        super().take(can_id, data, at_ns)

    def of(self, can_id: int) -> list[Recorded]:
        return [frame for frame in list(self.recorded) if frame.can_id == can_id]

    def wait_for_mark(self) -> None:
        """Wait until all that was sent so far is recorded and judged."""
        mark = send_mark(self.interface)
        wait_for(lambda: self._mark == mark, "the mark")


@contextmanager
def recording(interface: str) -> Iterator[Witness]:
    """All frames on an interface, to the last that is sent in the block."""
    watch = Witness(interface, {}, [])
    try:
        yield watch
        watch.wait_for_mark()
    finally:
        watch.close()


def configuration(
    interface: str, ports: Iterable[PtyPort], dbc: str = "", esc: str = NEVER_STALE
) -> str:
    """A configuration text for these ports."""
    parts = [f'[can]\ninterface = "socketcan"\nchannel = "{interface}"\nbitrate = 1000000\n{dbc}\n']
    parts += [
        f'[[esc]]\nport = "{port.path}"\npole_pairs = 7\ngear = 9.8\n{esc}\n' for port in ports
    ]
    return "\n".join(parts)


# --- ESCs whose frames are sent one by one


class Chain:
    """ESCs that say what is expected of them, the gateway, and a judge of each value on the bus."""

    def __init__(
        self, interface: str, folder: Path, identities: Sequence[Identity], toml: str, esc: str
    ) -> None:
        self.escs = [PtyPort(folder / f"port{n}", each) for n, each in enumerate(identities)]
        for fed in self.escs:
            fed.info_every = 10
        self.config = folder / "gateway.toml"
        self.config.write_text(configuration(interface, self.escs, toml, esc))
        table = table_sent(["-c", str(self.config)], "[canopen]" in toml, len(identities))
        self.watch = Witness(interface, table, self.escs)
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

    def check(self) -> None:
        """No value was wrong, and nothing was sent to an ESC."""
        self.watch.wait_for_mark()
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


# --- ESCs that send in real time


@contextmanager
def feeding(folder: Path, count: int = 1) -> Iterator[list[PtyPort]]:
    """ESCs that send 100 frames a second once they are switched on (``on``), and to which nothing may be sent."""
    ports = [PtyPort(folder / f"port{n}", Identity(n + 1), rate_hz=100) for n in range(count)]
    for port in ports:
        port.on = False
    feeder = Feeder(ports).start()
    try:
        yield ports
        assert not any(port.received() for port in ports), "something was sent to an ESC"
    finally:
        feeder.close()
        for port in ports:
            port.close()


def sent_by(port: PtyPort) -> list[LiveData]:
    """All live frames so far."""
    return [port.live(n) for n in range(len(port.sent))]


# --- CANopen

EDS = shipped("eds/kontronik_esc.eds")
SERIAL = 0x00100200


def canopen_table(store: Path, node_id: int = 1, more: str = "") -> str:
    """The table of a configuration that makes each ESC a node, from ``node_id`` on."""
    return f'[canopen]\nenabled = true\nnode_id = {node_id}\nserial = {SERIAL}\nstore = "{store}"\n{more}\n'
