"""The KONTRONIK protocol as an EscProtocol, made from the tables in fields.py and states.py."""

from collections.abc import Mapping

from kontronik_can_gw.esc.decoder import NO_NAMES, EscProtocol, Field
from kontronik_can_gw.esc.kontronik.deframer import Deframer
from kontronik_can_gw.esc.kontronik.fields import (
    VARIANT_BITS,
    DataType,
    InfoData,
    LiveData,
    body_format,
    rows,
)
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
)

_STATES = {int(state): state.about for state in OperatingState}
_STATE_NAMES = {number: state.text for number, state in _STATES.items()}
_DEVICES = {int(device): device.text for device in Device}
_PEAK_CURRENTS = {
    int(device): device.peak_current_of for device in Device if device.peak_current_of is not None
}
_SPLIT_ROWS = ("operating_state", "device_and_variant", "firmware_word")
"""Rows of the specification that are published as several fields. KONTRONIK lists these."""


def _whole_fields(data: DataType) -> list[Field]:
    """Return a field for each row that is published as one value."""
    found = []
    for word, (name, row) in enumerate(rows(data).items()):
        if name in _SPLIT_ROWS:
            continue
        low, high = row.type_range
        field = Field(
            name=name,
            unit=row.unit,
            word=word,
            low=low,
            high=high,
            per_unit=row.per_unit,
            is_info=data is InfoData,
            not_on=row.not_on,
        )
        found.append(field)
    return found


def _state_field(name: str, names: Mapping[int, str] = NO_NAMES) -> Field:
    word = LiveData._fields.index("operating_state")
    return Field(
        name,
        unit="",
        word=word,
        low=0,
        high=255,
        names=names,
    )


def _info_bits(
    name: str,
    row: str,
    shift: int,
    mask: int,
    names: Mapping[int, str] = NO_NAMES,
) -> Field:
    """Return the field ``row >> shift & mask`` of info data."""
    return Field(
        name=name,
        unit="",
        word=InfoData._fields.index(row),
        low=0,
        high=mask,
        is_info=True,
        shift=shift,
        mask=mask,
        names=names,
    )


KONTRONIK = EscProtocol(
    name="kontronik",
    make=Deframer,
    fields=(
        *_whole_fields(LiveData),
        _state_field("operating_state", _STATE_NAMES),
        _state_field("operating_state_raw"),
        *_whole_fields(InfoData),
        _info_bits(
            "device",
            "device_and_variant",
            shift=VARIANT_BITS,
            mask=0x3F,
            names=_DEVICES,
        ),
        _info_bits("device_raw", "device_and_variant", shift=VARIANT_BITS, mask=0x3F),
        _info_bits("variant", "device_and_variant", shift=0, mask=(1 << VARIANT_BITS) - 1),
        _info_bits("firmware_main", "firmware_word", shift=8, mask=0xFF),
        _info_bits("firmware_sub", "firmware_word", shift=0, mask=0xFF),
    ),
    maker="KONTRONIK",
    even_parity=True,
    layouts=("V4", "legacy"),
    errors={"operating_errors": tuple(OperatingError), "selftest_errors": tuple(SelfTestError)},
    states=_STATES,
    backward_states=frozenset({OperatingState.Sync_Backward, OperatingState.Backward}),
    devices=_DEVICES,
    wire=((body_format(LiveData), LiveData), (body_format(InfoData), InfoData)),
    peak_current_of=_PEAK_CURRENTS,
)
