"""The Rust crate ``dronecan`` reads our transfers and their values.

tests/foreign/install.sh builds it.
"""

import math
import random
import subprocess

import dronecan_bench
import pytest
from dronecan_bench import LIVE, Bench
from foreign_tools import PACKAGES, need

READER = PACKAGES / "dronecan_reader" / "release" / "dronecan-reader"
protocol = dronecan_bench.dronecan.uavcan.protocol

pytestmark = [
    pytest.mark.promise("dronecan"),
    pytest.mark.extended,
]


def test_crate_reads_the_same_transfers_as_the_package() -> None:
    need(READER.exists(), "dronecan-reader")
    rng = random.Random(3)
    bench = Bench(4, extended_hz=10)
    for turn in range(100):
        for esc in range(4):
            bench.live[esc] = LIVE._replace(
                electrical_speed=rng.randrange(700_000),
                battery_voltage=rng.randrange(6000),
                battery_current=rng.randrange(-1000, 3000),
                power_stage_temperature=rng.randrange(-20, 120),
                output_opening=rng.randrange(101),
                operating_errors=1 << turn % 20,
            )
        bench.run(0.1)
    requests = [protocol.param.GetSet.Request(index=number) for number in range(16)]
    for request in (protocol.GetNodeInfo.Request(), *requests):
        assert bench.ask(request) is not None
    lines = "".join(f"{f.can_id:X}#{f.data.hex()}\n" for _, f in bench.frames if f.extended)
    done = subprocess.run(
        [READER],
        input=lines,
        capture_output=True,
        text=True,
        check=True,
    )
    found = [line.split() for line in done.stdout.splitlines()]
    assert not [each for each in found if each[0] == "error"]
    assert len(found) == len(bench.read) + 17
    assert {each[4] for each in found} == {"true"}  # each CRC is right
    assert {(each[0], each[2]) for each in found} == {("message", "42"), ("response", "42")}
    assert sum(each[0] == "response" for each in found) == 17
    statuses = [each[6:] for each in found if each[:2] == ["message", "1034"]]
    read = [each.payload for each in bench.of("Status")]
    assert len(statuses) == len(read) > 1900
    for (wrong, *floats, speed, share, place), theirs in zip(statuses, read, strict=True):
        assert int(wrong) == theirs.error_count
        assert int(speed) == theirs.rpm
        assert int(share) == theirs.power_rating_pct
        assert int(place) == theirs.esc_index
        assert [*map(float, floats)] == [theirs.voltage, theirs.current, theirs.temperature]
        assert not any(map(math.isnan, map(float, floats)))
