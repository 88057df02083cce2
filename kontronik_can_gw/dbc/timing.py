"""When a message is sent: its send type, cycle time and minimum distance."""

from typing import TYPE_CHECKING

from kontronik_can_gw.dbc import send_types
from kontronik_can_gw.dbc.compilation import Compilation
from kontronik_can_gw.dbc.reader import attribute
from kontronik_can_gw.signals.plan import SendType

if TYPE_CHECKING:
    from cantools.database.can import Message


def timing(job: Compilation, message: "Message", where: str) -> tuple[SendType, int, int]:
    """Send type, cycle time and minimum distance in ms."""
    cycle = _time(job, message, "GenMsgCycleTime", where)
    delay = _time(job, message, "GenMsgDelayTime", where)
    text = str(attribute(message, "GenMsgSendType", job.database) or "")
    job.send_types.add(text)
    name, while_active = send_types.meaning(text, job.settings.send_types)
    if name is None:
        job.problems.append(
            f"{where}: GenMsgSendType {text!r} is not known. Say what it means: dbc.send_type.{text!r} = "
            f"one of {', '.join(send_types.NAMES)}."
        )
        return SendType.EVENT, cycle, delay
    if while_active:
        for other in ("GenMsgCycleTimeFast", "GenMsgCycleTimeActive"):
            cycle = cycle or _time(job, message, other, where)
        job.while_active.append(message.name)
    if name == send_types.NONE:
        return (SendType.CYCLIC if cycle else SendType.EVENT), cycle, delay
    send_type = send_types.NAMES[name]
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
