"""Frame bytes <-> data. Recorded frames are named so; every other vector here is synthetic."""

import binascii
import random
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kontronik_can_gw.esc.kontronik import (
    Deframer,
    Form,
    InfoData,
    Kind,
    Layout,
    LiveData,
    encode,
    rows,
)
from kontronik_can_gw.esc.kontronik.fields import Data, DataType

from . import reference, sheet
from .sheet import FORM_ROWS, Field, FormRow
from .streams import decoded, form_of

PROPERTY = settings(deadline=None, max_examples=75, database=None)

RECORDED_LIVE_VALUES = {
    "electrical_speed": 0,
    "battery_voltage": 24.42,
    "battery_current": 0.0,
    "motor_current": 0.0,
    "peak_current": 0.0,
    "consumed_charge": 0,
    "bec_current": 0.0,
    "bec_voltage": 8.024,
    "pwm_input": 1001,
    "throttle": 0,
    "output_opening": 0,
    "power_stage_temperature": 29,
    "bec_temperature": 32,
    "operating_errors": 0x00020000,
    "operating_state": 12,
    "timing": 0,
}
RECORDED_INFO_VALUES = {
    "device_and_variant": 3 * 1024 + 120,
    "firmware_word": 0x010E,
    "selftest_errors": 0,
    "cell_count": 6,
    "max_electrical_speed": 0,
    "min_battery_voltage": 24.14,
    "max_battery_voltage": 0.0,
    "max_battery_current": 0.0,
    "max_motor_current": 0.0,
    "max_peak_current": 0.0,
    "max_bec_current": 0.0,
    "min_bec_voltage": 5.599,
    "max_throttle": 0,
    "max_output_opening": 0,
    "min_power_stage_temperature": 27,
    "max_power_stage_temperature": 30,
    "min_bec_temperature": 28,
    "max_bec_temperature": 33,
}


def fields_of(kind: str) -> list[Field]:
    return sheet.LIVE_FIELDS if kind == "live" else sheet.INFO_FIELDS


def pack(row: FormRow, values: tuple[int, ...]) -> bytes:
    """The frame by the second list: struct codes, zeros for the reserved bytes, and the reference CRC."""
    body = struct.pack(sheet.LIVE_STRUCT if row.kind == "live" else sheet.INFO_STRUCT, *values)
    return reference.seal(row, body.ljust(row.crc_at - 4, b"\0"))


def form_in(frame: bytes) -> Form:
    """The form of bytes that are one frame."""
    (found,) = Deframer().feed(frame)
    assert (found.offset, found.form.length) == (0, len(frame))
    return found.form


def decode(frame: bytes) -> Data:
    return decoded(form_in(frame), frame)


def physical_values(data: Data) -> dict[str, int | float]:
    return {name: getattr(data, name) / row.per_unit for name, row in rows(type(data)).items()}


def raw_values(data_type: DataType, values: dict[str, int | float]) -> Data:
    return data_type(
        **{name: round(value * rows(data_type)[name].per_unit) for name, value in values.items()}
    )


def raw_strategy(kind: str) -> st.SearchStrategy[tuple[int, ...]]:
    return st.tuples(*(st.integers(*sheet.TYPE_RANGES[field.code]) for field in fields_of(kind)))


form_rows = pytest.mark.parametrize("row", FORM_ROWS, ids=lambda row: f"{row.kind} {row.layout}")


def test_the_references_crc_is_the_standard_one() -> None:
    assert reference.crc32_of_bits(b"123456789") == 0xCBF43926
    source = random.Random(1)
    for size in range(64):
        data = source.randbytes(size)
        assert reference.crc32_of_bits(data) == reference.crc32(data) == binascii.crc32(data)


@pytest.mark.parametrize(
    ("frame", "values", "data_type", "kind"),
    [
        (sheet.RECORDED_LIVE, RECORDED_LIVE_VALUES, LiveData, Kind.LIVE),
        (sheet.RECORDED_INFO, RECORDED_INFO_VALUES, InfoData, Kind.INFO),
    ],
    ids=["live", "info"],
)
def test_a_recorded_frame_is_that_of_the_stated_values(
    frame: bytes, values: dict[str, int | float], data_type: DataType, kind: Kind
) -> None:
    form = form_in(frame)
    assert (form.kind, form.layout) == (kind, Layout.LEGACY)
    assert physical_values(decode(frame)) == values
    assert encode(raw_values(data_type, values), Layout.LEGACY) == frame


