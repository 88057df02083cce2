"""Records from bytes: exact values, in wire order. (However a stream is cut: tests/esc.)"""

import json

from esc.sheet import RECORDED_INFO, RECORDED_LIVE
from hypothesis import given
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

LIVE, INFO = RECORDED_LIVE, RECORDED_INFO
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
        assert round(record[name] * rows(LiveData)[name].per_unit) == getattr(data, name)
        assert len(repr(record[name]).partition(".")[2]) <= 3
