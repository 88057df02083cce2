"""When a message is sent: its send type as Vector's and OEM templates spell it, its cycle time and minimum distance."""

from functools import cache
from pathlib import Path
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
_TABLE = Path(__file__).with_name("send_types.tsv")


@cache
def _meanings() -> dict[str, str]:
    """Meanings by normalized spellings."""
    found = {"": _BY_CYCLE}
    for line in _TABLE.read_text(encoding="ascii").splitlines()[1:]:
        name, spellings = line.split("\t")
        found |= {normalize(text): name.strip("-") for text in spellings.split()}
    return found


def timing(job: Compilation, message: "Message", where: str) -> tuple[SendType, int, int]:
    """Send type, cycle time and minimum distance in ms."""
    cycle = 0
    # the last two: of what is sent only while something is active; it is sent always
    for attribute_name in ("GenMsgCycleTime", "GenMsgCycleTimeFast", "GenMsgCycleTimeActive"):
        cycle = cycle or _time(job, message, attribute_name, where)
    delay = _time(job, message, "GenMsgDelayTime", where)
    text = str(attribute(message, "GenMsgSendType", job.database) or "")
    job.send_types.add(text)
    name = job.settings.send_types.get(text, _meanings().get(normalize(text)))
    if name is None:
        job.problems.append(
            f"{where}: GenMsgSendType {text!r} is not known. Say what it means: dbc.send_type.{text!r} = "
            f"one of {', '.join(SEND_TYPES)}."
        )
        return SendType.EVENT, cycle, delay
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
