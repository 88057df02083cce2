"""Compiles one message of a DBC: frame, timing, groups, signals and E2E protection."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.protection import message_protection, stated_protection
from kontronik_can_gw.dbc.raw_values import raw_range
from kontronik_can_gw.dbc.reader import attribute
from kontronik_can_gw.dbc.signal_compiler import Compilation, SignalCompiler
from kontronik_can_gw.esc.value_names import normalize
from kontronik_can_gw.signals.e2e import Protection
from kontronik_can_gw.signals.plan import (
    FD_LENGTHS,
    SEND_TYPES,
    MessagePlan,
    Role,
    SendType,
    SignalPlan,
)
from kontronik_can_gw.times import MS

if TYPE_CHECKING:
    from cantools.database.can import Message

_MAX_PAGES = 1024
"""Greatest number of multiplexer values in a message that the gateway sends."""
_BY_CYCLE = ""
"""A meaning of send types: cyclic with a cycle time, otherwise sent with each new value."""
_TABLE = Path(__file__).with_name("send_types.tsv")


def compile_message(job: Compilation, copy: Copy) -> MessagePlan | None:
    """Return the plan of a message. None if it cannot be sent, with lines in ``job.problems``."""
    message = copy.message
    before = len(job.problems)
    job.problems += _frame_problems(job, message)
    send_type, cycle_ns, delay_ns = _timing(job, message)
    numbers: set[int] = set()
    for signal in message.signals:
        numbers.update(signal.multiplexer_ids or ())
    pages = sorted(numbers)
    problem = _unsupported(message, len(pages))
    if problem:
        job.problems.append(f"{message.name}: {problem}")
    if problem or message.length > FD_LENGTHS[-1]:
        return None
    known = len(job.problems)
    stated = stated_protection(job, copy)
    is_unclear = stated is None and len(job.problems) > known
    signals = _signals(job, copy, stated)
    job.problems += _placement_problems(message)
    job.problems += _page_problems(message, pages, signals)
    protection = None if is_unclear else message_protection(job, copy, signals, stated)
    if len(job.problems) > before:
        return None
    return MessagePlan(
        name=copy.name,
        can_id=copy.frame_id,
        extended=message.is_extended_frame,
        fd=_is_fd(message),
        length=message.length,
        send_type=send_type,
        cycle_ns=cycle_ns if SendType.CYCLIC in send_type else 0,
        delay_ns=delay_ns,
        compiled=tuple(signals),
        escs=frozenset(s.esc for s in signals if s.esc is not None),
        paces=frozenset(s.source.pace or s.source.group for s in signals if s.source),
        pages=tuple(pages) or (None,),
        e2e=protection,
    )


def _is_fd(message: "Message") -> bool:
    return message.is_fd or message.length > 8


def _frame_problems(job: Compilation, message: "Message") -> Iterator[str]:
    if _is_fd(message) and not job.is_fd_allowed:
        yield (
            f"{message.name}: is a CAN FD message ({message.length} bytes). "
            "Set can.fd = true, or shorten it."
        )
    if _is_fd(message) and message.length not in FD_LENGTHS:
        lengths = ", ".join(map(str, FD_LENGTHS[9:]))
        yield (
            f"{message.name}: CAN FD has no frames of {message.length} bytes. Use one of {lengths}."
        )


def _unsupported(message: "Message", count: int) -> str | None:
    """Return the problem of a message that cannot be compiled, or None.

    It has no signals, or its multiplexing with ``count`` values is not supported.
    """
    if message.is_container or message.length == 0 or not message.signals:
        return "has no signals to send. Add signals, or exclude the message with dbc.messages."
    multiplexers = [signal for signal in message.signals if signal.is_multiplexer]
    if len(multiplexers) > 1 or any(signal.multiplexer_ids for signal in multiplexers):
        return (
            "has more than one level of multiplexing. Only one is supported. "
            "Leave the message out (dbc.messages)."
        )
    if count > _MAX_PAGES:
        return (
            f"has {count} multiplexer values. At most {_MAX_PAGES} are supported. "
            "Leave the message out (dbc.messages)."
        )
    return None


def _signals(job: Compilation, copy: Copy, protection: Protection | None) -> list[SignalPlan]:
    """Return the plans of a message's signals. A signal in several groups has one for each."""
    plans = []
    for signal in copy.message.signals:
        if signal.length > copy.message.length * 8:
            continue  # reported by _placement_problems
        compiler = SignalCompiler(job, copy, signal, protection)
        for page in signal.multiplexer_ids or (None,):
            plan = compiler.plan(page)
            if plan is not None:
                plans.append(plan)
    return plans


