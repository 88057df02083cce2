"""The KONTRONIK protocol for the gateway: the tables of fields.py and states.py in the form of an EscProtocol."""

from kontronik_can_gw.esc.decoder import EscProtocol, Field
from kontronik_can_gw.esc.kontronik.deframer import Deframer
from kontronik_can_gw.esc.kontronik.fields import DataType, InfoData, LiveData, body_format, rows
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
)

_STATES = {int(state): state.about for state in OperatingState}
_DEVICES = {int(device): device.text for device in Device}
_PARTS = ("operating_state", "device_and_variant", "firmware_word")
"""Rows of the sheet that are several values, or have names."""


def _wire(data: DataType) -> list[Field]:
    found = []
    for word, (name, row) in enumerate(rows(data).items()):
        if name not in _PARTS:
            of = (name, row.unit, word, *row.type_range, row.per_unit, data is InfoData)
            found.append(Field(*of, not_on=row.not_on))
    return found


def _bits(name: str, row: str, shift: int, mask: int, names: dict[int, str] | None = None) -> Field:
    word = InfoData._fields.index(row)
    return Field(name, "", word, 0, mask, 1, True, shift, mask, names=names or {})


_STATE = LiveData._fields.index("operating_state")

KONTRONIK = EscProtocol(
    name="kontronik",
    make=Deframer,
    fields=(
        *_wire(LiveData),
        Field("operating_state", "", _STATE, 0, 255, names={n: s.text for n, s in _STATES.items()}),
        Field("operating_state_raw", "", _STATE, 0, 255),
        *_wire(InfoData),
        _bits("device", "device_and_variant", 10, 0x3F, _DEVICES),
        _bits("device_raw", "device_and_variant", 10, 0x3F),
        _bits("variant", "device_and_variant", 0, 0x3FF),
        _bits("firmware_main", "firmware_word", 8, 0xFF),
        _bits("firmware_sub", "firmware_word", 0, 0xFF),
    ),
    maker="KONTRONIK",
    even_parity=True,
    layouts=("V4", "legacy"),
    errors={"operating_errors": tuple(OperatingError), "selftest_errors": tuple(SelfTestError)},
    states=_STATES,
    backward_states=frozenset({OperatingState.Sync_Backward, OperatingState.Backward}),
    devices=_DEVICES,
    wire=((body_format(LiveData), LiveData), (body_format(InfoData), InfoData)),
    peak_current_of={int(d): d.peak_current_of for d in Device if d.peak_current_of is not None},
)
