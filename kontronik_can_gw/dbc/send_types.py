"""Send types of messages: GenMsgSendType as Vector's and OEM templates spell it."""

from collections.abc import Mapping

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.signals.plan import SendType

NAMES = {
    "Cyclic": SendType.CYCLIC,
    "Event": SendType.EVENT,
    "OnChange": SendType.ON_CHANGE,
    "CyclicAndEvent": SendType.CYCLIC | SendType.EVENT,
    "CyclicAndOnChange": SendType.CYCLIC | SendType.ON_CHANGE,
}
"""Meanings that ``dbc.send_type`` can give."""
NONE = ""
"""Decided by the cycle time: cyclic with one, else sent with each new value."""

_SPELLINGS: dict[str, tuple[str, ...]] = {
    "Cyclic": (
        *("Cyclic", "CyclicX", "Periodic", "FixedPeriodic", "FixedCyclic", "Cycle", "Zyklisch", "Periodique", "P"),
        *("CyclicWithRepeatOnDemand", "CyclicFast", "Time", "TimeTriggered"),
    ),
    "Event": (
        *("Event", "OnEvent", "EventTriggered", "Evenement", "Ereignis", "E"),
        *("Spontaneous", "Spontan", "SpontanX", "SpontaneousWithDelay", "SpontanWithDelay", "SpontanWD"),
        *("SpontaneousWithRepetition", "SpontanWithRepetition", "SpontanWithRepitition"),
        *("OnWrite", "OnWriteWithRepetition", "Triggered", "Direct", "Sporadic", "Acyclic", "Aperiodic"),
    ),
    "OnChange": ("OnChange", "OnChangeWithRepetition", "Change", "OnDelta"),
    "CyclicAndEvent": (
        *("CyclicAndEvent", "EventPeriodic", "PeriodicEvent", "PeriodicAndEvent", "EventAndPeriodic", "EventAndCyclic"),
        *("CyclicAndSpontaneous", "CyclicAndSpontan", "CyclicAndSpontanX", "SpontaneousAndCyclic"),
        *("CyclicAndSpontaneousWithDelay", "CyclicAndSpontanWithDelay", "CyclicAndSpontanWD"),
        *("CyclicAndSpontaneousWD", "CyclicAndOnWrite", "CyclicEvent", "EventCyclic", "CE", "PE", "Mixed", "Mixte"),
    ),
    "CyclicAndOnChange": ("CyclicAndOnChange", "PeriodicAndOnChange", "CyclicOnChange", "CyclicAndChange"),
    # "only while a signal is active" is covered by sending always
    "IfActive": ("IfActive", "CyclicIfActive", "CyclicIfActiveX", "CyclicIfActiveFast", "EnabledPeriodic", "IfActiveWithRepetition"),
    "IfActiveAndEvent": (
        *("CyclicIfActiveAndSpontaneousWD", "CyclicIfActiveAndSpontanWD", "CyclicIfActiveAndSpontaneous"),
        *("CyclicIfActiveAndSpontan", "IfActiveAndOnWrite"),
    ),
    "IfActiveAndOnChange": ("OnChangeAndIfActive", "OnChangeAndIfActiveWithRepetition", "IfActiveAndOnChange"),
    NONE: (
        *("", "None", "NoMsgSendType", "NoSendType", "NoSigSendType", "NotUsed", "NotDefined", "Undefined"),
        *("vector_leerstring", "Unknown", "NA", "Reserved", "Default"),
    ),
}  # fmt: skip
_WHILE_ACTIVE = {
    "IfActive": "Cyclic",
    "IfActiveAndEvent": "CyclicAndEvent",
    "IfActiveAndOnChange": "CyclicAndOnChange",
}


_BY_KEY = {normalize(text): name for name, texts in _SPELLINGS.items() for text in texts}


def meaning(text: str, overrides: Mapping[str, str]) -> tuple[str | None, bool]:
    """One of ``NAMES``, NONE, or None for an unknown text; and True for a type that sends only while something is active."""
    name = overrides.get(text) or _BY_KEY.get(normalize(text))
    return (_WHILE_ACTIVE[name], True) if name in _WHILE_ACTIVE else (name, False)
