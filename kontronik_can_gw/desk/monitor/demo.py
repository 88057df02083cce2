"""The demonstration's bus: a gateway with a simulated ESC, without ports and threads."""

import time

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
from kontronik_can_gw.gateway import Gateway

_ERRORS = (
    OperatingError.POWER_STAGE_OVERTEMP_WARNING,
    OperatingError.BEC_OVERCURRENT,
    OperatingError.UNDERVOLTAGE,
    OperatingError.LIMIT_DISCHARGED_CAPACITY,
)
_STEP_S = 0.005


class DemoBus(Source):
    """A bus on which a gateway sends the telemetry of one flight, again and again."""

    def __init__(self, seed: int) -> None:
        esc = {"port": "simulated", "pole_pairs": 7, "gear": 9.8}
        made = assemble(parse({"esc": [esc]}, "demo"))
        assert made.database is not None
        super().__init__("demo", BusLayout(made.database, made.layout, made.escs, made.config))
        now = time.monotonic_ns()
        self._esc = _flight(seed, now)
        self._gateway = Gateway(made.escs, made.layout, now)
        self._gateway.port(0, True, now)
        self._gateway.start(now)

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
            if time.monotonic() >= until_s:
                return
            time.sleep(_STEP_S)


def _flight(seed: int, start_ns: int) -> SimulatedEsc:
    """A short flight, again and again, with damaged frames, silences and errors."""
    errors = tuple(
        ErrorWindow(_ERRORS[n % len(_ERRORS)], (6 + 13 * n) * SECOND_NS, 3 * SECOND_NS)
        for n in range(1000)
    )
    faults = Faults(flipped_bits=1e-5, dropout=Dropout(SECOND_NS, 17 * SECOND_NS), errors=errors)
    profile = tuple(phase._replace(duration_s=max(1.5, phase.duration_s * 0.4)) for phase in FLIGHT)
    return SimulatedEsc(EscOptions(profile=profile, faults=faults), seed=seed, start_ns=start_ns)
