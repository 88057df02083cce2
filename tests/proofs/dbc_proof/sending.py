"""When the frames of a message are sent, derived a second time from a DBC and its configuration.

docs/your-own-dbc.md ("Timing") and the keys of [dbc] have the rules. Only the spellings of send
types are read from the package.
"""

from collections.abc import Collection
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from specification.quantities import Pace
from specification.rule import letters_of

import kontronik_can_gw.dbc
from kontronik_can_gw.config.output_keys import DbcConfig

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

_NS_PER_MS = 1_000_000
_CYCLE_TIMES = ("GenMsgCycleTime", "GenMsgCycleTimeFast", "GenMsgCycleTimeActive")
_SECOND = 8
"""Event: a second of the statistics has ended."""
_EVENTS = {Pace.LIVE: 1, Pace.INFO: 2, Pace.LINK: 4, Pace.GATEWAY: 0}
"""Event of an ESC that changes the values of a pace."""


@dataclass(frozen=True)
class Sending:
    """When the frames of a message are sent, and the settings of all of its frames."""

    fd: bool
    cycle_ns: int
    delay_ns: int
    by_event: bool
    on_change: bool
    silent_on_loss: bool
    follows_gateway: bool
    """A changed value of the gateway requests the message."""
    untimed: bool
    """It has neither cycle nor minimum delay time nor several groups."""
    events: int
    """Bits of the events that request the message."""
    escs: tuple[int, ...]
    alive_values: int
    """Number of values of its alive counter. 1 without one."""


def attribute_of(owner: Any, name: str, database: "Database") -> Any:
    """Return an attribute of a message or signal, or its default. None if it is not defined.

    The value of an enumeration is its text.
    """
    if database.dbc is None or name not in database.dbc.attribute_definitions:
        return None
    definition = database.dbc.attribute_definitions[name]
    value = definition.default_value
    if has_own_attribute(owner, name):
        value = owner.dbc.attributes[name].value
    if not definition.choices or not isinstance(value, int):
        return value
    texts = dict(enumerate(definition.choices))
    return texts.get(value)


def has_own_attribute(owner: Any, name: str) -> bool:
    """Return True if the file has the attribute for this message or signal."""
    return owner.dbc is not None and name in owner.dbc.attributes


def sending_of(
    database: "Database",
    message: "Message",
    settings: DbcConfig,
    paces: Collection[Pace],
    pages: int,
    escs: Collection[int],
    alive_values: int,
) -> Sending:
    """Return the timing of a message. Its values have the ``paces`` and ``escs``."""
    cycle_ns = 0
    for name in _CYCLE_TIMES:
        cycle_ns = cycle_ns or _time_ns(attribute_of(message, name, database))
    delay_ns = _time_ns(attribute_of(message, "GenMsgDelayTime", database))
    text = str(attribute_of(message, "GenMsgSendType", database) or "")
    meaning = settings.send_type.get(text) or _meaning(text)
    if meaning == "-":
        meaning = "Cyclic" if cycle_ns else "Event"
    by_event = "Event" in meaning
    on_change = "OnChange" in meaning
    if "Cyclic" not in meaning:
        cycle_ns = 0
    events = 0
    if by_event or on_change:
        for pace in paces:
            events |= _EVENTS[pace]
        if Pace.LINK in paces and not cycle_ns and not (by_event and Pace.LIVE in paces):
            events |= _SECOND
    has_telemetry = Pace.LIVE in paces or Pace.INFO in paces
    is_silent = settings.on_loss == "silent" and has_telemetry and Pace.LINK not in paces
    return Sending(
        fd=message.is_fd or message.length > 8,
        cycle_ns=cycle_ns,
        delay_ns=delay_ns,
        by_event=by_event,
        on_change=on_change,
        silent_on_loss=is_silent,
        follows_gateway=Pace.GATEWAY in paces and (by_event or on_change),
        untimed=not cycle_ns and not delay_ns and pages == 1,
        events=events,
        escs=tuple(sorted(escs)),
        alive_values=alive_values,
    )


def _meaning(text: str) -> str:
    """Return the name of the send type with this spelling. "-" if it depends on the cycle time."""
    if not text:
        return "-"
    table = kontronik_can_gw.dbc.__path__[0] + "/send_types.tsv"
    with open(table, encoding="ascii") as rows:
        for row in rows:
            name, _, spellings = row.rstrip("\n").partition("\t")
            if letters_of(text) in map(letters_of, spellings.split()):
                return name
    raise KeyError(text)


def _time_ns(value: Any) -> int:
    """Return a time in ms as ns, at least 1 ms. 0 if there is none."""
    time_ns = round(Fraction(str(value or 0)) * _NS_PER_MS)
    return max(time_ns, _NS_PER_MS) if time_ns else 0