def _placement_problems(message: "Message") -> Iterator[str]:
    """Yield the first error of cantools about a signal outside the message, or an overlap."""
    from cantools.database.errors import Error

    try:
        message.refresh(strict=True)
    except Error as error:
        yield f"{message.name}: {error} Move or shorten it."


def _page_problems(
    message: "Message",
    pages: Sequence[int],
    signals: Sequence[SignalPlan],
) -> Iterator[str]:
    """Yield problems of multiplexer values that do not fit, and of multiplexed protection."""
    for multiplexer in message.signals:
        if multiplexer.is_multiplexer:
            largest = -1 if multiplexer.is_float else raw_range(multiplexer)[1]
            for page in pages:
                if page > largest:
                    problem = (
                        f"cannot represent the multiplexer value {page} (m{page}), at most "
                        f"{largest}. Make it longer, or change the value."
                    )
                    yield f"{message.name}.{multiplexer.name}: {problem}"
    for signal in signals:
        if signal.page is not None and signal.role in (Role.ALIVE, Role.CRC):
            yield (
                f"{message.name}.{signal.name}: is a multiplexed {signal.role.value}, "
                "but must be in every frame. "
                f"Remove its m{signal.page}, or bind it to a constant."
            )


@cache
def _meanings() -> dict[str, str]:
    """Return the meanings of send types by their normalized spellings."""
    found = {"": _BY_CYCLE}
    for line in _TABLE.read_text(encoding="ascii").splitlines()[1:]:
        name, spellings = line.split("\t")
        found |= {normalize(text): name.strip("-") for text in spellings.split()}
    return found


def _timing(job: Compilation, message: "Message") -> tuple[SendType, int, int]:
    """Return send type, cycle time and minimum delay time in ns."""
    cycle = 0
    # the last two are for messages that are sent only in an active state; here they always are
    for attribute_name in ("GenMsgCycleTime", "GenMsgCycleTimeFast", "GenMsgCycleTimeActive"):
        cycle = cycle or _time(job, message, attribute_name)
    delay = _time(job, message, "GenMsgDelayTime")
    text = str(attribute(message, "GenMsgSendType", job.database) or "")
    job.send_types.add(text)
    name = job.settings.send_type.get(text, _meanings().get(normalize(text)))
    if name is None:
        job.problems.append(
            f"{message.name}: unknown GenMsgSendType {text!r}. "
            f"Set dbc.send_type.{text!r} to its meaning: {', '.join(SEND_TYPES)}."
        )
        return SendType.EVENT, cycle, delay
    if name == _BY_CYCLE:
        send_type = SendType.CYCLIC if cycle else SendType.EVENT
        return send_type, cycle, delay
    send_type = SEND_TYPES[name]
    if SendType.CYCLIC in send_type and not cycle:
        job.problems.append(
            f"{message.name}: is sent {text}, but its GenMsgCycleTime is 0. "
            f'Set a time in ms, or dbc.send_type.{text!r} = "Event".'
        )
    return send_type, cycle, delay


def _time(job: Compilation, message: "Message", name: str) -> int:
    """Return an attribute in ms as exact ns. 0 if it is not set.

    Adds a line to the problems for a value that is not a time, and a warning for a time below 1 ms.
    """
    value = attribute(message, name, job.database)
    if value is None or value == "":
        return 0
    try:
        found = round(Fraction(str(value)) * MS)
        if found < 0:
            raise ValueError
    except (ValueError, OverflowError, ZeroDivisionError):
        job.problems.append(
            f"{message.name}: {name} is {str(value)[:40]!r}, which is not a time in ms. Correct it."
        )
        return 0
    if 0 < found < MS:
        job.warnings.append(
            f"{message.name}: {name} is {value} ms. The shortest time is used, 1 ms."
        )
        return MS
    return found
