"""Expands a one-ESC DBC to several ESCs: names prefixed, ids moved, nothing lost."""

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.binding import Binder, bind_key
from kontronik_can_gw.dbc.names import MAX_NAME, esc_prefix
from kontronik_can_gw.dbc.writer import frame_id
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.formats.dbc import DbcSpecifics

_SDO_END, _RESTRICTED = 0x67F, 0x6E0
"""CiA 301 uses no 11-bit ids in this range: it is after the SDO requests and before the restricted ids."""


def expand(
    database: "Database",
    node: str,
    escs: Sequence[EscSettings],
    file: str,
    bind: Mapping[str, str | float] | None = None,
    base_id: int | None = None,
    id_step: int | None = None,
) -> tuple["Database", dict[str, str | float]]:
    """The database for these ESCs and the bindings that go with it.

    With one ESC names stay. With several, messages and signals of each ESC get its name as prefix (in place of a leading ``Esc``) and ids
    are moved by ``id_step`` for each ESC; None: the smallest step without a clash. ``base_id`` becomes the lowest of our ids. Messages of
    the gateway itself and of other nodes are copied once. UserError for names or ids that do not fit.
    """
    bind = bind or {}
    ours = [message for message in database.messages if node in message.senders]
    binder = Binder([EscSettings()], bind)
    per_esc = [m for m in ours if binder.escs_of(m)] if len(escs) > 1 else []
    shift = 0 if base_id is None else base_id - min(message.frame_id for message in ours)
    once = [message for message in database.messages if message not in per_esc]
    taken = {(m.frame_id + (shift if m in ours else 0), m.is_extended_frame) for m in once}
    shifted = [(m.frame_id + shift, m.is_extended_frame) for m in per_esc]
    step = _step(shifted, taken, len(escs), id_step, file) if per_esc else 0
    copies = []
    for message in database.messages:
        distance = shift if message in ours else 0
        if message in per_esc:
            copies += [
                _copy(message, distance + index * step, esc) for index, esc in enumerate(escs)
            ]
        else:
            copies.append(_copy(message, distance, None))
    moved = [made for made in copies if made.old in ours]
    problems = _id_problems([made.new for made in moved], len(escs), base_id)
    problems += _length_problems(copies, escs)
    if problems:
        raise UserError(*(f"{file}: {problem}" for problem in problems))
    messages = [made.new for made in copies]
    expanded = with_messages(database, messages, _relations(database.dbc, copies))
    return expanded, _bindings(bind, moved)


def with_messages(
    database: "Database", messages: Sequence["Message"], specifics: "DbcSpecifics | None"
) -> "Database":
    """A database with other messages, and what the file says of attributes (``specifics``)."""
    import cantools.database.can

    return cantools.database.can.Database(
        messages=list(messages),
        nodes=database.nodes,
        buses=database.buses,
        version=database.version,
        dbc_specifics=specifics,
        strict=False,
        sort_signals=None,
    )


@dataclass(frozen=True)
class _Copy:
    """A message and what became of it."""

    old: "Message"
    new: "Message"
    esc: EscSettings | None
    """Whose name it has; None for one that is taken over once."""

    def signals(self) -> Iterator[tuple[str, str]]:
        """Old and new names."""
        for old, new in zip(self.old.signals, self.new.signals, strict=True):
            yield old.name, new.name


def _copy(message: "Message", distance: int, esc: EscSettings | None) -> _Copy:
    """A copy of a message, moved and renamed; it shares everything that does not change."""
    made = copy(message)
    made._signals = [copy(signal) for signal in message.signals]
    if message.signal_groups is not None:
        made.signal_groups = [copy(group) for group in message.signal_groups]
    made.frame_id = message.frame_id + distance
    if esc is not None:
        _rename(made, esc_prefix(esc.name))
    return _Copy(message, made, esc)


def _bindings(bind: Mapping[str, str | float], copies: Sequence[_Copy]) -> dict[str, str | float]:
    """The bindings of the copies. Keys that match no signal stay, and the compiler reports them."""
    found = dict(bind)
    for made in copies:
        for old, new in made.signals():
            key = bind_key(bind, made.old.name, old)
            if key is None:
                continue
            value = bind[key]
            if made.esc is not None and isinstance(value, str):
                value = f"{made.esc.name}.{value}"
            found.pop(key, None)
            found[f"{made.new.name}.{new}"] = value
    return found


