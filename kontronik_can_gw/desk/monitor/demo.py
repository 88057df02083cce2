"""The demonstration's bus: a gateway with a simulated ESC, and a CANopen master that looks after its node; without ports and threads."""

import time

from kontronik_can_gw.canopen import nmt
from kontronik_can_gw.config.assemble import assemble
from kontronik_can_gw.config.parse import parse
from kontronik_can_gw.desk.recordings.layouts import BusLayout
from kontronik_can_gw.desk.sources import Source, Take
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
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.node_state import NmtState

with without_asammdf():
    import canopen

_ERRORS = (
    OperatingError.POWER_STAGE_OVERTEMP_WARNING,
    OperatingError.BEC_OVERCURRENT,
    OperatingError.UNDERVOLTAGE,
    OperatingError.LIMIT_DISCHARGED_CAPACITY,
)
_STEP_S = 0.005
_NODE_ID = 1
_TPDOS = (0x181, 0x281, 0x381, 0x481)


class Master(canopen.Network):
    """The ``canopen`` package as master: what it sends is put into ``sent``; it starts its one node."""

    def __init__(self) -> None:
        super().__init__()
        self.sent: list[CanFrame] = []
        self._pdos = 0
        self._node = self.add_node(_NODE_ID)
        self._node.nmt.add_heartbeat_callback(self._heard)
        for cob_id in _TPDOS:
            self.subscribe(cob_id, self._count)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        self.sent.append(CanFrame(can_id, bytes(data)))

    def _heard(self, state: int) -> None:
        if state in (NmtState.INITIALISING, NmtState.PRE_OPERATIONAL):
            self._node.nmt.send_command(nmt.Command.START)

    def _count(self, *_: object) -> None:
        self._pdos += 1

    def line(self) -> str:
        """What the master knows of its node."""
        emergency = "no EMCY yet"
        if log := self._node.emcy.log:
            bits = PROTOCOLS[0].errors["operating_errors"]
            text = next((bit.meaning for bit in bits if bit == log[-1].data[0]), "of the gateway")
            emergency = f"EMCY {log[-1].code:04X}h {text if log[-1].code else 'no error any more'}"
        return f"CANopen: node {_NODE_ID} {self._node.nmt.state.lower()}, {self._pdos} PDOs, {emergency}"


class DemoBus(Source):
    """A bus on which a gateway sends the telemetry of one flight, again and again."""

    def __init__(self, seed: int) -> None:
        tables = {
            "canopen": {"enabled": True, "store": "/nowhere"},
            "esc": [{"port": "simulated", "pole_pairs": 7, "gear": 9.8}],
        }
        made = assemble(parse(tables, "demo"))
        assert made.database is not None
        super().__init__("demo", BusLayout(made.database, made.layout, made.escs, made.config))
        now = time.monotonic_ns()
        self._esc = _flight(seed, now)
        self._gateway = Gateway(made.escs, made.layout, now, canopen=made.canopen)
        self._gateway.port(0, True, now)
        self._gateway.start(now)
        self._master = Master()

    def pump(self, take: Take, until_s: float) -> None:
        """Let the gateway work until this time."""
        gateway = self._gateway
        while True:
            now = time.monotonic_ns()
            for sent in self._esc.frames_until(now):
                gateway.receive_bytes(0, sent.wire, now, now)
            gateway.advance(now)
            for frame in gateway.take_frames(now):
                take(frame, now)
                self._master.notify(frame.can_id, bytearray(frame.data), now / SECOND_NS)
            for command in self._master.sent:
                gateway.receive_frame(command, now, now)
            self._master.sent.clear()
            if time.monotonic() >= until_s:
                break
            time.sleep(_STEP_S)
        self.note = self._master.line()


def _flight(seed: int, start_ns: int) -> SimulatedEsc:
    """A short flight, again and again, with damaged frames, silences and errors."""
    errors = tuple(
        ErrorWindow(_ERRORS[n % len(_ERRORS)], (6 + 13 * n) * SECOND_NS, 3 * SECOND_NS)
        for n in range(1000)
    )
    faults = Faults(flipped_bits=1e-5, dropout=Dropout(SECOND_NS, 17 * SECOND_NS), errors=errors)
    profile = tuple(phase._replace(duration_s=max(1.5, phase.duration_s * 0.4)) for phase in FLIGHT)
    return SimulatedEsc(EscOptions(profile=profile, faults=faults), seed=seed, start_ns=start_ns)
