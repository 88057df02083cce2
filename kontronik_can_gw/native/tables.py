"""Makes the tables of the core in C (core.h, kcg_plan) from compiled messages.

Raises NotInCore for a message that the core in C cannot express. scale.py proves that no product
leaves int64, for any value and any settings within the limits. A single message without this proof
raises NotInCore, too. Then the core in Python runs the whole gateway (load.py, make_core).
"""

import struct
from ctypes import c_uint16, c_uint64
from itertools import accumulate, chain
from typing import Any

from kontronik_can_gw.core.messages import Traits, phases
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.protocols import protocol_named
from kontronik_can_gw.esc.values import VALUES, Divisor, Group, Kind, Value
from kontronik_can_gw.native.header import KCG
from kontronik_can_gw.native.rows import (
    COUNTS,
    GATEWAY,
    WIRE_TYPES,
    E2e,
    Message,
    NotInCore,
    Pair,
    Piece,
    Signal,
    TableRows,
    bind_direction,
    e2e_row,
    settings_of,
)
from kontronik_can_gw.native.scale import set_scale
from kontronik_can_gw.signals.packer import alive_modulus, place
from kontronik_can_gw.signals.plan import MessagePlan, Role, SignalPlan
from kontronik_can_gw.status import GatewayState
from kontronik_can_gw.times import END_OF_TIME

ALL_ESCS = 255
MAX_ROWS = 0xFFFF
"""Number of rows of a table whose index has 16 bits."""
MAX_ALIVE = 1 << 16
MAX_BITS = 64
_DIVISORS = {
    Divisor.ONE: KCG.BY_ONE,
    Divisor.POLE_PAIRS: KCG.BY_POLES,
    Divisor.SHAFT: KCG.BY_OUTPUT,
    Divisor.CELLS: KCG.BY_CELLS,
}
_M64 = (1 << 64) - 1


