"""The simulated ESC: what it sends is well-formed and plausible, the same for the same seed, and as faulty as asked for."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.esc.kontronik import (
    Deframer,
    Device,
    Frame,
    Layout,
    LiveData,
    OperatingError,
    OperatingState,
    SelfTestError,
)
from kontronik_can_gw.esc.kontronik.simulator import (
    FLIGHT,
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    Phase,
    Sent,
    SimulatedEsc,
    Swap,
    usual_layout,
)

S = 1_000_000_000


def sends(seconds: float, options: EscOptions | None = None, seed: int = 0) -> list[Sent]:
    return SimulatedEsc(options, seed=seed).frames_until(round(seconds * S) - 1)


def received(frames: list[Sent]) -> list[Frame]:
    deframer = Deframer()
    return deframer.feed(b"".join(sent.wire for sent in frames)) + deframer.flush()


def lives(frames: list[Sent]) -> list[LiveData]:
    return [sent.data for sent in frames if isinstance(sent.data, LiveData)]


phases = st.builds(
    Phase,
    st.just("any"),
    st.floats(0.001, 50),
    st.integers(-100, 100),
    st.sampled_from(OperatingState),
    st.floats(0, 20),
)
any_options = st.builds(
    EscOptions,
    device=st.sampled_from(Device),
    layout=st.sampled_from([None, *Layout]),
    period_ns=st.integers(1_000_000, 10 * S),
    info_every=st.integers(0, 20),
    profile=st.lists(phases, min_size=1, max_size=6).map(tuple),
)


@given(options=any_options, seed=st.integers())
@settings(max_examples=60, deadline=None)
def test_whatever_the_profile_every_frame_decodes_to_what_was_meant(
    options: EscOptions, seed: int
) -> None:
    esc = SimulatedEsc(options, seed=seed)
    frames = esc.frames_until(100 * options.period_ns)
    assert all(sent.intact and sent.wire == sent.frame for sent in frames)
    assert [frame.data for frame in received(frames)] == [sent.data for sent in frames]
    layout = options.layout or usual_layout(options.device)
    assert {frame.layout for frame in received(frames)} == {layout}


@given(cuts=st.lists(st.integers(0, 20 * S), max_size=20), seed=st.integers(0, 5))
@settings(max_examples=8, deadline=None)
def test_the_same_seed_gives_the_same_bytes_however_the_calls_are_spaced(
    cuts: list[int], seed: int
) -> None:
    faults = Faults(flipped_bits=0.001, dropout=Dropout(S, 3 * S))
    options = EscOptions(faults=faults)
    esc = SimulatedEsc(options, seed=seed)
    pieces = [esc.frames_until(cut) for cut in [*sorted(cuts), 20 * S]]
    whole = SimulatedEsc(options, seed=seed).frames_until(20 * S)
    assert [*itertools.chain.from_iterable(pieces)] == whole


@pytest.mark.parametrize("device", Device)
def test_the_flight_is_physically_plausible(device: Device) -> None:
    flight = lives(sends(101, EscOptions(device=device)))
    ranges = {"battery_voltage": (1800, 2580), "throttle": (-100, 100), "output_opening": (0, 100)}
    ranges |= {"pwm_input": (900, 2000), "power_stage_temperature": (15, 90)}
    for name, (low, high) in ranges.items():
        assert all(low <= getattr(live, name) <= high for live in flight), name
    assert {live.operating_state for live in flight} >= {phase.state for phase in FLIGHT}
    for before, live in itertools.pairwise(flight):
        assert 0 <= live.consumed_charge - before.consumed_charge <= 1
        assert live.peak_current >= before.peak_current
        assert abs(live.power_stage_temperature - before.power_stage_temperature) <= 1
    assert all(live.bec_current == 0 for live in flight) == (device is Device.JIVEPRO)
    charge = sum(max(live.battery_current, 0) / 10 * 0.01 / 3.6 for live in flight)
    assert flight[-1].consumed_charge == pytest.approx(charge, rel=0.02, abs=2)
    climb = min(flight, key=lambda live: live.battery_voltage)
    assert climb.battery_voltage < flight[250].battery_voltage - 50
    assert climb.motor_current >= climb.battery_current > 500
    kind = "battery_current" if device is Device.JIVEPRO else "motor_current"
    held = max(getattr(live, kind) for live in flight)
    assert held <= flight[-1].peak_current <= held * 1.2
    assert flight[-1].electrical_speed == 0  # the peak is held though the motor stands


@pytest.mark.parametrize("layout", Layout)
def test_a_receiver_finds_exactly_the_intact_frames_among_the_spoiled(layout: Layout) -> None:
    """In the legacy layout, besides, those with flips that its CRC does not cover."""
    faults = Faults(flipped_bits=0.001)
    frames = sends(60, EscOptions(layout=layout, faults=faults))
    intact = [sent.data for sent in frames if sent.intact]
    assert len(frames) * 0.5 < len(intact) < len(frames)
    found = [frame.data for frame in received(frames)]
    covered = 36 if layout is Layout.V4 else 32
    spoiled = [sent for sent in frames if not sent.intact]
    same = [s for s in spoiled if s.wire[-len(s.frame) :][:covered] == s.frame[:covered]]
    assert len(intact) <= len(found) <= len(intact) + len(same)
    rest = iter(found)
    assert all(data in rest for data in intact)  # in order


def test_error_bits_are_set_when_asked_and_another_device_powers_up_in_its_own_layout() -> None:
    errors = (
        ErrorWindow(OperatingError.UNDERVOLTAGE, 5 * S, 2 * S),
        ErrorWindow(OperatingError.BEC_OVERCURRENT, 6 * S),
        ErrorWindow(SelfTestError.TEST_EEPROM_SIZE, 3 * S, 3 * S),
    )
    swaps = (Swap(20 * S, Device.JIVEPRO), Swap(30 * S, Device.UHV, Layout.LEGACY))
    esc = SimulatedEsc(EscOptions(faults=Faults(errors=errors, swaps=swaps)))
    frames = esc.frames_until(40 * S)
    assert (esc.device, esc.layout) == (Device.UHV, Layout.LEGACY)
    asked = ~(1 << OperatingError.PROGRAMMING_ALLOWED)
    for sent, frame in zip(frames, received(frames), strict=True):
        at = sent.time_ns / S
        assert frame.layout is (Layout.V4 if at < 20 else Layout.LEGACY)
        if isinstance(sent.data, LiveData):
            expected = (1 if 5 <= at < 7 else 0) | (1 << 8 if at >= 6 else 0)
            assert sent.data.operating_errors & asked == expected
        else:
            device = Device.KOSMIK if at < 20 else Device.JIVEPRO if at < 30 else Device.UHV
            assert sent.data.device_and_variant >> 10 == device
            assert sent.data.selftest_errors == (1 << 17 if 3 <= at < 6 else 0)
    fresh = next(sent.data for sent in frames if sent.time_ns >= 20 * S)
    assert isinstance(fresh, LiveData)
    assert (fresh.peak_current, fresh.consumed_charge) == (0, 0)
    assert fresh.operating_state == OperatingState.Selftest
