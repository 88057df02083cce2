"""One typed line for each row of the protocol specification: wire order, type, step, unit, absence.

LiveData and InfoData hold integers as they are on the wire. Nothing is clipped: a value that fits
the wire type is passed on even if it is outside the range in the protocol specification.
"""

import struct
from typing import Annotated, NamedTuple, get_args, get_type_hints

from kontronik_can_gw.esc.kontronik.states import Device


class FieldRow(NamedTuple):
    """A row of the protocol specification."""

    wire: str
    """struct code of the wire type."""
    unit: str
    per_unit: int = 1
    """Number of steps that make one ``unit``."""
    not_on: frozenset[Device] = frozenset()
    """Devices that do not supply this value."""
    note: str = ""
    """Anything else that a reader of the number must know."""

    @property
    def type_range(self) -> tuple[int, int]:
        """Smallest and greatest value of the wire type."""
        bits = struct.calcsize("<" + self.wire) * 8
        is_signed = self.wire.islower()
        if is_signed:
            return -(1 << bits - 1), (1 << bits - 1) - 1
        return 0, (1 << bits) - 1


VARIANT_BITS = 10
"""Number of low bits of the info frame's first word that hold the variant."""
_NOT_JIVEPRO = frozenset({Device.JIVEPRO})

ElectricalSpeed = Annotated[int, FieldRow("I", "1/min")]
Voltage = Annotated[int, FieldRow("H", "V", 100)]
Current = Annotated[int, FieldRow("h", "A", 10, note="< 0 regenerates")]
Charge = Annotated[int, FieldRow("H", "mAh")]
BecCurrent = Annotated[int, FieldRow("H", "A", 1000, not_on=_NOT_JIVEPRO)]
BecVoltage = Annotated[int, FieldRow("H", "V", 1000)]
PwmInput = Annotated[int, FieldRow("H", "µs")]
Throttle = Annotated[int, FieldRow("b", "%", note="<= 0 brakes")]
Opening = Annotated[int, FieldRow("B", "%")]
Temperature = Annotated[int, FieldRow("b", "°C")]
Word = Annotated[int, FieldRow("I", "", note="a bit for each error")]
State = Annotated[int, FieldRow("B", "")]
Timing = Annotated[int, FieldRow("B", "µs")]
DevicePair = Annotated[int, FieldRow("H", "", note=f"{VARIANT_BITS} low bits: variant")]
VersionPair = Annotated[int, FieldRow("H", "", note="8 low bits: sub version")]
Count = Annotated[int, FieldRow("B", "")]


class LiveData(NamedTuple):
    """Live frame, offsets 4 to 33, in wire order."""

    electrical_speed: ElectricalSpeed = 0
    battery_voltage: Voltage = 0
    battery_current: Current = 0
    motor_current: Current = 0
    peak_current: Current = 0
    consumed_charge: Charge = 0
    bec_current: BecCurrent = 0
    bec_voltage: BecVoltage = 0
    pwm_input: PwmInput = 0
    throttle: Throttle = 0
    output_opening: Opening = 0
    power_stage_temperature: Temperature = 0
    bec_temperature: Temperature = 0
    operating_errors: Word = 0
    operating_state: State = 0
    timing: Timing = 0


class InfoData(NamedTuple):
    """Info frame, offsets 4 to 36, in wire order.

    The extremes are counted from a time that the ESC chooses.
    """

    device_and_variant: DevicePair = 0
    firmware_word: VersionPair = 0
    selftest_errors: Word = 0
    cell_count: Count = 0
    max_electrical_speed: ElectricalSpeed = 0
    min_battery_voltage: Voltage = 0
    max_battery_voltage: Voltage = 0
    max_battery_current: Current = 0
    max_motor_current: Current = 0
    max_peak_current: Current = 0
    max_bec_current: BecCurrent = 0
    min_bec_voltage: BecVoltage = 0
    max_throttle: Throttle = 0
    max_output_opening: Opening = 0
    min_power_stage_temperature: Temperature = 0
    max_power_stage_temperature: Temperature = 0
    min_bec_temperature: Temperature = 0
    max_bec_temperature: Temperature = 0


Data = LiveData | InfoData
DataType = type[LiveData] | type[InfoData]


def _rows(data: DataType) -> dict[str, FieldRow]:
    hints = get_type_hints(data, include_extras=True)
    found = {}
    for name in data._fields:
        _, row = get_args(hints[name])
        found[name] = row
    return found


_ROWS: dict[DataType, dict[str, FieldRow]] = {
    LiveData: _rows(LiveData),
    InfoData: _rows(InfoData),
}


def rows(data: DataType) -> dict[str, FieldRow]:
    """Return the rows of LiveData or InfoData by field name, in wire order."""
    return _ROWS[data]


def device_and_variant(device: int, variant: int) -> int:
    """Return the info frame's first word: device 0..63 above ten bits for variant 0..1023."""
    return device << VARIANT_BITS | variant


def body_format(data: DataType) -> str:
    """Return the struct codes of the fields, without byte order, header, reserved bytes and CRC."""
    return "".join(row.wire for row in rows(data).values())
