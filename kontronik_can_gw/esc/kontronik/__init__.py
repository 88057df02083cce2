"""KONTRONIK telemetry as it is on the wire: fields, states, codec, deframer. Standard library only, no I/O, no clock."""

from kontronik_can_gw.protocol.codec import Form, Kind, Layout, encode
from kontronik_can_gw.protocol.deframer import Counters, Deframer, Frame
from kontronik_can_gw.protocol.fields import InfoData, LiveData, Row, rows
from kontronik_can_gw.protocol.states import Device, OperatingError, OperatingState, SelfTestError

__all__ = [
    "Counters",
    "Deframer",
    "Device",
    "Form",
    "Frame",
    "InfoData",
    "Kind",
    "Layout",
    "LiveData",
    "OperatingError",
    "OperatingState",
    "Row",
    "SelfTestError",
    "encode",
    "rows",
]
