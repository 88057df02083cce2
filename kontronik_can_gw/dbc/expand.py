"""Copies a one-ESC DBC for several ESCs: names prefixed, ids moved, nothing lost."""

import fnmatch
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from copy import copy, deepcopy
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.binding import Binder
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.names import MAX_NAME, esc_prefix
from kontronik_can_gw.dbc.reader import choose_node
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.dbc.writer import frame_id
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.formats.dbc import DbcSpecifics

_SDO_END, _RESTRICTED = 0x67F, 0x6E0
"""CiA 301 uses no 11-bit ids in this range: it is after the SDO requests and before the restricted ids."""


def copies_of(
    database: "Database", file: str, escs: Sequence[EscSettings], settings: DbcSettings
) -> list[Copy]:
    """The messages of the DBC for these ESCs: ours (those that ``settings`` choose), and those of other nodes as they stand.

    With several ESCs and a DBC whose signals are bound to values of an ESC, and none names which one, each message with such values is
    there for each ESC: with its name as prefix, its ids moved by ``id_step`` (None: the smallest step without a clash). ``base_id``
    becomes the lowest of our ids. UserError for names or ids that do not fit.
    """
    node = choose_node(database, settings.node, file)
    messages = _chosen(database, node, settings.messages, file)
    ours = [message for message in messages if node in message.senders]
    shift = 0
    if settings.base_id is not None:
        shift = settings.base_id - min(message.frame_id for message in ours)
    binder = Binder(escs, settings.bind)
    values_of = {id(message): binder.escs_of(message) for message in ours if len(escs) > 1}
    each = {at for at, found in values_of.items() if found}
    if set().union(*values_of.values()) != {None}:
        each.clear()
    ids = [
        (m.frame_id + shift * (node in m.senders), m.is_extended_frame, id(m) in each)
        for m in messages
    ]
    step = _step(ids, len(escs), settings.id_step, file) if each else 0
    copies = []
    for message in messages:
        distance = shift if node in message.senders else 0
        if id(message) not in each:
            copies.append(Copy(message, distance))
            continue
        for index, esc in enumerate(escs):
            copies.append(Copy(message, distance + index * step, index, esc_prefix(esc.name)))
    if each or settings.base_id is not None:
        moved = [made for made in copies if node in made.message.senders]
        problems = [
            *_id_problems(moved, len(escs), settings.base_id),
            *_length_problems(copies, escs),
        ]
        if problems:
            raise UserError(*(f"{file}: {problem}" for problem in problems))
    return copies


def _chosen(database: "Database", node: str, patterns: Sequence[str], file: str) -> list["Message"]:
    """All messages but those of a node that match none of the patterns, if any. UserError for a pattern without a match."""
    if not patterns:
        return list(database.messages)
    ours = {message.name for message in database.messages if node in message.senders}
    others = {m.name: m for m in database.messages if m.name not in ours}
    chosen: set[str] = set()
    problems = []
    for pattern in patterns:
        if found := fnmatch.filter(ours, pattern):
            chosen.update(found)
            continue
        hint = did_you_mean(pattern, ours)
        for name in fnmatch.filter(others, pattern)[:1]:
            hint = f" {name} is sent by {', '.join(others[name].senders) or 'nobody'}."
        problems.append(f"dbc.messages: {pattern!r} is no message of {node} in {file}.{hint}")
    if problems:
        raise UserError(*problems)
    return [m for m in database.messages if m.name in chosen or m.name not in ours]


def expand(database: "Database", copies: Sequence[Copy]) -> "Database":
    """The database with these copies for its messages."""
    import cantools.database.can

    return cantools.database.can.Database(
        messages=[_message(made) for made in copies],
        nodes=database.nodes,
        buses=database.buses,
        version=database.version,
        dbc_specifics=_relations(database.dbc, copies),
        strict=False,
        sort_signals=None,
    )


def _message(made: Copy) -> "Message":
    """A copy as cantools has it; the database that it gets into refreshes what cantools derives of it."""
    message = copy(made.message)
    message.name, message.frame_id = made.name, made.frame_id
    message._signals = [copy(signal) for signal in made.message.signals]
    for signal in message._signals:
        signal.name = made.prefix + signal.name
        if signal.multiplexer_signal is not None:
            signal.multiplexer_signal = made.prefix + signal.multiplexer_signal
    if message.signal_groups is not None:
        message.signal_groups = [copy(group) for group in message.signal_groups]
        for group in message.signal_groups:
            group.signal_names = [made.prefix + name for name in group.signal_names]
    return message


