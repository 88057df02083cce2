"""Prepares what will be sent from a DBC file and the ESCs: the database (expanded if it describes one ESC) and its layout."""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.compiler import compile_layout
from kontronik_can_gw.dbc.expand import among_canopen, expand, needs_expansion, with_messages
from kontronik_can_gw.dbc.reader import choose_node
from kontronik_can_gw.dbc.settings import DbcSettings
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals.plan import Layout

if TYPE_CHECKING:
    from cantools.database.can import Database

WARN_LOAD, REFUSE_LOAD = 0.5, 1.0


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
    if needs_expansion(database, node, escs, settings.bind) or settings.base_id is not None:
        plain = database
        database, bind = expand(
            plain, node, escs, file, settings.bind, settings.base_id, settings.id_step
        )
        settings = replace(settings, bind=bind)
        if settings.base_id is None and (reason := among_canopen(plain, database, node)):
            warnings = (f"{file}: for {len(escs)} ESCs, {reason}",)
    layout = compile_layout(database, file, escs, settings, taken_ids, fd_allowed)
    return database, replace(layout, warnings=(*layout.warnings, *warnings))


def _with_chosen(database: "Database", node: str, patterns: Sequence[str], file: str) -> "Database":
    """The database with only those messages of a node that match a pattern. UserError for a pattern without a match."""
    ours = {message.name for message in database.messages if node in message.senders}
    problems = []
    for pattern in patterns:
        if not fnmatch.filter(ours, pattern):
            others = [
                m
                for m in database.messages
                if m.name not in ours and fnmatch.fnmatchcase(m.name, pattern)
            ]
            sender = (
                f" {others[0].name} is sent by {', '.join(others[0].senders) or 'nobody'}."
                if others
                else ""
            )
            hint = "" if others else did_you_mean(pattern, ours)
            problems.append(
                f"dbc.messages: {pattern!r} is no message of {node} in {file}.{sender}{hint}"
            )
    if problems:
        raise UserError(*problems)
    chosen = {name for pattern in patterns for name in fnmatch.filter(ours, pattern)}
    messages = [m for m in database.messages if m.name in chosen or m.name not in ours]
    return with_messages(database, messages, database.dbc)


def check_load(
    layout: Layout, bitrate: int, data_bitrate: int = 2_000_000, further_bits: float = 0
) -> str | None:
    """A warning above 50 % computed bus load, UserError above 100 %, else None. ``further_bits``: bits per second of CANopen nodes."""
    load = layout.bus_load(bitrate, data_bitrate) + further_bits / bitrate
    what = "the CANopen nodes" if not layout.messages else f"{layout.file}: the messages"
    if layout.messages and further_bits:
        what += " and the CANopen nodes"
    text = f"{what} need {load:.0%} of {bitrate // 1000} kbit/s"
    if load > REFUSE_LOAD:
        raise UserError(
            f"{text}. Send less often (GenMsgCycleTime, GenMsgDelayTime; inhibit times) or raise can.bitrate."
        )
    return f"{text}; other nodes get little" if load > WARN_LOAD else None
