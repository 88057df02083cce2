"""Records from bytes: exact values, in wire order, alike however the stream is cut."""

import json

from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.desk.recordings.decode import (
    Decoder,
    Record,
    json_lines,
    physical_fields,
)
from kontronik_can_gw.esc.kontronik import Device, InfoData, Layout, LiveData, encode, rows
from kontronik_can_gw.esc.kontronik.fields import device_and_variant
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Faults, SimulatedEsc, Swap

S = 1_000_000_000

# Recorded from a JIVE PRO 120, firmware 1.14, idle.
LIVE = bytes.fromhex(
    "4B4F444C 00000000 8A09 0000 0000 0000 0000 0000 581F E903 00 00 1D 20 00000200 0C 00 39234C14".replace(
        " ", ""
    )
)
INFO = bytes.fromhex(
    "4B4F4449 780C 0E01 00000000 06 00000000 6E09 0000 0000 0000 0000 0000 DF15 00 00 1B 1E 1C 21 904AE8A9".replace(
        " ", ""
    )
)

LIVE_JSON = (
    '{"kind": "live", "layout": "legacy", "offset": 0, "electrical_speed": 0, "battery_voltage": 24.42, '
    '"battery_current": 0.0, "motor_current": 0.0, "peak_current": 0.0, "consumed_charge": 0, "bec_current": 0.0, '
    '"bec_voltage": 8.024, "pwm_input": 1001, "throttle": 0, "output_opening": 0, "power_stage_temperature": 29, '
    '"bec_temperature": 32, "operating_errors": 131072, "operating_errors_names": ["programming_allowed"], '
    '"operating_state": "MotorOff", "operating_state_raw": 12, "timing": 0, "suspect": false}\n'
)
INFO_JSON = (
    '{"kind": "info", "layout": "legacy", "offset": 38, "device": "JIVEPro", "device_raw": 3, "variant": 120, '
    '"peak_current_of": "battery", '
    '"firmware": "1.14", "selftest_errors": 0, "selftest_errors_names": [], "cell_count": 6, '
    '"max_electrical_speed": 0, "min_battery_voltage": 24.14, "max_battery_voltage": 0.0, '
    '"max_battery_current": 0.0, "max_motor_current": 0.0, "max_peak_current": 0.0, "max_bec_current": null, '
    '"min_bec_voltage": 5.599, "max_throttle": 0, "max_output_opening": 0, "min_power_stage_temperature": 27, '
    '"max_power_stage_temperature": 30, "min_bec_temperature": 28, "max_bec_temperature": 33}\n'
)


def decode(data: bytes) -> list[Record]:
    decoder = Decoder()
    return decoder.feed(data) + decoder.flush()


def spoiled_stream() -> bytes:
    """Both layouts, rubbish, a device swap."""
    faults = Faults(
        noise=2, lost_bytes=0.002, flipped_bits=0.0002, swaps=(Swap(12 * S, Device.JIVEPRO),)
    )
    return b"".join(
        sent.wire for sent in SimulatedEsc(EscOptions(faults=faults)).frames_until(25 * S)
    )


def test_the_recorded_frames_give_exactly_this_json() -> None:
    assert json_lines(decode(LIVE + INFO)) == LIVE_JSON + INFO_JSON


def test_bec_current_is_null_once_a_jivepro_is_known_and_until_the_device_changes() -> None:
    v4 = encode(LiveData(bec_current=1500), Layout.V4)
    kosmik = encode(
        InfoData(device_and_variant(Device.KOSMIK, 1), max_bec_current=2500), Layout.LEGACY
    )
    stream = LIVE + INFO + LIVE + v4 + LIVE + INFO + LIVE + kosmik + LIVE
    currents = [record["bec_current"] for record in decode(stream) if record["kind"] == "live"]
    assert currents == [0.0, None, 1.5, 0.0, None, 0.0]


def test_an_impossible_state_in_the_unprotected_bytes_is_marked_suspect() -> None:
    spoiled = bytearray(LIVE)
    spoiled[32] = 200
    assert [record["suspect"] for record in decode(LIVE + spoiled)] == [False, True]


@given(raw=st.integers(0, 65535), signed=st.integers(-32768, 32767))
def test_printed_floats_read_back_to_the_exact_step(raw: int, signed: int) -> None:
    data = LiveData(battery_voltage=raw, battery_current=signed, bec_voltage=raw)
    record = json.loads(json.dumps(physical_fields(KONTRONIK, False, data)))
    for name in ("battery_voltage", "battery_current", "bec_voltage"):
        assert rows(LiveData)[name].raw(record[name]) == getattr(data, name)
        assert len(repr(record[name]).partition(".")[2]) <= 3


@given(st.lists(st.integers(1, 400), min_size=1, max_size=30))
@settings(max_examples=20, deadline=None)
def test_the_records_do_not_depend_on_how_the_stream_is_cut(sizes: list[int]) -> None:
    stream = spoiled_stream()[:20_000]
    decoder, records, at, turn = Decoder(), [], 0, 0
    while at < len(stream):
        size = sizes[turn % len(sizes)]
        records += decoder.feed(stream[at : at + size])
        at, turn = at + size, turn + 1
    assert records + decoder.flush() == decode(stream)
