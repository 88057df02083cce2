"""Compiles a DBC to a layout. All mistakes in a DBC or its bindings are found here, at start, at once.

A layout is the tuple of MessagePlans that the configured transmitter node sends. Ids, positions, byte order, sign, factor, offset,
limits, value tables and timing come only from the file.
"""

import difflib
import math
import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc import counters, send_types
from kontronik_can_gw.dbc.binding import Binder
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.reader import attribute, choose_node, listed
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import MS, EscSettings
from kontronik_can_gw.esc.values import Divisor, Group, Value, divisor_of_settings
from kontronik_can_gw.signals import units
from kontronik_can_gw.signals.plan import (
    FD_LENGTHS,
    Layout,
    MessagePlan,
    Piece,
    Role,
    SendType,
    SignalPlan,
)

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal


_NOT_AVAILABLE_TEXTS = frozenset({"notavailable", "sna", "na", "signalnotavailable"})

_ERROR_TEXTS = frozenset({"error", "err", "invalid"})

_LARGEST_FLOAT = int(struct.unpack("<f", b"\xff\xff\x7f\x7f")[0])

_MAX_PAGES = 1024
"""Maximum of multiplexer values in one of our messages."""

_MANY = 5

_SUSPECT = {
    None: "",
    counters.Kind.COUNTER: ' If it counts the frames: bind = "alive".',
    counters.Kind.CHECKSUM: ' If it is the CRC of AUTOSAR E2E profile 1: bind = "crc".',
}


@dataclass(frozen=True)
class DbcSettings:
    """How a DBC is used. ``bind``: "Message.Signal" or "Signal" to a source name (``name`` or ``esc.name``) or a constant."""

    bind: Mapping[str, str | float] = field(default_factory=dict)
    node: str | None = None
    """The transmitter node whose messages we send; None: the only one that sends."""
    base_id: int | None = None
    id_step: int | None = None
    data_ids: Mapping[str, int] = field(default_factory=dict)
    """Message name to E2E data id; otherwise the CAN id's low 16 bits."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Unit text of the DBC to the unit that it means."""
    send_types: Mapping[str, str] = field(default_factory=dict)
    """GenMsgSendType to the entry of ``send_types.NAMES`` that it means."""
    messages: tuple[str, ...] = ()
    """Patterns that select our messages by name (used by ``prepare``); empty: all."""
    unbound: str = "error"
    """For a signal without a source: "error", or always send its "start_value"."""
    flags_on_loss: int | None = None
    """Value without telemetry of a flag that has no code for it; None: its own start value, else 0."""


def compile_layout(
    database: "Database",
    file: str,
    escs: Sequence[EscSettings],
    settings: DbcSettings,
    taken_ids: Mapping[int, str] | None = None,
    fd_allowed: bool = False,
) -> Layout:
    """Compile all of our messages. UserError with all mistakes at once.

    ``taken_ids``: 11-bit ids already in use (COB-IDs of our CANopen nodes), and their users.
    """
    node = choose_node(database, settings.node, file)
    compiler = _Compiler(database, file, escs, settings, fd_allowed)
    ours = [message for message in database.messages if node in message.senders]
    plans = [plan for message in ours if (plan := compiler.message(message)) is not None]
    compiler.check_ids(ours, taken_ids or {})
    for key in sorted(set(settings.bind) - compiler.binder.used):
        known = [m.name for m in ours] + [f"{m.name}.{s.name}" for m in ours for s in m.signals]
        near = difflib.get_close_matches(key, known, n=1)
        hint = f" Did you mean {near[0]}?" if near else ""
        compiler.problems.append(
            f"dbc.bind.{key}: no such signal in the messages of {node} in {file}.{hint}"
        )
    for table, given, met, what in (
        ("units", settings.units, compiler.units, "signal of {} has this unit"),
        (
            "send_type",
            settings.send_types,
            compiler.send_types,
            "message of {} has this GenMsgSendType",
        ),
    ):
        for text in sorted(set(given) - met):
            near = difflib.get_close_matches(text, met, n=1, cutoff=0.3)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            compiler.problems.append(f"dbc.{table}.{text}: no {what.format(node)} in {file}.{hint}")
    for name in sorted(set(settings.data_ids) - {m.name for m in ours}):
        compiler.problems.append(f"dbc.e2e_data_ids.{name}: no such message of {node} in {file}.")
    if compiler.unbound > _MANY:
        compiler.problems.append(
            f"{file}: {compiler.unbound} signals of {node} are bound to nothing. dbc.messages chooses messages, as "
            f'["{ours[0].name}", "Esc*"]; dbc.unbound = "start_value" sends what is not bound as a constant.'
        )
    if compiler.problems:
        raise UserError(*compiler.problems)
    once = [plan.name for plan in plans if not plan.cycle_ns and not plan.paces]
    if once:
        compiler.warnings.append(
            f"{file}: sent once at the start, without a cycle and a value that changes: {listed(once)}"
        )
    if names := compiler.while_active:
        compiler.warnings.append(
            f"{file}: sent all the time, not only while something is active: {listed(names)}"
        )
    return Layout(file, node, tuple(plans), tuple(compiler.warnings))


