"""From a DBC and the ESCs to what will be sent: the database (expanded if it describes one ESC) and its compiled layout.

A layout is the tuple of MessagePlans that the configured transmitter node sends. Ids, positions, byte order, sign, factor, offset,
limits, value tables and timing come only from the file. All mistakes in a DBC or its bindings are found here, at start, at once.
"""

import fnmatch
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.binding import Binder
from kontronik_can_gw.dbc.expand import among_canopen, expand, with_messages
from kontronik_can_gw.dbc.message_compiler import compile_message
from kontronik_can_gw.dbc.reader import choose_node, listed
from kontronik_can_gw.dbc.settings import Compilation, DbcSettings
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import EXTENDED, block_of
from kontronik_can_gw.signals.plan import Layout, MessagePlan

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

WARN_LOAD, REFUSE_LOAD = 0.5, 1.0
_MANY = 5


def prepare(
    database: "Database",
    file: str,
    escs: Sequence[EscSettings],
    settings: DbcSettings,
    fd_allowed: bool = False,
    taken_ids: Mapping[int, str] | None = None,
) -> tuple["Database", Layout]:
    """The database of exactly what a gateway with these ESCs sends, and the compiled layout. UserError with every mistake."""
    node = choose_node(database, settings.node, file)
    if settings.messages:
        database = _with_chosen(database, node, settings.messages, file)
    warnings: tuple[str, ...] = ()
    if settings.base_id is not None or _describes_one(database, node, escs, settings):
        plain = database
        database, bind = expand(
            plain, node, escs, file, settings.bind, settings.base_id, settings.id_step
        )
        settings = replace(settings, bind=bind)
        if settings.base_id is None and (reason := among_canopen(plain, database, node)):
            warnings = (f"{file}: for {len(escs)} ESCs, {reason}",)
    layout = compile_layout(database, file, escs, settings, taken_ids, fd_allowed)
    return database, replace(layout, warnings=(*layout.warnings, *warnings))


def compile_layout(
    database: "Database",
    file: str,
    escs: Sequence[EscSettings],
    settings: DbcSettings,
    taken_ids: Mapping[int, str] | None = None,
    fd_allowed: bool = False,
) -> Layout:
    """Compile all of our messages. UserError with all mistakes at once.

    ``taken_ids``: ids and blocks of ids already in use (as COB-IDs of our CANopen nodes), and their users.
    """
    node = choose_node(database, settings.node, file)
    job = Compilation(database, file, settings, Binder(escs, settings.bind), fd_allowed)
    ours = [message for message in database.messages if node in message.senders]
    plans = [plan for message in ours if (plan := compile_message(job, message)) is not None]
    job.problems += _clashes(database, ours, taken_ids or {}, file)
    job.problems += _unused_settings(job, ours, node)
    if job.unbound > _MANY:
        job.problems.append(
            f"{file}: {job.unbound} signals of {node} are bound to nothing. dbc.messages chooses messages, as "
            f'["{ours[0].name}", "Esc*"]; dbc.unbound = "start_value" sends what is not bound as a constant.'
        )
    if job.problems:
        raise UserError(*job.problems)
    warnings = (*job.warnings, *_timing_warnings(job, plans))
    return Layout(file, node, tuple(plans), warnings)


def _describes_one(
    database: "Database", node: str, escs: Sequence[EscSettings], settings: DbcSettings
) -> bool:
    """True for several ESCs and a DBC whose signals are bound to values of an ESC, and none names which one."""
    binder = Binder(escs, settings.bind)
    ours = (message for message in database.messages if node in message.senders)
    return len(escs) > 1 and set().union(*map(binder.escs_of, ours)) == {None}


def _with_chosen(database: "Database", node: str, patterns: Sequence[str], file: str) -> "Database":
    """The database with only those messages of a node that match a pattern. UserError for a pattern without a match."""
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
    messages = [m for m in database.messages if m.name in chosen or m.name not in ours]
    return with_messages(database, messages, database.dbc)


