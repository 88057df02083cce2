"""Copies a one-ESC DBC for several ESCs without loss: names get prefixes, ids are moved."""

import fnmatch
from collections.abc import Container, Iterator, Sequence
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
    database: "Database",
    file: str,
    escs: Sequence[EscSettings],
    settings: DbcConfig,
) -> list[Copy]:
    """Return the messages of a DBC for these ESCs.

    The gateway's messages are those of its node that ``settings`` choose. Messages of other nodes
    are not changed.

    If there are several ESCs, and no signal of the DBC names an ESC, each message with values of an
    ESC is copied for each ESC. A copy has the ESC's name as prefix. Its id is moved by ``id_step``,
    or by the smallest step without a clash if this is None. ``base_id`` becomes the lowest id of
    the gateway's messages. Raises UserError for names or ids that do not fit.
    """
    node = choose_node(database, settings.node, file, settings.messages)
    messages = _chosen(database, node, settings.messages, file)
    ours = [message for message in messages if node in message.senders]
    shift = 0
    if settings.base_id is not None:
        shift = settings.base_id - min(message.frame_id for message in ours)
    copied: set[int] = set()
    if len(escs) > 1:
        copied = _messages_of_each(ours, Binder(escs, settings.bind))
    moved = [Copy(message, shift if node in message.senders else 0) for message in messages]
    step = _step(moved, copied, len(escs), settings.id_step, file) if copied else 0
    copies = []
    for copy in moved:
        if id(copy.message) not in copied:
            copies.append(copy)
            continue
        for index, esc in enumerate(escs):
            distance = copy.distance + index * step
            copies.append(Copy(copy.message, distance, index, esc_prefix(esc.name)))
    problems = [f"{file}: {problem}" for problem in _problems(copies, node, settings)]
    if problems:
        raise UserError(*problems)
    return copies


def _messages_of_each(messages: Sequence["Message"], binder: Binder) -> set[int]:
    """Return the object ids of the messages that are copied for each ESC.

    They have values of an ESC that is not named. Empty if a signal names its ESC.
    """
    found: set[int] = set()
    for message in messages:
        escs = binder.escs_of(message)
        if escs - {None}:
            return set()
        if escs:
            found.add(id(message))
    return found


def _chosen(
    database: "Database",
    node: str,
    patterns: Sequence[str],
    file: str,
) -> list["Message"]:
    """Return the messages of other nodes, and those of ``node`` that match one of the patterns.

    Without patterns all messages are returned. Raises UserError for a pattern without a match.
    """
    if not patterns:
        return list(database.messages)
    ours = {message.name for message in database.messages if node in message.senders}
    others = {message.name: message for message in database.messages if message.name not in ours}
    chosen: set[str] = set()
    problems = []
    for pattern in patterns:
        found = fnmatch.filter(ours, pattern)
        if found:
            chosen.update(found)
            continue
        hint = did_you_mean(pattern, others if node == NO_NODE else ours)
        for name in fnmatch.filter(others, pattern)[:1]:
            senders = ", ".join(others[name].senders)
            hint = f" {name} is sent by {senders}." if senders else f" {name} has no transmitter."
        problems.append(f"dbc.messages: {pattern!r} matches no message of {node} in {file}.{hint}")
    if problems:
        raise UserError(*problems)
    chosen.update(others)
    return [message for message in database.messages if message.name in chosen]


def _id_problem(ours: Sequence[Copy], settings: DbcConfig) -> str | None:
    """Return the problem of messages that were moved beyond the last id. None without it."""
    outside = []
    limits = set()
    excess = 0
    for copy in ours:
        limit = 0x1FFFFFFF if copy.message.is_extended_frame else 0x7FF
        if copy.frame_id > limit:
            outside.append(f"{copy.name} {copy.frame_id:X}h")
            limits.add(f"{limit:X}h")
            excess = max(excess, copy.frame_id - limit)
    if not outside:
        return None
    lowest = min(copy.frame_id for copy in ours)
    reasons = []
    if settings.base_id is not None:
        reasons.append(f"dbc.base_id = 0x{settings.base_id:X}")
    if any(copy.prefix for copy in ours):
        reasons.append("the distance between the ids of the ESCs, dbc.id_step,")
    remedy = "Leave out messages with dbc.messages."
    if excess <= lowest:
        remedy = f"Set dbc.base_id to at most 0x{lowest - excess:X}, or leave out messages with "
        remedy += "dbc.messages."
    return (
        f"{len(outside)} of {len(ours)} ids are beyond {' or '.join(sorted(limits))}, because "
        f"{' and '.join(reasons)} moves them: {listed(outside)}. {remedy}"
    )


def _problems(copies: Sequence[Copy], node: str, settings: DbcConfig) -> Iterator[str]:
    """Yield a line about ids out of range, and a line about names that are too long."""
    problem = _id_problem([copy for copy in copies if node in copy.message.senders], settings)
    if problem is not None:
        yield problem
    names = []
    for copy in copies:
        if copy.prefix:
            names.append(copy.name)
            names += [name for _, name in copy.signals()]
    too_long = [name for name in names if len(name) > MAX_NAME]
    if too_long:
        problem = f"longer than {MAX_NAME} characters with the ESC's name as prefix"
        remedy = "Shorten the name of the ESC, or the names in the DBC."
        yield f"{problem}: {listed(too_long)}. {remedy}"


def _step(
    messages: Sequence[Copy],
    copied: Container[int],
    count: int,
    wanted: int | None,
    file: str,
) -> int:
    """Return the distance of the ids of adjacent ESCs.

    This is ``wanted``, or the smallest distance without a clash. ``copied`` contains the object ids
    of the messages that are copied for each of ``count`` ESCs.
    """
    taken = {copy.key for copy in messages if id(copy.message) not in copied}
    own = [copy.key for copy in messages if id(copy.message) in copied]
    ids = [copy.frame_id for copy in messages]
    steps = range(1, max(ids) - min(ids) + 2) if wanted is None else [wanted]
    for step in steps:
        moved: set[int] = set()
        for index in range(count):
            moved.update(key + index * step for key in own)
        if len(taken | moved) == len(taken) + len(own) * count:
            return step
    if wanted is not None:
        raise UserError(
            f"{file}: with dbc.id_step = {wanted} the ids of {count} ESCs clash. "
            "Choose another step."
        )
    raise UserError(
        f"{file}: no dbc.id_step separates the ids of {count} ESCs. Change the ids of the messages."
    )