class Tables:
    """The tables of the core for a layout."""

    def __init__(
        self,
        settings: CoreSettings,
    ) -> None:
        layout = settings.layout
        escs = settings.escs
        self._core_settings = settings
        self._plans = layout.messages
        self.signals = TableRows(Signal)
        self.messages = TableRows(Message)
        self.pieces = TableRows(Piece)
        self.pairs = TableRows(Pair)
        self.e2e = TableRows(E2e)
        self.constants: list[int] = []
        self.esc_of: list[int] = []
        self.pages = 0
        self.settings = [settings_of(esc) for esc in escs]
        self.slots: list[Any] = []
        """A row of kcg_slot_row for each slot."""
        self.listeners_of: list[list[int]] = [[] for _ in escs]
        """For each ESC, the messages that follow its events."""
        self.of_settings: dict[int, tuple[Any, SignalPlan]] = {}
        """Rows of ``signals`` that contain settings of their ESC, by index."""
        self._escs = escs
        self._wire = [places_of(protocol_named(esc.protocol)) for esc in escs]
        starts = phases([plan.cycle_ns for plan in layout.messages])
        if len(escs) >= ALL_ESCS or len(layout.messages) > 0xFFFF:
            raise NotInCore(f"too many ESCs ({len(escs)}) or messages ({len(layout.messages)})")
        for index, plan in enumerate(layout.messages):
            if plan.length > KCG.DATA or len(plan.pages) > KCG.PAGES:
                size = f"{plan.length} bytes, {len(plan.pages)} pages"
                raise NotInCore(f"{plan.name}: too large ({size})")
            longest = max(plan.cycle_ns, plan.delay_ns)
            if longest >= END_OF_TIME:
                raise NotInCore(f"{plan.name}: a cycle time or delay of {longest} ns is too long")
            self._add(plan, starts[index])
            for esc in plan.escs:
                if self.messages[-1].triggers:
                    self.listeners_of[esc].append(index)
        most = max(len(self.signals), self.pages, len(self.listeners))
        if most > MAX_ROWS:
            raise NotInCore(f"too many signals ({len(self.signals)}) or groups ({self.pages})")

    @property
    def names(self) -> dict[str, list[str]]:
        """Names of the rows of the tables of messages and signals."""
        messages = []
        signals = []
        for plan in self._plans:
            messages.append(plan.name)
            for signal in plan.signals:
                if signal.role in (Role.SOURCE, Role.ALIVE):
                    signals.append(f"{plan.name}.{signal.name}")
        return {"message": messages, "signal": signals}

    @property
    def listeners(self) -> list[int]:
        """``listeners_of`` of all ESCs, one after the other."""
        return [*chain.from_iterable(self.listeners_of)]

    @property
    def first_listeners(self) -> list[int]:
        """The first index in ``listeners`` of each ESC, and the length of ``listeners``."""
        return [*accumulate(map(len, self.listeners_of), initial=0)]

    @property
    def arrays(self) -> dict[str, tuple[Any, Any]]:
        """Type and rows of each table of kcg_plan, by name."""
        return {
            "message": (Message, self.messages),
            "signal": (Signal, self.signals),
            "piece": (Piece, self.pieces),
            "pair": (Pair, self.pairs),
            "constant": (c_uint64, self.constants),
            "e2e": (E2e, self.e2e),
            "esc_of": (c_uint16, self.esc_of),
            "listener": (c_uint16, self.listeners),
            "first_listener": (c_uint16, self.first_listeners),
        }

    @property
    def counts(self) -> dict[str, int]:
        """The numbers of kcg_plan, by name."""
        slots = len(self.slots)
        return {
            "words": len(self.constants),
            "messages": len(self.messages) - slots,
            "escs": len(self.settings),
            "pages": self.pages,
            "slots": slots,
            **self._core_settings.numbers,
        }

    def _add(self, plan: MessagePlan, phase: int) -> None:
        crc = next((s for s in plan.compiled if s.role is Role.CRC), None)
        traits = Traits(plan, self._core_settings)
        flags = KCG.EVENT * traits.by_event
        flags |= KCG.ON_CHANGE * traits.on_change
        flags |= KCG.HAS_CRC * (crc is not None)
        flags |= KCG.SILENT_ON_LOSS * traits.is_silent_on_loss
        flags |= KCG.OF_THE_GATEWAY * traits.follows_gateway
        flags |= KCG.FREE * traits.is_untimed
        first_signal = len(self.signals)
        first_word = len(self.constants)
        words = max(1, -(-plan.length // 8))
        for page in plan.pages:
            self.constants += _constants(plan, page, words)
        for signal in plan.signals:
            if signal.role in (Role.SOURCE, Role.ALIVE):
                self._add_signal(signal, plan)
        first_esc = len(self.esc_of)
        self.esc_of += sorted(plan.escs)
        row = Message(
            id=plan.key,
            length=plan.length,
            words=words,
            flags=flags,
            triggers=traits.triggers,
            pages=len(plan.pages),
            crc_at=crc.pieces[0].at // 8 if crc else 0,
            escs=len(plan.escs),
            fd_flags=int(plan.fd),
            first_signal=first_signal,
            signals=len(self.signals) - first_signal,
            e2e=len(self.e2e) if plan.e2e else 0,
            first_page=self.pages,
            last_alive=max(0, traits.alive_modulus - 1),
            first_word=first_word,
            first_esc=first_esc,
            cycle=plan.cycle_ns,
            delay=plan.delay_ns,
            phase=phase,
        )
        self.messages.append(row)
        if plan.e2e is not None:
            self.e2e.append(e2e_row(plan.e2e))
        self.pages += len(plan.pages)

    def _add_signal(self, signal: SignalPlan, plan: MessagePlan) -> None:
        if signal.length > MAX_BITS:
            raise NotInCore(f"{plan.name}.{signal.name}: too long ({signal.length} bits)")
        first_piece = len(self.pieces)
        for piece in signal.pieces:  # split at borders of 64 bits
            width = min(piece.width, 64 - piece.at % 64)
            self.pieces.append(Piece(piece.shift, width, piece.at))
            if width < piece.width:
                rest = Piece(
                    shift=piece.shift + width,
                    width=piece.width - width,
                    at=piece.at + width,
                )
                self.pieces.append(rest)
        row = Signal(first_piece=first_piece, pieces=len(self.pieces) - first_piece)
        row.page = KCG.PAGES
        if signal.page is not None:
            row.page = plan.pages.index(signal.page)
        row.esc = ALL_ESCS if signal.esc is None else signal.esc
        row.length = signal.length
        row.error = signal.error & _M64
        row.not_available = signal.not_available & _M64
        if signal.role is Role.ALIVE:
            row.kind = KCG.OF_ALIVE
            row.div = alive_modulus(signal, plan.e2e)
            if row.div > MAX_ALIVE:
                name = f"{plan.name}.{signal.name}"
                raise NotInCore(f"{name}: an alive counter of {signal.length} bits is too long")
        else:
            try:
                self._add_source(row, signal)
            except NotInCore as error:
                raise NotInCore(f"{plan.name}.{signal.name}: {error}") from None
        self.signals.append(row)

    def _add_source(self, row: Any, signal: SignalPlan) -> None:
        value = signal.source
        assert value is not None
        esc = signal.esc or 0
        bind(row, value, self._wire[esc], signal.esc)
        if signal.numbers is not None:
            row.first_pair = len(self.pairs)
            row.pairs = len(signal.numbers)
            for number, raw in signal.numbers.items():
                self.pairs.append(Pair(int(number), raw & _M64))
            row.flags |= KCG.TABLE
        is_of_settings = set_scale(row, signal, value, self._escs[esc])
        if is_of_settings:
            self.of_settings[len(self.signals)] = row, signal


Words = list[tuple[int, int]]
Places = tuple[Words, Words]
"""Offset after the header and wire type of each word, in live data and in info data."""
_COUNTERS = {
    (Kind.STATE, "link_state"): "link_state",
    (Kind.STATE, "layout"): "layout",
    (Kind.COUNT, "losses"): "losses",
    (Kind.COUNT, "crc_errors"): "crc_errors",
    (Kind.COUNT, "dropped_bytes"): "dropped_bytes",
    (Kind.COUNT, "live_frames"): "live_frames",
    (Kind.COUNT, "info_frames"): "info_frames",
    (Kind.COUNT, "received_bytes"): "bytes",
    (Kind.COUNT, "suspect_frames"): "suspect_frames",
    (Kind.OBJECT, "live_counter"): "live_frames",
}
"""Maps kind and name of a value to a name of COUNTS."""
SOURCES: dict[tuple[Kind, str], tuple[int, int]] = {
    (Kind.PRODUCT, "battery_power"): (KCG.OF_POWER, 0),
    (Kind.INTEGRAL, "energy_used"): (KCG.OF_ENERGY, 0),
    (Kind.RUN_TIME, "motor_run_time"): (KCG.OF_RUN_TIME, 0),
    (Kind.AGE, "data_age"): (KCG.OF_AGE, 0),
    (Kind.RATE, "frame_rate"): (KCG.OF_RATE, 0),
    (Kind.GATEWAY, "uptime"): (KCG.OF_UPTIME, 0),
    (Kind.OBJECT, "link_status"): (KCG.OF_STATUS, GatewayState.REPLAY),
    **{key: (KCG.OF_COUNT, COUNTS.index(name)) for key, name in _COUNTERS.items()},
    **{
        (Kind.GATEWAY, name): (KCG.OF_GATEWAY, GATEWAY.index(name))
        for name in GATEWAY
        if name in VALUES
    },
}
"""``kind`` and ``place`` of a row of kcg_signal for each value that is not a field of the wire.

The core in C computes these values itself. It has no other ones.
"""


def bind(
    row: Any,
    value: Value,
    places: Places,
    esc: int | None,
) -> None:
    """Enter the source of a value into a row of Signal. Raises NotInCore if the core has none."""
    row.divisor = _DIVISORS[value.divisor]
    if value.kind in (Kind.WIRE, Kind.BITS):
        if not value.supplied or esc is None:
            raise NotInCore("not supplied by this ESC's protocol")
        _bind_field(row, value, places)
        return
    source = SOURCES.get((value.kind, value.name))
    if source is None:
        raise NotInCore(f"{value.name} is computed in Python only")
    row.kind, row.place = source


def _bind_field(row: Any, value: Value, places: Places) -> None:
    """Enter a field of the wire, or some bits of a field."""
    is_info = value.group is Group.INFO or value.last
    row.kind = KCG.OF_LIVE
    if value.last:
        row.kind = KCG.OF_LAST
    elif is_info:
        row.kind = KCG.OF_INFO
    row.place, row.wire = places[is_info][value.words[0]]
    row.not_on = sum(1 << device for device in value.not_on)
    if value.mask != -1:
        row.shift = value.shift
        row.mask = value.mask
    if value.negative_in is not None:
        bind_direction(row, value.negative_in, places[False])
    elif row.kind == KCG.OF_LIVE and value.divisor is Divisor.ONE and not row.not_on:
        row.flags = KCG.DIRECT


def places_of(protocol: EscProtocol) -> Places:
    """Return offset and type of each word. Raises NotInCore if C cannot decode the protocol."""
    if protocol.wire is None:
        raise NotInCore(f"ESC protocol {protocol.name} is decoded in Python only")
    found: Places = ([], [])
    for places, (codes, _) in zip(found, protocol.wire, strict=True):
        at = 0
        for code in codes:
            places.append((at, WIRE_TYPES[code]))
            at += struct.calcsize("<" + code)
    return found


def _constants(plan: MessagePlan, page: int | None, words: int) -> list[int]:
    bits = 0
    for signal in plan.compiled:
        if signal.role in (Role.CONSTANT, Role.DATA_ID) and signal.page in (None, page):
            bits |= place(signal.pieces, signal.constant)
        elif signal.role is Role.MULTIPLEXER and page is not None:
            bits |= place(signal.pieces, page)
    return [bits >> 64 * word & _M64 for word in range(words)]