@form_rows
@PROPERTY
@given(choice=st.data())
def test_every_combination_of_raw_values_survives_the_round_trip(
    row: FormRow, choice: st.DataObject
) -> None:
    values = choice.draw(raw_strategy(row.kind))
    data_type: DataType = LiveData if row.kind == "live" else InfoData
    data = data_type(*values)
    frame = encode(data, Layout(row.layout))
    assert frame == pack(row, values)
    form = form_in(frame)
    assert form is form_of(row)
    again = decode(frame)
    assert again == data
    assert type(again) is data_type
    assert raw_values(data_type, physical_values(again)) == data


@form_rows
def test_a_value_that_does_not_fit_is_refused_by_the_name_of_its_field(row: FormRow) -> None:
    data_type: DataType = LiveData if row.kind == "live" else InfoData
    for field in fields_of(row.kind):
        low, high = sheet.TYPE_RANGES[field.code]
        for value in (low - 1, high + 1, 1 << 70):
            with pytest.raises(
                ValueError, match=f"^{field.name}: {value} is outside {low}\\.\\.{high}$"
            ):
                encode(data_type(**{field.name: value}), Layout(row.layout))


@form_rows
def test_a_value_that_is_no_whole_number_makes_no_frame(row: FormRow) -> None:
    data_type: DataType = LiveData if row.kind == "live" else InfoData
    for field in fields_of(row.kind):
        wrong: Any = 1.5
        with pytest.raises(struct.error):
            encode(data_type(**{field.name: wrong}), Layout(row.layout))


@form_rows
@PROPERTY
@given(choice=st.data())
def test_the_reserved_bytes_are_sent_as_zero_and_accepted_with_any_value(
    row: FormRow, choice: st.DataObject
) -> None:
    size = row.crc_at - row.body_end
    reserved = choice.draw(st.binary(min_size=size, max_size=size))
    values = choice.draw(raw_strategy(row.kind))
    sent = pack(row, values)
    assert sent[row.body_end : row.crc_at] == bytes(size)
    frame = reference.seal(row, sent[4 : row.body_end] + reserved)
    assert tuple(decode(frame)) == values


@form_rows
def test_every_flipped_bit_under_the_crc_is_found(row: FormRow) -> None:
    frame = reference.random_frame(row, random.Random(7))
    form = form_in(frame)
    assert form is form_of(row)
    for offset in range(row.length):
        unprotected = row.covered <= offset < row.crc_at
        for bit in range(8):
            flipped = bytearray(frame)
            flipped[offset] ^= 1 << bit
            found = [each.form for each in Deframer().feed(bytes(flipped))]
            assert found == [form] * unprotected, f"byte {offset} bit {bit}"


@pytest.mark.parametrize(
    ("frame", "offset", "name"),
    [
        (sheet.RECORDED_LIVE, 32, "operating_state"),
        (sheet.RECORDED_LIVE, 33, "timing"),
        (sheet.RECORDED_INFO, 36, "max_bec_temperature"),
    ],
)
def test_an_altered_unprotected_byte_of_a_recorded_frame_is_delivered(
    frame: bytes, offset: int, name: str
) -> None:
    whole = decode(frame)
    for value in range(256):
        altered = frame[:offset] + bytes([value]) + frame[offset + 1 :]
        expected = value - 256 if name == "max_bec_temperature" and value > 127 else value
        received = Deframer().feed(altered)
        assert [frame.data for frame in received] == [whole._replace(**{name: expected})]
        assert received[0].suspect == (name == "operating_state" and value > 26)


def test_no_other_frame_is_suspect_whatever_it_holds() -> None:
    odd_info = InfoData(selftest_errors=0xFFFFFFFF, max_bec_temperature=127)
    sent = [encode(LiveData(operating_state=state), Layout.V4) for state in range(256)]
    sent += [encode(odd_info, layout) for layout in Layout]
    assert [frame.suspect for frame in Deframer().feed(b"".join(sent))] == [False] * 258


@pytest.mark.parametrize("kind", ["live", "info"])
def test_where_both_layouts_fit_the_shorter_is_taken(kind: str) -> None:
    frame = reference.ambiguous(kind)
    fitting = [row for row in FORM_ROWS if reference.fits(frame, 0, row)]
    assert {(row.kind, row.layout) for row in fitting} == {(kind, "legacy"), (kind, "v4")}
    assert [found.form for found in Deframer().feed(frame)] == [
        form_of(reference.form_row(kind, "legacy"))
    ]
