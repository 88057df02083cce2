"""When a message is sent: its send type as Vector's and OEM templates spell it, its cycle time and minimum distance."""

from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.dbc.reader import attribute
from kontronik_can_gw.dbc.settings import Compilation
from kontronik_can_gw.signals.plan import SendType

if TYPE_CHECKING:
    from cantools.database.can import Message

SEND_TYPES = {
    "Cyclic": SendType.CYCLIC,
    "Event": SendType.EVENT,
    "OnChange": SendType.ON_CHANGE,
    "CyclicAndEvent": SendType.CYCLIC | SendType.EVENT,
    "CyclicAndOnChange": SendType.CYCLIC | SendType.ON_CHANGE,
}
"""Meanings that ``dbc.send_type`` can give."""
_BY_CYCLE = ""
"""A meaning too: cyclic with a cycle time, else sent with each new value."""
_SPELLINGS = {
    "Cyclic": "Cyclic CyclicX Periodic FixedPeriodic FixedCyclic Cycle Zyklisch Periodique P CyclicWithRepeatOnDemand "
    "CyclicFast Time TimeTriggered",
    "Event": "Event OnEvent EventTriggered Evenement Ereignis E Spontaneous Spontan SpontanX SpontaneousWithDelay "
    "SpontanWithDelay SpontanWD SpontaneousWithRepetition SpontanWithRepetition SpontanWithRepitition "
    "OnWrite OnWriteWithRepetition Triggered Direct Sporadic Acyclic Aperiodic",
    "OnChange": "OnChange OnChangeWithRepetition Change OnDelta",
    "CyclicAndEvent": "CyclicAndEvent EventPeriodic PeriodicEvent PeriodicAndEvent EventAndPeriodic EventAndCyclic "
    "CyclicAndSpontaneous CyclicAndSpontan CyclicAndSpontanX SpontaneousAndCyclic "
    "CyclicAndSpontaneousWithDelay CyclicAndSpontanWithDelay CyclicAndSpontanWD CyclicAndSpontaneousWD "
    "CyclicAndOnWrite CyclicEvent EventCyclic CE PE Mixed Mixte",
    "CyclicAndOnChange": "CyclicAndOnChange PeriodicAndOnChange CyclicOnChange CyclicAndChange",
    _BY_CYCLE: "None NoMsgSendType NoSendType NoSigSendType NotUsed NotDefined Undefined vector_leerstring Unknown NA "
    "Reserved Default",
}
_WHILE_ACTIVE = {
    "Cyclic": "IfActive CyclicIfActive CyclicIfActiveX CyclicIfActiveFast EnabledPeriodic IfActiveWithRepetition",
    "CyclicAndEvent": "CyclicIfActiveAndSpontaneousWD CyclicIfActiveAndSpontanWD CyclicIfActiveAndSpontaneous "
    "CyclicIfActiveAndSpontan IfActiveAndOnWrite",
    "CyclicAndOnChange": "OnChangeAndIfActive OnChangeAndIfActiveWithRepetition IfActiveAndOnChange",
}
"""Only while a signal is active, which is covered by sending always."""
_MEANINGS = {"": (_BY_CYCLE, False)} | {
    normalize(text): (name, while_active)
    for table, while_active in ((_SPELLINGS, False), (_WHILE_ACTIVE, True))
    for name, texts in table.items()
    for text in texts.split()
}


def timing(job: Compilation, message: "Message", where: str) -> tuple[SendType, int, int]:
    """Send type, cycle time and minimum distance in ms."""
    cycle = _time(job, message, "GenMsgCycleTime", where)
    delay = _time(job, message, "GenMsgDelayTime", where)
    text = str(attribute(message, "GenMsgSendType", job.database) or "")
    job.send_types.add(text)
    name, while_active = _MEANINGS.get(normalize(text), (None, False))
    if text in job.settings.send_types:
        name, while_active = job.settings.send_types[text], False
    if name is None:
        job.problems.append(
            f"{where}: GenMsgSendType {text!r} is not known. Say what it means: dbc.send_type.{text!r} = "
            f"one of {', '.join(SEND_TYPES)}."
        )
        return SendType.EVENT, cycle, delay
    if while_active:
        for other in ("GenMsgCycleTimeFast", "GenMsgCycleTimeActive"):
            cycle = cycle or _time(job, message, other, where)
        job.while_active.append(message.name)
    if name == _BY_CYCLE:
        return (SendType.CYCLIC if cycle else SendType.EVENT), cycle, delay
    send_type = SEND_TYPES[name]
    if SendType.CYCLIC in send_type and not cycle:
        job.problems.append(
            f'{where}: is sent {text} but its GenMsgCycleTime is 0. Set one in ms, or dbc.send_type.{text!r} = "Event".'
        )
    return send_type, cycle, delay


def _time(job: Compilation, message: "Message", name: str, where: str) -> int:
    """An attribute in ms; 0 where it is not set or, with a line in the problems, no time."""
    value = attribute(message, name, job.database)
    if value is None or value == "":
        return 0
    try:
        if float(value) < 0:
            raise ValueError
        return round(float(value))
    except (ValueError, OverflowError):
        job.problems.append(f"{where}: {name} is {str(value)[:40]!r}, which is no time in ms.")
        return 0
