"""EscStream: link, freshness, derived values, deadlines. All frames are synthetic.

The golden flights (tests/golden) test losses, frame rate, and the change of a device or layout.
"""

import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from esc.reference import SHORTEST_FIRST, fits
from esc.streams import decoded, form_of, random_stream
from kontronik_can_gw.core.esc_stream import EscStream
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import Data, InfoData, LiveData, device_and_variant
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, SimulatedEsc
from kontronik_can_gw.esc.kontronik.states import Device
from kontronik_can_gw.esc.telemetry import INFO_TIMEOUT_NS, EscSettings, Event, LinkState
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("ages")

NS_PER_BYTE = KONTRONIK.byte_ns

TIMEOUT = 250 * MS
LIVE = LiveData(
    electrical_speed=21_000,
    battery_voltage=2400,
    battery_current=100,
    operating_state=21,
)
BAD = bytearray(encode(LIVE, WireLayout.V4))
BAD[10] ^= 1
BROKEN = bytes(BAD)
"""A frame whose CRC fails."""
NOISE = b"\x55" * 20


def live(speed: int = 21_000, layout: WireLayout = WireLayout.V4) -> bytes:
    return encode(LIVE._replace(electrical_speed=speed), layout)


def info() -> bytes:
    known = device_and_variant(Device.KOSMIK, 120)
    return encode(InfoData(device_and_variant=known, cell_count=6), WireLayout.V4)


def esc(timeout_ns: int = TIMEOUT) -> EscStream:
    return EscStream(EscSettings(timeout_ns=timeout_ns), 0)


def read(
    telemetry: EscStream,
    data: bytes,
    now: int,
    since: int | None = None,
) -> int:
    """Pass bytes that arrived after ``since``, by default just now. Return all events."""
    if since is None:
        since = now
    events = telemetry.expire(now)
    for changes in telemetry.receive_each(data, now, since):
        events |= changes
    return events


def alive(now: int = SECOND) -> EscStream:
    """Return an ESC whose first live frame was read at ``now``."""
    telemetry = esc()
    read(telemetry, live(), now)
    return telemetry


def stream(
    telemetry: EscStream,
    begin: int,
    seconds: float,
    extra: bytes = b"",
) -> int:
    """Pass a frame every 10 ms, and call ``advance`` at each deadline. Return the last time."""
    now = begin
    while now < begin + seconds * SECOND:
        while telemetry.next_deadline() <= now:
            telemetry.advance(max(telemetry.next_deadline(), 0))
        read(telemetry, extra + live(), now)
        now += 10 * MS
    return now - 10 * MS


# --- link states


@pytest.mark.promise("link-state")
@pytest.mark.parametrize(
    ("broken", "noise", "state"),
    [
        (4, 0, LinkState.OK),
        (5, 0, LinkState.DEGRADED),
        (0, 4, LinkState.OK),  # 9 % of the bytes
        (0, 5, LinkState.DEGRADED),  # 11 % of the bytes
    ],
)
def test_bad_second_degrades_the_link_and_clean_second_restores_it(
    broken: int,
    noise: int,
    state: LinkState,
) -> None:
    telemetry = alive(SECOND)
    for n in range(broken):
        read(telemetry, BROKEN + live(), SECOND + (n + 1) * 10 * MS)
    now = stream(telemetry, SECOND + 60 * MS, 1.1, extra=b"\x55" * noise)
    assert telemetry.link == state
    stream(telemetry, now + 10 * MS, 2.2)
    link: LinkState = telemetry.link
    assert link == LinkState.OK


@pytest.mark.promise("link-state")
@pytest.mark.parametrize("seen", [False, True])
def test_lost_port_is_an_error_until_it_is_reopened(seen: bool) -> None:
    """Bytes from before and after the loss do not form a frame."""
    telemetry = esc()
    if seen:
        read(telemetry, info() + live(), SECOND)
    read(telemetry, live()[:30], SECOND)
    events = telemetry.port_lost()
    assert events & Event.LINK
    assert bool(events & Event.LIVE) is seen
    assert telemetry.live is None
    assert telemetry.info is None
    telemetry.advance(3 * SECOND)
    assert telemetry.port_lost() == Event.NONE
    states = [telemetry.link]
    assert telemetry.port_opened() == Event.LINK
    for data in (live()[30:], live()):
        states.append(telemetry.link)
        assert telemetry.live is None
        read(telemetry, data, 4 * SECOND)
    lost = [LinkState.LOST] * 2 if seen else [LinkState.NEVER_SEEN, LinkState.SEARCHING]
    assert [*states, telemetry.link] == [LinkState.PORT_ERROR, *lost, LinkState.OK]


# --- freshness


