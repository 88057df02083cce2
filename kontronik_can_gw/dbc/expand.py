"""Expands a one-ESC DBC to several ESCs: names prefixed, ids moved, nothing lost."""

import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.binding import Binder, is_one_esc_layout
from kontronik_can_gw.dbc.writer import dbc_text, frame_id
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import Group

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.formats.dbc import DbcSpecifics

__all__ = ["dbc_text", "esc_prefix", "expand", "needs_expansion"]
_NAME_LIMIT = 32
_SDO_END, _RESTRICTED = 0x67F, 0x6E0
"""CiA 301 uses no 11-bit ids in this range: it is after the SDO requests and before the restricted ids."""


def esc_prefix(name: str) -> str:
    """An ESC's name as the beginning of message and signal names: ``left_front`` becomes ``LeftFront``."""
    return "".join(part[:1].upper() + part[1:] for part in re.split(r"[^A-Za-z0-9]+", name) if part)


def needs_expansion(
    database: "Database",
    node: str,
    escs: Sequence[EscSettings],
    bind: Mapping[str, str | float] | None = None,
) -> bool:
    """True for several ESCs and a DBC that describes one."""
    return len(escs) > 1 and is_one_esc_layout(database, node, Binder(escs, bind or {}))


def expand(
    database: "Database",
    node: str,
    escs: Sequence[EscSettings],
    file: str,
    bind: dict[str, str | float] | None = None,
    base_id: int | None = None,
    id_step: int | None = None,
) -> tuple["Database", dict[str, str | float]]:
    """The database for these ESCs and the bindings that go with it.

    With one ESC names stay. With several, messages and signals of each ESC get its name as prefix (in place of a leading ``Esc``) and ids
    are moved by ``id_step`` for each ESC; None: the smallest step without a clash. ``base_id`` becomes the lowest of our ids. Messages of
    the gateway itself and of other nodes are copied once. UserError for names or ids that do not fit.
    """
    import cantools.database.can

    bind = dict(bind or {})
    ours = [message for message in database.messages if node in message.senders]
    per_esc = (
        [message for message in ours if _has_values_of_an_esc(message, bind)]
        if len(escs) > 1
        else []
    )
    shift = 0 if base_id is None else base_id - min(message.frame_id for message in ours)
    once = [message for message in database.messages if message not in per_esc]
    taken = {(m.frame_id + (shift if m in ours else 0), m.is_extended_frame) for m in once}
    step = _step(
        [(m.frame_id + shift, m.is_extended_frame) for m in per_esc],
        taken,
        len(escs),
        id_step,
        file,
    )
    messages: list[Message] = []
    moved: dict[int, list[tuple[int, dict[str, str]]]] = {}
    moves: list[tuple[int, int, bool]] = []
    out_bind = dict(bind)  # keys that match no signal stay, and the compiler reports them
    for message in database.messages:
        copies = enumerate(escs) if message in per_esc else [(0, None)]
        for index, esc in copies:
            made = _copy(message)
            if message in ours:
                made.frame_id = message.frame_id + shift + index * step
                moves.append((message.frame_id, made.frame_id, message.is_extended_frame))
            if esc is not None:
                _rename(made, esc_prefix(esc.name))
            for old, new in zip(message.signals, made.signals, strict=True):
                for key in (f"{message.name}.{old.name}", old.name):
                    if key in bind and message in ours:
                        value = bind[key]
                        out_bind.pop(key, None)
                        if esc is not None and isinstance(value, str):
                            value = f"{esc.name}.{value}"
                        out_bind[f"{made.name}.{new.name}"] = value
                        break
            messages.append(made)
            names = {
                old.name: new.name for old, new in zip(message.signals, made.signals, strict=True)
            }
            moved.setdefault(frame_id(message), []).append((frame_id(made), names))
    problems = [f"{file}: {problem}" for problem in _id_problems(moves, len(escs), base_id)]
    _check_lengths(messages, per_esc, escs, problems, file)
    if problems:
        raise UserError(*problems)
    result = cantools.database.can.Database(
        messages=messages,
        nodes=database.nodes,
        buses=database.buses,
        version=database.version,
        dbc_specifics=_relations(database.dbc, moved),
        strict=False,
        sort_signals=None,
    )
    return result, out_bind


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
        "Take fewer ESCs, a DBC with 29-bit ids, or an explicit lowest id (dbc.base_id, --base-id)."
    )