def among_canopen(copies: Sequence[Copy], node: str) -> str:
    """A warning where 11-bit ids of ``node`` are moved out of the range that CANopen leaves free (CiA 301, 7.3.5), else empty."""
    low, high = _SDO_END + 1, _RESTRICTED - 1
    ours = [
        made
        for made in copies
        if node in made.message.senders and not made.message.is_extended_frame
    ]
    known = {made.message.frame_id for made in ours}
    outside = {made.frame_id for made in ours if not low <= made.frame_id <= high}
    left = outside - known
    if not left or not any(low <= can_id <= high for can_id in known):
        return ""
    return (
        f"{len(left)} of {len(ours)} ids leave {low:X}h..{high:X}h, up to {max(left):X}h, where CANopen has its own. "
        "Take fewer ESCs, a DBC with 29-bit ids, or an explicit lowest id (dbc.base_id)."
    )


def _id_problems(copies: Sequence[Copy], count: int, base_id: int | None) -> Iterator[str]:
    """A line for ids outside the range of CAN ids."""
    why = f"for {count} ESCs" if base_id is None else f"with {base_id:X}h as the lowest id"
    every = [made.frame_id for made in copies]
    for extended, limit in ((False, 0x7FF), (True, 0x1FFFFFFF)):
        ids = [m.frame_id for m in copies if m.message.is_extended_frame is extended]
        if outside := [can_id for can_id in ids if not 0 <= can_id <= limit]:
            span = max(every) - min(every)
            remedy = f" The lowest id can be at most {limit - span:X}h." if limit > span else ""
            yield f"{why}, {len(outside)} of {len(every)} messages lie outside 0..{limit:X}h, up to {max(outside):X}h.{remedy}"


def _length_problems(copies: Sequence[Copy], escs: Sequence[EscSettings]) -> list[str]:
    """One line for all names that become too long with a prefix."""
    stems = {
        name.removeprefix(made.prefix)
        for made in copies
        if made.prefix
        for name in (made.name, *(name for _, name in made.signals()))
    }
    longest = max(sorted(stems), key=len, default="")
    room = MAX_NAME - len(longest)
    long = [esc.name for esc in escs if len(esc_prefix(esc.name)) > room]
    if not stems or not long:
        return []
    remedy = (
        f"Take ESC names of at most {room} letters" if room > 0 else "Shorten the names in the DBC"
    )
    which = f"names are longer than {MAX_NAME} characters, as that of {longest}"
    return [f"ESC name {' and '.join(long)}: with it in front, {which}. {remedy}."]


def _relations(specifics: "DbcSpecifics | None", copies: Sequence[Copy]) -> "DbcSpecifics | None":
    """Copies attributes of relations (BA_REL_), which refer to messages and signals by id and name."""
    specifics = deepcopy(specifics)
    relations = specifics.relation_attributes if specifics is not None else None
    if relations is None:
        return specifics
    moved: dict[int, list[Copy]] = {}
    for made in copies:
        moved.setdefault(frame_id(made.message), []).append(made)
    signals, messages = relations.node_signal_relations, relations.node_message_relations
    old_signals, old_messages = dict(signals), dict(messages)
    signals.clear()
    messages.clear()
    for number, by_signal in old_signals.items():
        for made in moved.get(number, []):
            renamed = ((made.prefix + name, nodes) for name, nodes in by_signal.items())
            signals[number + made.distance] = OrderedDict(renamed)
    for number, by_node in old_messages.items():
        for made in moved.get(number, []):
            messages[number + made.distance] = by_node
    return specifics


def _step(ids: Sequence[tuple[int, bool, bool]], count: int, wanted: int | None, file: str) -> int:
    """The distance of the ids from ESC to ESC: ``wanted``, else the smallest without a clash.

    ``ids``: id, whether it has 29 bits, whether it is that of each ESC.
    """
    taken = {(i, extended) for i, extended, each in ids if not each}
    own = [(i, extended) for i, extended, each in ids if each]
    widest = max(ids)[0] - min(ids)[0] + 1
    for step in [wanted] if wanted is not None else range(1, widest + 1):
        moved = {(i + n * step, extended) for i, extended in own for n in range(count)}
        if len(moved) == len(own) * count and not taken & moved:
            return step
    if wanted is not None:
        raise UserError(
            f"{file}: with ids moved by {wanted} an ESC, ids of {count} ESCs clash. Take another step."
        )
    raise UserError(
        f"{file}: no step moves the ids for {count} ESCs without a clash. Give the messages other ids."
    )