class _Compiler:
    def __init__(
        self,
        database: "Database",
        file: str,
        escs: Sequence[EscSettings],
        settings: DbcSettings,
        fd_allowed: bool,
    ) -> None:
        self.database = database
        self.file = file
        self.settings = settings
        self.fd_allowed = fd_allowed
        self.binder = Binder(escs, settings.bind)
        self.problems: list[str] = []
        self.warnings: list[str] = []
        self.units: set[str] = set()
        """Unit texts found in our messages."""
        self.send_types: set[str] = set()
        self.while_active: list[str] = []
        """Messages whose send type means: only while a signal is active."""
        self.unbound = 0

    def check_ids(self, ours: Sequence["Message"], taken: Mapping[int, str]) -> None:
        mine = {id(message) for message in ours}
        ids: dict[tuple[int, bool], Message] = {}
        names: dict[str, Message] = {}
        for message in self.database.messages:
            other = ids.setdefault((message.frame_id, message.is_extended_frame), message)
            if other is not message and mine & {id(message), id(other)}:
                self.problems.append(
                    f"{self.file}: {message.name}: id {message.frame_id:X}h is also that of {other.name}. Change one of them."
                )
            other = names.setdefault(message.name, message)
            if other is not message and mine & {id(message), id(other)}:
                self.problems.append(
                    f"{self.file}: {message.name}: two messages have this name. Rename one of them."
                )
            if id(message) in mine:
                counted = Counter(signal.name for signal in message.signals)
                for name in (name for name, count in counted.items() if count > 1):
                    self.problems.append(
                        f"{self.file}: {message.name}.{name}: two signals have this name. Rename one."
                    )
        for message in ours:
            if not message.is_extended_frame and message.frame_id in taken:
                self.problems.append(
                    f"{self.file}: {message.name}: id {message.frame_id:X}h is used by {taken[message.frame_id]}. "
                    f"Move the message (free for all: 680h..6DFh) or change the node-ID."
                )

    def message(self, message: "Message") -> MessagePlan | None:
        where = f"{self.file}: {message.name}"
        before = len(self.problems)
        is_fd = message.is_fd or message.length > 8
        if is_fd and not self.fd_allowed:
            self.problems.append(
                f"{where}: is a CAN FD message ({message.length} bytes). Set can.fd = true, or shorten it."
            )
        if is_fd and message.length not in FD_LENGTHS:
            self.problems.append(
                f"{where}: CAN FD has no frames of {message.length} bytes, but {', '.join(map(str, FD_LENGTHS[9:]))}."
            )
        if message.is_container or message.length == 0 or not message.signals:
            self.problems.append(
                f"{where}: has no signal that could be sent. Give it signals, or leave it out (dbc.messages)."
            )
            return None
        if message.length > FD_LENGTHS[-1]:
            return None
        send_type, cycle_ms, delay_ms = self._timing(message, where)
        multiplexers = [s for s in message.signals if s.is_multiplexer]
        if len(multiplexers) > 1 or any(
            s.is_multiplexer and s.multiplexer_ids for s in message.signals
        ):
            self.problems.append(
                f"{where}: has more than one level of multiplexing; one is supported."
            )
            return None
        pages: set[int] = {page for s in message.signals for page in s.multiplexer_ids or ()}
        if len(pages) > _MAX_PAGES:
            self.problems.append(
                f"{where}: has {len(pages)} multiplexer values; {_MAX_PAGES} are supported."
            )
            return None
        signals: list[SignalPlan] = []
        for signal in message.signals:
            for page in signal.multiplexer_ids or (None,):
                if (plan := self._signal(message, signal, page)) is not None:
                    signals.append(plan)
        self._check_overlap(message, where)
        for multiplexer in multiplexers:
            room = (
                (1 << multiplexer.length - (1 if multiplexer.is_signed else 0))
                if not multiplexer.is_float
                else 0
            )
            for page in sorted(p for p in pages if p >= room):
                self.problems.append(
                    f"{where}.{multiplexer.name}: cannot hold the multiplexer value {page} (m{page})."
                )
        for paged in signals:
            if paged.page is not None and paged.role in (Role.ALIVE, Role.CRC):
                self.problems.append(
                    f"{where}.{paged.name}: is a multiplexed {paged.role.value}; it has to be in every frame. "
                    f"Take the m{paged.page} away, or bind it to a constant."
                )
        crcs = [s for s in signals if s.role is Role.CRC]
        if len(crcs) > 1:
            self.problems.append(
                f"{where}: has several CRC signals: {', '.join(s.name for s in crcs)}. Bind all but one to constants."
            )
        elif crcs:
            self._check_e2e(message, where, crcs[0], [s for s in signals if s.role is Role.ALIVE])
        if len(self.problems) > before:
            return None
        return MessagePlan(
            name=message.name,
            can_id=message.frame_id,
            extended=message.is_extended_frame,
            fd=is_fd,
            length=message.length,
            send_type=send_type,
            cycle_ns=cycle_ms * MS if SendType.CYCLIC in send_type else 0,
            delay_ns=delay_ms * MS,
            signals=tuple(signals),
            escs=frozenset(s.esc for s in signals if s.esc is not None),
            paces=frozenset(s.source.pace or s.source.group for s in signals if s.source),
            pages=tuple(sorted(pages)) if pages else (None,),
            data_id=self.settings.data_ids.get(message.name, message.frame_id & 0xFFFF),
        )

    def _check_e2e(
        self, message: "Message", where: str, crc: SignalPlan, alive: Sequence[SignalPlan]
    ) -> None:
        """A checksum is sent only as AUTOSAR E2E profile 1, if it is configured or has the well-known names."""
        asked = (
            message.name in self.settings.data_ids
            or self.binder.bound(message.name, crc.name) is not None
        )
        fits = len(crc.pieces) == 1 and crc.length == 8 and not crc.pieces[0].at % 8
        one = len(alive) == 1 and alive[0].high >= 14
        key = f"dbc.e2e_data_ids.{message.name} = 0x{message.frame_id & 0xFFFF:X}"
        by_names = one and counters.is_e2e(
            crc.name, str(self.binder.bound(message.name, alive[0].name) or alive[0].name)
        )
        if not asked and not (fits and by_names):
            self.problems.append(
                f"{where}.{crc.name}: the DBC does not say how this checksum is made. AUTOSAR E2E profile 1 (8 bits on a byte border, "
                f"beside exactly one alive counter, 0 to 14) is chosen by {key}. Otherwise bind it to a constant, if receivers take "
                "one, or leave the message out (dbc.messages)."
            )
            return
        if not fits:
            self.problems.append(
                f"{where}.{crc.name}: an E2E profile 1 CRC needs 8 bits on a byte border."
            )
        if not one:
            self.problems.append(
                f"{where}: {crc.name}: E2E profile 1 needs exactly one alive counter, 0 to 14, in the message."
            )
        if not asked:
            self.warnings.append(
                f"{where}.{crc.name}: sent as AUTOSAR E2E profile 1. If that is right, say so: {key}"
            )

    def _timing(self, message: "Message", where: str) -> tuple[SendType, int, int]:
        def number(name: str) -> int:
            value = attribute(message, name, self.database)
            if value is None or value == "":
                return 0
            try:
                if float(value) < 0:
                    raise ValueError
                return round(float(value))
            except (ValueError, OverflowError):
                self.problems.append(
                    f"{where}: {name} is {str(value)[:40]!r}, which is no time in ms."
                )
                return 0

        cycle, delay = number("GenMsgCycleTime"), number("GenMsgDelayTime")
        text = str(attribute(message, "GenMsgSendType", self.database) or "")
        self.send_types.add(text)
        name, while_active = send_types.meaning(text, self.settings.send_types)
        if name is None:
            self.problems.append(
                f"{where}: GenMsgSendType {text!r} is not known. Say what it means: dbc.send_type.{text!r} = "
                f"one of {', '.join(send_types.NAMES)}."
            )
            return SendType.EVENT, cycle, delay
        if while_active:
            cycle = cycle or number("GenMsgCycleTimeFast") or number("GenMsgCycleTimeActive")
            self.while_active.append(message.name)
        if name == send_types.NONE:
            return (SendType.CYCLIC if cycle else SendType.EVENT), cycle, delay
        send_type = send_types.NAMES[name]
        if SendType.CYCLIC in send_type and not cycle:
            self.problems.append(
                f'{where}: is sent {text} but its GenMsgCycleTime is 0. Set one in ms, or dbc.send_type.{text!r} = "Event".'
            )
        return send_type, cycle, delay

    def _check_overlap(self, message: "Message", where: str) -> None:
        used: Counter[int | None] = Counter()
        """Bit mask of the used bits, for each page."""
        placed: list[tuple[str, int, set[int | None]]] = []
        every: set[int | None] = {None} | {
            page for s in message.signals for page in s.multiplexer_ids or ()
        }
        for signal in message.signals:
            mask = (
                sum(1 << bit for bit in _bits(signal))
                if signal.length <= message.length * 8
                else -1
            )
            if mask < 0 or mask.bit_length() > message.length * 8:
                self.problems.append(
                    f"{where}.{signal.name}: lies outside the message's {message.length} bytes. Move or shorten it."
                )
                continue
            pages: set[int | None] = (
                set(signal.multiplexer_ids) if signal.multiplexer_ids else every
            )
            left = mask if any(used[page] & mask for page in pages) else 0
            for other, others_mask, others_pages in placed if left else ():
                if others_mask & left and others_pages & pages and other != signal.name:
                    self.problems.append(
                        f"{where}.{signal.name}: overlaps {other}. Move one of them."
                    )
                    left &= ~others_mask
            for page in pages:
                used[page] |= mask
            placed.append((signal.name, mask, pages))

    def _unit(self, signal: "Signal") -> str:
        """A signal's unit after ``dbc.units``; empty where none is given."""
        text = (signal.unit or "").strip()
        self.units.add(text)
        text = self.settings.units.get(text, text)
        return "" if units.says_nothing(text) else text

    def _signal(self, message: "Message", signal: "Signal", page: int | None) -> SignalPlan | None:
        where = f"{self.file}: {message.name}.{signal.name}"
        length, signed, is_float = signal.length, signal.is_signed, signal.is_float
        if length > message.length * 8:
            return None  # reported by _check_overlap
        if is_float and length not in (32, 64):
            self.problems.append(
                f"{where}: a float of {length} bits cannot be sent; 32 and 64 can."
            )
            return None
        given = (signal.scale, signal.offset, signal.minimum or 0, signal.maximum or 0)
        if not all(math.isfinite(number) for number in given):
            self.problems.append(
                f"{where}: has a factor, offset or limit that is no finite number."
            )
            return None
        factor, offset = _exact(signal.scale), _exact(signal.offset)
        if factor == 0:
            self.problems.append(f"{where}: has factor 0.")
            return None
        codes = {normalize(str(text)): int(raw) for raw, text in (signal.choices or {}).items()}
        low, high = (
            (-(1 << length - 1), (1 << length - 1) - 1) if signed else (0, (1 << length) - 1)
        )
        wide = [
            f"{raw} {str(text)!r}"
            for raw, text in (signal.choices or {}).items()
            if not low <= int(raw) <= high
        ]
        if wide and not is_float:
            self.problems.append(
                f"{where}: cannot hold {', '.join(wide)} of its value table; its values are {low} to {high}."
            )
            return None
        if (
            is_float
            and length == 32
            and any(abs(int(raw)) > _LARGEST_FLOAT for raw in signal.choices or {})
        ):
            self.problems.append(
                f"{where}: has a value table with numbers that no 32-bit float holds."
            )
            return None
        start = attribute(signal, "GenSigStartValue", self.database)
        not_available = next((codes[t] for t in codes if t in _NOT_AVAILABLE_TEXTS), None)
        error = next((codes[t] for t in codes if t in _ERROR_TEXTS), None)
        if not_available is None:
            start_is_set = signal.dbc is not None and "GenSigStartValue" in signal.dbc.attributes
            # a start value that is a mere default does not mean "not available"; a flag has nothing better
            usable = (start_is_set or length == 1) and _is_raw(start, low, high)
            not_available = int(start) if usable else low if signed else high
        if error is None:
            error = not_available
        base: dict[str, Any] = {
            "name": signal.name,
            "unit": self._unit(signal),
            "length": length,
            "signed": signed,
            "is_float": is_float,
            "pieces": _pieces(signal),
            "not_available": not_available,
            "error": error,
            "page": page,
            "factor": factor,
            "offset": offset,
            "texts": _value_texts(signal),
        }
        special = [
            code for name, code in codes.items() if name in _NOT_AVAILABLE_TEXTS | _ERROR_TEXTS
        ]
        limits_set = not (signal.minimum is None and signal.maximum is None) and not (
            signal.minimum == 0 and signal.maximum == 0
        )
        if limits_set:
            ends = sorted(
                (_exact(end) - offset) / factor
                for end in (signal.minimum, signal.maximum)
                if end is not None
            )
            if signal.minimum is not None and signal.maximum is not None:
                low, high = max(low, math.ceil(ends[0])), min(high, math.floor(ends[1]))
        while high in special:
            high -= 1
        while low in special:
            low += 1
        base |= {"low": low, "high": high}
        if is_float:
            base |= _float_codes(signal, factor, offset, codes)
        if signal.is_multiplexer:
            return SignalPlan(role=Role.MULTIPLEXER, **base)
        bound = self.binder.bound(message.name, signal.name)
        if isinstance(bound, (int, float)):
            constant = _constant(bound, factor, offset, length, signed, is_float)
            if constant is None:
                self.problems.append(
                    f"{where}: the constant {bound} bound to it cannot be sent exactly."
                )
                return None
            return SignalPlan(role=Role.CONSTANT, constant=constant, **base)
        name = signal.name if bound is None else bound
        found = self.binder.by_name(name)
        kind = counters.kind(name) if found is None else None
        if kind is counters.Kind.COUNTER:
            if is_float or base["low"] > 0 or base["high"] < 2:
                self.problems.append(
                    f"{where}: an alive counter needs a whole number of 2 bits or more that begins at 0. Or bind it to a constant."
                )
                return None
            return SignalPlan(role=Role.ALIVE, **base)
        if kind is counters.Kind.CHECKSUM:
            return SignalPlan(role=Role.CRC, **base)
        if found is None and bound is None and self.settings.unbound == "start_value":
            constant = self._start_value(where, signal, base, codes)
            return (
                None
                if constant is None
                else SignalPlan(role=Role.CONSTANT, constant=constant, unbound=True, **base)
            )
        if found is None:
            self.unbound += bound is None
            via = f" (bound by dbc.bind to {bound!r})" if bound is not None else ""
            self.problems.append(
                f"{where}: no such source{via}.{self.binder.suggestions(name)}{_SUSPECT[counters.suspect(name)]} "
                "Bind it under [dbc.bind] or rename it."
            )
            return None
        source, esc = found
        if esc is None and source.group is not Group.GATEWAY:
            names = " or ".join(f"{e.name}.{source.name}" for e in self.binder.escs[:2])
            self.problems.append(
                f"{where}: does not say of which ESC. Prefix it or bind it: {names}."
            )
            return None
        return self._bound_signal(where, signal, source, esc, base, codes)

    def _start_value(
        self, where: str, signal: "Signal", base: Mapping[str, Any], codes: Mapping[str, int]
    ) -> int | None:
        """The raw bits of an unbound signal: its own start value, else NotAvailable, else the default or 0."""
        is_set = signal.dbc is not None and "GenSigStartValue" in signal.dbc.attributes
        if not is_set and _NOT_AVAILABLE_TEXTS & set(codes):
            return int(base["not_available"])
        start = attribute(signal, "GenSigStartValue", self.database) or 0
        length, signed = signal.length, signal.is_signed
        if signal.is_float and isinstance(start, (int, float)):
            raw = _constant(start, Fraction(1), Fraction(0), length, signed, is_float=True)
        elif _is_raw(
            start,
            *((-(1 << length - 1), (1 << length - 1) - 1) if signed else (0, (1 << length) - 1)),
        ):
            raw = int(start)
        else:
            raw = None
        if raw is None:
            self.problems.append(
                f"{where}: its GenSigStartValue {start} is none of its raw values. Bind it to a constant."
            )
        return raw

    def _flag_on_loss(self, signal: "Signal", codes: Mapping[str, int]) -> int | None:
        """Value without telemetry, 0 or 1, of a flag that has no code for it; None: its own start value."""
        if _NOT_AVAILABLE_TEXTS & set(codes):
            return None
        if (
            self.settings.flags_on_loss is None
            and signal.dbc is not None
            and "GenSigStartValue" in signal.dbc.attributes
        ):
            start = attribute(signal, "GenSigStartValue", self.database)
            if _is_raw(start, *((-1, 0) if signal.is_signed else (0, 1))):
                return None
        return self.settings.flags_on_loss or 0

    def _bound_signal(
        self,
        where: str,
        signal: "Signal",
        source: Value,
        esc: int | None,
        base: dict[str, Any],
        codes: Mapping[str, int],
    ) -> SignalPlan | None:
        factor, offset, unit = base["factor"], base["offset"], base["unit"]
        numbers: dict[int, int] | None = None
        notes: list[str] = []
        if source.names:
            by_text = {
                number: codes[normalize(text)]
                for number, text in source.names.items()
                if normalize(text) in codes
            }
            if by_text:
                numbers = by_text
                missing = [text for number, text in source.names.items() if number not in by_text]
                if missing:
                    notes.append(f"sent as Error, not in the value table: {', '.join(missing)}")
            else:
                notes.append("the value table has no name of it: sent as the ESC's number")
        converted = units.conversion(source.unit, unit)
        if converted is None:
            can = ", ".join(units.texts_like(source.unit))
            self.problems.append(
                f"{where}: {source.name} is in {source.unit or 'no unit'} and cannot be converted to "
                f"{unit!r}. Possible: {can}; dbc.units says what other texts mean."
            )
            return None
        if source.unit and not unit:
            self.warnings.append(f"{where}: has no unit; {source.unit} is taken.")
        scale, shift = converted
        slope = slope_of_esc = scale / source.per_unit / factor
        intercept = (shift - offset) / factor
        low, high = base["low"], base["high"]
        if numbers is None and not signal.is_float:
            if esc is not None:
                slope_of_esc = slope / divisor_of_settings(source, self.binder.escs[esc])
            step = abs(1 / slope_of_esc)
            if step > 1 and source.divisor is not Divisor.CELLS:
                notes.append(f"resolution {_number(abs(factor))} {unit or source.unit}".rstrip())
            if not source.rolls:
                ends = [
                    end * slope_of_esc + intercept
                    for end in (source.low, source.high)
                    if end is not None
                ]
                if ends and (min(ends) < low - 2 or max(ends) > high + 2):
                    # more is lost than the codes NotAvailable and Error take
                    first, last = sorted(end * factor + offset for end in (low, high))
                    text = f"{_number(first)} to {_number(last)} {unit or source.unit}".rstrip()
                    notes.append(f"range {text}, beyond it Error")
        if source.bit is not None and signal.length == 1:
            raws = [math.floor(value * slope + intercept + Fraction(1, 2)) for value in (0, 1)]
            if [raw if low <= raw <= high else base["error"] for raw in raws] != raws:
                sign = " Make it unsigned." if signal.is_signed else ""
                self.problems.append(f"{where}: cannot hold both values of a flag, 0 and 1.{sign}")
                return None
            if (on_loss := self._flag_on_loss(signal, codes)) is not None:
                base |= {"not_available": raws[on_loss], "error": raws[on_loss]}
                # an "Error" in the value table at 0 or 1 is a value, not a code
                base |= {
                    "low": min(raws),
                    "high": max(raws),
                }
        if source.rolls:
            if slope != 1 or intercept != 0 or low != 0 or high < 1 or signal.is_float:
                self.problems.append(
                    f"{where}: {source.name} is a counter; it needs factor 1, offset 0 and a minimum of 0."
                )
                return None
            notes.append(f"starts again at 0 after {high}")
        if (
            not signal.is_float
            and not _NOT_AVAILABLE_TEXTS & set(codes)
            and low <= base["not_available"] <= high
        ):
            notes.append(
                f"not available is sent as {_number(base['not_available'] * factor + offset)}"
            )
        return SignalPlan(
            role=Role.SOURCE,
            source=source,
            esc=esc,
            numbers=numbers,
            slope=slope,
            intercept=intercept,
            notes=tuple(notes),
            **base,
        )