@pytest.mark.parametrize(
    ("gap", "taken"),
    [
        (TIMEOUT, True),
        (TIMEOUT + 1, False),
    ],
)
def test_frame_with_a_first_byte_older_than_the_time_out_is_dropped(gap: int, taken: bool) -> None:
    telemetry = esc()
    frame = live()
    read(telemetry, NOISE + frame[:1], SECOND)
    read(telemetry, frame[1:], SECOND + gap)
    assert (telemetry.live is not None) is taken
    read(telemetry, live(3), SECOND + gap + 10 * MS)
    assert telemetry.live is not None
    assert telemetry.live.electrical_speed == 3


def test_frames_in_old_bytes_are_counted_as_late_and_not_shown() -> None:
    telemetry = esc(timeout_ns=100 * MS)
    # The frame is complete, but the header before it could still begin a frame of 44 bytes.
    hidden = b"KODI" + live(5, WireLayout.LEGACY)
    read(telemetry, hidden, SECOND)
    assert telemetry.live is None
    read(telemetry, b"", SECOND + 100 * MS + 1)
    assert telemetry.live is None
    assert telemetry.late_frames == 1


def test_bytes_of_one_read_get_their_times_on_the_wire() -> None:
    telemetry = esc()
    read(telemetry, live(1) + live(2) + live(3) + NOISE, SECOND)
    assert telemetry.live is not None
    assert telemetry.live.electrical_speed == 3
    assert telemetry.live_ns == SECOND - 20 * NS_PER_BYTE
    assert telemetry.run_time_ns == 2 * 40 * NS_PER_BYTE
    assert telemetry.energy_mw_ns == 2 * 40 * NS_PER_BYTE * 2400 * 100


# --- arrival of bytes

WIRE = 39 * NS_PER_BYTE
"""Time from the first byte of a live frame to its last."""


@pytest.mark.parametrize(
    "known",
    [
        False,
        True,
    ],
    ids=["interval not known yet", "100 Hz"],
)
@pytest.mark.parametrize(
    "noise",
    [
        0,
        1,
    ],
    ids=["a frame alone", "with another byte"],
)
@pytest.mark.parametrize(
    ("waited", "bound", "shown"),
    # Time since the port was empty, since the earliest end of the frame, and age shown if the
    # interval is known.
    [
        (0, 0, 0),
        (2 * MS, 0, 0),
        (WIRE, 0, 0),
        (10 * MS + WIRE, 10 * MS, 0),
        (10 * MS + WIRE + 1, 10 * MS + 1, 10 * MS + 1),
        (TIMEOUT + WIRE, TIMEOUT, TIMEOUT),
        (TIMEOUT + WIRE + 1, None, None),
    ],
)
def test_time_outs_and_old_ages_count_from_the_earliest_arrival(
    known: bool,
    noise: int,
    waited: int,
    bound: int | None,
    shown: int | None,
) -> None:
    telemetry = esc()
    now = TIMEOUT + (stream(telemetry, SECOND, 2.5) if known else SECOND)
    data = bytes(noise) + live(5)
    since = now - waited - noise * NS_PER_BYTE
    read(telemetry, data, now, since)
    if bound is None or shown is None:
        assert telemetry.live is None or telemetry.live.electrical_speed != 5
        assert telemetry.late_frames == 1
        return
    assert telemetry.live is not None
    assert telemetry.live.electrical_speed == 5
    assert now - telemetry.live_bound_ns == bound
    assert telemetry.live_ns == now - (shown if known else bound)
    telemetry.advance(now - bound + TIMEOUT)
    assert telemetry.live is not None
    telemetry.advance(now - bound + TIMEOUT + 1)
    assert telemetry.live is None


def test_info_frame_is_late_after_its_own_time_out() -> None:
    telemetry = alive()
    length = (len(info()) - 1) * NS_PER_BYTE
    since = 30 * SECOND - INFO_TIMEOUT_NS
    read(telemetry, info(), 30 * SECOND, since)
    assert telemetry.info_bound_ns == since + length
    assert telemetry.last_info_ns == since + length
    since = 60 * SECOND - INFO_TIMEOUT_NS - SECOND
    read(telemetry, info(), 60 * SECOND, since)
    assert telemetry.info is None
    assert telemetry.late_frames == 1


# --- derived values


@pytest.mark.promise("round-once")
@pytest.mark.promise("energy")
def test_energy_and_run_time_agree_with_an_independent_integration() -> None:
    telemetry = esc()
    watt_seconds = 0.0
    run_seconds = 0.0
    sent = SimulatedEsc(EscOptions(info_every=0), seed=3).frames_until(60 * SECOND)
    for before, after in pairwise(sent):
        data = before.data
        seconds = (after.time_ns - before.time_ns) / 1e9
        assert isinstance(data, LiveData)
        volts = data.battery_voltage / 100
        amperes = data.battery_current / 10
        watt_seconds += max(0.0, volts * amperes) * seconds  # regeneration is not subtracted
        if data.electrical_speed:
            run_seconds += seconds
    for each in sent:
        read(telemetry, each.wire, SECOND + each.time_ns)
    assert telemetry.energy_mw_ns / 1e12 == pytest.approx(watt_seconds, rel=1e-9)
    assert telemetry.run_time_ns / 1e9 == pytest.approx(run_seconds, rel=1e-9)
    assert watt_seconds > 10_000
    assert 30 < run_seconds < 50


