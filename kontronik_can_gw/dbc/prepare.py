"""Compiles a DBC for some ESCs to a layout.

A layout is the tuple of MessagePlans that the configured transmitter node sends. Ids, positions,
byte order, sign, factor, offset, limits, value tables and timing are taken only from the file. All
mistakes in a DBC or its bindings are found here together, at the start.

Settings that are valid but misleading cause a warning: a bus that is nearly full, flags without a
code for "not available" in a message that does not report lost telemetry, a state of the gateway
without Quiet, and values that a protocol does not supply.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.expand import copies_of
from kontronik_can_gw.dbc.message_compiler import compile_message
from kontronik_can_gw.dbc.names import Binder
from kontronik_can_gw.dbc.protection import shared_data_ids
from kontronik_can_gw.dbc.reader import choose_node, listed, own_left_out
from kontronik_can_gw.dbc.signal_compiler import Compilation
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES, Group, Value
from kontronik_can_gw.frames import block_of
from kontronik_can_gw.signals.packer import has_code
from kontronik_can_gw.signals.plan import MessageLayout, MessagePlan, SignalPlan
from kontronik_can_gw.status import GatewayState

if TYPE_CHECKING:
    from cantools.database.can import Database

WARN_LOAD = 0.5
REFUSE_LOAD = 1.0
_MANY = 5
"""If more signals are not bound, the error describes how to send only some messages."""
_OF_LINK = frozenset({"link_state", "data_age"})
"""Values that report the loss of live data."""


def prepare(
    database: "Database",
    file: str,
    escs: Sequence[EscSettings],
    settings: DbcConfig,
    is_fd_allowed: bool = False,
    taken_ids: Mapping[int, str] | None = None,
) -> MessageLayout:
    """Return the compiled layout of a gateway with these ESCs.

    ``taken_ids`` contains ids and blocks of ids that are already in use, and their users, for
    example the CANopen nodes with their COB-IDs. Raises UserError with all mistakes together.
    """
    node = choose_node(database, settings.node, file, settings.messages)
    left_out = own_left_out(database, node, file, settings.messages)
    copies = copies_of(database, file, escs, settings)
    ours = [copy for copy in copies if node in copy.message.senders]
    job = Compilation(database, settings, Binder(escs, settings.bind), is_fd_allowed)
    job.problems += left_out
    plans = [*_compiled(job, ours)]
    job.problems += _clashes(copies, node, taken_ids or {})
    if len(job.unbound) > _MANY:
        job.problems.append(
            f"{len(job.unbound)} signals of {node} have no source. "
            "Choose the messages to send with dbc.messages, for example "
            f'["{ours[0].message.name}", "Esc*"], '
            'or send such signals as constants with dbc.unbound = "start_value".'
        )
    problems = [f"{file}: {problem}" for problem in dict.fromkeys(job.problems)]
    problems += _unused_settings(job, ours, node, file)
    if problems:
        raise UserError(*problems)
    job.warnings += shared_data_ids(plans)
    job.warnings += _timing_warnings(plans)
    warnings = [f"{file}: {warning}" for warning in dict.fromkeys(job.warnings)]
    return MessageLayout(file, node, tuple(plans), tuple(warnings))


def _compiled(job: Compilation, ours: Sequence[Copy]) -> Iterator[MessagePlan]:
    """Yield the plans of the gateway's messages.

    A message is compiled only once for ESCs with the same protocol and the same bindings.
    """
    made: dict[object, tuple[Copy, MessagePlan]] = {}
    for copy in ours:
        key: object = None
        if copy.esc is not None:
            protocol = job.binder.escs[copy.esc].protocol
            bound = [job.binder.bound(copy, signal.name) for signal in copy.message.signals]
            key = (id(copy.message), protocol, *bound)
        if copy.esc is not None and key in made:
            first, plan = made[key]
            yield replace(
                plan,
                name=copy.name,
                can_id=copy.frame_id,
                escs=frozenset((copy.esc,)),
                renamed=(first.prefix, copy.prefix),
            )
            continue
        compiled = compile_message(job, copy)
        if compiled is not None:
            yield compiled
            # a CRC must be configured with the name of each copy, so its copies may differ
            if compiled.escs == {copy.esc} and compiled.e2e is None:
                made[key] = (copy, compiled)


def _clashes(
    copies: Sequence[Copy],
    node: str,
    taken: Mapping[int, str],
) -> Iterator[str]:
    """Yield the problems of ids and names that are used twice, and of ids that are taken.

    Clashes between two messages of other nodes are not problems.
    """
    ids: dict[int, Copy] = {}
    names: dict[str, Copy] = {}
    for copy in copies:
        same_id = ids.setdefault(copy.key, copy)
        same_name = names.setdefault(copy.name, copy)
        senders = copy.message.senders
        if same_id is not copy and node in (*senders, *same_id.message.senders):
            yield (
                f"{copy.name}: id {copy.frame_id:X}h is already used by {same_id.name}. "
                "Change one of them."
            )
        if same_name is not copy and node in (*senders, *same_name.message.senders):
            yield f"{copy.name}: two messages have this name. Rename one of them."
        if node not in senders:
            continue
        counted = Counter(signal.name for signal in copy.message.signals)
        for name, count in counted.items():
            if count > 1:
                yield f"{copy.message.name}.{name}: two signals have this name. Rename one."
        user = copy.key if copy.key in taken else block_of(copy.key, taken)
        if user is not None:
            yield (
                f"{copy.name}: id {copy.frame_id:X}h is used by {taken[user]}. "
                f"Move the message (always free: 680h..6DFh) or change the node-ID."
            )


def _unused_settings(
    job: Compilation,
    ours: Sequence[Copy],
    node: str,
    file: str,
) -> Iterator[str]:
    """Yield the problems of settings that do not apply to any of the gateway's messages."""
    settings = job.settings
    messages = [copy.message for copy in ours]
    known = [message.name for message in messages]
    for message in messages:
        known += [f"{message.name}.{signal.name}" for signal in message.signals]
    for key in sorted(set(settings.bind) - job.binder.used):
        near = did_you_mean(key, known)
        yield f"dbc.bind.{key}: no such signal in the messages of {node} in {file}.{near}"
    condition = f"signal of {node} has this unit"
    yield from _unmet("units", settings.units, job.units, condition, file)
    condition = f"message of {node} has this GenMsgSendType"
    yield from _unmet("send_type", settings.send_type, job.send_types, condition, file)
    names = {copy.name for copy in ours}
    for name in sorted(set(settings.e2e_data_ids) - names):
        near = did_you_mean(name, names)
        yield f"dbc.e2e_data_ids.{name}: no such message of {node} in {file}.{near}"
    for name in sorted(set(settings.e2e) - job.protected):
        near = did_you_mean(name, [copy.name for copy in ours])
        yield f"dbc.e2e.{name}: no message of {node} in {file} with this name has a CRC.{near}"