def _is_raw(value: Any, low: int, high: int) -> bool:
    """True for a whole number within the raw range."""
    return (
        isinstance(value, (int, float))
        and math.isfinite(value)
        and value == int(value)
        and low <= value <= high
    )


def _value_texts(signal: "Signal") -> dict[int, str]:
    """The value table without the codes NotAvailable and Error."""
    table = {int(raw): str(text) for raw, text in (signal.choices or {}).items()}
    return {
        raw: text
        for raw, text in table.items()
        if normalize(text) not in _NOT_AVAILABLE_TEXTS | _ERROR_TEXTS
    }


def _float_codes(
    signal: "Signal", factor: Fraction, offset: Fraction, codes: Mapping[str, int]
) -> dict[str, Any]:
    """Limits and codes of a float signal: from its value table as floats, else NaN."""
    code = "<f" if signal.length == 32 else "<d"

    def pattern(texts: frozenset[str]) -> int:
        number = next((float(codes[text]) for text in codes if text in texts), math.nan)
        return int.from_bytes(struct.pack(code, number), "little")

    found: dict[str, Any] = {
        "not_available": pattern(_NOT_AVAILABLE_TEXTS),
        "error": pattern(_ERROR_TEXTS),
    }
    if (
        signal.minimum is not None
        and signal.maximum is not None
        and (signal.minimum, signal.maximum) != (0, 0)
    ):
        ends = sorted(
            float((_exact(end) - offset) / factor) for end in (signal.minimum, signal.maximum)
        )
        found["limits"] = (ends[0], ends[1])
    return found


