"""The bench of the end-to-end tests: ESCs, a gateway process, witnesses of the bus, a master.

The result of a test does not depend on the speed of the machine. A test waits for an event, with a
limit that no working machine reaches, and judges order, values and counts. A ``Chain`` sends an
ESC's next frame when the bus has shown the one before. To show that an event does not occur, a test
waits for a later event that must occur.
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
"""Key of an [[esc]], so that a hold-up of the machine causes no loss of telemetry."""

NO_LIMIT_NS = 3600 * 10**9
"""Slack of a chain's judge, which judges values and their order but not their age."""


def ip(*words: str) -> None:
    """Run ``ip`` with these words."""
    subprocess.run(["ip", *words], check=True)


def wait_for(condition: Callable[[], object], what: object) -> None:
    """Wait until a condition is true. Raise AssertionError if it stays false.

    ``what`` describes the condition. It may be a function that describes the actual state.
    """
    end = time.monotonic() + LIMIT_S
    while not condition():
        if time.monotonic() > end:
            text = what() if callable(what) else what
            raise AssertionError(f"{text}: not within {LIMIT_S:g} s")
        time.sleep(0.005)


class GatewayProcess(LoggedProcess):
    """``kontronik-can-gw run``, or another command of the program, in a separate process."""

    def __init__(
        self,
        config: Path | None,
        *options: object,
        command: str = "run",
    ) -> None:
        words: list[object] = [*PROGRAM, command]
        if config is not None:
            words += ["-c", config]
        words += options
        super().__init__([str(word) for word in words], keep_out=command != "run")

    def wait_for_line(self, text: str) -> None:
        """Wait until a log line contains ``text``."""

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
    """A frame and the time at which it was read."""

    time: float
    can_id: int
    data: bytes


MARK = 0x7F2
"""An unused id. When a mark is recorded, all frames that were sent before it are recorded too."""
_marks = itertools.count(1)


def send_mark(interface: str) -> bytes:
    """Send a mark. Return its data, which no other mark has."""
    data = next(_marks).to_bytes(4, "little")
    with RawBus(interface) as bus:
        bus.send(MARK, data)
    return data


def wait_for_delivery(interface: str) -> None:
    """Wait until every socket on this interface has all frames that were sent so far."""
    with RawBus(interface, (MARK, 0x7FF)) as witness:
        expected = MARK, send_mark(interface)
        wait_for(lambda: witness.receive(1) == expected, "the mark")


class Witness(BusWatch):
    """Records the frames of a bus, and judges their values if it has ESCs.

    tests/faults/bus_watch.py has the judge.
    """

    def __init__(self, interface: str, table: Table, escs: Sequence[PtyPort]) -> None:
        super().__init__(
            interface,
            table,
            escs,
            slack_ns=NO_LIMIT_NS,
            ignore_local=False,
        )
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
        """Wait until all frames that were sent so far are recorded and judged."""
        mark = send_mark(self.interface)
        wait_for(lambda: self._mark == mark, "the mark")


@contextmanager
def recording(interface: str) -> Iterator[Witness]:
    """Record all frames on an interface that are sent within the block."""
    watch = Witness(interface, {}, [])
    try:
        yield watch
        watch.wait_for_mark()
    finally:
        watch.close()


def configuration(
    interface: str,
    ports: Iterable[PtyPort],
    dbc: str = "",
    esc: str = NEVER_STALE,
) -> str:
    """Return the text of a configuration for these ports."""
    can = f'[can]\ninterface = "socketcan"\nchannel = "{interface}"\nbitrate = 1000000\n'
    parts = [f"{can}{dbc}\n"]
    for port in ports:
        parts.append(f'[[esc]]\nport = "{port.path}"\npole_pairs = 7\ngear = 9.8\n{esc}\n')
    return "\n".join(parts)


# --- ESCs whose frames are sent one by one


class Chain:
    """ESCs that send frames on request, the gateway, and a judge of each value on the bus."""

    def __init__(
        self,
        interface: str,
        folder: Path,
        identities: Sequence[Identity],
        toml: str,
        esc: str,
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
        """Start a gateway and wait until its ports are open. Kill it at the end if necessary."""
        self.gateway = GatewayProcess(self.config, *options)
        try:
            self.gateway.wait_for_line(f"esc{len(self.escs)}: /")
            self.gateway.wait_for_line("CAN socketcan")
            yield self.gateway
        finally:
            self.gateway.kill()

    @property
    def held_up(self) -> int:
        """The number of logged hold-ups. The gateway may discard frames after a hold-up."""
        assert self.gateway is not None
        return self.gateway.log.count("suspended")

    def feed(self, *escs: int, times: int = 1) -> None:
        """Send the next live frames of these ESCs, by default of all.

        Each frame is sent as soon as the bus has shown the one before.
        """
        chosen = [self.escs[esc] for esc in escs] or self.escs
        for _ in range(times):
            numbers = [len(fed.sent) for fed in chosen]
            held_up = self.held_up
            for fed, number in zip(chosen, numbers, strict=True):
                while len(fed.sent) == number:  # some frames are info frames
                    fed.send_one()

            def shown(numbers: Sequence[int] = numbers, held_up: int = held_up) -> bool:
                seen = [fed.seen[n] for fed, n in zip(chosen, numbers, strict=True)]
                are_seen = all(each == SPEED | CURRENT for each in seen)
                return are_seen or self.held_up > held_up

            wait_for(shown, f"frames {numbers} on the bus")

    def check(self) -> None:
        """Check that no value was wrong and that no byte was sent to an ESC."""
        self.watch.wait_for_mark()
        assert not self.watch.wrong, self.watch.wrong
        assert not any(esc.received() for esc in self.escs), "something was sent to an ESC"

    def close(self) -> None:
        self.watch.close()
        for esc in self.escs:
            esc.close()


@contextmanager
def chain(
    interface: str,
    folder: Path,
    *identities: Identity,
    toml: str = "",
    esc: str = NEVER_STALE,
) -> Iterator[Chain]:
    """Yield a chain. Check its values at the end unless the test has failed."""
    made = Chain(interface, folder, identities, toml, esc)
    try:
        yield made
        made.check()
    finally:
        made.close()


# --- ESCs that send in real time


@contextmanager
def feeding(folder: Path, count: int = 1) -> Iterator[list[PtyPort]]:
    """Yield ESCs that send 100 frames a second while they are ``on``.

    No byte may be sent to them.
    """
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
    """Return all live frames that an ESC has sent so far."""
    return [port.live(n) for n in range(len(port.sent))]


# --- CANopen

EDS = shipped("eds/kontronik_esc.eds")
SERIAL = 0x00100200


def canopen_table(store: Path, node_id: int = 1, more: str = "") -> str:
    """Return the table of a configuration with a node for each ESC, beginning at ``node_id``."""
    text = f"[canopen]\nenabled = true\nnode_id = {node_id}\nserial = {SERIAL}\n"
    return f'{text}store = "{store}"\n{more}\n'
