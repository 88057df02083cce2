"""Models of three autopilots receive telemetry with gaps.

They must not take a stale value for a fresh one, and must not refuse to arm. The models follow the
sources of the autopilots. ArduPilot: libraries/AP_DroneCAN (AP_DroneCAN.cpp,
AP_DroneCAN_DNA_Server.cpp), AP_ESC_Telem.cpp. PX4: src/drivers/uavcan/actuators/esc.cpp.
Betaflight: dronecan_esc.c.
"""

import random
from typing import Any

import pytest
from dronecan_bench import LIVE, Bench, Transfer

from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("dronecan")

TIMEOUT = 250 * MS
"""Time after which the gateway's value of an ESC is not available (telemetry_timeout_ms)."""
RPM_LIFE = SECOND
TELEMETRY_LIFE = 5 * SECOND
RUNNING_LIFE = 210 * MS
"""Times for which ArduPilot uses a value.

They are for a speed, for a voltage, and for a speed that shows before take-off that the motor
turns.
"""
PX4_ONLINE = 1200 * MS
BETAFLIGHT_LIFE = SECOND


class Autopilot:
    """The state that all three keep: the newest Status of each ESC, and the state of each node."""

    def __init__(self) -> None:
        self.status: dict[int, tuple[int, Any]] = {}
        self.nodes: dict[int, tuple[int, int, int]] = {}
        self.rounds: list[dict[int, int]] = [{}]
        """Time of each index in a round. PX4 publishes a round when an index is repeated."""

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
        """Return the newest Status of an ESC, or None if it is older than ``life_ns``."""
        at, got = self.status.get(esc, (now - life_ns, None))
        return got if now - at < life_ns else None

    def refuses_to_arm(self, now: int) -> bool:
        """Return whether ArduPilot refuses: it needs every node healthy, operational and alive.

        PX4 takes a node with health 2 for a failed ESC.
        """
        oldest = now - 3 * SECOND
        states = self.nodes.values()
        return any(health or mode or at < oldest for at, health, mode in states)


class World:
    """Random flights of several ESCs.

    ``history`` has the sent values of each ESC: time, electrical speed and voltage in V.
    """

    def __init__(self, seed: int, escs: int, rpm: str) -> None:
        self.rng = random.Random(seed)
        self.bench = Bench(escs, rpm=rpm)
        self.bench.live = [None] * escs
        self.history: list[list[tuple[int, int, float]]] = [[] for _ in range(escs)]
        self.pilot = Autopilot()

    def step(self) -> None:
        """Let the ESCs send for ten milliseconds, and the autopilot receive the transfers."""
        bench = self.bench
        rng = self.rng
        for esc, live in enumerate(bench.live):
            if rng.random() < (0.01 if live is not None else 0.02):
                bench.live[esc] = LIVE if live is None else None
            live = bench.live[esc]
            if live is not None:
                speed = 70 * rng.randrange(300)
                volts = rng.randrange(1600, 6000)
                bench.live[esc] = live._replace(electrical_speed=speed, battery_voltage=volts)
                self.history[esc].append((bench.now + 10 * MS, speed, volts / 100))
        bench.run(0.01)
        while bench.read:
            self.pilot.take(bench.read.pop(0))

    def silent_ns(self, esc: int) -> int:
        """Return the time since the last frame of this ESC in ns."""
        history = self.history[esc]
        last = history[-1][0] if history else -(1 << 60)
        return self.bench.now - last

    def sent(
        self,
        esc: int,
        since: int,
    ) -> list[tuple[int, int, float]]:
        return [entry for entry in self.history[esc][-200:] if entry[0] >= since]


@pytest.mark.parametrize(
    ("rpm", "ratio"),
    [
        ("motor", 7),
        ("output", 70),
        ("electrical", 1),
    ],
)
def test_no_stale_value_is_taken_for_fresh_and_arming_is_never_blocked(
    rpm: str,
    ratio: int,
) -> None:
    """Betaflight takes ``rpm`` for the electrical speed. Its temperature is in whole degrees."""
    world = World(1, 4, rpm)
    seen = 0
    pilot = world.pilot
    for _ in range(1500):
        world.step()
        now = world.bench.now
        assert not pilot.refuses_to_arm(now)
        for esc in range(4):
            got = pilot.known(esc, now, 20 * MS)
            if got is not None:  # it has just arrived, so the ESC sent it within its timeout
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
        assert max(found.values()) - min(found.values()) <= 30 * MS  # a round is short


def test_ardupilot_notices_immediately_that_a_motor_turns() -> None:
    """The check before take-off needs a speed every 210 ms, and always gets it from a live ESC."""
    bench = Bench(first_index=4).run(3)
    statuses = bench.of("Status")
    assert {(each.payload.esc_index, each.payload.rpm) for each in statuses} == {(4, 6000)}
    assert max(bench.intervals("Status")) < RUNNING_LIFE
