"""Every row of the sheet, compared with the list of sheet.py, which was typed a second time from the description of the wire."""

import struct

import pytest

from kontronik_can_gw.esc.decoder import ErrorBit, bit_texts
from kontronik_can_gw.esc.kontronik import (
    InfoData,
    LiveData,
    OperatingError,
    OperatingState,
    SelfTestError,
    rows,
)
from kontronik_can_gw.esc.kontronik.fields import device_and_variant
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK

from . import sheet
from .sheet import Bit, FormRow
from .streams import decoded, form_of

WORDS = [(OperatingError, sheet.OPERATING_BITS), (SelfTestError, sheet.SELFTEST_BITS)]


def test_a_field_has_the_type_unit_and_step_of_the_sheet_and_the_device_that_lacks_it() -> None:
    for data, fields in ((LiveData, sheet.LIVE_FIELDS), (InfoData, sheet.INFO_FIELDS)):
        for (name, row), field in zip(rows(data).items(), fields, strict=True):
            assert (name, row.wire, row.unit, row.per_unit) == (
                *(field.name, field.code, field.unit, field.steps),
            )
            assert row.type_range == sheet.TYPE_RANGES[field.code]
            assert row.not_on == ({3} if name in ("bec_current", "max_bec_current") else set())


@pytest.mark.parametrize("row", sheet.FORM_ROWS, ids=lambda row: f"{row.kind} {row.layout}")
def test_a_field_is_read_from_its_own_bytes_and_no_others(row: FormRow) -> None:
    fields = sheet.LIVE_FIELDS if row.kind == "live" else sheet.INFO_FIELDS
    form = form_of(row)
    assert (form.header, form.length, form.covered, form.crc_at) == (
        *(row.header, row.length, row.covered, row.crc_at),
    )
    for offset in range(row.length):
        changed = bytearray(row.length)
        changed[offset] = 0x5A
        data = decoded(form, bytes(changed))
        found = {field.name: getattr(data, field.name) for field in fields}
        assert {name: value for name, value in found.items() if value} == {
            f.name: 0x5A << 8 * (offset - f.offset)  # little-endian
            for f in fields
            if f.offset <= offset < f.offset + struct.calcsize("<" + f.code)
        }, f"byte {offset}"


def test_devices_and_states_have_the_names_of_the_sheet_and_no_others() -> None:
    assert KONTRONIK.devices == sheet.DEVICES
    assert {state.value: state.name for state in OperatingState} == sheet.OPERATING_STATES
    states = {number: state.text for number, state in KONTRONIK.states.items()}
    assert states == sheet.OPERATING_STATES
    assert KONTRONIK.peak_current_of == sheet.PEAK_CURRENT_OF


@pytest.mark.parametrize(("names", "bits"), WORDS, ids=["operating", "selftest"])
def test_an_error_bit_means_what_the_sheet_says(names: type[ErrorBit], bits: list[Bit]) -> None:
    for found, bit in zip(names, bits, strict=True):
        text = f"{found.text} {found.meaning}".lower()
        assert found.value == bit.number
        assert [word for word in bit.words if word not in text] == []
        assert bit.severity in (None, found.severity.value)
        assert found.remedy.endswith(".") and found.remedy != found.meaning
    texts = [bit.text for bit in names] + [f"bit{number}" for number in range(len(names), 32)]
    assert bit_texts(0xFFFFFFFF, names) == texts
    assert [bit_texts(1 << number, names) for number in range(32)] == [[text] for text in texts]


def test_the_text_of_a_bit_is_unique_over_both_words() -> None:
    assert len(KONTRONIK.bits) == len(OperatingError) + len(SelfTestError)


def test_parts_of_a_word_are_read_by_name_and_written_together() -> None:
    for device, variant, word in ((3, 120, 0x0C78), (63, 1023, 0xFFFF), (1, 0, 0x400)):
        assert device_and_variant(device, variant) == word
        info = InfoData(device_and_variant=word)
        found = [KONTRONIK.value(name, info) for name in ("device_raw", "variant")]
        assert found == [device, variant]
    for device, variant in ((64, 0), (-1, 0), (0, 1024)):
        with pytest.raises(ValueError, match=f"device {device} or variant {variant}"):
            device_and_variant(device, variant)
    for word, text in ((0x010E, "1.14"), (0x0300, "3.0"), (0xFFFF, "255.255")):
        assert KONTRONIK.firmware_text(InfoData(firmware_word=word)) == text