def _clashes(
    database: "Database", ours: Sequence["Message"], taken: Mapping[int, str], file: str
) -> Iterator[str]:
    """Ids and names that one of our messages shares with another, names that its signals share, and ids that are taken."""
    mine = {id(message) for message in ours}
    ids: dict[tuple[int, bool], Message] = {}
    names: dict[str, Message] = {}
    for message in database.messages:
        other = ids.setdefault((message.frame_id, message.is_extended_frame), message)
        if other is not message and mine & {id(message), id(other)}:
            yield (
                f"{file}: {message.name}: id {message.frame_id:X}h is also that of {other.name}. "
                "Change one of them."
            )
        other = names.setdefault(message.name, message)
        if other is not message and mine & {id(message), id(other)}:
            yield f"{file}: {message.name}: two messages have this name. Rename one of them."
    for message in ours:
        counted = Counter(signal.name for signal in message.signals)
        for name in (name for name, count in counted.items() if count > 1):
            yield f"{file}: {message.name}.{name}: two signals have this name. Rename one."
        key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
        user = key if key in taken else block_of(key, taken)
        if user is not None:
            yield (
                f"{file}: {message.name}: id {message.frame_id:X}h is used by {taken[user]}. "
                f"Move the message (free for all: 680h..6DFh) or change the node-ID."
            )


def _unused_settings(job: Compilation, ours: Sequence["Message"], node: str) -> Iterator[str]:
    """Entries of the configuration for what is not in our messages."""
    settings, file = job.settings, job.file
    known = [m.name for m in ours] + [f"{m.name}.{s.name}" for m in ours for s in m.signals]
    for key in sorted(set(settings.bind) - job.binder.used):
        near = did_you_mean(key, known)
        yield f"dbc.bind.{key}: no such signal in the messages of {node} in {file}.{near}"
    yield from _unmet("units", settings.units, job.units, f"signal of {node} has this unit", file)
    what = f"message of {node} has this GenMsgSendType"
    yield from _unmet("send_type", settings.send_types, job.send_types, what, file)
    for name in sorted(set(settings.data_ids) - {m.name for m in ours}):
        yield f"dbc.e2e_data_ids.{name}: no such message of {node} in {file}."


def _unmet(
    table: str, given: Iterable[str], met: Iterable[str], what: str, file: str
) -> Iterator[str]:
    for text in sorted(set(given) - set(met)):
        near = did_you_mean(text, met, 0.3, show=repr)
        yield f"dbc.{table}.{text}: no {what} in {file}.{near}"


def _timing_warnings(job: Compilation, plans: Sequence[MessagePlan]) -> Iterator[str]:
    once = [plan.name for plan in plans if not plan.cycle_ns and not plan.paces]
    if once:
        yield (
            f"{job.file}: sent once at the start, without a cycle and a value that changes: {listed(once)}"
        )
    if names := job.while_active:
        yield f"{job.file}: sent all the time, not only while something is active: {listed(names)}"


def check_load(
    layout: Layout,
    bitrate: int,
    data_bitrate: int = 2_000_000,
    further: Mapping[str, float] | None = None,
) -> str | None:
    """A warning above 50 % computed bus load, UserError above 100 %, else None. ``further``: other outputs and their bits per second."""
    further = further or {}
    load = layout.bus_load(bitrate, data_bitrate) + sum(further.values()) / bitrate
    who = [*([f"{layout.file}: the messages"] if layout.messages else []), *further]
    text = f"{' and '.join(who)} need {load:.0%} of {bitrate // 1000} kbit/s"
    if load > REFUSE_LOAD:
        raise UserError(
            f"{text}. Send less often (GenMsgCycleTime, GenMsgDelayTime; inhibit times) or raise can.bitrate."
        )
    return f"{text}; other nodes get little" if load > WARN_LOAD else None