@pytest.mark.promise("energy")
def test_energy_does_not_count_in_a_gap_and_survives_a_loss() -> None:
    telemetry = alive(SECOND)
    read(telemetry, live(), SECOND + 100 * MS)
    kept = telemetry.energy_mw_ns
    assert kept == 2400 * 100 * 100 * MS
    read(telemetry, live(), 20 * SECOND)
    assert telemetry.energy_mw_ns == kept
    assert telemetry.run_time_ns == 100 * MS
    telemetry.port_lost()
    telemetry.port_opened()
    read(telemetry, live(), 20 * SECOND + 10 * MS)
    assert telemetry.energy_mw_ns == kept
    assert telemetry.run_time_ns == 100 * MS


# --- deadlines


GAPS = (0, 1, MS, 10 * MS, TIMEOUT - 1, TIMEOUT, TIMEOUT + 1)


def chunks_of(seed: int) -> list[tuple[bytes, int]]:
    """Return chunks of bytes with the times of their reads.

    They contain frames of both layouts, damaged frames and noise, with gaps of all sizes.
    """
    source = random.Random(seed)
    out = random_stream(source, source.randrange(1, 20))
    cuts = sorted(source.choices(range(len(out) + 1), k=source.randrange(40)))
    now = source.randrange(SECOND)
    timed = []
    for begin, end in pairwise([0, *cuts, len(out)]):
        now += source.choice([*GAPS, source.randrange(3 * SECOND)])
        timed.append((out[begin:end], now))
    return timed


def fresh_frames(timed: list[tuple[bytes, int]], now: int) -> list[Data]:
    """Return the live frames that may be shown at ``now``, by brute force.

    All bytes of such a frame were read within the timeout before its last byte, and that byte was
    read within the timeout before ``now``.
    """
    whole = b"".join(piece for piece, _ in timed)
    read_at = [when for piece, when in timed for _ in piece]
    found = []
    for at in range(len(whole)):
        fitting = [row for row in SHORTEST_FIRST if fits(whole, at, row)]
        if not fitting or fitting[0].kind != "live":
            continue
        row = fitting[0]
        first = read_at[at]
        last = read_at[at + row.length - 1]
        if last - first <= TIMEOUT and now - last <= TIMEOUT:
            found.append(decoded(form_of(row), whole, at))
    return found


@settings(max_examples=75, deadline=None)
@given(st.integers(0, 2**32), st.booleans())
def test_shown_data_was_received_within_the_time_out(seed: int, advance: bool) -> None:
    telemetry = esc()
    timed = chunks_of(seed)
    for n, (piece, now) in enumerate(timed):
        if advance:
            telemetry.advance(now)
        read(telemetry, piece, now)
        if telemetry.live is not None:
            assert telemetry.live in fresh_frames(timed[: n + 1], now)
            assert telemetry.live_ns is not None
            assert 0 <= now - telemetry.live_ns <= TIMEOUT
        later = now + random.Random(seed + n).randrange(TIMEOUT * 2)
        if n + 1 == len(timed) or later <= timed[n + 1][1]:
            telemetry.advance(later)
            if telemetry.live is not None:
                assert telemetry.live in fresh_frames(timed[: n + 1], later)
        assert telemetry.up is (telemetry.link in (LinkState.OK, LinkState.DEGRADED))


@settings(max_examples=75, deadline=None)
@given(st.integers(0, 2**32))
def test_next_deadline_is_never_late_and_nothing_expires_before_it(seed: int) -> None:
    """An EscStream advanced only at its deadlines equals one that is advanced all the time."""
    seldom = esc()
    often = esc()
    source = random.Random(seed)

    def same() -> None:
        assert seldom.live == often.live
        assert seldom.info == often.info
        assert seldom.link == often.link

    for piece, now in chunks_of(seed):
        due = seldom.next_deadline()
        while due <= now:
            seldom.advance(due)
            assert seldom.next_deadline() > due
            often.advance(due)
            same()
            due = seldom.next_deadline()
        read(seldom, piece, now)
        read(often, piece, now)
        often.advance(now)
        seldom.advance(now)
        assert seldom.next_deadline() > now
        between = source.randrange(now, seldom.next_deadline())
        often.advance(between)
        same()
        if between > now:
            break  # otherwise time would run backwards for one of them
