"""The simulated ESC: plausible data, the same bytes for the same seed, the requested faults."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.esc.kontronik.codec import WireLayout
from kontronik_can_gw.esc.kontronik.deframer import Deframer, Frame
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.simulator import (
    FLIGHT,
    Dropout,
    ErrorWindow,
    EscOptions,
    Faults,
    Phase,
    SimulatedEsc,
    SimulatedFrame,
    Swap,
    usual_layout,
)
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
)

pytestmark = pytest.mark.promise("simulated-esc")

S = 1_000_000_000


def received(frames: list[SimulatedFrame]) -> list[Frame]:
    deframer = Deframer()
    wire = b"".join(sent.wire for sent in frames)
    return deframer.feed(wire) + deframer.flush()


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
    layout=st.sampled_from([None, *WireLayout]),
    period_ns=st.integers(1_000_000, 10 * S),
    info_every=st.integers(0, 20),
    profile=st.lists(phases, min_size=1, max_size=6).map(tuple),
)


@given(options=any_options, seed=st.integers())
@settings(max_examples=60, deadline=None)
def test_every_frame_of_any_profile_decodes_to_its_data(options: EscOptions, seed: int) -> None:
    frames = SimulatedEsc(options, seed=seed).frames_until(100 * options.period_ns)
    found = received(frames)
    assert [frame.data for frame in found] == [sent.data for sent in frames]
    layout = options.layout or usual_layout(options.device)
    assert {frame.layout for frame in found} == {layout}


@given(
    cuts=st.lists(st.integers(0, 20 * S), max_size=20),
    seed=st.integers(0, 5),
)
@settings(max_examples=8, deadline=None)
def test_same_seed_gives_same_bytes_for_any_spacing_of_calls(cuts: list[int], seed: int) -> None:
    options = EscOptions(faults=Faults(flipped_bits=0.001, dropout=Dropout(S, 3 * S)))
    esc = SimulatedEsc(options, seed=seed)
    pieces = [esc.frames_until(cut) for cut in [*sorted(cuts), 20 * S]]
    whole = SimulatedEsc(options, seed=seed).frames_until(20 * S)
    assert list(itertools.chain.from_iterable(pieces)) == whole


@pytest.mark.parametrize("device", Device)
def test_flight_is_physically_plausible(device: Device) -> None:
    sent = SimulatedEsc(EscOptions(device=device)).frames_until(101 * S)
    flight = [each.data for each in sent if isinstance(each.data, LiveData)]
    assert all(1800 <= live.battery_voltage <= 2580 for live in flight)
    assert {live.operating_state for live in flight} >= {phase.state for phase in FLIGHT}
    for before, live in itertools.pairwise(flight):
        assert 0 <= live.consumed_charge - before.consumed_charge <= 1
        assert live.peak_current >= before.peak_current
        assert abs(live.power_stage_temperature - before.power_stage_temperature) <= 1
    assert all(live.bec_current == 0 for live in flight) == (device is Device.JIVEPRO)
    amperes = [max(live.battery_current, 0) / 10 for live in flight]
    charge = sum(amperes) * 0.01 / 3.6
    assert flight[-1].consumed_charge == pytest.approx(charge, rel=0.02, abs=2)
    climb = min(flight, key=lambda live: live.battery_voltage)
    assert climb.motor_current >= climb.battery_current > 500
    kind = "battery_current" if device is Device.JIVEPRO else "motor_current"
    held = max(getattr(live, kind) for live in flight)
    assert held <= flight[-1].peak_current <= held * 1.2
    assert flight[-1].electrical_speed == 0  # the peak is held although the motor is at rest


@pytest.mark.parametrize(
    ("layout", "covered"),
    [
        (WireLayout.V4, 36),
        (WireLayout.LEGACY, 32),
    ],
)
def test_receiver_finds_exactly_the_intact_frames(layout: WireLayout, covered: int) -> None:
    """In the legacy layout, frames with flipped bits outside the CRC are found as well."""
    options = EscOptions(layout=layout, faults=Faults(flipped_bits=0.001))
    frames = SimulatedEsc(options).frames_until(60 * S)
    intact = [sent.data for sent in frames if sent.intact]
    assert len(frames) * 0.5 < len(intact) < len(frames)
    same = [sent for sent in frames if sent.wire[:covered] == sent.frame[:covered]]
    found = [frame.data for frame in received(frames)]
    assert len(intact) <= len(found) <= len(same)
    rest = iter(found)
    assert all(data in rest for data in intact)  # in order


def test_requested_error_bits_and_swapped_devices_are_sent() -> None:
    errors = (
        ErrorWindow(OperatingError.UNDERVOLTAGE, 5 * S, 2 * S),
        ErrorWindow(OperatingError.BEC_OVERCURRENT, 6 * S),
        ErrorWindow(SelfTestError.TEST_EEPROM_SIZE, 3 * S, 3 * S),
    )
    swaps = (
        Swap(20 * S, Device.JIVEPRO),
        Swap(30 * S, Device.UHV, WireLayout.LEGACY),
    )
    esc = SimulatedEsc(EscOptions(faults=Faults(errors=errors, swaps=swaps)))
    frames = esc.frames_until(40 * S)
    assert esc.device == Device.UHV
    assert esc.layout == WireLayout.LEGACY
    for sent, frame in zip(frames, received(frames), strict=True):
        at = sent.time_ns / S
        data = sent.data
        assert frame.layout is (WireLayout.V4 if at < 20 else WireLayout.LEGACY)
        if isinstance(data, LiveData):
            others = data.operating_errors & ~(1 << OperatingError.PROGRAMMING_ALLOWED)
            undervoltage = 5 <= at < 7
            overcurrent = at >= 6
            assert others == undervoltage | overcurrent << OperatingError.BEC_OVERCURRENT
        else:
            assert data.device_and_variant >> 10 == device_at(at)
            has_error = 3 <= at < 6
            assert data.selftest_errors == has_error << SelfTestError.TEST_EEPROM_SIZE
    fresh = next(sent.data for sent in frames if sent.time_ns >= 20 * S)
    assert isinstance(fresh, LiveData)
    assert fresh.peak_current == 0
    assert fresh.consumed_charge == 0
    assert fresh.operating_state == OperatingState.Selftest


def device_at(seconds: float) -> Device:
    """Return the device on the line in the test above."""
    if seconds < 20:
        return Device.KOSMIK
    return Device.JIVEPRO if seconds < 30 else Device.UHV
