"""Live frames as a read mostly brings them: one, whole and alone."""

import pytest

from esc.reference import ambiguous
from kontronik_can_gw.esc.kontronik import Layout, LiveData, encode
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscSettings, EscStream, Event

NS_PER_BYTE = KONTRONIK.byte_ns

STEP = 10 * MS
FLIGHT = [
    LiveData(
        electrical_speed=20_000, battery_voltage=2400, battery_current=100, operating_state=21
    ),
    # regeneration: drawn is nothing
    LiveData(electrical_speed=20_000, battery_voltage=2300, battery_current=-50),
    LiveData(
        electrical_speed=0, battery_voltage=2410, battery_current=7, bec_current=1200, throttle=-100
    ),
    LiveData(
        electrical_speed=1, battery_voltage=2390, battery_current=300, operating_errors=1 << 31
    ),
    LiveData(),
]


def read(telemetry: EscStream, data: bytes, now: int) -> list[int]:
    """As the gateway gives what it has read; the events of each frame."""
    return list(telemetry.receive_each(data, now, now))


def started() -> tuple[EscStream, int]:
    telemetry = EscStream(EscSettings(), 0)
    read(telemetry, encode(LiveData(), Layout.V4), SECOND)
    return telemetry, SECOND


def test_values_counters_energy_and_run_time() -> None:
    telemetry, now = started()
    length = len(encode(LiveData(), Layout.V4))
    energy = run_time = 0
    before = LiveData()
    for number, data in enumerate(FLIGHT * 20, 1):
        now += STEP
        energy += max(0, before.battery_voltage * before.battery_current) * STEP
        run_time += STEP if before.electrical_speed else 0
        assert read(telemetry, encode(data, Layout.V4), now) == [Event.LIVE]
        assert (telemetry.live, telemetry.last_live) == (data, data)
        assert telemetry.live_ns == now
        assert telemetry.drawn.energy_mw_ns == energy
        assert telemetry.drawn.run_time == run_time
        counters = telemetry.decoder.counters
        assert counters.live_v4 == counters.headers == 1 + number
        assert counters.bytes == (1 + number) * length
        assert counters.pending == counters.dropped_bytes == 0
        before = data


def test_no_energy_while_time_stands_still_or_goes_back() -> None:
    telemetry, now = started()
    frame = encode(FLIGHT[0], Layout.V4)
    read(telemetry, frame, now + STEP)
    energy, run_time = telemetry.drawn.energy, telemetry.drawn.run_time
    assert read(telemetry, frame, now + STEP) == [Event.LIVE]
    assert read(telemetry, frame, now) == [Event.LIVE]
    assert (telemetry.drawn.energy, telemetry.drawn.run_time, telemetry.live_ns) == (
        energy,
        run_time,
        now + STEP,
    )


def test_frames_between_damage_are_at_their_places() -> None:
    """What is found after damage is dropped for the right reason, and nothing of it is counted twice."""
    telemetry, now = started()
    frame = encode(FLIGHT[0], Layout.V4)
    broken = frame[:10] + bytes((frame[10] ^ 1,)) + frame[11:]
    for data in (broken, frame, frame, b"\x55" * 7, frame, frame[:20], frame[20:], frame):
        now += STEP
        read(telemetry, data, now)
    counters = telemetry.decoder.counters
    assert counters.bytes == counters.dropped_bytes + (1 + 5) * len(frame)
    assert (counters.live, counters.crc_errors, counters.headers) == (6, 1, 7)
    assert (counters.dropped_crc, counters.dropped_noise) == (len(broken), 7)
    assert telemetry.live == FLIGHT[0]
    assert telemetry.live_ns == now


@pytest.mark.parametrize("behind", [0, 1, 7, 100])
def test_bytes_behind_a_frame_make_it_as_much_older_whatever_came_before(behind: int) -> None:
    telemetry, now = started()
    for _ in range(9):
        now += STEP
        read(telemetry, FRAME, now)
    now += STEP
    read(telemetry, FRAME + b"\x55" * behind, now)
    assert telemetry.live_ns == now - behind * NS_PER_BYTE
    assert telemetry.late_frames == 0


FRAME = encode(FLIGHT[0], Layout.V4)


def test_where_two_layouts_match_it_is_the_shorter() -> None:
    telemetry, now = started()
    read(telemetry, ambiguous("live"), now + STEP)
    assert (telemetry.decoder.counters.live_v4, telemetry.decoder.counters.live_legacy) == (1, 1)
