"""Objects that show a value of an ESC or of the gateway: how they are read by SDO and packed into PDOs.

The one place of CANopen that compiles: packers of values are made once for all nodes.
"""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache, partial
from typing import Any

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, Value, Variable
from kontronik_can_gw.canopen.eds import FLOATS, SIGNED, TYPE_BITS, Entry, range_of
from kontronik_can_gw.canopen.objects import LINK, Bound, bindings_of
from kontronik_can_gw.core.slots import SlotPlan
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group, Kind
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.signals.packer import compile_pack, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SendType, SignalPlan
from kontronik_can_gw.status import GatewayStatus

_LAST_VALUE, _CODES = 1, 2  # 2100h:5; 0: abort
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.SECOND | Event.LINK,
    Group.GATEWAY: Event.SECOND,
}
_MAX_PDOS = 256  # kept; masters can write any


def bits_of(variable: Variable) -> int:
    """Length of a variable in a PDO; 0 where it has no fixed one."""
    return TYPE_BITS.get(variable.entry.data_type, 0)


def bind_values(dictionary: Dictionary, esc: EscTelemetry, gateway: GatewayStatus) -> None:
    """Let the objects that show a value of the ESC or of the gateway do so."""
    source = (esc, gateway)
    for (index, sub), bound in bindings_of(esc.protocol).items():
        variable = dictionary.get(index, sub)
        if variable is not None:
            variable.bound = bound
            variable.read = partial(_read, bound, variable.entry.data_type, dictionary, source)


def _read(
    bound: Bound,
    data_type: int,
    dictionary: Dictionary,
    source: tuple[EscTelemetry, GatewayStatus],
    now: int,
) -> Value:
    """The value of an object by SDO. Without one it aborts, or shows what 2100h:5 says."""
    esc, (low, high) = source[0], range_of(data_type)
    behaviour = dictionary.number(at.SETTINGS, 5)
    value, why = None, Abort.NO_DATA
    if bound.source.group is not Group.LIVE or esc.live is not None:
        value = bound.read(*source, now, high)
    elif esc.last_live is not None:
        if behaviour == _LAST_VALUE:
            value = bound.last(esc, high)
        else:
            why = Abort.DEVICE_STATE
    if value is not None and low <= value <= high:
        return value
    if behaviour == _CODES:
        return high if low == 0 else low
    raise SdoAbort(why)


def compile_pdo(mapped: Sequence[Variable]) -> SlotPlan:
    """The packer of a PDO with these objects; one for all nodes where they show values only."""
    shown = tuple((each.entry, each.bound) for each in mapped if each.bound is not None)
    return _shared_pdo(shown) if len(shown) == len(mapped) else _compile(mapped)


@lru_cache(_MAX_PDOS)
def _shared_pdo(shown: tuple[tuple[Entry, Bound], ...]) -> SlotPlan:
    variables = []
    for entry, bound in shown:
        variables.append(variable := Variable(entry))
        variable.bound = bound
    return _compile(variables)


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


def message_plan(name: str, cob_id: int, mapped: Sequence[Variable]) -> MessagePlan:
    """The plan of a PDO: one object after the other, the lowest bit first."""
    signals = []
    at_bit = 0
    for variable in mapped:
        signal = _signal_plan(variable, at_bit)
        signals.append(signal)
        at_bit += signal.length
    sources = [variable.bound.source for variable in mapped if variable.bound is not None]
    return MessagePlan(
        name=name,
        can_id=cob_id,
        extended=False,
        fd=False,
        length=(at_bit + 7) // 8,
        send_type=SendType.EVENT,
        cycle_ns=0,
        delay_ns=0,
        compiled=tuple(signals),
        escs=frozenset({0}),
        paces=frozenset(source.pace or source.group for source in sources),
    )


def _signal_plan(variable: Variable, at_bit: int) -> SignalPlan:
    entry, bound = variable.entry, variable.bound
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


def _compile(mapped: Sequence[Variable]) -> SlotPlan:
    plan = message_plan("TPDO", 0, mapped)
    is_live = carries_link = False
    status = []
    only_python = ""
    for variable, signal in zip(mapped, plan.signals, strict=True):
        bound = variable.bound
        if bound is None:
            only_python = f"{variable.entry.index:04X}h is no value of an ESC"
            if variable.read is not None:
                # of a service: the error register, the error code
                status.append(signal)
            continue
        is_live |= bound.source.group is Group.LIVE
        if bound.status:
            carries_link |= variable.entry.index == LINK
            status.append(signal)
    triggers = Event.NONE
    for pace in plan.paces:
        triggers |= _EVENT_OF_PACE[pace]
    if status:
        triggers |= Event.LIVE | Event.LINK | Event.INFO
    return SlotPlan(
        message=plan,
        pack=compile_pack(plan),
        triggers=triggers,
        watched=sum(place(signal.pieces, -1) for signal in status),
        pack_watched=compile_pack(replace(plan, compiled=tuple(status))) if status else None,
        needs_live=is_live and not carries_link,
        only_python=only_python,
    )
