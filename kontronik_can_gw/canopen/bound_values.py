"""Reading of objects that show a value of an ESC or the gateway, by SDO and in PDOs.

This is the only module of CANopen that compiles. Packers of values are shared by all nodes.
"""

from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache, partial
from typing import Any

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort, Value, Variable
from kontronik_can_gw.canopen.eds import FLOATS, TYPE_BITS, EdsEntry, range_of
from kontronik_can_gw.canopen.objects import LINK, Bound, bindings_of
from kontronik_can_gw.core.slots import SlotPlan
from kontronik_can_gw.esc.telemetry import EscTelemetry, Event
from kontronik_can_gw.esc.values import Group, Kind, steps, steps_of
from kontronik_can_gw.esc.values import Value as EscValue
from kontronik_can_gw.signals.packer import compile_pack, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, SignalPlan
from kontronik_can_gw.status import GatewayStatus

_LAST_VALUE = 1
"""2100h:5: SDO responses with the last value while telemetry is lost. With 0 it aborts."""
_CODES = 2
"""2100h:5: SDO responses with the number that means "not available" in a PDO."""
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.SECOND | Event.LINK,
    Group.GATEWAY: Event.SECOND,
}
_MAX_PDOS = 256
"""Maximum number of cached packers, because masters can write any number of mappings."""


def bits_of(variable: Variable) -> int:
    """Return the number of bits of a variable in a PDO. 0 if its length is not fixed."""
    return TYPE_BITS.get(variable.entry.data_type, 0)


def bind_values(
    dictionary: Dictionary,
    esc: EscTelemetry,
    gateway: GatewayStatus,
) -> None:
    """Bind all objects that show a value of the ESC or the gateway."""
    source = (esc, gateway)
    for (index, sub), bound in bindings_of(esc.protocol).items():
        variable = dictionary.get(index, sub)
        if variable is not None:
            variable.bound = bound
            data_type = variable.entry.data_type
            variable.read = partial(_read, bound, data_type, dictionary, source)


def _read(
    bound: Bound,
    data_type: int,
    dictionary: Dictionary,
    source: tuple[EscTelemetry, GatewayStatus],
    now: int,
) -> Value:
    """Return the value of an object for SDO.

    If it is not available, 2100h:5 decides: SdoAbort, the last value, or the number that means
    "not available".
    """
    esc, gateway = source
    low, high = range_of(data_type)
    behaviour = dictionary.number(at.SETTINGS, 5)
    count = None
    reason = Abort.NO_DATA
    if bound.source.group is not Group.LIVE or esc.live is not None:
        count = steps(bound.source, esc, gateway, now)
    elif behaviour == _LAST_VALUE:
        count = steps_of(bound.source, esc, esc.last_live)
    elif esc.last_live is not None:
        reason = Abort.DEVICE_STATE
    value = bound.shown(esc, count, high)
    if value is not None and low <= value <= high:
        return value
    if behaviour == _CODES:
        return low or high
    raise SdoAbort(reason)


def compile_pdo(mapped: Sequence[Variable]) -> SlotPlan:
    """Return the plan of a PDO with these objects.

    All nodes share it if the objects only show values.
    """
    shown = []
    for variable in mapped:
        if variable.bound is None:
            return _compile(mapped)
        shown.append((variable.entry, variable.bound))
    return _shared_pdo(tuple(shown))


@lru_cache(_MAX_PDOS)
def _shared_pdo(shown: tuple[tuple[EdsEntry, Bound], ...]) -> SlotPlan:
    variables = []
    for entry, bound in shown:
        variable = Variable(entry)
        variable.bound = bound
        variables.append(variable)
    return _compile(variables)


def _stored(variable: Variable) -> EscValue:
    """Return the source of an object that shows no value of an ESC or the gateway.

    It stores its value or is bound to a service. A missing value (1003h) is not available.
    """

    def read(_esc: EscTelemetry, _gateway: GatewayStatus, now: int) -> Any:
        if variable.read is None:
            return variable.value
        try:
            return variable.read(now)
        except SdoAbort:
            return None

    return EscValue(variable.entry.name, "", Group.GATEWAY, Kind.OBJECT, read=read)


def message_plan(
    name: str,
    cob_id: int,
    mapped: Sequence[Variable],
) -> MessagePlan:
    """Return the plan of a PDO, which holds one object after the other, lowest bit first."""
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
        length=(at_bit + 7) // 8,
        compiled=tuple(signals),
        escs=frozenset({0}),
        paces=frozenset(source.pace or source.group for source in sources),
    )


def _signal_plan(variable: Variable, at_bit: int) -> SignalPlan:
    entry = variable.entry
    bound = variable.bound
    length = bits_of(variable)
    low, high = range_of(entry.data_type)
    source = _stored(variable) if bound is None else bound.source
    return SignalPlan(
        name=entry.name,
        length=length,
        signed=low < 0,
        is_float=entry.data_type in FLOATS,
        pieces=(Piece(0, length, at_bit),),
        low=low,
        high=high,
        not_available=low or high,
        error=low or high,
        slope=Fraction(1) if bound is None else bound.slope,
        source=source,
        esc=None if source.group is Group.GATEWAY else 0,
    )


def _compile(mapped: Sequence[Variable]) -> SlotPlan:
    plan = message_plan("TPDO", 0, mapped)
    is_live = False
    carries_link = False
    status = []
    only_python = ""
    for variable, signal in zip(mapped, plan.signals, strict=True):
        bound = variable.bound
        if bound is None:
            only_python = f"{variable.entry.index:04X}h is not a value of an ESC"
            if variable.read is not None:
                # the error register and the error code, which are bound to a service
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
        needs_live=is_live and not carries_link,
        only_python=only_python,
    )
