"""The compiled plan in terms of the proof: the source and the arithmetic of each signal.

Nothing is simplified here: each number of a ``SignalPlan`` and of a row of kcg_signal appears as it
is. ``formulas`` gives them the meaning that signals/packer.py and native/core.c give them.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dbc_proof.end_to_end import CrcRule, rule_of_c, rule_of_python
from dbc_proof.quantities import (
    HEADER,
    PRODUCT,
    Divisor,
    Presence,
    Read,
)
from kontronik_can_gw.esc import values
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.rows import COUNTS, GATEWAY, MAX_GEAR, MAX_POLES
from kontronik_can_gw.native.tables import ALL_ESCS, Tables
from kontronik_can_gw.signals.packer import alive_modulus, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SignalPlan

_WIRES = {"B": "u8", "b": "i8", "H": "u16", "h": "i16", "I": "u32"}
_C_WIRES = {KCG.U8: "u8", KCG.I8: "i8", KCG.U16: "u16", KCG.I16: "i16", KCG.U32: "u32"}
_DIVISORS = {
    values.Divisor.ONE: Divisor.ONE,
    values.Divisor.POLE_PAIRS: Divisor.POLES,
    values.Divisor.OUTPUT: Divisor.OUTPUT,
    values.Divisor.CELLS: Divisor.CELLS,
}
_C_DIVISORS = {
    KCG.BY_ONE: Divisor.ONE,
    KCG.BY_POLES: Divisor.POLES,
    KCG.BY_OUTPUT: Divisor.OUTPUT,
    KCG.BY_CELLS: Divisor.CELLS,
}
_C_NAMES = {
    KCG.OF_ENERGY: "energy_used",
    KCG.OF_RUN_TIME: "motor_run_time",
    KCG.OF_AGE: "data_age",
    KCG.OF_RATE: "frame_rate",
    KCG.OF_UPTIME: "uptime",
}
_NAMES_OF_COUNTS = {"bytes": "received_bytes"}
"""Counters of the core whose values have another name."""
_PRESENCE = {"data_age": Presence.AFTER_LIVE, "frame_rate": Presence.RATED}
LARGEST = {
    Divisor.ONE: (1, 1),
    Divisor.POLES: (MAX_POLES, 1),
    Divisor.OUTPUT: (MAX_POLES * MAX_GEAR, MAX_GEAR),
    Divisor.CELLS: (255, 1),
}
"""Largest ``by`` and ``over`` of each divisor, which is ``by / over``, for the core in C."""


INT64_END = 1 << 63
"""The core in C computes with smaller numbers."""


@dataclass(frozen=True)
class Scale:
    """The raw value is ``floor((x * mul * over + add * by) / (div * by))``."""

    mul: int
    add: int
    div: int
    most: int | None = None
    """Beyond this number of steps, the value is not computed but sent as ``error``."""


@dataclass(frozen=True)
class Planned:
    """The plan of a signal with a source."""

    read: Read
    presence: Presence
    esc: int | None
    divisor: Divisor
    not_on: int
    """Bit n: device n does not supply the value."""
    length: int
    scale: Scale | None
    """None: the raw value is the number of steps."""
    low: int
    high: int
    error: int
    not_available: int
    excluded: int | None
    """A raw value between low and high that is sent as ``error``."""
    numbers: Mapping[int, int] | None = None
    rolls: bool = False
    saturates: bool = False
    is_float: bool = False
    has_64_bits: bool = False
    """True for the core in C. Numbers of the core in Python have no limit."""


@dataclass(frozen=True)
class PlannedSignal:
    """A signal in a frame."""

    name: str
    page: int | None
    pieces: tuple[Piece, ...]
    planned: Planned | None
    """None for an alive counter."""
    modulus: int = 0
    """Number of values of an alive counter."""


@dataclass(frozen=True)
class PlannedMessage:
    """A message as one of the cores sends it."""

    can_id: int
    extended: bool
    length: int
    crc: CrcRule | None
    """None without a CRC."""
    crc_at: int
    """Byte of the CRC."""
    constants: Mapping[int | None, int]
    """Constant bits of a frame by page."""
    signals: tuple[PlannedSignal, ...] = field(default=())


def of_python(plan: MessagePlan, escs: Sequence[EscSettings]) -> PlannedMessage:
    """Return a message as signals/packer.py packs it."""
    crc = next((signal for signal in plan.signals if signal.role is Role.CRC), None)
    constants = {}
    for page in plan.pages:
        bits = 0
        for signal in plan.signals:
            if signal.role is Role.MULTIPLEXER:
                bits |= place(signal.pieces, page or 0)
            elif signal.role in (Role.CONSTANT, Role.DATA_ID) and signal.page in (None, page):
                bits |= place(signal.pieces, signal.constant)
        constants[page] = bits
    signals = []
    for signal in plan.signals:
        if signal.role is Role.ALIVE:
            modulus = alive_modulus(signal, plan.e2e)
            made = PlannedSignal(signal.name, signal.page, signal.pieces, None, modulus)
        elif signal.role is Role.SOURCE:
            protocol = protocol_named(escs[signal.esc or 0].protocol)
            planned = _python_plan(signal, _offsets(protocol.wire))
            made = PlannedSignal(signal.name, signal.page, signal.pieces, planned)
        else:
            continue
        signals.append(made)
    return PlannedMessage(
        can_id=plan.can_id,
        extended=plan.extended,
        length=plan.length,
        crc=None if plan.e2e is None else rule_of_python(plan.e2e),
        crc_at=0 if crc is None else crc.pieces[0].at // 8,
        constants=constants,
        signals=tuple(signals),
    )


def _offsets(wire: Any) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """Return offset in the frame and type of each word, for live data and info data."""
    found: tuple[list[tuple[int, str]], list[tuple[int, str]]] = ([], [])
    for places, (codes, _) in zip(found, wire or (), strict=False):
        at = HEADER
        for code in codes:
            places.append((at, _WIRES[code]))
            at += struct.calcsize("<" + code)
    return found


def _python_plan(
    signal: SignalPlan, offsets: tuple[list[tuple[int, str]], list[tuple[int, str]]]
) -> Planned:
    value = signal.source
    assert value is not None
    is_info = value.group is values.Group.INFO
    presence = _PRESENCE.get(value.name, Presence.ALWAYS)
    if value.group in (values.Group.LIVE, values.Group.INFO):
        presence = Presence.INFO if is_info else Presence.LIVE
    if value.last:
        presence = Presence.KNOWN_INFO
    if value.kind is values.Kind.PRODUCT:
        fields = [offsets[is_info][word] for word in value.words]
        is_power = fields == [(8, "u16"), (10, "i16")]
        read = PRODUCT if is_power else Read(f"product of the fields {fields}")
    elif value.words:
        offset, wire = offsets[is_info][value.words[0]]
        mask = 0 if value.mask == -1 else value.mask
        read = Read("info" if is_info else "live", offset, wire, value.shift, mask)
    else:
        read = Read(value.name)
    common = signal.slope.denominator * signal.intercept.denominator
    scale = Scale(
        mul=2 * int(signal.slope * common),
        add=2 * int(signal.intercept * common) + common,
        div=2 * common,
    )
    return Planned(
        read=read,
        presence=presence,
        esc=signal.esc,
        divisor=_DIVISORS[value.divisor],
        not_on=sum(1 << int(device) for device in value.not_on),
        length=signal.length,
        scale=scale,
        low=signal.low,
        high=signal.high,
        error=signal.error,
        not_available=signal.not_available,
        excluded=signal.not_available,
        numbers=signal.numbers,
        rolls=value.rolls,
        saturates=signal.saturates,
        is_float=signal.is_float,
    )


def of_c(plan: MessagePlan, index: int, tables: Tables) -> PlannedMessage:
    """Return message ``index`` as native/core.c packs it from its tables."""
    row = tables.messages[index]
    constants: dict[int | None, int] = {}
    for number, page in enumerate(plan.pages):
        bits = 0
        for word in range(row.words):
            at = row.first_word + number * row.words + word
            bits |= tables.constants[at] << 64 * word
        constants[page] = bits
    names = [s.name for s in plan.signals if s.role in (Role.SOURCE, Role.ALIVE)]
    signals = []
    for number, name in enumerate(names[: row.signals]):
        signal = tables.signals[row.first_signal + number]
        pieces = [
            tables.pieces[place]
            for place in range(signal.first_piece, signal.first_piece + signal.pieces)
        ]
        is_alive = signal.kind == KCG.OF_ALIVE
        signals.append(
            PlannedSignal(
                name,
                None if signal.page == KCG.PAGES else plan.pages[signal.page],
                tuple(_within_word(piece) for piece in pieces),
                None if is_alive else _c_plan(signal, tables),
                signal.div if is_alive else 0,
            )
        )
    extended = 1 << 31
    return PlannedMessage(
        can_id=row.id & ~extended,
        extended=bool(row.id & extended),
        length=row.length,
        crc=rule_of_c(tables.e2e[row.e2e]) if row.flags & KCG.HAS_CRC else None,
        crc_at=row.crc_at,
        constants=constants,
        signals=tuple(signals),
    )


def _within_word(piece: Any) -> Piece:
    """Return a piece without the bits that core.c would shift out of a word of 64 bits."""
    return Piece(piece.shift, min(piece.width, 64 - piece.at % 64), piece.at)


def _c_source(row: Any) -> tuple[Read, Presence]:
    """Return the source of a row of kcg_signal (twin: core.c, steps)."""
    kind = row.kind
    field_kinds = {
        KCG.OF_LIVE: ("live", Presence.LIVE),
        KCG.OF_INFO: ("info", Presence.INFO),
        KCG.OF_LAST: ("info", Presence.KNOWN_INFO),
    }
    if kind in field_kinds:
        source, presence = field_kinds[kind]
        offset = row.place + HEADER
        return Read(source, offset, _C_WIRES[row.wire], row.shift, row.mask), presence
    if kind == KCG.OF_POWER:
        return PRODUCT, Presence.LIVE
    if kind == KCG.OF_COUNT:
        name = COUNTS[row.place]
        return Read(_NAMES_OF_COUNTS.get(name, name)), Presence.ALWAYS
    if kind == KCG.OF_GATEWAY:
        return Read(GATEWAY[row.place]), Presence.ALWAYS
    name = _C_NAMES.get(kind, f"kind {kind} of the core in C")
    return Read(name), _PRESENCE.get(name, Presence.ALWAYS)


def _c_plan(row: Any, tables: Tables) -> Planned:
    read, presence = _c_source(row)
    flags = row.flags
    numbers: dict[int, int] | None = None
    if flags & KCG.TABLE:
        numbers = {}
        for at in range(row.first_pair, row.first_pair + row.pairs):
            pair = tables.pairs[at]
            numbers.setdefault(pair.number, pair.raw)
    scale = None
    if not flags & KCG.PLAIN and numbers is None:
        scale = Scale(row.mul, row.add, row.div, row.most)
    is_float = bool(flags & KCG.REAL)
    if is_float and numbers is None:
        scale = Scale(row.mul, 0, row.div)
    is_direct = flags == KCG.DIRECT | KCG.PLAIN
    return Planned(
        read=read,
        presence=presence,
        esc=None if row.esc == ALL_ESCS else row.esc,
        divisor=Divisor.ONE if is_direct else _C_DIVISORS[row.divisor],
        not_on=0 if is_direct else row.not_on,
        length=row.length,
        scale=scale,
        low=row.low,
        high=row.high,
        error=row.error,
        not_available=row.not_available,
        excluded=_signed(row.not_available) if flags & KCG.CODE_AMID else None,
        numbers=numbers,
        rolls=bool(flags & KCG.ROLLS),
        saturates=bool(flags & KCG.SATURATES),
        is_float=is_float,
        has_64_bits=True,
    )


def _signed(bits: int) -> int:
    """Return 64 bits as the signed number that C compares."""
    return bits - (1 << 64) if bits >> 63 else bits


def products(planned: Planned, most_steps: int) -> Iterator[tuple[str, int]]:
    """Yield each product and sum that the core in C computes, at its largest absolute value.

    Each is a sum of products of independent numbers, so it is largest at the ends of their ranges.
    """
    scale = planned.scale
    if scale is None or not planned.has_64_bits:
        return
    by, over = LARGEST[planned.divisor]
    steps = most_steps if scale.most is None else min(most_steps, scale.most)
    first = steps * abs(scale.mul)
    yield "steps times factor", first
    yield "steps times factor times gear", first * over
    yield "offset times divisor", abs(scale.add) * by
    yield "the sum of both", first * over + abs(scale.add) * by
    yield "the divisor of both", scale.div * by
