"""KONTRONIK telemetry as it is on the wire: fields, states, codec, deframer. Standard library only, no I/O, no clock."""

from kontronik_can_gw.esc.kontronik.codec import Form, Layout, encode
from kontronik_can_gw.esc.kontronik.deframer import Counters, Deframer, Frame
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData, Row, rows
from kontronik_can_gw.esc.kontronik.states import (
    Device,
    OperatingError,
    OperatingState,
    SelfTestError,
)

__all__ = [
    "Counters",
    "Deframer",
    "Device",
    "Form",
    "Frame",
    "InfoData",
    "Layout",
    "LiveData",
    "OperatingError",
    "OperatingState",
    "Row",
    "SelfTestError",
    "encode",
    "rows",
]
