"""Transmit PDOs: parameters with their rules, events, SYNC, inhibit time, event timer (CiA 301, 7.2.2 and 7.5.2.37/38).

The bytes of a PDO come from a compiled plan like those of a DBC message, straight from the ESC's snapshot.

Event of types 254 and 255: new data of what is mapped (a UART frame, a second, a download). A PDO that carries a status object (errors,
operating state, link status) is sent when one of these changes instead. When telemetry is lost, PDOs with live values stop, unless they
carry the link status: those go on, with all ones (80..0h for signed types) for what is not available.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.dictionary import Dictionary, Variable
from kontronik_can_gw.canopen.heartbeat import NEVER
from kontronik_can_gw.canopen.objects import LINK, Bound
from kontronik_can_gw.esc.telemetry import MS, SECOND, EscTelemetry, Event
from kontronik_can_gw.esc.values import GatewayStatus, Group, Kind
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.signals.packer import Pack, compile_pack, place
from kontronik_can_gw.signals.plan import (
    EXPECTED_LIVE_HZ,
    MessagePlan,
    Piece,
    Role,
    SendType,
    SignalPlan,
)

COMMUNICATION, MAPPING = 0x1800, 0x1A00
MOST = 512
COB_ID, TYPE, INHIBIT, EVENT_TIMER, SYNC_START = 1, 2, 3, 5, 6
INVALID_BIT, FRAME_BIT = 1 << 31, 1 << 29
EVENT_TYPES = (254, 255)
_MAX_BITS = 64
_BOOLEAN = 0x01
_SIGNED = frozenset({0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15})
_FLOAT = frozenset({0x08, 0x11})
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.SECOND | Event.LINK,
    Group.GATEWAY: Event.SECOND,
}


def restricted(cob_id: int) -> bool:
    """COB-IDs that no PDO, SYNC or EMCY may use (CiA 301, table of restricted CAN-IDs)."""
    return (
        cob_id <= 0x07F
        or 0x101 <= cob_id <= 0x180
        or 0x581 <= cob_id <= 0x5FF
        or 0x601 <= cob_id <= 0x67F
        or 0x6E0 <= cob_id <= 0x6FF
        or cob_id >= 0x701
    )


def bits_of(variable: Variable) -> int:
    """Length of a variable in a PDO; 0 where it has no fixed one."""
    return 1 if variable.entry.data_type == _BOOLEAN else 8 * (variable.size or 0)


@dataclass(frozen=True)
class Mapped:
    """One object in a PDO."""

    variable: Variable
    bound: Bound | None


def _stored(variable: Variable) -> EscValue:
    """An object that is no value of the ESC: storage, or of a service; not available where that has none (1003h)."""

    def read(_esc: EscTelemetry, _gateway: GatewayStatus, now: int) -> Any:
        if variable.read is None:
            return variable.value
        try:
            return variable.read(now)
        except SdoAbort:
            return None

    return EscValue(variable.entry.name, "", Group.GATEWAY, Kind.GATEWAY, read=read)


def message_plan(name: str, cob_id: int, mapped: Sequence[Mapped]) -> MessagePlan:
    """The plan of a PDO: objects one behind the other, the lowest bit first."""
    signals = []
    at = 0
    paces = set()
    for entry in mapped:
        variable, bound = entry.variable, entry.bound
        length = bits_of(variable)
        signed = variable.entry.data_type in _SIGNED
        if bound is None:
            source = _stored(variable)
        else:
            source = bound.source
            paces.add(source.pace or source.group)
        not_available = 1 << length - 1 if signed else (1 << length) - 1
        signals.append(
            SignalPlan(
                name=variable.entry.name,
                unit="",
                role=Role.SOURCE,
                length=length,
                signed=signed,
                is_float=variable.entry.data_type in _FLOAT,
                pieces=(Piece(0, length, at),),
                low=-(1 << length - 1) if signed else 0,
                high=(1 << length - signed) - 1,
                not_available=not_available,
                error=not_available,
                slope=Fraction(1) if bound is None else bound.slope,
                source=source,
                esc=None if source.group is Group.GATEWAY else 0,
            )
        )
        at += length
    return MessagePlan(
        name=name,
        can_id=cob_id,
        extended=False,
        fd=False,
        length=(at + 7) // 8,
        send_type=SendType.EVENT,
        cycle_ns=0,
        delay_ns=0,
        signals=tuple(signals),
        escs=frozenset({0}),
        paces=frozenset(paces),
    )


def _check_cob_id(value: int, taken: Callable[[int], bool]) -> None:
    # Bit 30, no RTR, may be 0: most masters write it so. An RTR is not answered either way.
    if value & FRAME_BIT or value & 0x1FFFF800:
        raise SdoAbort(Abort.VALUE)
    if value & INVALID_BIT:
        return
    if restricted(value & 0x7FF):
        raise SdoAbort(Abort.VALUE)
    if taken(value & 0x7FF):
        raise SdoAbort(Abort.INCOMPATIBLE)


class Tpdo:
    """One transmit PDO of one node."""

    def __init__(
        self,
        number: int,
        dictionary: Dictionary,
        bound: Mapping[tuple[int, int], Bound],
        esc: EscTelemetry,
        gateway: GatewayStatus,
        send: Callable[[CanFrame], None],
    ) -> None:
        self.number = number
        self.bound = bound
        self.cob_id = 0
        self.valid = False
        self.due = NEVER
        self.sent = 0
        """Frames so far."""
        self._dictionary = dictionary
        self._esc = esc
        self._escs = (esc,)
        self._gateway = gateway
        self._send_frame = send
        self._started = False
        self._type = 255
        self._by_event = True
        self._inhibit_ns = self._event_ns = 0
        self._sync_start = 0
        self._mapped: list[Mapped] = []
        self._compiled: tuple[object, ...] = ()
        self._pack: Pack | None = None
        self._length = 0
        self.triggers = 0
        """The events (of telemetry.Event) that are news to it."""
        self._status_mask = 0
        self._status: Pack | None = None
        """Only the status objects at their places; None where a change of them is not what causes it."""
        self._needs_live = False
        self._last_status = -1
        self._last_ns = -NEVER
        self._held_until = -NEVER
        self._event_due = NEVER
        self.pending = False
        """It waits for the inhibit time to end: further events change nothing."""
        self._fresh = False
        self._syncs = 0
        self._sync_waits = False

    # --- configuration

    @property
    def mapped(self) -> list[Mapped]:
        """What is in the PDO; empty where nothing is."""
        return self._mapped

    @property
    def type(self) -> int:
        """Transmission type."""
        return self._type

    @property
    def event_ns(self) -> int:
        return self._event_ns

    @property
    def inhibit_ns(self) -> int:
        return self._inhibit_ns

    @property
    def on_change(self) -> bool:
        """True if changes of a status object are what causes it."""
        return bool(self._status_mask)

    @property
    def rate_hz(self) -> float:
        """Frames a second to be expected with the UART at 100 Hz; those sent on change or at SYNC (10 Hz taken) by their cycle."""
        if not self._running:
            return 0.0
        if self._type not in EVENT_TYPES:
            return 10.0 / max(1, self._type)
        cycle = SECOND / self._event_ns if self._event_ns else 0.0
        if self.on_change:
            return cycle or 1.0
        events = EXPECTED_LIVE_HZ if self.triggers & Event.LIVE else 1.0
        return max(cycle, min(events, SECOND / self._inhibit_ns) if self._inhibit_ns else events)

    def configure(self, now: int) -> None:
        """Take over what the dictionary says. A PDO that begins to exist in OPERATIONAL begins like at its start."""
        number = self._dictionary.number
        index = COMMUNICATION + self.number
        cob_id = number(index, COB_ID)
        was_running = self._running
        self.cob_id = cob_id & 0x7FF
        self.valid = not cob_id & INVALID_BIT
        self._type = number(index, TYPE)
        self._by_event = self._type in EVENT_TYPES
        self._inhibit_ns = number(index, INHIBIT) * MS // 10
        self._held_until = self._last_ns + self._inhibit_ns
        self._event_ns = number(index, EVENT_TIMER) * MS
        self._sync_start = number(index, SYNC_START)
        self._mapped = [
            self.resolve(number(MAPPING + self.number, sub))
            for sub in range(1, number(MAPPING + self.number) + 1)
        ]
        self._compile()
        if self._started and self._running:
            if was_running:
                self.pending = self.pending and self._by_event
                self._event_due = self._next_event(now)
                self._set_due()
            else:
                self.start(now)
        else:
            self._event_due = NEVER
            self.pending = False
            self._set_due()

    def resolve(self, mapping: int) -> Mapped:
        """The object of a mapping entry (index, sub-index, bits). SdoAbort where it cannot be mapped."""
        index, sub, bits = mapping >> 16, mapping >> 8 & 0xFF, mapping & 0xFF
        variable = self._dictionary.find(index, sub)
        if (
            not variable.entry.mappable
            or not variable.readable
            or not bits_of(variable)
            or bits_of(variable) != bits
        ):
            raise SdoAbort(Abort.NOT_MAPPABLE)
        return Mapped(variable, self.bound.get((index, sub)))

    def check(self, taken: Callable[[int], bool]) -> None:
        """Whether the parameters as they are make a PDO. SdoAbort if not."""
        number = self._dictionary.number
        cob_id = number(COMMUNICATION + self.number, COB_ID)
        if sum(bits_of(entry.variable) for entry in self._mapped) > _MAX_BITS:
            raise SdoAbort(Abort.PDO_LENGTH)
        self.check_type(self._type)
        _check_cob_id(cob_id, taken)

    def check_cob_id(self, value: int, taken: Callable[[int], bool]) -> None:
        """A new 180xh:1.

        SdoAbort 06090030h for 29 bits, restricted ids, a change while the PDO exists, and a PDO with nothing mapped;
        06040043h for an id in use.
        """
        if not value & INVALID_BIT and (
            not self._mapped or (self.valid and value & 0x7FF != self.cob_id)
        ):
            raise SdoAbort(Abort.VALUE)
        _check_cob_id(value, taken)

    def check_type(self, value: int) -> None:
        """A new 180xh:2. Reserved types and 252, 253 (on request by RTR) are refused: 06090030h."""
        if 241 <= value <= 253:
            raise SdoAbort(Abort.VALUE)

    def check_while_invalid(self, _value: int) -> None:
        """Inhibit time and SYNC start value cannot change while the PDO exists: 06090030h."""
        if self.valid:
            raise SdoAbort(Abort.VALUE)

    def check_sync_start(self, value: int) -> None:
        """A new 180xh:6."""
        self.check_while_invalid(value)
        if value > 240:
            raise SdoAbort(Abort.VALUE)

    def check_count(self, count: int) -> None:
        """A new 1A0xh:0. The PDO must not exist; the entries must be there and be 64 bits at most."""
        if self.valid:
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        mapping = MAPPING + self.number
        if self._dictionary.get(mapping, count) is None:
            raise SdoAbort(Abort.PDO_LENGTH)
        found = [self.resolve(self._dictionary.number(mapping, sub)) for sub in range(1, count + 1)]
        if sum(bits_of(entry.variable) for entry in found) > _MAX_BITS:
            raise SdoAbort(Abort.PDO_LENGTH)

    def check_entry(self, mapping: int) -> None:
        """A new 1A0xh:1..8. The PDO must not exist and sub-index 0 must be 0, else 06010000h."""
        if self.valid or self._dictionary.number(MAPPING + self.number):
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if mapping:
            self.resolve(mapping)

    # --- transmission

    @property
    def _running(self) -> bool:
        return self.valid and self._pack is not None

    def start(self, now: int) -> None:
        """The node has become OPERATIONAL: event-driven PDOs say once what is."""
        self._started = True
        self._last_ns = self._held_until = -NEVER
        self._last_status = -1
        self._fresh = True
        self.pending = False
        self._syncs = 0
        self._sync_waits = self._sync_start != 0
        self._event_due = NEVER
        if self._running and self._by_event:
            self._event_due = self._next_event(now)
            self._request(now)
        self._set_due()

    def stop(self) -> None:
        """No PDO outside OPERATIONAL."""
        self._started = False
        self.pending = False
        self._event_due = self.due = NEVER

    def on_event(self, now: int) -> None:
        """Something of ``triggers`` happened."""
        if not self._started or not self.valid or self._pack is None:
            return
        if self.pending:
            if now >= self._held_until:
                self._send(now)
            return
        if self._status is not None:
            status = self._status(self._escs, self._gateway, now, 0, 0)
            if status == self._last_status:
                return
            self._last_status = status
        self._news(now)

    def on_download(self, variable: Variable, now: int) -> None:
        """An object was written over the bus."""
        if (
            self._started
            and self._running
            and any(entry.variable is variable for entry in self._mapped)
        ):
            self._news(now)

    def tell_again(self, now: int) -> None:
        """Say once more what is sent on change only."""
        if self._started and self._running and self._status_mask:
            self._news(now)

    def on_sync(self, counter: int, now: int, answer: bool = True) -> None:
        """A SYNC message; ``counter`` 0 where it has none. Without ``answer`` it is only counted."""
        if not self._started or not self._running or self._type > 240:
            return
        if self._sync_waits and counter:
            if counter != self._sync_start:
                return
            self._sync_waits = False  # this SYNC counts as the first
        if self._type == 0:
            if self._fresh and answer:
                self._send(now)
            return
        self._syncs += 1
        if self._syncs >= self._type:
            self._syncs = 0
            if answer:
                self._send(now)

    def advance(self, now: int) -> None:
        """Event timer, and what the inhibit time held back."""
        if now < self.due:
            return
        if now >= self._event_due:
            self._event_due = self._next_event(now)
            self._request(now)
        elif self.pending and now >= self._held_until:
            self._send(now)
        self._set_due()

    def _news(self, now: int) -> None:
        self._fresh = True
        if self._by_event:
            self._request(now)

    def _request(self, now: int) -> None:
        if now >= self._held_until:
            self._send(now)
        else:
            self.pending = self._fresh = True
            self._set_due()

    def _send(self, now: int) -> None:
        self.pending = False
        if self._needs_live and self._esc.live is None:
            self._set_due()
            return
        assert self._pack is not None
        self._fresh = False
        self._last_ns = now
        self._held_until = now + self._inhibit_ns
        self.due = self._event_due = self._next_event(now)
        bits = self._pack(self._escs, self._gateway, now, 0, 0)
        self._last_status = bits & self._status_mask
        self.sent += 1
        self._send_frame(CanFrame(self.cob_id, bits.to_bytes(self._length, "little")))

    def _next_event(self, now: int) -> int:
        return now + self._event_ns if self._event_ns and self._by_event else NEVER

    def _set_due(self) -> None:
        due = self._event_due
        self.due = self._held_until if self.pending and self._held_until < due else due

    def _compile(self) -> None:
        """Compile the plan anew if what it is made from has changed."""
        made_from = tuple((id(entry.variable), entry.bound) for entry in self._mapped)
        if made_from == self._compiled:
            return
        self._compiled = made_from
        self._pack = self._status = None
        self.triggers = self._status_mask = 0
        if not self._mapped:
            return
        plan = message_plan(f"TPDO {self.number + 1}", self.cob_id, self._mapped)
        self._pack = compile_pack(plan)
        self._length = plan.length
        carries_link = False
        status = []
        for entry, signal in zip(self._mapped, plan.signals, strict=True):
            if entry.bound is None:
                if entry.variable.read is not None:
                    # of a service: the error register, the error code
                    status.append(signal)
                continue
            carries_link |= entry.variable.entry.index == LINK and entry.bound.status
            if entry.bound.status:
                status.append(signal)
        if status:
            self._status_mask = sum(place(signal.pieces, -1) for signal in status)
            self._status = compile_pack(replace(plan, signals=tuple(status)))
        for pace in plan.paces:
            self.triggers |= _EVENT_OF_PACE[pace]
        if self._status_mask:
            self.triggers |= Event.LIVE | Event.LINK | Event.INFO
        live = any(entry.bound and entry.bound.source.group is Group.LIVE for entry in self._mapped)
        self._needs_live = live and not carries_link
