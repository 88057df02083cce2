"""Every row of the sheet, compared with the list of sheet.py, which was typed a second time from the description of the wire."""

import struct

import pytest

from kontronik_can_gw.esc.decoder import ErrorBit, bit_texts
from kontronik_can_gw.esc.kontronik import (
    Device,
    InfoData,
    LiveData,
    OperatingError,
    OperatingState,
    Row,
    SelfTestError,
    rows,
)
from kontronik_can_gw.esc.kontronik.codec import FORMS
from kontronik_can_gw.esc.kontronik.fields import DataType, device_and_variant
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.kontronik.states import LARGEST_STATE

from . import sheet
from .sheet import Bit, Field, FormRow
from .streams import decoded, form_of

ALL_FIELDS = [(LiveData, field) for field in sheet.LIVE_FIELDS] + [
    (InfoData, field) for field in sheet.INFO_FIELDS
]


def row_of(data: DataType, field: Field) -> Row:
    return rows(data)[field.name]


def bit_of(names: type[ErrorBit], number: int) -> ErrorBit:
    return next(bit for bit in names if bit.value == number)


def text_of(names: type[ErrorBit], number: int) -> str:
    bit = bit_of(names, number)
    return f"{bit.text} {bit.meaning}".lower()


@pytest.mark.parametrize(
    ("data", "field"), ALL_FIELDS, ids=lambda value: getattr(value, "name", "")
)
def test_a_field_has_the_type_unit_and_step_of_the_sheet(data: DataType, field: Field) -> None:
    row = row_of(data, field)
    assert (row.wire, row.unit, row.per_unit) == (field.code, field.unit, field.steps)
    assert row.type_range == sheet.TYPE_RANGES[field.code]


@pytest.mark.parametrize("form_row", sheet.FORM_ROWS, ids=lambda row: f"{row.kind} {row.layout}")
def test_a_field_is_read_from_its_own_bytes_and_no_others(form_row: FormRow) -> None:
    fields = sheet.LIVE_FIELDS if form_row.kind == "live" else sheet.INFO_FIELDS
    form = form_of(form_row)
    blank = decoded(form, bytes(form_row.length))
    assert blank == form.data_type() == (0,) * len(fields)
    for offset in range(form_row.length):
        changed = bytearray(form_row.length)
        changed[offset] = 0x5A
        data = decoded(form, bytes(changed))
        differing = [field for field in fields if getattr(data, field.name) != 0]
        owners = [
            f for f in fields if f.offset <= offset < f.offset + struct.calcsize("<" + f.code)
        ]
        assert differing == owners, f"byte {offset}"
        for owner in owners:
            assert getattr(data, owner.name) == 0x5A << 8 * (offset - owner.offset), "little-endian"


def test_bec_current_alone_is_not_supplied_and_only_on_the_jivepro() -> None:
    absent = {
        field.name: row_of(data, field).not_on
        for data, field in ALL_FIELDS
        if row_of(data, field).not_on
    }
    assert absent == {"bec_current": {3}, "max_bec_current": {3}}


def test_devices_and_states_have_the_names_of_the_sheet_and_no_others() -> None:
    assert {device.value: device.text for device in Device} == KONTRONIK.devices == sheet.DEVICES
    assert {state.value: state.name for state in OperatingState} == sheet.OPERATING_STATES
    states = {number: state.text for number, state in KONTRONIK.states.items()}
    assert states == sheet.OPERATING_STATES
    assert LARGEST_STATE == 26


def test_the_peak_current_belongs_to_motor_or_battery_by_device() -> None:
    assert KONTRONIK.peak_current_of == sheet.PEAK_CURRENT_OF