def _exact(number: Any) -> Fraction:
    """The decimal number in the file, not the float nearest to it."""
    return Fraction(repr(number)) if isinstance(number, float) else Fraction(number)


def _constant(
    value: float, factor: Fraction, offset: Fraction, length: int, signed: bool, is_float: bool
) -> int | None:
    """The raw bits of a constant physical value; None where the signal cannot hold it (floats are rounded)."""
    if not math.isfinite(value):
        return None
    raw = (_exact(value) - offset) / factor
    if is_float:
        try:
            return int.from_bytes(struct.pack("<f" if length == 32 else "<d", float(raw)), "little")
        except OverflowError:
            return None
    low, high = (-(1 << length - 1), (1 << length - 1) - 1) if signed else (0, (1 << length) - 1)
    return int(raw) if raw.denominator == 1 and low <= raw <= high else None


def _number(value: Fraction) -> str:
    return f"{float(value):.10g}"


def _bits(signal: "Signal") -> list[int]:
    """The signal's bits from its least significant one, each as byte * 8 + bit in byte."""
    if signal.byte_order == "little_endian":
        return list(range(signal.start, signal.start + signal.length))
    bits, at = (
        [],
        signal.start,
    )  # big-endian: start is the most significant bit, downward within a byte, then the next byte
    for _ in range(signal.length):
        bits.append(at)
        at = at + 15 if at % 8 == 0 else at - 1
    return bits[::-1]


def _pieces(signal: "Signal") -> tuple[Piece, ...]:
    """The signal as runs of adjacent bits."""
    pieces: list[Piece] = []
    for shift, at in enumerate(_bits(signal)):
        last = pieces[-1] if pieces else None
        if last and at == last.at + last.width:
            pieces[-1] = last._replace(width=last.width + 1)
        else:
            pieces.append(Piece(shift, 1, at))
    return tuple(pieces)
