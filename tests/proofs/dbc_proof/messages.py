"""The messages that a gateway sends, derived a second time from a DBC and its configuration.

docs/your-own-dbc.md and the keys of [dbc] have the rules. Nothing here uses the names,
ids and copies that the compiler made. Only the meaning of a signal's name is the compiler's, too.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from kontronik_can_gw.config.output_keys import DbcConfig
from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.names import Binder
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import Group

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

_NODE = "KontronikGateway"
"""The gateway's node in a DBC with several nodes, if the configuration does not name one."""
_NO_NODE = "Vector__XXX"
"""In a DBC, this means that a message has no transmitter."""


@dataclass(frozen=True)
class SentMessage:
    """A message of the DBC, or its copy for one of several ESCs."""

    message: "Message"
    name: str
    can_id: int
    esc: int | None = None
    """Index of the ESC. None for a message that is not copied."""
    prefix: str = ""
    """The ESC's name before the names of the signals."""

    @property
    def for_binder(self) -> Copy:
        """The message in the form that the compiler's code needs to look up its bindings."""
        return Copy(self.message, self.can_id - self.message.frame_id, self.esc, self.prefix)


def sent_messages(
    database: "Database", escs: Sequence[EscSettings], settings: DbcConfig
) -> Iterator[SentMessage]:
    """Yield the messages of the gateway in the order of the file, with a copy for each ESC."""
    ours = _messages_of_gateway(database, settings)
    names = {message.name for message in ours}
    distance = 0
    if settings.base_id is not None:
        distance = settings.base_id - min(message.frame_id for message in ours)
    copied = _copied_for_each_esc(ours, escs, settings.bind) if len(escs) > 1 else set()
    fixed: set[tuple[int, bool]] = set()
    moved: list[tuple[int, bool]] = []
    for message in ours:
        key = (message.frame_id + distance, message.is_extended_frame)
        if message.name in copied:
            moved.append(key)
        else:
            fixed.add(key)
    for message in _messages_of_others(database, settings, names):
        fixed.add((message.frame_id, message.is_extended_frame))
    step = settings.id_step or _smallest_step(fixed, moved, len(escs))
    for message in ours:
        can_id = message.frame_id + distance
        if message.name not in copied:
            yield SentMessage(message, message.name, can_id)
            continue
        for index, esc in enumerate(escs):
            prefix = _prefix(esc.name)
            name = prefix + re.sub("^Esc(?=[A-Z])", "", message.name)
            yield SentMessage(message, name, can_id + index * step, index, prefix)


def _transmitters(message: "Message") -> set[str]:
    return set(message.senders) - {_NO_NODE}


def _node(database: "Database", settings: DbcConfig) -> str | None:
    """Return the gateway's node. None if no message has a transmitter."""
    nodes: set[str] = set()
    for message in database.messages:
        nodes |= _transmitters(message)
    if settings.node is not None or not nodes:
        return settings.node
    return nodes.pop() if len(nodes) == 1 else _NODE


def _messages_of_gateway(database: "Database", settings: DbcConfig) -> list["Message"]:
    node = _node(database, settings)
    found = []
    for message in database.messages:
        is_chosen = any(fnmatchcase(message.name, pattern) for pattern in settings.messages)
        if node is None:
            if is_chosen:
                found.append(message)
        elif node in _transmitters(message) and (is_chosen or not settings.messages):
            found.append(message)
    return found


def _messages_of_others(
    database: "Database", settings: DbcConfig, names: set[str]
) -> Iterator["Message"]:
    """Yield the messages of other nodes. The gateway's other messages are on no bus."""
    node = _node(database, settings)
    for message in database.messages:
        is_left_out = node is not None and node in _transmitters(message)
        if message.name not in names and not is_left_out:
            yield message


def _copied_for_each_esc(
    messages: Sequence["Message"],
    escs: Sequence[EscSettings],
    bind: Mapping[str, str | float],
) -> set[str]:
    """Return the names of the messages with values of an ESC that is not named.

    Empty if a signal names its ESC, because then the DBC is for several ESCs already.
    """
    binder = Binder(escs, bind)
    found: set[str] = set()
    for message in messages:
        for signal in message.signals:
            bound = bind.get(f"{message.name}.{signal.name}", bind.get(signal.name))
            source = binder.by_name(bound if isinstance(bound, str) else signal.name)
            if source is None:
                continue
            value, esc = source
            if esc is not None:
                return set()
            if value.group is not Group.GATEWAY:
                found.add(message.name)
    return found


def _smallest_step(
    fixed: set[tuple[int, bool]], moved: Sequence[tuple[int, bool]], count: int
) -> int:
    """Return the smallest distance of the ESCs that lets no id be used twice.

    ``fixed`` and ``moved`` contain the ids of messages that are sent once and for each ESC, and
    True for 29 bits.
    """
    numbers = [can_id for can_id, _ in (*fixed, *moved)]
    span = max(numbers) - min(numbers)
    for step in range(1, span + 1):
        ids = list(fixed)
        for index in range(count):
            ids += [(can_id + index * step, extended) for can_id, extended in moved]
        if len(set(ids)) == len(ids):
            return step
    return span + 1


def _prefix(name: str) -> str:
    """Return ``LeftFront`` for an ESC with the name ``left_front``."""
    words = re.findall("[A-Za-z0-9]+", name)
    return "".join(word[0].upper() + word[1:] for word in words)
