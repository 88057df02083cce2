"""The demonstration's bus: a simulated ESC on a pseudo terminal, the real gateway, python-can's in-process bus, a CANopen master."""

import contextlib
import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from kontronik_can_gw.canopen import nmt
from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk import pty
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.sources import Bus, Take
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.simulator import (
    FLIGHT,
    SECOND_NS,
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    OperatingError,
    SimulatedEsc,
)
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.node_state import NmtState
from kontronik_can_gw.runtime.loop import Loop

with without_asammdf():
    import canopen

_NODE_ID = 1
_TPDOS = (0x180, 0x280, 0x380, 0x480)
_ERRORS = (
    OperatingError.POWER_STAGE_OVERTEMP_WARNING,
    OperatingError.BEC_OVERCURRENT,
    OperatingError.UNDERVOLTAGE,
    OperatingError.LIMIT_DISCHARGED_CAPACITY,
)


class Master:
    """A CANopen master that starts its one node, and notes its state, PDOs and emergencies."""

    def __init__(self, network: canopen.Network) -> None:
        self._node = network.add_node(_NODE_ID)
        self._node.nmt.add_heartbeat_callback(self._heard)
        self._pdos = 0
        for cob_id in _TPDOS:
            network.subscribe(cob_id + _NODE_ID, self._count)

    def _heard(self, state: int) -> None:
        if state in (NmtState.INITIALISING, NmtState.PRE_OPERATIONAL):
            self._node.nmt.send_command(nmt.Command.START)

    def _count(self, *_: object) -> None:
        self._pdos += 1

    def line(self) -> str:
        """One line with everything that the master knows."""
        emergency = "none yet"
        if log := self._node.emcy.log:
            bits = PROTOCOLS[0].errors["operating_errors"]
            text = next((bit.meaning for bit in bits if bit == log[-1].data[0]), "of the gateway")
            emergency = f"{log[-1].code:04X}h {text if log[-1].code else 'no error any more'}"
        state = self._node.nmt.state.lower()
        return f"CANopen: node {_NODE_ID} {state}, {self._pdos} PDOs, EMCY {emergency}"


class DemoBus(Bus):
    """The simulated bus as the monitor sees it, with the master's line."""

    def __init__(self, layout: BusLayout, master: Master) -> None:
        assert layout.config is not None
        super().__init__(layout, layout.config.can)
        self.name = "demo"
        self._master = master

    def pump(self, take: Take, until_s: float) -> None:
        super().pump(take, until_s)
        self.note = self._master.line()


@contextmanager
def simulated_bus(seed: int, stop: threading.Event) -> Iterator[DemoBus]:
    """A bus on which a gateway sends; a failure in it sets ``stop`` and is a RunError at the end."""
    # the screen shows what the log would
    logging.getLogger("kontronik_can_gw").addHandler(logging.NullHandler())
    failures: list[BaseException] = []

    def guarded(work: Callable[[], object]) -> None:
        try:
            work()
        except BaseException as error:
            failures.append(error)
            stop.set()

    with contextlib.ExitStack() as stack:
        esc = stack.enter_context(pty.PtyEsc())
        layout, loop = _gateway(esc.path, stack.enter_context(tempfile.TemporaryDirectory()))
        assert layout.config is not None
        channel = layout.config.can.channel
        network = stack.enter_context(canopen.Network())
        network.NOTIFIER_CYCLE = 0.1
        bus = stack.enter_context(DemoBus(layout, Master(network)))
        network.connect(interface="virtual", channel=channel)
        loop.open()
        flight = [(_flight(seed), esc)]
        works: tuple[Callable[[], object], ...] = (
            loop.run,
            lambda: pty.run(flight, stop=stop.is_set),
        )
        threads = [threading.Thread(target=guarded, args=(work,), daemon=True) for work in works]
        for thread in threads:
            thread.start()
        try:
            yield bus
        finally:
            stop.set()
            loop.stop()
            for thread in threads:
                thread.join(2)
        if failures:
            raise RunError(f"the demonstration failed: {failures[0]!r}")
        if esc.received:
            raise RunError(
                f"the gateway sent {esc.received} bytes to the ESC; it must never send any"
            )


def _gateway(port: str, store: str) -> tuple[BusLayout, Loop]:
    tables = {
        "can": {"interface": "virtual", "channel": f"demo-{os.getpid()}"},
        "canopen": {"enabled": True, "store": store},
        "esc": [{"port": port, "pole_pairs": 7, "gear": 9.8}],
    }
    loaded = assemble(parse(tables, "demo"))
    assert loaded.database is not None
    gateway = Gateway(loaded.escs, loaded.layout, time.monotonic_ns(), canopen=loaded.canopen)
    layout = BusLayout(loaded.database, loaded.layout, loaded.escs, loaded.config)
    return layout, Loop(gateway, [port], loaded.config.can)


def _flight(seed: int) -> SimulatedEsc:
    """A short flight, again and again, with noise, damaged frames, silences and errors."""
    errors = tuple(
        ErrorWindow(_ERRORS[n % len(_ERRORS)], (6 + 13 * n) * SECOND_NS, 3 * SECOND_NS)
        for n in range(1000)
    )
    faults = Faults(
        noise=0.02, flipped_bits=1e-5, dropout=Dropout(SECOND_NS, 17 * SECOND_NS), errors=errors
    )
    profile = tuple(phase._replace(duration_s=max(1.5, phase.duration_s * 0.4)) for phase in FLIGHT)
    return SimulatedEsc(EscOptions(profile=profile, faults=faults), seed=seed)
