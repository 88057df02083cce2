"""Objects that show a value of an ESC or of the gateway: how they are read by SDO and packed into PDOs.

The one place of CANopen that compiles: packers of values are made once for all nodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache, partial
from typing import Any, NamedTuple

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.data_types import FLOATS, SIGNED, TYPE_BITS, range_of
from kontronik_can_gw.canopen.dictionary import Dictionary, Value, Variable
from kontronik_can_gw.canopen.eds_object import Entry
from kontronik_can_gw.canopen.objects import LINK, Bound, bindings_of
from kontronik_can_gw.esc.decoder import EscProtocol
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group, Kind
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.gateway_status import GatewayStatus
from kontronik_can_gw.signals.packer import Pack, compile_pack, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SendType, SignalPlan

_LAST_VALUE, _CODES = 1, 2  # 2100h:5; 0: abort
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.SECOND | Event.LINK,
    Group.GATEWAY: Event.SECOND,
}
_MAX_PDOS = 256  # kept; masters can write any


class Mapped(NamedTuple):
    """One object in a PDO. ``bound`` None: it shows no value of ESC or gateway."""

    variable: Variable
    bound: Bound | None


@dataclass(frozen=True, slots=True)
class CompiledPdo:
    """How a PDO is filled and what causes it."""

    pack: Pack
    length: int
    triggers: int
    """The events (of telemetry.Event) that are news to it."""
    status_mask: int
    """Bits of the status objects; 0 where a change of them is not what causes it."""
    status: Pack | None
    """Only the status objects at their places."""
    needs_live: bool
    """It is not sent while telemetry is lost."""


def bits_of(variable: Variable) -> int:
    """Length of a variable in a PDO; 0 where it has no fixed one."""
    return TYPE_BITS.get(variable.entry.data_type, 0)


def bind_values(dictionary: Dictionary, esc: EscTelemetry, gateway: GatewayStatus) -> None:
    """Let the objects that show a value of the ESC or of the gateway do so."""
    for (index, sub), bound in bindings_of(esc.protocol).items():
        variable = dictionary.get(index, sub)
        if variable is not None:
            low, high = range_of(variable.entry.data_type)
            variable.read = partial(_read, bound, low, high, dictionary, esc, gateway)


def compile_pdo(mapped: Sequence[Mapped], protocol: EscProtocol) -> CompiledPdo:
    """The packer of a PDO with these objects."""
    if all(entry.bound is not None for entry in mapped):
        return _shared_pdo(tuple(entry.variable.entry for entry in mapped), protocol)
    return _compile(mapped)


@lru_cache(_MAX_PDOS)
def _shared_pdo(entries: tuple[Entry, ...], protocol: EscProtocol) -> CompiledPdo:
    """Of values only: the same for all nodes."""
    bindings = bindings_of(protocol)
    return _compile([Mapped(Variable(e), bindings[e.index, e.sub]) for e in entries])


def _read(
    bound: Bound,
    low: int,
    high: int,
    dictionary: Dictionary,
    esc: EscTelemetry,
    gateway: GatewayStatus,
    now: int,
) -> Value:
    """The value of an object by SDO. Without one it aborts, or shows what 2100h:5 says."""
    behaviour = dictionary.number(at.SETTINGS, 5)
    not_available = high if low == 0 else low
    if bound.source.group is Group.LIVE and esc.live is None:
        if behaviour == _CODES:
            return not_available
        if esc.last_live is None:
            raise SdoAbort(Abort.NO_DATA)
        if behaviour != _LAST_VALUE:
            raise SdoAbort(Abort.DEVICE_STATE)
        value = bound.last(esc, high)
    else:
        value = bound.read(esc, gateway, now, high)
    if value is not None and low <= value <= high:
        return value
    if behaviour == _CODES:
        return not_available
    raise SdoAbort(Abort.NO_DATA)


def _stored(variable: Variable) -> EscValue:
    """An object that shows no value: storage, or of a service; not available where that has none (1003h)."""

    def read(_esc: EscTelemetry, _gateway: GatewayStatus, now: int) -> Any:
        if variable.read is None:
            return variable.value
        try:
            return variable.read(now)
        except SdoAbort:
            return None

    return EscValue(variable.entry.name, "", Group.GATEWAY, Kind.GATEWAY, read=read)


def message_plan(name: str, cob_id: int, mapped: Sequence[Mapped]) -> MessagePlan:
    """The plan of a PDO: one object after the other, the lowest bit first."""
    signals = []
    at_bit = 0
    for entry in mapped:
        signal = _signal_plan(entry, at_bit)
        signals.append(signal)
        at_bit += signal.length
    sources = [entry.bound.source for entry in mapped if entry.bound is not None]
    return MessagePlan(
        name=name,
        can_id=cob_id,
        extended=False,
        fd=False,
        length=(at_bit + 7) // 8,
        send_type=SendType.EVENT,
        cycle_ns=0,
        delay_ns=0,
        signals=tuple(signals),
        escs=frozenset({0}),
        paces=frozenset(source.pace or source.group for source in sources),
    )


def _signal_plan(mapped: Mapped, at_bit: int) -> SignalPlan:
    variable, bound = mapped
    entry = variable.entry
    length = bits_of(variable)
    signed = entry.data_type in SIGNED
    source = _stored(variable) if bound is None else bound.source
    not_available = 1 << length - 1 if signed else (1 << length) - 1
    return SignalPlan(
        name=entry.name,
        unit="",
        role=Role.SOURCE,
        length=length,
        signed=signed,
        is_float=entry.data_type in FLOATS,
        pieces=(Piece(0, length, at_bit),),
        low=-(1 << length - 1) if signed else 0,
        high=(1 << length - signed) - 1,
        not_available=not_available,
        error=not_available,
        slope=Fraction(1) if bound is None else bound.slope,
        source=source,
        esc=None if source.group is Group.GATEWAY else 0,
    )


def _compile(mapped: Sequence[Mapped]) -> CompiledPdo:
    plan = message_plan("TPDO", 0, mapped)
    is_live = carries_link = False
    status = []
    for entry, signal in zip(mapped, plan.signals, strict=True):
        if entry.bound is None:
            if entry.variable.read is not None:
                # of a service: the error register, the error code
                status.append(signal)
            continue
        is_live |= entry.bound.source.group is Group.LIVE
        if entry.bound.status:
            carries_link |= entry.variable.entry.index == LINK
            status.append(signal)
    triggers = Event.NONE
    for pace in plan.paces:
        triggers |= _EVENT_OF_PACE[pace]
    if status:
        triggers |= Event.LIVE | Event.LINK | Event.INFO
    return CompiledPdo(
        pack=compile_pack(plan),
        length=plan.length,
        triggers=triggers,
        status_mask=sum(place(signal.pieces, -1) for signal in status),
        status=compile_pack(replace(plan, signals=tuple(status))) if status else None,
        needs_live=is_live and not carries_link,
    )