@pytest.mark.parametrize(
    ("bits", "names", "used"),
    [(sheet.OPERATING_BITS, OperatingError, 24), (sheet.SELFTEST_BITS, SelfTestError, 19)],
    ids=["operating", "selftest"],
)
def test_the_error_words_have_the_stated_number_of_bits(
    bits: list[Bit], names: type[ErrorBit], used: int
) -> None:
    assert [bit.number for bit in bits] == list(range(used))
    assert [bit.value for bit in names] == list(range(used))


@pytest.mark.parametrize(
    ("names", "bit"),
    [(OperatingError, bit) for bit in sheet.OPERATING_BITS]
    + [(SelfTestError, bit) for bit in sheet.SELFTEST_BITS],
    ids=lambda value: str(value.number) if isinstance(value, Bit) else value.__name__,
)
def test_an_error_bit_means_what_the_sheet_says(names: type[ErrorBit], bit: Bit) -> None:
    text = text_of(names, bit.number)
    assert [word for word in bit.words if word not in text] == []
    if bit.severity is not None:
        assert bit_of(names, bit.number).severity.value == bit.severity


def test_every_error_bit_has_a_remedy_that_is_not_its_meaning() -> None:
    for bit in (*OperatingError, *SelfTestError):
        assert bit.remedy.endswith("."), bit
        assert bit.remedy != bit.meaning


def test_the_text_of_a_bit_is_unique_over_both_words() -> None:
    texts = [bit.text for names in (OperatingError, SelfTestError) for bit in names]
    assert len(set(texts)) == 24 + 19
    assert all(text == text.lower() and text.isidentifier() for text in texts)


@pytest.mark.parametrize("names", [OperatingError, SelfTestError])
def test_bits_without_a_name_are_listed_by_number(names: type[ErrorBit]) -> None:
    used = len(names)
    texts = bit_texts(0xFFFFFFFF, names)
    assert texts == [bit.text for bit in names] + [f"bit{number}" for number in range(used, 32)]
    assert bit_texts(0, names) == []
    for number in range(32):
        assert bit_texts(1 << number, names) == [texts[number]]


def test_there_are_four_forms_the_shorter_of_a_kind_first() -> None:
    assert len(FORMS) == 4
    for kind in ("live", "info"):
        lengths = [form.length for form in FORMS if form.kind.value == kind]
        assert lengths == sorted(row.length for row in sheet.FORM_ROWS if row.kind == kind)


@pytest.mark.parametrize("row", sheet.FORM_ROWS, ids=lambda row: f"{row.kind} {row.layout}")
def test_a_form_has_the_length_and_crc_of_the_sheet(row: FormRow) -> None:
    form = form_of(row)
    assert (form.header, form.length, form.covered, form.crc_at) == (
        row.header,
        row.length,
        row.covered,
        row.crc_at,
    )
    assert form.data_type is (LiveData if row.kind == "live" else InfoData)


@pytest.mark.parametrize(
    ("device", "variant", "word"), [(3, 120, 0x0C78), (0, 0, 0), (63, 1023, 0xFFFF), (1, 0, 0x400)]
)
def test_device_and_variant_share_a_word_six_bits_high_ten_low(
    device: int, variant: int, word: int
) -> None:
    assert device_and_variant(device, variant) == word
    info = InfoData(device_and_variant=word)
    found = [KONTRONIK.value(name, info) for name in ("device_raw", "variant")]
    assert found == [device, variant]


@pytest.mark.parametrize(("device", "variant"), [(64, 0), (-1, 0), (0, 1024), (0, -1)])
def test_a_device_or_variant_that_does_not_fit_is_refused(device: int, variant: int) -> None:
    with pytest.raises(ValueError, match=f"device {device} or variant {variant}"):
        device_and_variant(device, variant)


@pytest.mark.parametrize(
    ("word", "text"), [(0x010E, "1.14"), (0x0411, "4.17"), (0x0300, "3.0"), (0xFFFF, "255.255")]
)
def test_the_firmware_is_main_and_sub_version(word: int, text: str) -> None:
    assert KONTRONIK.firmware_text(InfoData(firmware_word=word)) == text
