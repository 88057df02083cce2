"""Telemetry that comes and goes, seen by models of three autopilots: nothing stale is taken for fresh, nothing blocks arming."""

import random
from typing import Any

import pytest
from autopilots import ArduPilot, Betaflight, Px4
from dronecan_bench import LIVE, Bench

from kontronik_can_gw.esc.telemetry import MS, SECOND

TIMEOUT = 250 * MS
"""After which the gateway's value of an ESC is not available (telemetry_timeout_ms)."""


class World:
    """Random flights of several ESCs; ``history``: of each what it sent, (time, motor speed, volts)."""

    def __init__(self, seed: int, escs: int, **table: Any) -> None:
        self.rng = random.Random(seed)
        self.bench = Bench(escs, **table)
        self.bench.live = [None] * escs
        self.history: list[list[tuple[int, int, float]]] = [[] for _ in range(escs)]
        self._taken = 0

    def step(self, *autopilots: ArduPilot | Px4 | Betaflight) -> None:
        """Ten milliseconds: what the ESCs send now, and what the autopilots hear of it."""
        bench, rng = self.bench, self.rng
        for esc, live in enumerate(bench.live):
            if rng.random() < (0.01 if live is not None else 0.02):
                bench.live[esc] = LIVE if live is None else None
            if (live := bench.live[esc]) is not None:
                speed, volts = 7 * rng.randrange(3000), rng.randrange(1600, 6000)
                bench.live[esc] = live._replace(electrical_speed=speed, battery_voltage=volts)
                self.history[esc].append((bench.now + 10 * MS, speed // 7, volts / 100))
        bench.run(0.01)
        for transfer in bench.read[self._taken :]:
            for autopilot in autopilots:
                autopilot.take(transfer)
        self._taken = len(bench.read)

    def newest(self, esc: int) -> int:
        """When this ESC was heard last."""
        return self.history[esc][-1][0] if self.history[esc] else -(1 << 60)

    def sent(self, esc: int, since: int) -> list[tuple[int, int, float]]:
        return [entry for entry in self.history[esc][-200:] if entry[0] >= since]


@pytest.mark.parametrize("seed", range(3))
def test_ardupilot_takes_nothing_stale_for_fresh_and_arms(seed: int) -> None:
    world, pilot = World(seed, 2), ArduPilot()
    seen = 0
    for _ in range(1500):
        world.step(pilot)
        now = world.bench.now
        assert not pilot.refuses_to_arm(now)
        for esc in (0, 1):
            rpm, volts = pilot.rpm(esc, now), pilot.volts(esc, now)
            last = pilot.speeds.get(esc)
            if last is not None and now - last[0] < 20 * MS:
                # it has come just now: the ESC said so within its time-out
                known = world.sent(esc, last[0] - TIMEOUT)
                assert last[1] in [speed for _, speed, _ in known]
                assert any(volts == pytest.approx(said, abs=0.016) for _, _, said in known)
                seen += 1
            if now - world.newest(esc) >= TIMEOUT + ArduPilot.RPM_NS:
                assert rpm is None
            if now - world.newest(esc) >= TIMEOUT + ArduPilot.RUNNING_NS:
                assert not pilot.runs(esc, now)
            if now - world.newest(esc) >= TIMEOUT + ArduPilot.TELEMETRY_NS:
                assert volts is None
    assert seen > 500


def test_ardupilot_knows_at_once_that_a_motor_turns() -> None:
    """The check before a take-off wants a speed at least each 210 ms; it never misses one while the ESC is heard."""
    bench, pilot = Bench(), ArduPilot(offset=4)
    bench.run(0.1)
    for _ in range(300):
        bench.run(0.01)
        while bench.read:
            pilot.take(bench.read.pop(0))
        assert pilot.runs(4, bench.now)


@pytest.mark.parametrize("seed", range(2))
def test_px4_has_all_escs_in_each_round_and_only_those_that_are_heard(seed: int) -> None:
    world, pilot = World(seed, 4), Px4()
    for _ in range(1000):
        world.step(pilot)
        now = world.bench.now
        heard = {esc for esc in range(4) if now - world.newest(esc) < TIMEOUT - 30 * MS}
        alive = {esc for esc in range(4) if now - world.newest(esc) < TIMEOUT + 1200 * MS}
        settled = {esc for esc in heard if len(world.sent(esc, now - TIMEOUT)) >= 5}
        assert settled <= pilot.online(now) <= alive
        assert not pilot.failures
    whole = [found for found in pilot.rounds if len(found) == 4]
    assert len(whole) > 100
    for found in pilot.rounds:
        assert max(found.values()) - min(found.values()) <= 30 * MS  # a round is one moment


def test_betaflight_is_right_with_electrical_speed() -> None:
    world, pilot = World(5, 1, rpm="electrical"), Betaflight(pole_pairs=7)
    seen = 0
    for _ in range(1500):
        world.step(pilot)
        now = world.bench.now
        rpm = pilot.motor_rpm(0, now)
        if now - world.newest(0) >= TIMEOUT + SECOND:
            assert rpm is None
        if rpm is not None:
            seen += 1
            assert rpm in [speed for _, speed, _ in world.sent(0, now - SECOND - TIMEOUT)]
            assert pilot.celsius(0) in (29, 30)
    assert seen > 300
