"""The value that a signal carries: by its name, by ``[dbc.bind]``, a constant, a counter or a CRC.

Enumerations and their codes are tested here too.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from dbc_bench import compiled, gateway_with, packed, refused
from e2e import p01
from packer_oracle import Msg, Sig, dbc_text, get

from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.names import Binder
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.times import MS

pytestmark = pytest.mark.promise("binding")

LIVE = LiveData(
    electrical_speed=70_000,
    battery_voltage=4442,
    battery_current=-123,
    bec_current=1500,
    throttle=-7,
    power_stage_temperature=-13,
    operating_errors=0b1010_0000,
    operating_state=21,
)


def layout_of(
    messages: Sequence[Msg], names: Sequence[str] = ("esc1",), **more: Any
) -> MessageLayout:
    return compiled(dbc_text(messages), names, **more)


def raw_of(signal: Sig, bind: str | float | None = None, live: LiveData = LIVE) -> int:
    """Return the raw value of a signal that is alone in its message."""
    message = Msg("M", 0x100, 20, [replace(signal, start=8)])
    bindings = {} if bind is None else {f"M.{signal.name}": bind}
    layout = layout_of([message], bind=bindings)
    data = packed(layout.messages[0], gateway_with(layout, live))
    return get(data, 8, signal.length, True, signal.signed)


def float_of(signal: Sig, bind: float | None = None, live: LiveData = LIVE) -> float:
    """Return the number in a float that is alone in its message, without factor and offset."""
    as_float = replace(signal, signed=True, is_float=True)
    raw = raw_of(as_float, bind, live) % (1 << signal.length)
    data = raw.to_bytes(signal.length // 8, "little")
    (number,) = struct.unpack("<f" if signal.length == 32 else "<d", data)
    return float(number)


# --- names


def test_longer_prefix_wins_over_a_shorter_one_and_a_source_over_a_prefix() -> None:
    binder = Binder([EscSettings("left"), EscSettings("left_rear"), EscSettings("l")], {})
    found = binder.by_name("LeftRearBatteryVoltage")
    assert found is not None
    assert found[1] == 1
    found = Binder([EscSettings("max")], {}).by_name("MaxBatteryVoltage")
    assert found is not None
    assert found[0].name == "max_battery_voltage"


# --- [dbc.bind]


def test_binding_overrides_the_name_of_the_signal() -> None:
    throttle = Sig("Throttle", 0, 16, unit="V", factor="0.01")
    assert raw_of(throttle, "battery_voltage") == 4442


def test_binding_with_the_message_overrides_one_of_the_signal_alone() -> None:
    voltage = Sig("U", 0, 16)
    messages = [
        Msg("A", 1, 8, [voltage]),
        Msg("B", 2, 8, [voltage]),
    ]
    bind = {"U": "battery_voltage", "B.U": "operating_state_raw"}
    plans = layout_of(messages, bind=bind).messages
    sources = [plan.signals[0].source for plan in plans]
    names = [source.name for source in sources if source]
    assert names == ["battery_voltage", "operating_state_raw"]


def test_bindings_of_a_one_esc_layout_apply_to_every_esc() -> None:
    voltage = Sig("U", 0, 16, unit="V", factor="0.01")
    constant = Sig("Id", 16, 8)
    uptime = Sig("Up", 24, 32, unit="s")
    message = Msg("Power", 0x100, 8, [voltage, constant, uptime])
    for key in ("U", "Power.U"):
        bind = {key: "battery_voltage", "Id": 7, "Up": "uptime"}
        layout = layout_of([message], ("esc1", "esc2"), bind=bind)
        gateway = gateway_with(layout, LIVE, LIVE._replace(battery_voltage=1))
        frames = {plan.can_id: packed(plan, gateway)[:3] for plan in layout.messages}
        assert frames == {
            0x100: struct.pack("<HB", 4442, 7),
            0x101: struct.pack("<HB", 1, 7),
        }


@pytest.mark.parametrize(
    ("signal", "constant", "raw"),
    [
        (Sig("X", 0, 8), 255, 255),
        (Sig("X", 0, 8), 0, 0),
        (Sig("X", 0, 8, signed=True), -128, -128),
        (Sig("X", 0, 8, signed=True), 127, 127),
        (Sig("X", 0, 16, factor="0.1", offset="-40"), 12.3, 523),
        (Sig("X", 0, 8, factor="-1"), -200, 200),
        (Sig("X", 0, 64), (1 << 64) - 1, (1 << 64) - 1),
        (Sig("X", 0, 8, minimum="0", maximum="10"), 255, 255),
    ],
)
def test_constant_is_sent_as_its_physical_value(signal: Sig, constant: float, raw: int) -> None:
    assert raw_of(signal, constant) == raw


@pytest.mark.parametrize("length", [32, 64])
def test_constant_in_a_float_is_sent_as_a_float(length: int) -> None:
    assert float_of(Sig("X", 0, length, factor="0.5"), -3) == -6.0


# --- codes


def test_enumeration_in_a_float_is_sent_by_its_value_table_or_as_nan() -> None:
    state = Sig("OperatingState", 0, 32, texts={5: "Forward"})
    assert float_of(state) == 5.0
    other = LIVE._replace(operating_state=1)
    assert math.isnan(float_of(state, live=other))


@pytest.mark.parametrize(
    ("maximum", "is_sent"), [("1", False), ("44.4", False), ("44.5", True), ("0", True)]
)
def test_float_beyond_its_limits_is_nan(maximum: str, is_sent: bool) -> None:
    number = float_of(Sig("BatteryVoltage", 0, 32, unit="V", maximum=maximum))
    if is_sent:
        assert number == pytest.approx(44.42)
    else:
        assert math.isnan(number)


@pytest.mark.promise("codes")
@pytest.mark.parametrize(
    "text", ["NotAvailable", "SNA", "sna", "N_A", "SignalNotAvailable", "not_available"]
)
def test_code_for_not_available_is_found_by_its_usual_names(text: str) -> None:
    signal = Sig("MaxBatteryVoltage", 0, 8, texts={9: text})  # an info value, not yet received
    assert raw_of(signal) == 9


@pytest.mark.promise("codes")
@pytest.mark.parametrize("text", ["Error", "ERR", "Invalid"])
def test_code_for_an_error_is_found_by_its_usual_names(text: str) -> None:
    signal = Sig("BatteryVoltage", 0, 8, unit="mV", texts={9: text})
    assert raw_of(signal) == 9


@pytest.mark.parametrize(("first_code", "sent"), [(7, [6, 0, 1]), (2, [0, 1, 0])])
def test_counter_restarts_at_0_before_the_first_code(first_code: int, sent: list[int]) -> None:
    signal = Sig("LiveFrames", 0, 8, texts={first_code: "Error"})
    layout = layout_of([Msg("M", 0x100, 1, [signal])])
    read: list[int] = []
    for count in (6, 7, 8):
        gateway = gateway_with(layout)
        for _ in range(count):
            gateway.receive_bytes(0, encode(LIVE, WireLayout.V4), 50 * MS, 50 * MS)
        read += packed(layout.messages[0], gateway)
    assert read == sent


@pytest.mark.promise("e2e")
def test_alive_counter_restarts_at_0_before_the_first_code() -> None:
    signal = Sig("MessageCounter", 0, 4, texts={14: "Error", 5: "NotAvailable"})
    (plan,) = layout_of([Msg("M", 0x100, 1, [signal])]).messages
    assert plan.signals[0].high == 4


@pytest.mark.parametrize("texts", [{100: "Invalid", 101: "Error"}, {9: "SNA", 8: "SNA"}])
def test_further_code_between_the_values_is_refused(texts: dict[int, str]) -> None:
    signal = Sig("PwmInput", 0, 16, texts=texts)
    (line,) = refused(dbc_text([Msg("M", 0x100, 8, [signal])]))
    assert "further code" in line


@pytest.mark.promise("codes")
def test_further_code_at_the_end_of_the_range_is_no_value() -> None:
    texts = {65535: "SNA", 65534: "Error", 65533: "Invalid"}
    (plan,) = layout_of([Msg("M", 0x100, 8, [Sig("PwmInput", 0, 16, texts=texts)])]).messages
    assert plan.signals[0].high == 65532


# --- alive counter and E2E profile 1


def theirs(data: bytes, at: int, data_id: int) -> bytes:
    """Return the frame as the autosar-e2e package protects it, with an unchanged counter."""
    buffer = bytearray(data)
    p01.e2e_p01_protect(buffer, data_id, offset=at, increment_counter=False)
    return bytes(buffer)


@pytest.mark.parametrize(
    ("at", "length", "data_ids"),
    [(0, 4, {}), (3, 5, {}), (7, 8, {"M": 0xABCD}), (1, 4, {"M": 0})],
)
def test_frames_with_a_crc_pass_the_check_of_the_autosar_package(
    at: int,
    length: int,
    data_ids: dict[str, int],
) -> None:
    counter_at = 8 * ((at + 1) % 8)
    value_at = 16 * ((at // 2 + 2) % 4)
    signals = [
        Sig("Crc8", at * 8, 8),
        Sig("Alive", counter_at, length),
        Sig("BatteryVoltage", value_at, 16, unit="V"),
    ]
    layout = layout_of([Msg("M", 0x12345, 8, signals, extended=True)], e2e_data_ids=data_ids)
    data_id = data_ids.get("M", 0x2345)
    gateway = Gateway(CoreSettings([EscSettings("esc1", 7)], layout), 0)
    gateway.start(0)
    frames = gateway.take_frames(0)
    for n in range(40):
        loss = 600 * (n // 20)  # between the first 20 frames and the others
        now = (50 + 10 * n + loss) * MS
        gateway.advance(now)
        frames += gateway.take_frames(now)
        wire = encode(LIVE._replace(battery_voltage=n * 100), WireLayout.V4)
        gateway.receive_bytes(0, wire, now, now)
        frames += gateway.take_frames(now)
    counters = [get(frame.data, counter_at, length, True) for frame in frames]
    assert counters == [n % 15 for n in range(42)]
    for frame in frames:
        # the package needs a byte after the CRC
        crc = frame.data[at : at + 1]
        moved = crc + frame.data[:at] + frame.data[at + 1 :]
        assert theirs(moved, 0, data_id) == moved
        assert p01.e2e_p01_check(bytearray(moved), data_id, offset=0)