def _unmet(
    table: str,
    given: Iterable[str],
    met: Iterable[str],
    condition: str,
    file: str,
) -> Iterator[str]:
    for text in sorted(set(given) - set(met)):
        near = did_you_mean(text, met, 0.3, show=repr)
        yield f"dbc.{table}.{text}: no {condition} in {file}.{near}"


def _timing_warnings(plans: Sequence[MessagePlan]) -> Iterator[str]:
    once = [plan.name for plan in plans if not plan.cycle_ns and not plan.paces]
    if once:
        yield (
            f"sent only once, at the start, without a cycle time or a changing value: "
            f"{listed(once)}"
        )


def check_load(
    layout: MessageLayout,
    bitrate: int,
    data_bitrate: int = 2_000_000,
    further: Mapping[str, float] | None = None,
    worst_further: Mapping[str, float] | None = None,
) -> str | None:
    """Return a warning if the worst bus load is above 50 %.

    Raises UserError if the usual load is above 100 %. ``further`` and ``worst_further`` contain the
    bits per second of other outputs, usual and at worst.
    """
    further = further or {}
    worst_further = worst_further or further
    load = layout.bus_load(bitrate, data_bitrate) + sum(further.values()) / bitrate
    worst = layout.bus_load(bitrate, data_bitrate, is_worst=True)
    worst += sum(worst_further.values()) / bitrate
    senders = list(further)
    if layout.messages:
        senders.insert(0, f"{layout.file}: the messages")
    text = f"{' and '.join(senders)} need {load:.0%} of {bitrate // 1000} kbit/s"
    if load > REFUSE_LOAD:
        raise UserError(
            f"{text}. Send less often (GenMsgCycleTime, GenMsgDelayTime; "
            "inhibit times) or raise can.bitrate."
        )
    if worst <= WARN_LOAD:
        return None
    if round(worst, 2) > round(load, 2):
        text += f", and up to {worst:.0%} while all values sent on change keep changing"
    return f"{text}. Little is left for other nodes"


