"""From a DBC and the ESCs to what will be sent: the compiled layout.

A layout is the tuple of MessagePlans that the configured transmitter node sends. Ids, positions, byte order, sign, factor, offset,
limits, value tables and timing come only from the file. All mistakes in a DBC or its bindings are found here, at start, at once. What is
no mistake but hides something is a warning: a bus that is nearly full, flags without a code for "not available" where nothing reports
lost telemetry, values that a protocol lacks.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.expand import copies_of
from kontronik_can_gw.dbc.message_compiler import compile_message
from kontronik_can_gw.dbc.names import Binder
from kontronik_can_gw.dbc.reader import choose_node, listed
from kontronik_can_gw.dbc.signal_compiler import Compilation
from kontronik_can_gw.errors import UserError, did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import Group
from kontronik_can_gw.frames import block_of
from kontronik_can_gw.signals.packer import has_code
from kontronik_can_gw.signals.plan import Layout, MessagePlan, Role, SignalPlan

if TYPE_CHECKING:
    from cantools.database.can import Database

WARN_LOAD, REFUSE_LOAD = 0.5, 1.0
_MANY = 5
_OF_LINK = frozenset({"link_state", "data_age"})


def prepare(
    database: "Database",
    file: str,
    escs: Sequence[EscSettings],
    settings: DbcConfig,
    fd_allowed: bool = False,
    taken_ids: Mapping[int, str] | None = None,
) -> Layout:
    """The compiled layout of a gateway with these ESCs. UserError with every mistake at once.

    ``taken_ids``: ids and blocks of ids already in use (as COB-IDs of our CANopen nodes), and their users.
    """
    node = choose_node(database, settings.node, file, settings.messages)
    copies = copies_of(database, file, escs, settings)
    ours = [copy for copy in copies if node in copy.message.senders]
    job = Compilation(database, file, settings, Binder(escs, settings.bind), fd_allowed)
    plans = [*_compiled(job, ours)]
    job.problems += _clashes(copies, node, taken_ids or {}, file)
    job.problems += _unused_settings(job, ours, node)
    if len(job.unbound) > _MANY:
        job.problems.append(
            f"{file}: {len(job.unbound)} signals of {node} are bound to nothing. dbc.messages chooses messages, as "
            f'["{ours[0].message.name}", "Esc*"]; dbc.unbound = "start_value" sends what is not bound as a constant.'
        )
    if job.problems:
        raise UserError(*dict.fromkeys(job.problems))
    job.warnings += _timing_warnings(job, plans)
    return Layout(file, node, tuple(plans), tuple(dict.fromkeys(job.warnings)))


def _compiled(job: Compilation, ours: Sequence[Copy]) -> Iterator[MessagePlan]:
    """The plans of our messages, compiled once for ESCs that differ in nothing that signals know of."""
    made: dict[object, tuple[Copy, MessagePlan]] = {}
    for copy in ours:
        key: object = None
        if copy.esc is not None:
            protocol = job.binder.escs[copy.esc].protocol
            bound = (job.binder.bound(copy, signal.name) for signal in copy.message.signals)
            key = (id(copy.message), protocol, *bound)
        if copy.esc is not None and key in made:
            of, plan = made[key]
            yield replace(
                plan,
                name=copy.name,
                can_id=copy.frame_id,
                escs=frozenset((copy.esc,)),
                data_id=job.settings.e2e_data_ids.get(copy.name, copy.frame_id & 0xFFFF),
                renamed=(of.prefix, copy.prefix),
            )
        elif (compiled := compile_message(job, copy)) is not None:
            yield compiled
            # each copy with a CRC has to be asked for by its own name
            protected = any(signal.role is Role.CRC for signal in compiled.compiled)
            if compiled.escs == {copy.esc} and not protected:
                made[key] = copy, compiled


def _clashes(
    copies: Sequence[Copy], node: str, taken: Mapping[int, str], file: str
) -> Iterator[str]:
    """Ids and names that one of our messages shares with another, names that its signals share, and ids that are taken."""
    ids: dict[int, Copy] = {}
    names: dict[str, Copy] = {}
    for copy in copies:
        same_id, same_name = ids.setdefault(copy.key, copy), names.setdefault(copy.name, copy)
        senders = copy.message.senders
        if same_id is not copy and node in (*senders, *same_id.message.senders):
            yield (
                f"{file}: {copy.name}: id {copy.frame_id:X}h is also that of {same_id.name}. "
                "Change one of them."
            )
        if same_name is not copy and node in (*senders, *same_name.message.senders):
            yield f"{file}: {copy.name}: two messages have this name. Rename one of them."
        if node not in senders:
            continue
        counted = Counter(signal.name for signal in copy.message.signals)
        for name in (name for name, count in counted.items() if count > 1):
            yield f"{file}: {copy.message.name}.{name}: two signals have this name. Rename one."
        user = copy.key if copy.key in taken else block_of(copy.key, taken)
        if user is not None:
            yield (
                f"{file}: {copy.name}: id {copy.frame_id:X}h is used by {taken[user]}. "
                f"Move the message (free for all: 680h..6DFh) or change the node-ID."
            )


def _unused_settings(job: Compilation, ours: Sequence[Copy], node: str) -> Iterator[str]:
    """Entries of the configuration for what is not in our messages."""
    settings, file = job.settings, job.file
    messages = [copy.message for copy in ours]
    known = [m.name for m in messages] + [f"{m.name}.{s.name}" for m in messages for s in m.signals]
    for key in sorted(set(settings.bind) - job.binder.used):
        near = did_you_mean(key, known)
        yield f"dbc.bind.{key}: no such signal in the messages of {node} in {file}.{near}"
    yield from _unmet("units", settings.units, job.units, f"signal of {node} has this unit", file)
    what = f"message of {node} has this GenMsgSendType"
    yield from _unmet("send_type", settings.send_type, job.send_types, what, file)
    for name in sorted(set(settings.e2e_data_ids) - {copy.name for copy in ours}):
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


def check_load(
    layout: Layout,
    bitrate: int,
    data_bitrate: int = 2_000_000,
    further: Mapping[str, float] | None = None,
    worst_further: Mapping[str, float] | None = None,
) -> str | None:
    """Returns a warning if the worst bus load is above 50 %. UserError if the usual one is above 100 %.

    ``further`` and ``worst_further``: other outputs and their bits per second, usual and worst.
    """
    further = further or {}
    worst_further = worst_further or further
    load = layout.bus_load(bitrate, data_bitrate) + sum(further.values()) / bitrate
    worst = layout.bus_load(bitrate, data_bitrate, is_worst=True)
    worst += sum(worst_further.values()) / bitrate
    who = [*([f"{layout.file}: the messages"] if layout.messages else []), *further]
    text = f"{' and '.join(who)} need {load:.0%} of {bitrate // 1000} kbit/s"
    if load > REFUSE_LOAD:
        raise UserError(
            f"{text}. Send less often (GenMsgCycleTime, GenMsgDelayTime; inhibit times) or raise can.bitrate."
        )
    if worst <= WARN_LOAD:
        return None
    if round(worst, 2) > round(load, 2):
        text += f", and {worst:.0%} while everything changes that is sent on change"
    return f"{text}; other nodes get little"


def is_mute(signal: SignalPlan) -> bool:
    """True for a flag that shows one of its two values without telemetry."""
    source = signal.source
    if source is None or source.bit is None or signal.is_float or not source.supplied:
        return False
    values = {value * signal.slope + signal.intercept for value in (0, 1)}
    return source.group in (Group.LIVE, Group.INFO) and signal.not_available in values


def reporter(message: MessagePlan, flag: SignalPlan) -> SignalPlan | None:
    """The signal in the same frame as the flag that reports the loss."""
    for signal in message.signals:
        source = signal.source
        if source is None or signal.esc != flag.esc or signal.page not in (None, flag.page):
            continue
        assert flag.source is not None
        if source.name in _OF_LINK and flag.source.group is Group.LIVE:
            return signal
        if source.group is flag.source.group and not source.optional and has_code(signal):
            return signal
    return None


def unreported(layout: Layout, silent: bool) -> list[str]:
    """A warning for each message whose flags hide the loss of telemetry. ``silent``: ``dbc.on_loss``."""
    found = []
    for message in layout.messages:
        stops = bool(message.paces & {Group.LIVE, Group.INFO}) and Group.LINK not in message.paces
        flags = [s.name for s in message.signals if is_mute(s) and reporter(message, s) is None]
        if flags and not (silent and stops):
            remedy = ', or set dbc.on_loss = "silent"' if stops else ""
            found.append(
                f"{layout.file}: {message.name}: without telemetry {listed(flags, 3)} are sent as if they were known, and no signal "
                f"of the message reports the loss. Add one bound to link_state, or with NotAvailable in its value table{remedy}."
            )
    return found


def unsupplied(layout: Layout, escs: Sequence[EscSettings]) -> list[str]:
    """A warning for each message with values that the protocol of their ESC does not have."""
    found = []
    for message in layout.messages:
        missing = [s for s in message.signals if s.source is not None and not s.source.supplied]
        if missing:
            names = listed((signal.name for signal in missing), 3)
            whose = " or ".join(sorted({escs[signal.esc or 0].protocol for signal in missing}))
            found.append(
                f"{layout.file}: {message.name}: {names}: not supplied by the protocol {whose}, never available. "
                "A flag, which has no code for that, is sent as 0 or its start value."
            )
    return found
