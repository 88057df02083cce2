"""What autopilots make of DroneCAN, written down from their sources: an oracle of what they would show and do.

ArduPilot: libraries/AP_DroneCAN (AP_DroneCAN.cpp, AP_DroneCAN_DNA_Server.cpp), AP_ESC_Telem.cpp. PX4: src/drivers/uavcan/actuators/esc.cpp.
Betaflight: dronecan_esc.c. Each takes transfers as they come, and is asked at a time.
"""

import math
from dataclasses import dataclass, field
from typing import Any

from dronecan_bench import Transfer

from kontronik_can_gw.esc.telemetry import MS, SECOND


class ArduPilot:
    """Time-outs: rpm 1 s, telemetry 5 s, the check that motors run 210 ms. Pre-arm: every node well, operational and known."""

    RPM_NS, TELEMETRY_NS, RUNNING_NS = SECOND, 5 * SECOND, 210 * MS

    def __init__(self, offset: int = 0) -> None:
        self.speeds: dict[int, tuple[int, float]] = {}
        """Of each ESC when it came, and what."""
        self.voltages: dict[int, tuple[int, float]] = {}
        self.nodes: dict[int, tuple[int, int, int]] = {}
        self._offset = offset

    def take(self, transfer: Transfer) -> None:
        got, at = transfer.payload, transfer.at
        if transfer.name == "NodeStatus":
            self.nodes[transfer.source] = at, got.health, got.mode
        if transfer.name == "Status" and (esc := got.esc_index + self._offset) < 32:
            self.speeds[esc] = at, got.rpm
            if not math.isnan(got.voltage):
                self.voltages[esc] = at, got.voltage

    def rpm(self, esc: int, now: int, life_ns: int = RPM_NS) -> float | None:
        at, speed = self.speeds.get(esc, (now - life_ns, 0))
        return speed if now - at < life_ns else None

    def runs(self, esc: int, now: int) -> bool:
        """The check that a motor turns, before a take-off."""
        return bool(self.rpm(esc, now, self.RUNNING_NS))

    def volts(self, esc: int, now: int) -> float | None:
        at, volts = self.voltages.get(esc, (now - self.TELEMETRY_NS, 0))
        return volts if now - at < self.TELEMETRY_NS else None

    def refuses_to_arm(self, now: int) -> list[str]:
        """Pre-arm messages."""
        return [
            f"Node {node} unhealthy!"
            for node, (at, health, mode) in self.nodes.items()
            if health or mode or now - at > 3 * SECOND
        ]


@dataclass
class Px4:
    """An ESC is online for 1200 ms. What was gathered is published when an index comes again: a round (index to time)."""

    size: int = 8
    rounds: list[dict[int, int]] = field(default_factory=list)
    failures: set[int] = field(default_factory=set)
    last: dict[int, tuple[int, Any]] = field(default_factory=dict)
    _round: dict[int, int] = field(default_factory=dict)

    def take(self, transfer: Transfer) -> None:
        got = transfer.payload
        if transfer.name == "NodeStatus":
            (self.failures.add if got.health >= 2 else self.failures.discard)(transfer.source)
        if transfer.name != "Status" or got.esc_index >= self.size:
            return
        if got.esc_index in self._round:
            self.rounds.append(self._round)
            self._round = {}
        self._round[got.esc_index] = transfer.at
        self.last[got.esc_index] = transfer.at, got

    def online(self, now: int) -> set[int]:
        return {index for index, (at, _) in self.last.items() if now - at < 1200 * MS}


class Betaflight:
    """A slot is of use for 1 s. Status.rpm is taken as electrical; temperatures are whole degrees of 0 to 255."""

    def __init__(self, pole_pairs: int) -> None:
        self._slots: dict[int, tuple[int, Any]] = {}
        self._pole_pairs = pole_pairs

    def take(self, transfer: Transfer) -> None:
        if transfer.name == "Status":
            self._slots[transfer.payload.esc_index] = transfer.at, transfer.payload

    def motor_rpm(self, esc: int, now: int) -> float | None:
        at, got = self._slots.get(esc, (now - 2 * SECOND, None))
        return None if now - at >= SECOND or got is None else got.rpm / self._pole_pairs

    def celsius(self, esc: int) -> int:
        return max(0, min(255, int(self._slots[esc][1].temperature - 273.15)))
