"""Objects that show a value of an ESC or of the gateway: how they are read by SDO and packed into PDOs.

The one place of CANopen that compiles: readers and packers are made once for all nodes whose drive trains are equal.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache, partial
from typing import NamedTuple

from kontronik_can_gw.canopen import objects as at
from kontronik_can_gw.canopen.abort import Abort, SdoAbort
from kontronik_can_gw.canopen.data_types import BOOLEAN, FLOATS, SIGNED
from kontronik_can_gw.canopen.dictionary import Dictionary, Value, Variable, range_of
from kontronik_can_gw.canopen.eds import Entry
from kontronik_can_gw.canopen.objects import LINK, Bound, bindings, reader_text
from kontronik_can_gw.esc.telemetry import EscSettings, EscTelemetry, Event
from kontronik_can_gw.esc.values import GatewayStatus, Group, Source
from kontronik_can_gw.signals.packer import Pack, compile_pack, place
from kontronik_can_gw.signals.plan import MessagePlan, Piece, Role, SendType, SignalPlan

_LAST_VALUE, _CODES = 1, 2  # 2100h:5; 0: abort
_EVENT_OF_PACE = {
    Group.LIVE: Event.LIVE,
    Group.INFO: Event.INFO,
    Group.LINK: Event.SECOND | Event.LINK,
    Group.GATEWAY: Event.SECOND,
}
_MAX_DRIVE_TRAINS, _MAX_READERS, _MAX_PDOS = 64, 1024, 256  # kept; masters can write any
_ReadValue = Callable[[EscTelemetry, object, GatewayStatus, int], int | None]
_DriveTrain = tuple[int, Fraction]


class _Reader(NamedTuple):
    """How an object is read by SDO; ``low`` and ``high`` of its type."""

    value_of: _ReadValue
    is_live: bool
    low: int
    high: int


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
    return 1 if variable.entry.data_type == BOOLEAN else 8 * (variable.size or 0)


class BoundValues:
    """The objects of one dictionary that show a value of its ESC or of the gateway."""

    def __init__(self, dictionary: Dictionary, esc: EscTelemetry, gateway: GatewayStatus) -> None:
        self._dictionary = dictionary
        self._esc = esc
        self._gateway = gateway
        self._bound: Mapping[tuple[int, int], Bound] = {}
        self.bind()

    def bind(self) -> None:
        """Let the objects show their values. Done again when pole pairs or gear change."""
        self._bound = _bindings(*self._drive_train)
        for (index, sub), bound in self._bound.items():
            variable = self._dictionary.get(index, sub)
            if variable is not None:
                low, high = range_of(variable)
                is_live = bound.source.group is Group.LIVE
                reader = _reader(reader_text(bound, high), is_live, low, high)
                variable.read = partial(_read, reader, self._dictionary, self._esc, self._gateway)

    def get(self, index: int, sub: int) -> Bound | None:
        """What an object shows."""
        return self._bound.get((index, sub))

    def compile(self, mapped: Sequence[Mapped]) -> CompiledPdo:
        """The packer of a PDO with these objects."""
        if all(entry.bound is not None for entry in mapped):
            return _shared_pdo(self._drive_train, tuple(entry.variable.entry for entry in mapped))
        return _compile(mapped, {"storage": self._dictionary.variables, "shown": self._shown})

    @property
    def _drive_train(self) -> _DriveTrain:
        return self._esc.settings.pole_pairs, self._esc.settings.gear

    def _shown(self, number: int, now: int) -> Value:
        """What a service's object holds; -1, which no unsigned object can hold, where it has nothing (1003h)."""
        try:
            return self._dictionary.value(self._dictionary.variables[number], now)
        except SdoAbort:
            return -1


# --- shared by all nodes


@lru_cache(_MAX_DRIVE_TRAINS)
def _bindings(pole_pairs: int, gear: Fraction) -> Mapping[tuple[int, int], Bound]:
    return bindings(EscSettings(pole_pairs=pole_pairs, gear=gear))


@lru_cache(_MAX_READERS)
def _reader(text: str, is_live: bool, low: int, high: int) -> _Reader:
    names: dict[str, _ReadValue] = {}
    exec(text, names)  # noqa: S102  text made by us, from sources of ours
    return _Reader(names.pop("read"), is_live, low, high)


@lru_cache(_MAX_PDOS)
def _shared_pdo(drive_train: _DriveTrain, entries: tuple[Entry, ...]) -> CompiledPdo:
    bound = _bindings(*drive_train)
    return _compile([Mapped(Variable(e), bound[e.index, e.sub]) for e in entries], {})


def _read(
    reader: _Reader, dictionary: Dictionary, esc: EscTelemetry, gateway: GatewayStatus, now: int
) -> Value:
    """The value of an object by SDO. Without one it aborts, or shows what 2100h:5 says."""
    behaviour = dictionary.number(at.SETTINGS, 5)
    not_available = reader.high if reader.low == 0 else reader.low
    live: object = None
    if reader.is_live:
        live = esc.live
        if live is None and behaviour == _CODES:
            return not_available
        if live is None:
            live = esc.last_live
            if live is None:
                raise SdoAbort(Abort.NO_DATA)
            if behaviour != _LAST_VALUE:
                raise SdoAbort(Abort.DEVICE_STATE)
    value = reader.value_of(esc, live, gateway, now)
    if value is not None and reader.low <= value <= reader.high:
        return value
    if behaviour == _CODES:
        return not_available
    raise SdoAbort(Abort.NO_DATA)


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
    if bound is None:
        number = f"{entry.index << 8 | entry.sub:#x}"
        storage = f"storage[{number}].value" if variable.read is None else f"shown({number}, now)"
        source = Source(entry.name, "", Group.GATEWAY, storage)
    else:
        source = bound.source
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


def _compile(mapped: Sequence[Mapped], names: Mapping[str, object]) -> CompiledPdo:
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
        pack=compile_pack(plan, names),
        length=plan.length,
        triggers=triggers,
        status_mask=sum(place(signal.pieces, -1) for signal in status),
        status=compile_pack(replace(plan, signals=tuple(status)), names) if status else None,
        needs_live=is_live and not carries_link,
    )