def is_mute(signal: SignalPlan) -> bool:
    """Return True for a flag that has one of its two values without telemetry."""
    source = signal.source
    if source is None or source.bit is None or signal.is_float or not source.supplied:
        return False
    if source.group not in (Group.LIVE, Group.INFO):
        return False
    return signal.not_available in (signal.intercept, signal.slope + signal.intercept)


def reporter(message: MessagePlan, flag: SignalPlan) -> SignalPlan | None:
    """Return the signal in the frame of a flag that reports lost telemetry. None without it."""
    group = cast(Value, flag.source).group
    for signal in message.signals:
        source = signal.source
        is_in_frame = signal.page in (None, flag.page)
        if source is None or not is_in_frame or signal.esc != flag.esc:
            continue
        if source.name in _OF_LINK and group is Group.LIVE:
            return signal
        if source.group is group and not source.optional and has_code(signal):
            return signal
    return None


def unreported(settings: CoreSettings) -> Iterator[str]:
    """Yield a warning for each message whose flags hide the loss of telemetry."""
    layout = settings.layout
    for message in layout.messages:
        flags = []
        for signal in message.signals:
            if is_mute(signal) and reporter(message, signal) is None:
                flags.append(signal.name)
        if flags and not (settings.silent_on_loss and message.can_stop):
            remedy = ', or set dbc.on_loss = "silent"' if message.can_stop else ""
            yield (
                f"{layout.file}: {message.name}: without telemetry {listed(flags, 3)} are sent "
                "as if they were known, and no signal "
                "of the message reports the loss. Add a signal bound to link_state, or one with "
                f"NotAvailable in its value table{remedy}."
            )


def without_quiet(settings: CoreSettings) -> Iterator[str]:
    """Yield a warning for each signal that cannot report quiet mode, if this mode can begin."""
    layout = settings.layout
    messages = layout.messages if settings.quiet_after_ns else ()
    for message in messages:
        for signal in message.signals:
            numbers = signal.numbers
            is_state = signal.source is VALUES["gateway_state"]
            if is_state and numbers is not None and GatewayState.QUIET not in numbers:
                yield (
                    f"{layout.file}: {message.name}.{signal.name}: "
                    "its value table has no Quiet, so quiet mode is sent as Error. Add it."
                )


def unsupplied(settings: CoreSettings) -> Iterator[str]:
    """Yield a warning for each message with values that its ESC's protocol does not have."""
    layout = settings.layout
    for message in layout.messages:
        names = []
        protocols = set()
        for signal in message.signals:
            if signal.source is not None and not signal.source.supplied:
                names.append(signal.name)
                protocols.add(settings.escs[signal.esc or 0].protocol)
        if names:
            yield (
                f"{layout.file}: {message.name}: {listed(names, 3)}: "
                f"never available, because the protocol {' or '.join(sorted(protocols))} "
                "does not supply them. "
                "A flag has no code for this: it is sent as 0 or its start value."
            )