def _id_problems(
    moves: Sequence[tuple[int, int, bool]], count: int, base_id: int | None
) -> list[str]:
    """A line for ids outside the range of CAN ids. ``moves``: from, to, 29 bits."""
    problems = []
    why = f"for {count} ESCs" if base_id is None else f"with {base_id:X}h as the lowest id"
    for extended, limit in ((False, 0x7FF), (True, 0x1FFFFFFF)):
        ids = [made for _, made, is_extended in moves if is_extended is extended]
        if outside := [made for made in ids if not 0 <= made <= limit]:
            most = max(made for _, made, _ in moves) - min(made for _, made, _ in moves)
            remedy = f" The lowest id can be at most {limit - most:X}h." if limit > most else ""
            problems.append(
                f"{why}, {len(outside)} of {len(moves)} messages lie outside 0..{limit:X}h, up to {max(outside):X}h.{remedy}"
            )
    return problems


def _check_lengths(
    messages: Sequence["Message"],
    per_esc: Sequence["Message"],
    escs: Sequence[EscSettings],
    problems: list[str],
    file: str,
) -> None:
    """One line for all names that become too long."""
    longest = max(
        (signal.name for message in per_esc for signal in message.signals), key=len, default=""
    )
    if any(
        len(name) > _NAME_LIMIT
        for m in messages
        for name in (m.name, *(signal.name for signal in m.signals))
    ):
        room = _NAME_LIMIT - len(longest)
        long = [esc.name for esc in escs if len(esc_prefix(esc.name)) > room]
        problems.append(
            f"{file}: ESC name {' and '.join(long)}: with it in front, names are longer than {_NAME_LIMIT} characters, as that of "
            f"{longest}. {f'Take ESC names of at most {room} letters' if room > 0 else 'Shorten the names in the DBC'}."
        )


def _relations(
    specifics: "DbcSpecifics | None", moved: Mapping[int, list[tuple[int, dict[str, str]]]]
) -> "DbcSpecifics | None":
    """Copies attributes of relations (BA_REL_), which refer to messages and signals by id and name."""
    specifics = deepcopy(specifics)
    relations = specifics.relation_attributes if specifics is not None else None
    if relations is not None:
        signals, messages = relations.node_signal_relations, relations.node_message_relations
        old_signals, old_messages = dict(signals), dict(messages)
        signals.clear()
        messages.clear()
        for number, by_signal in old_signals.items():
            for new, names in moved.get(number, [(number, {})]):
                signals[new] = OrderedDict(
                    (names.get(name, name), nodes) for name, nodes in by_signal.items()
                )
        for number, by_node in old_messages.items():
            for new, _ in moved.get(number, [(number, {})]):
                messages[new] = by_node
    return specifics


def _has_values_of_an_esc(message: "Message", bind: dict[str, str | float]) -> bool:
    binder = Binder([EscSettings()], bind)
    for signal in message.signals:
        bound = binder.bound(message.name, signal.name)
        found = binder.by_name(bound if isinstance(bound, str) else signal.name)
        if found and found[0].group is not Group.GATEWAY:
            return True
    return False


def _step(
    ids: Sequence[tuple[int, bool]],
    taken: set[tuple[int, bool]],
    count: int,
    wanted: int | None,
    file: str,
) -> int:
    if not ids:
        return 0
    every = [i for i, _ in ids] + [i for i, _ in taken]
    for step in [wanted] if wanted is not None else range(1, max(every) - min(every) + 2):
        moved = [(i + n * step, extended) for i, extended in ids for n in range(count)]
        if len(set(moved)) == len(moved) and not taken & set(moved):
            return step
    if wanted is not None:
        raise UserError(
            f"{file}: with ids moved by {wanted} an ESC, ids of {count} ESCs clash. Take another step."
        )
    raise UserError(
        f"{file}: no step moves the ids for {count} ESCs without a clash. Give the messages other ids."
    )


def _copy(message: "Message") -> "Message":
    """A copy that can be moved and renamed; it shares everything that does not change."""
    made = copy(message)
    made._signals = [copy(signal) for signal in message.signals]
    if message.signal_groups is not None:
        made.signal_groups = [copy(group) for group in message.signal_groups]
    return made


def _rename(message: "Message", prefix: str) -> None:
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
    message.refresh(strict=False)
