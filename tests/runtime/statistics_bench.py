"""A gateway with simulated ESCs, and its status documents. Time is passed in."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from kontronik_can_gw.core.settings import CoreSettings
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
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS, SECOND

START = 1000 * SECOND
PROGRAM = ProgramFacts(
    "/etc/kontronik-can-gw/gateway.toml", "1.2.3", 4711, 99, "pid:[1]", "2026-01-02T03:04:05Z"
)


@dataclass
class Bench:
    """A gateway that receives frames of ``escs`` simulated ESCs from the time START."""

    escs: int = 2
    settings: EscSettings = field(default_factory=lambda: EscSettings("esc", 7, Fraction(98, 10)))
    options: EscOptions | None = None

    def __post_init__(self) -> None:
        self.now = START
        names = [f"esc{number + 1}" for number in range(self.escs)]
        made = [EscSettings(name, self.settings.pole_pairs, self.settings.gear) for name in names]
        self.gateway = Gateway(CoreSettings(made, MessageLayout("", "", ())), START)
        self.gateway.start(START)
        self.simulated = [
            SimulatedEsc(self.options, seed=n, start_ns=START) for n in range(self.escs)
        ]
        self.sent: list[list[LiveData | InfoData]] = [[] for _ in names]
        self.silent: set[int] = set()

    def run(self, seconds: float) -> None:
        """Let time pass in steps of 10 ms. Frames of ``silent`` ESCs do not arrive."""
        end = self.now + round(seconds * SECOND)
        while self.now < end:
            self.now += 10 * MS
            for number, simulated in enumerate(self.simulated):
                for frame in simulated.frames_until(self.now):
                    if number not in self.silent:
                        self.gateway.receive_bytes(number, frame.wire, self.now, self.now)
                        self.sent[number].append(frame.data)
            self.gateway.advance(self.now)

    def newest(
        self,
        esc: int,
        kind: type[LiveData] | type[InfoData],
    ) -> Any:
        return next(data for data in reversed(self.sent[esc]) if isinstance(data, kind))

    def document(
        self,
        *,
        at: int | None = None,
        **facts: Any,
    ) -> dict[str, Any]:
        """Return the document as a reader of the file gets it.

        ``at`` is the time of the document, by default now. ``facts`` replace fields of the Moment.
        """
        if at is None:
            at = self.now
        moment = moment_of(self.gateway, at)._replace(**facts)
        read: dict[str, Any] = json.loads(snapshot(moment))
        return read


def moment_of(gateway: Gateway, now: int) -> Moment:
    """Return the Moment of a gateway whose ports and bus are open."""
    names = [esc.settings.name for esc in gateway.escs]
    return Moment(
        gateway_facts(gateway),
        now=now,
        wall=1_700_000_000.5,
        program=PROGRAM,
        process=ProcessFacts(20_000_000, 12, 3),
        ports=[PortFacts(name, f"/dev/{name}", True) for name in names],
        can=CanFacts("socketcan", "can0", 500_000, True),
    )


def with_nodes(
    document: Mapping[str, Any],
    count: int = 2,
    sent: int = 0,
) -> dict[str, Any]:
    """Return the document of a gateway with CANopen nodes."""
    nodes = []
    for number in range(count):
        node = {
            "esc": f"esc{number + 1}",
            "node_id": number + 1,
            "state": "operational",
            "pdos_sent": sent + number,
        }
        nodes.append(node)
    return {**document, "nodes": nodes}
