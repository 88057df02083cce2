"""Finds the value that a signal is bound to: by its name, the ESC's prefix, or [dbc.bind]."""

import difflib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES, Group, Value, values_of, values_of_esc

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

_NAMES = {normalize(name): name for name in VALUES}


class Binder:
    """Resolves signal names to sources for a given set of ESCs."""

    def __init__(self, escs: Sequence[EscSettings], bind: Mapping[str, str | float]) -> None:
        self.escs = escs
        self.bind = bind
        self._values = [values_of_esc(esc) for esc in escs] or [values_of(PROTOCOLS[0])]
        self.used: set[str] = set()
        self._prefixes = sorted(
            ((normalize(e.name), i) for i, e in enumerate(escs)), key=lambda p: -len(p[0])
        )

    def gateway_or_esc(self, key: str, esc: int | None) -> tuple[Value, int | None] | None:
        """The source of a normalized name without a final ``percent``; ``esc`` None: the name has no prefix."""
        name = _NAMES.get(key) or _NAMES.get(key.removesuffix("percent"))
        if name is None:
            return None
        source = self._values[esc or 0][name]
        return (source, None) if source.group is Group.GATEWAY else (source, esc)

    def by_name(self, name: str) -> tuple[Value, int | None] | None:
        """The source of a signal name or a bound name, and its ESC (None: no ESC named, or the gateway)."""
        key = normalize(name)
        if len(self.escs) == 1 and (found := self.gateway_or_esc(key, 0)):
            return found
        for prefix, esc in self._prefixes:
            if key.startswith(prefix) and (found := self.gateway_or_esc(key[len(prefix) :], esc)):
                return found
        return self.gateway_or_esc(key, None)

    def bound(self, message: str, signal: str) -> str | float | None:
        """The entry of ``[dbc.bind]`` for a signal."""
        key = bind_key(self.bind, message, signal)
        if key is None:
            return None
        self.used.add(key)
        return self.bind[key]

    def suggestions(self, name: str) -> str:
        """A sentence with the nearest known names, or an empty string."""
        key = normalize(name)
        for prefix, _ in self._prefixes:
            key = key.removeprefix(prefix) or key
        near = difflib.get_close_matches(key, _NAMES, n=3, cutoff=0.5)
        names = [_NAMES[n] for n in near]
        return f" Did you mean {' or '.join(names)}?" if names else ""


def bind_key(bind: Mapping[str, str | float], message: str, signal: str) -> str | None:
    """The key of a signal's entry in ``[dbc.bind]``: its name with that of its message, or alone."""
    return next((key for key in (f"{message}.{signal}", signal) if key in bind), None)


def escs_of(message: "Message", binder: Binder) -> set[int | None]:
    """The ESCs that a message has values of, by index; None: of one that is not named."""
    escs = set()
    for signal in message.signals:
        bound = binder.bound(message.name, signal.name)
        found = binder.by_name(bound if isinstance(bound, str) else signal.name)
        if found and found[0].group is not Group.GATEWAY:
            escs.add(found[1])
    return escs


def is_one_esc_layout(database: "Database", node: str, binder: Binder) -> bool:
    """True if our signals are bound to values of an ESC, and none names which one."""
    escs: set[int | None] = set()
    for message in database.messages:
        if node in message.senders:
            escs |= escs_of(message, binder)
    return escs == {None}
