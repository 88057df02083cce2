"""Records with the state of the loop's parts, from which the status document is made."""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw import __version__
from kontronik_can_gw.core.output import NodeState
from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.system.process import pid_namespace, start_ticks
from kontronik_can_gw.status import GatewayStatus


class GatewayFacts(NamedTuple):
    """The state of a gateway at one moment. Any thread may read it, because it never changes."""

    escs: Sequence[EscTelemetry]
    status: GatewayStatus
    nodes: Sequence[NodeState]
    outputs: Mapping[str, Any]
    """The facts of the other outputs, by their names."""
    layout: str | None
    """As Gateway.layout."""
    core: str
    """The language of the core."""
    core_reason: str
    """As Core.note."""


def gateway_facts(gateway: Gateway) -> GatewayFacts:
    """Return the present state of a gateway."""
    outputs = {}
    for output in gateway.outputs:
        facts = output.facts()
        if facts:
            outputs[output.name] = facts
    return GatewayFacts(
        escs=[esc.frozen() for esc in gateway.escs],
        status=gateway.status.frozen(),
        nodes=gateway.node_states(),
        outputs=outputs,
        layout=gateway.layout,
        core=gateway.core.language,
        core_reason=gateway.core.note,
    )


class PortFacts(NamedTuple):
    """The state of one ESC's port."""

    name: str
    path: str
    open: bool
    complaint: str = ""
    reopened: int = 0
    line_errors: Mapping[str, int] = {}
    lost_since_ns: int | None = None
    """Time of the loss on the monotonic clock. None while the port is open."""
    diagnosis: str | None = None
    """The reason why no frame is received."""


class CanFacts(NamedTuple):
    """The state of the CAN interface, with the names of the status document.

    The controller's state and counters are in GatewayStatus.
    """

    interface: str
    channel: str
    bitrate: int | None
    open: bool
    complaint: str | None = None
    stalled: bool = False
    """True if no frame can be sent."""
    slow: bool = False
    """True if the bus takes so few frames that some measurements are not sent."""
    restart_ms: int | None = None
    error_counters: tuple[int, int] | None = None
    """Transmit and receive error counter of the controller. None if unknown."""


class StoreFacts(NamedTuple):
    """The state of the parameter store, with the names of the status document."""

    waiting: int = 0
    """Number of savings that are not on disk yet."""
    last_error: str | None = None
    """The reason why the last saving failed. None if it succeeded."""


@dataclass(frozen=True)
class ProgramFacts:
    """Values that stay the same while the process runs."""

    configuration: str
    version: str = __version__
    pid: int = 0
    ticks: int = 0
    """Start time of the process in clock ticks, as in /proc."""
    pid_namespace: str = ""
    started: str = ""
    """Start time of the process in UTC, by the wall clock."""


def utc(wall: float) -> str:
    """Return Unix time in seconds as text in UTC."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(wall))


def program_facts(configuration: Path | str) -> ProgramFacts:
    """Return the values of this process."""
    pid = os.getpid()
    return ProgramFacts(
        str(Path(configuration).absolute()),
        pid=pid,
        ticks=start_ticks(pid),
        pid_namespace=pid_namespace(),
        started=utc(time.time()),
    )
