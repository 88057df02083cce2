"""What the loop's parts tell of themselves, for the snapshot."""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from kontronik_can_gw import __version__
from kontronik_can_gw.esc.telemetry import EscTelemetry
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.runtime.system.process import pid_namespace, start_ticks
from kontronik_can_gw.status import GatewayStatus


class GatewayFacts(NamedTuple):
    """What a gateway knows at one moment, in copies that nobody changes: any thread may read it."""

    escs: Sequence[EscTelemetry]
    status: GatewayStatus
    nodes: Sequence[tuple[int, Any, int]]
    """As Gateway.node_states."""
    outputs: Mapping[str, Any]
    """What further outputs say of themselves, by their names."""
    layout: str | None
    """As Gateway.layout."""
    core: str
    """Its language, and as Gateway.core_note."""
    core_note: str


def gateway_facts(gateway: Gateway) -> GatewayFacts:
    """What it knows now."""
    escs = [esc.frozen() for esc in gateway.escs]
    core = gateway.core.language, gateway.core_note
    outputs = {output.name: found for output in gateway.outputs if (found := output.facts())}
    return GatewayFacts(
        escs, gateway.status.frozen(), gateway.node_states(), outputs, gateway.layout, *core
    )


class PortFacts(NamedTuple):
    """What the loop knows of one ESC's port. ``lost_since_ns``: monotonic, None while it is open."""

    name: str
    path: str
    open: bool
    complaint: str = ""
    reopened: int = 0
    line_errors: Mapping[str, int] = {}
    lost_since_ns: int | None = None
    diagnosis: str | None = None
    """Why no frame comes."""


class CanFacts(NamedTuple):
    """What the loop knows of the CAN interface; its state and its counters are in GatewayStatus."""

    interface: str
    channel: str
    bitrate: int | None
    open: bool
    complaint: str = ""
    stalled: bool = False
    restart_ms: int | None = None
    error_counters: tuple[int, int] | None = None
    """Transmit and receive error counter of the controller, where known."""


class StoreFacts(NamedTuple):
    """Parameters that wait for the disk, and why the last saving failed ('' where it did not)."""

    waiting: int = 0
    last_error: str = ""


@dataclass(frozen=True)
class ProgramFacts:
    """What stays the same while the process runs. ``started``: wall clock at start, UTC; ``ticks``: start time in /proc."""

    configuration: str
    version: str = __version__
    pid: int = 0
    ticks: int = 0
    pid_namespace: str = ""
    started: str = ""


def utc(wall: float) -> str:
    """Wall clock seconds as text."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(wall))


def program_facts(configuration: Path | str) -> ProgramFacts:
    """About this process."""
    pid = os.getpid()
    return ProgramFacts(
        str(Path(configuration).absolute()),
        pid=pid,
        ticks=start_ticks(pid),
        pid_namespace=pid_namespace(),
        started=utc(time.time()),
    )
