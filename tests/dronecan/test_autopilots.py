"""Telemetry that comes and goes, seen by models of three autopilots: nothing stale is taken for fresh, nothing blocks arming.

The models are written down from their sources. ArduPilot: libraries/AP_DroneCAN (AP_DroneCAN.cpp, AP_DroneCAN_DNA_Server.cpp),
AP_ESC_Telem.cpp. PX4: src/drivers/uavcan/actuators/esc.cpp. Betaflight: dronecan_esc.c.
"""

import random
from typing import Any

import pytest
from dronecan_bench import LIVE, Bench, Transfer

from kontronik_can_gw.times import MS, SECOND

TIMEOUT = 250 * MS
"""After which the gateway's value of an ESC is not available (telemetry_timeout_ms)."""
RPM_LIFE = SECOND
TELEMETRY_LIFE = 5 * SECOND
RUNNING_LIFE = 210 * MS
"""Of ArduPilot: of a speed, of a voltage, of a speed that says before a take-off that the motor turns."""
PX4_ONLINE = 1200 * MS
BETAFLIGHT_LIFE = SECOND


class Autopilot:
    """What all three keep: of each ESC the newest Status and when it came, of each node its state."""

    def __init__(self) -> None:
        self.status: dict[int, tuple[int, Any]] = {}
        self.nodes: dict[int, tuple[int, int, int]] = {}
        self.rounds: list[dict[int, int]] = [{}]
        """PX4 publishes what was gathered when an index comes again: index to time."""

    def take(self, transfer: Transfer) -> None:
        got = transfer.payload
        at = transfer.at
        if transfer.name == "NodeStatus":
            self.nodes[transfer.source] = at, got.health, got.mode
        if transfer.name == "Status":
            self.status[got.esc_index] = at, got
            if got.esc_index in self.rounds[-1]:
                self.rounds.append({})
            self.rounds[-1][got.esc_index] = at

    def known(self, esc: int, now: int, life_ns: int) -> Any:
        """The Status of an ESC that came within its life; None: the autopilot shows nothing."""
        at, got = self.status.get(esc, (now - life_ns, None))
        return got if now - at < life_ns else None

    def refuses_to_arm(self, now: int) -> bool:
        """ArduPilot: every node is well, operational and heard. PX4 takes a node with health 2 for a failed ESC."""
        return any(bad or mode or now - at > 3 * SECOND for at, bad, mode in self.nodes.values())


class World:
    """Random flights of several ESCs; ``history``: of each what it sent, (time, electrical speed, volts)."""

    def __init__(self, seed: int, escs: int, rpm: str) -> None:
        self.rng = random.Random(seed)
        self.bench = Bench(escs, rpm=rpm)
        self.bench.live = [None] * escs
        self.history: list[list[tuple[int, int, float]]] = [[] for _ in range(escs)]
        self.pilot = Autopilot()

    def step(self) -> None:
        """Ten milliseconds: what the ESCs send now, and what the autopilot hears of it."""
        bench = self.bench
        rng = self.rng
        for esc, live in enumerate(bench.live):
            if rng.random() < (0.01 if live is not None else 0.02):
                bench.live[esc] = LIVE if live is None else None
            if (live := bench.live[esc]) is not None:
                speed = 70 * rng.randrange(300)
                volts = rng.randrange(1600, 6000)
                bench.live[esc] = live._replace(electrical_speed=speed, battery_voltage=volts)
                self.history[esc].append((bench.now + 10 * MS, speed, volts / 100))
        bench.run(0.01)
        while bench.read:
            self.pilot.take(bench.read.pop(0))

    def silent_ns(self, esc: int) -> int:
        """For how long this ESC was not heard."""
        return self.bench.now - (self.history[esc][-1][0] if self.history[esc] else -(1 << 60))

    def sent(self, esc: int, since: int) -> list[tuple[int, int, float]]:
        return [entry for entry in self.history[esc][-200:] if entry[0] >= since]


@pytest.mark.parametrize(("rpm", "ratio"), [("motor", 7), ("output", 70), ("electrical", 1)])
def test_nothing_stale_is_taken_for_fresh_and_nothing_blocks_arming(rpm: str, ratio: int) -> None:
    """Betaflight takes ``rpm`` for electrical; its temperature is in whole degrees."""
    world = World(1, 4, rpm)
    seen = 0
    pilot = world.pilot
    for _ in range(1500):
        world.step()
        now = world.bench.now
        assert not pilot.refuses_to_arm(now)
        for esc in range(4):
            got = pilot.known(esc, now, 20 * MS)
            if got is not None:  # it has come just now: the ESC said so within its time-out
                known = world.sent(esc, now - 20 * MS - TIMEOUT)
                assert got.rpm in [speed // ratio for _, speed, _ in known]
                assert any(got.voltage == pytest.approx(volts, abs=0.016) for *_, volts in known)
                assert int(got.temperature - 273.15) in (29, 30)
                seen += 1
            silent = world.silent_ns(esc)
            for life in (RPM_LIFE, TELEMETRY_LIFE, RUNNING_LIFE, PX4_ONLINE, BETAFLIGHT_LIFE):
                assert silent < TIMEOUT + life or pilot.known(esc, now, life) is None
            if silent < TIMEOUT - 30 * MS and len(world.sent(esc, now - TIMEOUT)) >= 5:
                assert pilot.known(esc, now, PX4_ONLINE) is not None
    assert seen > 2000
    assert sum(len(found) == 4 for found in pilot.rounds) > 100
    for found in pilot.rounds:
        assert max(found.values()) - min(found.values()) <= 30 * MS  # a round is one moment


def test_ardupilot_knows_at_once_that_a_motor_turns() -> None:
    """The check before a take-off wants a speed at least each 210 ms; it never misses one while the ESC is heard."""
    bench = Bench(first_index=4).run(3)
    statuses = bench.of("Status")
    assert {(each.payload.esc_index, each.payload.rpm) for each in statuses} == {(4, 6000)}
    assert max(bench.intervals("Status")) < RUNNING_LIFE
