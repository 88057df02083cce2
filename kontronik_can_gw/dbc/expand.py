"""Copies a one-ESC DBC for several ESCs: names prefixed, ids moved, nothing lost."""

import fnmatch
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.names import MAX_NAME, Binder, esc_prefix
from kontronik_can_gw.dbc.reader import NO_NODE, choose_node, listed
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings

if TYPE_CHECKING:
    from cantools.database.can import Database, Message


def copies_of(
    database: "Database", file: str, escs: Sequence[EscSettings], settings: DbcConfig
) -> list[Copy]:
    """The messages of the DBC for these ESCs: ours (those that ``settings`` choose), and those of other nodes as they stand.

    With several ESCs and a DBC whose signals are bound to values of an ESC, and none names which one, each message with such values is
    there for each ESC: with its name as prefix, its ids moved by ``id_step`` (None: the smallest step without a clash). ``base_id``
    becomes the lowest of our ids. UserError for names or ids that do not fit.
    """
    node = choose_node(database, settings.node, file, settings.messages)
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
    if problems := [f"{file}: {problem}" for problem in _problems(copies, node)]:
        raise UserError(*problems)
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
        hint = did_you_mean(pattern, others if node == NO_NODE else ours)
        for name in fnmatch.filter(others, pattern)[:1]:
            hint = f" {name} is sent by {', '.join(others[name].senders) or 'nobody'}."
        problems.append(f"dbc.messages: {pattern!r} is no message of {node} in {file}.{hint}")
    if problems:
        raise UserError(*problems)
    return [m for m in database.messages if m.name in chosen or m.name not in ours]


def _problems(copies: Sequence[Copy], node: str) -> Iterator[str]:
    """Ids outside the range of CAN ids, and names that become too long with a prefix: a line for all of them."""
    ours = [made for made in copies if node in made.message.senders]
    limits = [0x1FFFFFFF if made.message.is_extended_frame else 0x7FF for made in ours]
    outside = [
        f"{made.frame_id:X}h"
        for made, limit in zip(ours, limits, strict=True)
        if not 0 <= made.frame_id <= limit
    ]
    if outside:
        what = f"{len(outside)} of {len(ours)} ids are out of range: {listed(outside)}."
        yield f"{what} Take fewer ESCs or another dbc.base_id."
    names = [
        name
        for made in copies
        if made.prefix
        for name in (made.name, *(name for _, name in made.signals()))
        if len(name) > MAX_NAME
    ]
    if names:
        what = f"longer than {MAX_NAME} characters with the ESC's name in front"
        yield f"{what}: {listed(names)}. Shorten the name of the ESC, or those in the DBC."


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
