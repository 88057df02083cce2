"""The compiled plan in terms of the proof: the source and the arithmetic of each signal.

Nothing is simplified here: each number of a ``SignalPlan`` and of a row of kcg_signal appears as it
is. ``formulas`` gives them the meaning that signals/packer.py and native/core.c give them.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from specification.quantities import (
    HEADER,
    PRODUCT,
    Divisor,
    Presence,
    Read,
)

from dbc_proof.end_to_end import CrcRule, rule_of_c, rule_of_python
from dbc_proof.sending import Sending
from kontronik_can_gw.core.messages import Traits
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc import values
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.rows import COUNTS, GATEWAY, MAX_GEAR, MAX_POLES
from kontronik_can_gw.native.tables import ALL_ESCS, Tables
from kontronik_can_gw.signals.packer import alive_modulus, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SignalPlan

_C_WIRES = {KCG.U8: "B", KCG.I8: "b", KCG.U16: "H", KCG.I16: "h", KCG.U32: "I"}
_DIVISORS = {
    values.Divisor.ONE: Divisor.ONE,
    values.Divisor.POLE_PAIRS: Divisor.POLES,
    values.Divisor.SHAFT: Divisor.OUTPUT,
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
    is_of_settings: bool = False
    """True if the scale contains pole pairs and gear of the ESC, and is valid only with them."""
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
    """Constant bits of a frame by group."""
    sending: Sending
    signals: tuple[PlannedSignal, ...] = ()
    wrong_rows: tuple[str, ...] = ()
    """Numbers of the core in C that contradict each other."""


def of_python(plan: MessagePlan, settings: CoreSettings) -> PlannedMessage:
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
            protocol = protocol_named(settings.escs[signal.esc or 0].protocol)
            planned = _python_plan(signal, _offsets(protocol.wire))
            made = PlannedSignal(signal.name, signal.page, signal.pieces, planned)
        else:
            continue
        signals.append(made)
    traits = Traits(plan, settings)
    return PlannedMessage(
        can_id=plan.can_id,
        extended=plan.extended,
        length=plan.length,
        crc=None if plan.e2e is None else rule_of_python(plan.e2e),
        crc_at=0 if crc is None else crc.pieces[0].at // 8,
        constants=constants,
        sending=Sending(
            fd=plan.fd,
            cycle_ns=plan.cycle_ns,
            delay_ns=plan.delay_ns,
            by_event=traits.by_event,
            on_change=traits.on_change,
            silent_on_loss=traits.is_silent_on_loss,
            follows_gateway=traits.follows_gateway,
            untimed=traits.is_untimed,
            events=int(traits.triggers),
            escs=tuple(sorted(plan.escs)),
            alive_values=max(1, traits.alive_modulus),
        ),
        signals=tuple(signals),
    )


def _offsets(wire: Any) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """Return offset in the frame and type of each word, for live data and info data."""
    found: tuple[list[tuple[int, str]], list[tuple[int, str]]] = ([], [])
    for places, (codes, _) in zip(found, wire or (), strict=False):
        at = HEADER
        for code in codes:
            places.append((at, code))
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
        is_power = fields == [(8, "H"), (10, "h")]
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


def of_c(
    plan: MessagePlan, index: int, tables: Tables, pages: Sequence[int | None]
) -> PlannedMessage:
    """Return message ``index`` as native/core.c packs it from its tables.

    ``pages`` are the multiplexer values of the DBC. The rows have their positions only.
    """
    row = tables.messages[index]
    names = [s.name for s in plan.signals if s.role in (Role.SOURCE, Role.ALIVE)]
    wrong = [*_wrong_numbers(row, len(names), tables)]
    constants: dict[int | None, int] = {}
    for position in range(row.pages):
        bits = 0
        for word in range(row.words):
            at = row.first_word + position * row.words + word
            if at < len(tables.constants):
                bits |= tables.constants[at] << 64 * word
        constants[_page(pages, position)] = bits
    signals = []
    for number, name in enumerate(names):
        at = row.first_signal + number
        if number >= row.signals or at >= len(tables.signals):
            break  # a wrong number, too
        signal = tables.signals[at]
        wrong += [f"{name}: {problem}" for problem in _wrong_numbers_of_signal(signal, tables)]
        is_alive = signal.kind == KCG.OF_ALIVE
        signals.append(
            PlannedSignal(
                name,
                None if signal.page == KCG.PAGES else _page(pages, signal.page),
                tuple(_within_word(piece) for piece in _rows(tables.pieces, signal, "piece")),
                None if is_alive else _c_plan(at, tables),
                signal.div if is_alive else 0,
            )
        )
    extended = 1 << 31
    crc = None
    if row.flags & KCG.HAS_CRC and row.e2e < len(tables.e2e):
        crc = rule_of_c(tables.e2e[row.e2e])
    return PlannedMessage(
        can_id=row.id & ~extended,
        extended=bool(row.id & extended),
        length=row.length,
        crc=crc,
        crc_at=row.crc_at,
        constants=constants,
        sending=Sending(
            fd=bool(row.fd_flags),
            cycle_ns=row.cycle,
            delay_ns=row.delay,
            by_event=bool(row.flags & KCG.EVENT),
            on_change=bool(row.flags & KCG.ON_CHANGE),
            silent_on_loss=bool(row.flags & KCG.SILENT_ON_LOSS),
            follows_gateway=bool(row.flags & KCG.OF_THE_GATEWAY),
            untimed=bool(row.flags & KCG.FREE),
            events=row.triggers,
            escs=tuple(tables.esc_of[row.first_esc : row.first_esc + row.escs]),
            alive_values=row.last_alive + 1,
        ),
        signals=tuple(signals),
        wrong_rows=tuple(wrong),
    )


def _page(pages: Sequence[int | None], position: int) -> int | None:
    """Return the multiplexer value at a position. A negative number if there is none."""
    return pages[position] if position < len(pages) else -position


def _rows(table: Any, owner: Any, name: str) -> list[Any]:
    """Return the rows of a table that belong to a row, as far as the table has them."""
    first = getattr(owner, f"first_{name}")
    end = min(first + getattr(owner, f"{name}s"), len(table))
    return [table[at] for at in range(first, end)]


def _wrong_numbers(row: Any, signals: int, tables: Tables) -> Iterator[str]:
    """Yield numbers of a row of kcg_message that no other description has."""
    if row.signals != signals:
        yield f"has {row.signals} signals with a value, not {signals}"
    if row.words != max(1, -(-row.length // 8)):
        yield f"has {row.words} words for {row.length} bytes"
    if row.fd_flags > 1:
        yield f"has the flags {row.fd_flags} of CAN FD"
    if row.flags & (KCG.TRANSFER | KCG.PACED) or row.flags > 2 * KCG.PACED:
        yield f"has the flags {row.flags:#x}"
    if not 0 <= row.phase < max(1, row.cycle):
        yield f"begins {row.phase} ns after the start, with a cycle of {row.cycle} ns"


def _wrong_numbers_of_signal(row: Any, tables: Tables) -> Iterator[str]:
    """Yield numbers of a row of kcg_signal that no other description has."""
    if row.first_piece + row.pieces > len(tables.pieces) or not row.pieces:
        yield f"has {row.pieces} parts from {row.first_piece} on"
    if row.flags & KCG.TABLE and row.first_pair + row.pairs > len(tables.pairs):
        yield f"has {row.pairs} names from {row.first_pair} on"
    if row.state_place or row.negative_states:
        yield f"is negative in states {row.negative_states:#x} of byte {row.state_place}"
    if row.kind == KCG.OF_ALIVE and row.esc != ALL_ESCS:
        yield f"is an alive counter of ESC {row.esc}"


def wrong_tables(
    expected: Sequence[tuple[int, Sending | None]], tables: Tables, quiet_after_ns: int
) -> Iterator[str]:
    """Yield numbers of kcg_plan and its tables that contradict the messages.

    ``expected`` has the number of groups and the timing of each message.
    """
    counts = tables.counts
    wanted = {
        "words": len(tables.constants),
        "messages": len(expected),
        "escs": len(tables.settings),
        "pages": sum(pages for pages, _ in expected),
        "slots": 0,
        "quiet_after_ns": quiet_after_ns,
    }
    for name, number in counts.items():
        if number != wanted.get(name):
            yield f"{name} is {number}, not {wanted.get(name)}"
    phases: dict[tuple[int, int], int] = {}
    words = list[int]()
    pages = list[int]()
    escs = list[int]()
    for number, row in enumerate(tables.messages):
        words += range(row.first_word, row.first_word + row.pages * row.words)
        pages += range(row.first_page, row.first_page + row.pages)
        escs += range(row.first_esc, row.first_esc + row.escs)
        if row.cycle and phases.setdefault((row.cycle, row.phase), number) != number:
            yield f"two messages with a cycle of {row.cycle} ns begin after {row.phase} ns"
    for name, places, size in (
        ("constant", words, len(tables.constants)),
        ("page", pages, tables.pages),
        ("esc_of", escs, len(tables.esc_of)),
    ):
        if sorted(places) != [*range(size)]:
            yield f"the messages do not use each entry of {name} once"
    for esc in range(len(tables.settings)):
        wanted_listeners = [
            number
            for number, (_, sending) in enumerate(expected)
            if sending is not None and sending.events and esc in sending.escs
        ]
        first, end = tables.first_listeners[esc : esc + 2]
        known = {number for number, (_, sending) in enumerate(expected) if sending is not None}
        listeners = [number for number in tables.listeners[first:end] if number in known]
        if listeners != wanted_listeners:
            yield f"events of ESC {esc} request the messages {listeners}, not {wanted_listeners}"


def wrong_settings(escs: Sequence[EscSettings], tables: Tables) -> Iterator[str]:
    """Yield settings of an ESC that differ from the configuration."""
    for esc, row in zip(escs, tables.settings, strict=True):
        wanted = {
            "timeout": esc.timeout_ns,
            "crc_errors": min(esc.crc_error_threshold, (1 << 32) - 1),
            "poles": esc.pole_pairs,
            "gear_numerator": esc.gear.numerator,
            "gear_denominator": esc.gear.denominator,
            "cells": esc.cell_count,
        }
        for name, number in wanted.items():
            if getattr(row, name) != number:
                yield f"{esc.name}: {name} is {getattr(row, name)}, not {number}"


def _within_word(piece: Any) -> Piece:
    """Return a piece without the bits that core.c would shift out of a word of 64 bits."""
    return Piece(piece.shift, min(piece.width, 64 - piece.at % 64), piece.at)


def c_source(row: Any) -> tuple[Read, Presence]:
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


def _c_plan(index: int, tables: Tables) -> Planned:
    row = tables.signals[index]
    read, presence = c_source(row)
    flags = row.flags
    numbers: dict[int, int] | None = None
    if flags & KCG.TABLE:
        numbers = {}
        for pair in _rows(tables.pairs, row, "pair"):
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
        is_of_settings=index in tables.of_settings,
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
