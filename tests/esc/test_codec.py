"""Fields, names and frame bytes, compared with the protocol specification.

Frames whose names contain RECORDED are recorded. All others are synthetic.
"""

import struct

import pytest
import specification
from hypothesis import given, settings
from hypothesis import strategies as st
from specification import FORM_ROWS, Bit, Field, FormRow

from kontronik_can_gw.esc.decoder import ErrorBit, bit_texts
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.deframer import Deframer, Frame
from kontronik_can_gw.esc.kontronik.fields import (
    Data,
    DataType,
    InfoData,
    LiveData,
    device_and_variant,
    rows,
)
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.states import OperatingError, SelfTestError

from . import reference
from .streams import form_of

pytestmark = pytest.mark.promise("fields")

RECORDED: dict[bytes, LiveData | InfoData] = {
    specification.RECORDED_LIVE: LiveData(
        battery_voltage=2442,
        bec_voltage=8024,
        pwm_input=1001,
        power_stage_temperature=29,
        bec_temperature=32,
        operating_errors=0x0002_0000,
        operating_state=12,
    ),
    specification.RECORDED_INFO: InfoData(
        device_and_variant=3 << 10 | 120,
        firmware_word=0x010E,
        cell_count=6,
        min_battery_voltage=2414,
        min_bec_voltage=5599,
        min_power_stage_temperature=27,
        max_power_stage_temperature=30,
        min_bec_temperature=28,
        max_bec_temperature=33,
    ),
}
"""The recorded values in steps of the protocol specification."""
form_rows = pytest.mark.parametrize("row", FORM_ROWS, ids=lambda row: f"{row.kind} {row.layout}")


def fields_of(row: FormRow) -> tuple[DataType, list[Field]]:
    if row.kind == "live":
        return LiveData, specification.LIVE_FIELDS
    return InfoData, specification.INFO_FIELDS


def frame_in(wire: bytes) -> Frame:
    """Return the only frame in these bytes."""
    (found,) = Deframer().feed(wire)
    assert found.offset == 0
    assert found.form.length == len(wire)
    return found


@pytest.mark.parametrize(("wire", "data"), RECORDED.items(), ids=["live", "info"])
def test_recorded_frame_has_the_stated_values(wire: bytes, data: Data) -> None:
    found = frame_in(wire)
    assert found.layout == WireLayout.LEGACY
    assert type(found.data) is type(data)
    assert found.data == data
    assert encode(data, WireLayout.LEGACY) == wire


@form_rows
@settings(deadline=None, max_examples=75, database=None)
@given(choice=st.data())
def test_raw_values_survive_a_round_trip_with_any_reserved_bytes(
    row: FormRow, choice: st.DataObject
) -> None:
    data_type, fields = fields_of(row)
    ranges = [st.integers(*specification.TYPE_RANGES[field.code]) for field in fields]
    data = data_type(*choice.draw(st.tuples(*ranges)))
    size = row.crc_at - row.body_end
    body = b""
    for field in fields:
        body += struct.pack("<" + field.code, getattr(data, field.name))
    sent = encode(data, WireLayout(row.layout))
    assert sent == reference.seal(row, body + bytes(size))
    assert frame_in(sent).form is form_of(row)
    for field in fields:
        packed = struct.pack("<" + field.code, getattr(data, field.name))
        assert sent.startswith(packed, field.offset)
    reserved = choice.draw(st.binary(min_size=size, max_size=size))
    other = reference.seal(row, body + reserved)
    assert frame_in(other).data == frame_in(sent).data == data


@pytest.mark.promise("layouts")
@pytest.mark.parametrize(
    ("frame", "offset", "name"),
    [
        (specification.RECORDED_LIVE, 32, "operating_state"),
        (specification.RECORDED_LIVE, 33, "timing"),
        (specification.RECORDED_INFO, 36, "max_bec_temperature"),
    ],
)
def test_changed_unprotected_byte_is_delivered_and_maybe_suspect(
    frame: bytes,
    offset: int,
    name: str,
) -> None:
    for value in range(256):
        found = frame_in(frame[:offset] + bytes((value,)) + frame[offset + 1 :])
        expected = value - 256 if name == "max_bec_temperature" and value > 127 else value
        assert found.data == RECORDED[frame]._replace(**{name: expected})
        assert found.is_suspect == (name == "operating_state" and value > 26)
    assert not frame_in(encode(LiveData(operating_state=255), WireLayout.V4)).is_suspect


def test_field_has_type_unit_step_and_absence_of_the_sheet() -> None:
    for data, fields in (
        (LiveData, specification.LIVE_FIELDS),
        (InfoData, specification.INFO_FIELDS),
    ):
        names = [field.name for field in fields]
        assert [*rows(data)] == names, "add the field to tests/specification"
        for (name, row), field in zip(rows(data).items(), fields, strict=True):
            assert row.wire == field.code
            assert row.unit == field.unit
            assert row.per_unit == field.steps
            assert row.type_range == specification.TYPE_RANGES[field.code]
            is_bec_current = name in ("bec_current", "max_bec_current")
            assert row.not_on == ({3} if is_bec_current else set())


def test_devices_and_states_have_exactly_the_names_of_the_sheet() -> None:
    assert KONTRONIK.devices == specification.DEVICES
    states = {number: state.text for number, state in KONTRONIK.states.items()}
    assert states == specification.OPERATING_STATES
    assert KONTRONIK.peak_current_of == specification.PEAK_CURRENT_OF


@pytest.mark.parametrize(
    ("names", "bits"),
    [(OperatingError, specification.OPERATING_BITS), (SelfTestError, specification.SELFTEST_BITS)],
    ids=["operating", "selftest"],
)
def test_error_bit_has_the_meaning_of_the_sheet(names: type[ErrorBit], bits: list[Bit]) -> None:
    for found, bit in zip(names, bits, strict=True):
        text = f"{found.text} {found.meaning}".lower()
        assert found.value == bit.number
        assert [word for word in bit.words if word not in text] == []
        assert bit.severity in (None, found.severity.value)
        assert found.remedy.endswith(".")
        assert found.remedy != found.meaning
        assert KONTRONIK.bits[found.text] is found
    texts = [bit.text for bit in names]
    texts += [f"bit{number}" for number in range(len(names), 32)]
    assert bit_texts(0xFFFFFFFF, names) == texts


def test_parts_of_a_word_are_read_separately_and_written_together() -> None:
    for device, variant, word in (
        (3, 120, 0x0C78),
        (63, 1023, 0xFFFF),
        (1, 0, 0x400),
    ):
        assert device_and_variant(device, variant) == word
        info = InfoData(device_and_variant=word)
        assert KONTRONIK.value("device_raw", info) == device
        assert KONTRONIK.value("variant", info) == variant
    for word, text in (
        (0x010E, "1.14"),
        (0x0300, "3.0"),
        (0xFFFF, "255.255"),
    ):
        assert KONTRONIK.firmware_text(InfoData(firmware_word=word)) == text