def among_canopen(database: "Database", expanded: "Database", node: str) -> str:
    """A warning where 11-bit ids of ``node`` are moved out of the range that CANopen leaves free (CiA 301, 7.3.5), else empty."""
    low, high = _SDO_END + 1, _RESTRICTED - 1

    def ids(of: "Database") -> list[int]:
        return [m.frame_id for m in of.messages if node in m.senders and not m.is_extended_frame]

    known, made = set(ids(database)), ids(expanded)
    left = [can_id for can_id in made if can_id not in known and not low <= can_id <= high]
    if not left or not any(low <= can_id <= high for can_id in known):
        return ""
    return (
        f"{len(left)} of {len(made)} ids leave {low:X}h..{high:X}h, up to {max(left):X}h, where CANopen has its own. "
        "Take fewer ESCs, a DBC with 29-bit ids, or an explicit lowest id (dbc.base_id)."
    )


def _id_problems(messages: Sequence["Message"], count: int, base_id: int | None) -> list[str]:
    """A line for ids outside the range of CAN ids."""
    problems = []
    why = f"for {count} ESCs" if base_id is None else f"with {base_id:X}h as the lowest id"
    every = [message.frame_id for message in messages]
    for extended, limit in ((False, 0x7FF), (True, 0x1FFFFFFF)):
        ids = [m.frame_id for m in messages if m.is_extended_frame is extended]
        if outside := [can_id for can_id in ids if not 0 <= can_id <= limit]:
            span = max(every) - min(every)
            remedy = f" The lowest id can be at most {limit - span:X}h." if limit > span else ""
            problems.append(
                f"{why}, {len(outside)} of {len(every)} messages lie outside 0..{limit:X}h, up to {max(outside):X}h.{remedy}"
            )
    return problems


def _length_problems(copies: Sequence[_Copy], escs: Sequence[EscSettings]) -> list[str]:
    """One line for all names that become too long with a prefix."""
    stems: set[str] = set()
    for made in copies:
        if made.esc is not None:
            names = [made.new.name, *(new for _, new in made.signals())]
            stems |= {name.removeprefix(esc_prefix(made.esc.name)) for name in names}
    longest = max(sorted(stems), key=len, default="")
    room = MAX_NAME - len(longest)
    long = [esc.name for esc in escs if len(esc_prefix(esc.name)) > room]
    if not long:
        return []
    remedy = (
        f"Take ESC names of at most {room} letters" if room > 0 else "Shorten the names in the DBC"
    )
    which = f"names are longer than {MAX_NAME} characters, as that of {longest}"
    return [f"ESC name {' and '.join(long)}: with it in front, {which}. {remedy}."]


def _relations(specifics: "DbcSpecifics | None", copies: Sequence[_Copy]) -> "DbcSpecifics | None":
    """Copies attributes of relations (BA_REL_), which refer to messages and signals by id and name."""
    moved: dict[int, list[tuple[int, dict[str, str]]]] = {}
    for made in copies:
        moved.setdefault(frame_id(made.old), []).append((frame_id(made.new), dict(made.signals())))
    specifics = deepcopy(specifics)
    relations = specifics.relation_attributes if specifics is not None else None
    if relations is not None:
        signals, messages = relations.node_signal_relations, relations.node_message_relations
        old_signals, old_messages = dict(signals), dict(messages)
        signals.clear()
        messages.clear()
        for number, by_signal in old_signals.items():
            for new, names in moved.get(number, [(number, {})]):
                renamed = ((names.get(name, name), nodes) for name, nodes in by_signal.items())
                signals[new] = OrderedDict(renamed)
        for number, by_node in old_messages.items():
            for new, _ in moved.get(number, [(number, {})]):
                messages[new] = by_node
    return specifics


def _step(
    ids: Sequence[tuple[int, bool]],
    taken: set[tuple[int, bool]],
    count: int,
    wanted: int | None,
    file: str,
) -> int:
    """The distance of the ids from ESC to ESC: ``wanted``, else the smallest without a clash."""
    every = [i for i, _ in (*ids, *taken)]
    widest = max(every) - min(every) + 1
    for step in [wanted] if wanted is not None else range(1, widest + 1):
        moved = {(i + n * step, extended) for i, extended in ids for n in range(count)}
        if len(moved) == len(ids) * count and not taken & moved:
            return step
    if wanted is not None:
        raise UserError(
            f"{file}: with ids moved by {wanted} an ESC, ids of {count} ESCs clash. Take another step."
        )
    raise UserError(
        f"{file}: no step moves the ids for {count} ESCs without a clash. Give the messages other ids."
    )


def _rename(message: "Message", prefix: str) -> None:
    """Rename a message and its signals; the database that it gets into refreshes what cantools derives of them."""
    old_name = message.name
    stem = old_name.removeprefix("Esc")
    message.name = prefix + (stem if stem[:1].isupper() else old_name)
    names = {signal.name: prefix + signal.name for signal in message.signals}
    for signal in message.signals:
        signal.name = names[signal.name]
        if signal.multiplexer_signal is not None:
            signal.multiplexer_signal = names[signal.multiplexer_signal]
    for group in message.signal_groups or []:
        group.signal_names = [names.get(name, name) for name in group.signal_names]
