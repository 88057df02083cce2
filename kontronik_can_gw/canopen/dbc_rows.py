"""Rows of the PDO DBC: its attributes, and its messages and signals from raw values."""

from collections.abc import Mapping, Sequence
from fractions import Fraction

from kontronik_can_gw.dbc.rows import Definition, Message, Signal, specifics

LAYOUT_VERSION = "1.0.0"
GATEWAY, LOGGER = "KontronikGateway", "Logger"
_SEND_TYPES = ("Cyclic", "Event", "OnChange", "CyclicAndEvent", "CyclicAndOnChange", "None")
_MAX_MS = 65535

DEFINITIONS = {
    definition.name: definition
    for definition in (
        Definition("LayoutVersion", "", "STRING", ""),
        Definition("BusType", "", "STRING", "CAN"),
        Definition("GenMsgCycleTime", "BO_", "INT", 0, 0, _MAX_MS),
        Definition("GenMsgSendType", "BO_", "ENUM", "None", choices=_SEND_TYPES),
        Definition("GenMsgDelayTime", "BO_", "INT", 0, 0, _MAX_MS),
        Definition("GenSigStartValue", "SG_", "FLOAT", 0, -(1 << 31), (1 << 32) - 1),
    )
}


def message_row(
    cob_id: int,
    name: str,
    length: int,
    comment: str,
    schedule: tuple[str, int, int],
    signals: Sequence[Signal],
) -> Message:
    """A message that the gateway sends. ``schedule``: send type, cycle and least distance in ms."""
    send_type, cycle, delay = schedule
    values: dict[str, str | int] = {
        "GenMsgCycleTime": cycle,
        "GenMsgSendType": send_type,
        "GenMsgDelayTime": delay,
    }
    attributes = specifics(DEFINITIONS, values)
    return Message(cob_id, name, length, _plain(comment), [GATEWAY], signals, attributes)


def signal_row(
    name: str,
    start: int,
    length: int,
    comment: str,
    *,
    signed: bool = False,
    is_float: bool = False,
    factor: Fraction = Fraction(1),
    unit: str = "",
    low: int = 0,
    high: int = 1,
    start_value: int = 0,
    names: Mapping[int, str] | None = None,
) -> Signal:
    """A signal for every receiver. ``low``, ``high`` and ``start_value`` are raw; a float has no limits."""
    return Signal(
        name,
        start,
        length,
        _plain(comment),
        [LOGGER],
        is_signed=signed,
        is_float=is_float,
        scale=number(factor),
        minimum=None if is_float else number(low * factor),
        maximum=None if is_float else number(high * factor),
        unit=unit,
        choices=names or {},
        dbc=specifics(DEFINITIONS, {"GenSigStartValue": start_value}),
    )


def number(value: Fraction) -> int | float:
    """A number as DBC files have it: the nearest float where it is not whole."""
    return value.numerator if value.denominator == 1 else float(value)


def _plain(text: str) -> str:
    """A comment without what a parser may take for syntax: names of objects come from any EDS."""
    return text.translate(str.maketrans('";\\', "',/"))
