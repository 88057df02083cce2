"""The signals of mapped objects in the PDO DBC."""

import re
from collections.abc import Mapping, Sequence

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Variable
from kontronik_can_gw.canopen.eds import EdsEntry
from kontronik_can_gw.canopen.objects import Bound
from kontronik_can_gw.desk.dbc.canopen_names import emergency_names, pascal_case
from kontronik_can_gw.desk.dbc.writer import SignalRow
from kontronik_can_gw.esc.decoder import ErrorBit, EscProtocol
from kontronik_can_gw.esc.telemetry import LinkState
from kontronik_can_gw.signals.plan import SignalPlan

_MAX_START_VALUE_BITS = 32
"""Maximum length of a signal whose numbers all fit the range of GenSigStartValue."""
_ASCII_UNITS = {"°C": "degC", "µs": "us"}
_LINK_BITS = 6
"""Number of bits of the link state in the link status 2020h:1."""
_LINK_FLAGS = (
    ("Replay", 6, "The values come from a recording, not from an ESC."),
    ("InfoValid", 7, "The information of the ESC (its info frame) is fresh."),
)
"""The other bits of the link status."""
_MIRRORS = 0x6000
"""From this index on, objects repeat values of others under names of CiA 402."""
_NOTES = {
    "peak_current": " A held maximum that does not fall back when the motor stops.",
    "bec_current": " Not supplied by a JIVEPro.",
    "firmware": " Main version times 256 plus sub version.",
    "data_age": " 65534 means this age or more.",
    "info_age": " 65534 means this age or more.",
}
"""Remarks on sources, which are added to the comment of a signal."""
_SYNTAX = str.maketrans('";\\', "',/")


def unsigned_signal(
    stem: str,
    start: int,
    length: int,
    comment: str,
    high: int = 1,
    texts: Mapping[int, str] | None = None,
    start_value: int = 0,
) -> SignalRow:
    """Return an unsigned signal. All numbers are raw."""
    return SignalRow(
        stem,
        start,
        length,
        comment,
        limits=(0, high),
        receivers=["Logger"],
        texts=texts or {},
        attributes={"GenSigStartValue": start_value},
    )


def signals_of(
    variable: Variable,
    place: SignalPlan,
    protocol: EscProtocol,
) -> list[SignalRow]:
    """Return the signals of a mapped object: several for an error word and the link status."""
    entry = variable.entry
    bound = variable.bound
    # names of any EDS: characters that a parser may take for syntax are replaced
    comment = f"Object {entry.place}, {entry.name.translate(_SYNTAX)}."
    start = place.pieces[0].at
    if bound is not None and not place.signed:
        bits = protocol.errors.get(bound.source.name)
        if bits:
            return _error_word(
                bits,
                start,
                place.length,
                comment,
            )
        if bound.source.name == "link_status":
            return _link(start, comment)
    signal = SignalRow(
        _stem(entry),
        start,
        place.length,
        comment,
        is_signed=place.signed,
        is_float=place.is_float,
        receivers=["Logger"],
        attributes={"GenSigStartValue": 0},
    )
    low = -(1 << place.length - 1) if place.signed else 0
    high = low + (1 << place.length) - 1
    if bound is not None:
        _describe_value(
            signal,
            bound,
            protocol,
            low,
            high,
        )
        if entry.index >= _MIRRORS:
            signal.name = _stem(entry)
        return [signal]
    if not place.is_float:
        signal.limits = (low * signal.factor, high * signal.factor)
    shape = (place.length, place.signed)
    if (entry.index, entry.sub, *shape) == (at.ERROR_CODE, 0, 16, False):
        signal.texts = emergency_names(protocol.errors.get("operating_errors", ()))
    return [signal]


def _error_word(
    bits: Sequence[ErrorBit],
    start: int,
    length: int,
    comment: str,
) -> list[SignalRow]:
    """Return a signal for each bit of an error word."""
    return [
        unsigned_signal(
            pascal_case(bit.name),
            start=start + bit,
            length=1,
            comment=f"{comment} Bit {int(bit)}, {bit.meaning}.",
        )
        for bit in bits
        if bit < length
    ]


def _describe_value(
    signal: SignalRow,
    bound: Bound,
    protocol: EscProtocol,
    low: int,
    high: int,
) -> None:
    """Set name, unit, factor, limits and value names of a value of the ESC or the gateway.

    ``low`` and ``high`` are the raw limits of the object's type.
    """
    source = bound.source
    names, signal.name = _named(source.name, source.names, protocol)
    signal.unit = _ASCII_UNITS.get(source.unit, source.unit)
    signal.factor = 1 / bound.steps
    signal.comment = f"{signal.comment}{_NOTES.get(source.name, '')}"
    if not source.rolls:
        if signal.is_signed:
            not_available = low
            low += 1
        else:
            not_available = high
            high -= 1
        names = {raw: text for raw, text in names.items() if low <= raw <= high}
        signal.texts = names | {not_available: "NotAvailable"}
        if signal.length <= _MAX_START_VALUE_BITS:
            signal.attributes = {"GenSigStartValue": not_available}
    high = max(names, default=high)
    if not signal.is_float:
        signal.limits = (low * signal.factor, high * signal.factor)


def _link(start: int, comment: str) -> list[SignalRow]:
    """Return the signals of the link status."""
    names = {int(state): pascal_case(state.name) for state in LinkState}
    state = unsigned_signal(
        "LinkState",
        start=start,
        length=_LINK_BITS,
        comment=f"{comment} State of the telemetry line between ESC and gateway.",
        high=max(names),
        texts=names,
    )
    flags = [
        unsigned_signal(stem, start=start + bit, length=1, comment=f"{comment} {meaning}")
        for stem, bit, meaning in _LINK_FLAGS
    ]
    return [state, *flags]


def _named(
    name: str,
    names: Mapping[int, str],
    protocol: EscProtocol,
) -> tuple[dict[int, str], str]:
    """Return value names and signal name of a source.

    Each number of an enumeration has a name, because tools discard all names if one sample has
    none.
    """
    if name == "operating_state_raw":
        texts = {number: state.text for number, state in protocol.states.items()}
        return _complete(texts, 0xFF, "State"), "OperatingState"
    if name == "device_raw":
        wire = protocol.by_name.get(name)
        last = 0 if wire is None else min(wire.high, 0xFF)
        return _complete(protocol.devices, last, "Device"), "Device"
    value_names = {int(number): pascal_case(text) for number, text in names.items()}
    return value_names, pascal_case(name)


def _complete(
    texts: Mapping[int, str],
    last: int,
    word: str,
) -> dict[int, str]:
    """Return a name for each number up to ``last``: its text, or ``word`` and the number."""
    return {number: pascal_case(texts.get(number, f"{word}{number}")) for number in range(last + 1)}


def _stem(entry: EdsEntry) -> str:
    """Return a signal name for an object, whose name may have any characters."""
    stem = pascal_case(entry.name)
    if re.fullmatch("[A-Z].*[a-z].*", stem):
        return stem
    return f"Object{entry.index:04X}Sub{entry.sub:02X}"
