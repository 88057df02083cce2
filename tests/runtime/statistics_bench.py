"""A gateway with simulated ESCs whose time is passed in, and documents of it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, SimulatedEsc
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.status.facts import (
    CanFacts,
    PortFacts,
    ProgramFacts,
    gateway_facts,
)
from kontronik_can_gw.runtime.status.snapshot import Moment, snapshot
from kontronik_can_gw.runtime.system.process import ProcessFacts
from kontronik_can_gw.signals.plan import Layout
from kontronik_can_gw.times import MS, SECOND

START = 1000 * SECOND
PROGRAM = ProgramFacts(
    "/etc/kontronik-can-gw/gateway.toml", "1.2.3", 4711, 99, "pid:[1]", "2026-01-02T03:04:05Z"
)


@dataclass
class Bench:
    """``escs`` simulated ESCs that are heard from START on."""

    escs: int = 2
    settings: EscSettings = field(default_factory=lambda: EscSettings("esc", 7, Fraction(98, 10)))
    options: EscOptions | None = None

    def __post_init__(self) -> None:
        self.now = START
        names = [f"esc{number + 1}" for number in range(self.escs)]
        made = [EscSettings(name, self.settings.pole_pairs, self.settings.gear) for name in names]
        self.gateway = Gateway(made, Layout("", "", ()), START)
        self.gateway.start(START)
        self.simulated = [
            SimulatedEsc(self.options, seed=n, start_ns=START) for n in range(self.escs)
        ]
        self.sent: list[list[LiveData | InfoData]] = [[] for _ in names]
        self.silent: set[int] = set()

    def run(self, seconds: float) -> None:
        """Let time pass in steps of 10 ms; ``silent`` ESCs are not heard."""
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            self.now += 10 * MS
            for number, simulated in enumerate(self.simulated):
                for frame in simulated.frames_until(self.now):
                    if number not in self.silent:
                        self.gateway.receive_bytes(number, frame.wire, self.now, self.now)
                        self.sent[number].append(frame.data)
            self.gateway.advance(self.now)

    def newest(self, esc: int, kind: type[LiveData] | type[InfoData]) -> Any:
        return next(data for data in reversed(self.sent[esc]) if isinstance(data, kind))

    def document(self, *, at: int | None = None, **facts: Any) -> dict[str, Any]:
        """The document now, as a reader of the file gets it; ``facts``: those of a Moment that are others."""
        moment = moment_of(self.gateway, self.now if at is None else at)._replace(**facts)
        read: dict[str, Any] = json.loads(snapshot(moment))
        return read


def moment_of(gateway: Gateway, now: int) -> Moment:
    """What the statistics are made of, of a gateway whose ports and bus are open."""
    return Moment(
        gateway_facts(gateway),
        now=now,
        wall=1_700_000_000.5,
        program=PROGRAM,
        process=ProcessFacts(20_000_000, 12, 3),
        ports=[PortFacts(e.settings.name, f"/dev/{e.settings.name}", True) for e in gateway.escs],
        can=CanFacts("socketcan", "can0", 500_000, True),
    )


def with_nodes(document: Mapping[str, Any], count: int = 2, sent: int = 0) -> dict[str, Any]:
    """The document of a gateway with CANopen nodes."""
    nodes = [
        {"esc": f"esc{n + 1}", "node_id": n + 1, "state": "operational", "pdos_sent": sent + n}
        for n in range(count)
    ]
    return {**document, "nodes": nodes}
