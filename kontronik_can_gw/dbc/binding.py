"""Finds the value that a signal is bound to: by its name, the ESC's prefix, or [dbc.bind]."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.dbc.names import normalize
from kontronik_can_gw.errors import did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.values import VALUES, Group, Value, values_of_esc

if TYPE_CHECKING:
    from cantools.database.can import Message

VALUES_BY_KEY = {normalize(name): value for name, value in VALUES.items()}
"""Every value by its normalized name."""


class Binder:
    """Resolves signal names to sources for a given set of ESCs."""

    def __init__(self, escs: Sequence[EscSettings], bind: Mapping[str, str | float]) -> None:
        self.escs = escs
        self.bind = bind
        self.used: set[str] = set()
        self._known = [
            {normalize(name): value for name, value in values_of_esc(esc).items()} for esc in escs
        ]
        """Values of each ESC by normalized name."""
        self._prefixes = sorted(
            ((normalize(e.name), i) for i, e in enumerate(escs)), key=lambda p: -len(p[0])
        )

    def by_name(self, name: str, esc: int | None = None) -> tuple[Value, int | None] | None:
        """The source of a signal name or a bound name, and its ESC (None: no ESC named, or the gateway).

        ``esc``: whose values a name without an ESC means.
        """
        key = normalize(name)
        if esc is None and len(self.escs) == 1:
            esc = 0
        meant: list[tuple[int | None, str]] = [] if esc is None else [(esc, key)]
        for prefix, index in self._prefixes:
            if key.startswith(prefix):
                meant.append((index, key.removeprefix(prefix)))
        for of_esc, rest in [*meant, (None, key)]:
            known = VALUES_BY_KEY if of_esc is None else self._known[of_esc]
            value = known.get(rest) or known.get(rest.removesuffix("percent"))
            if value is not None:
                return value, None if value.group is Group.GATEWAY else of_esc
        return None

    def bound(self, copy: Copy, signal: str) -> str | float | None:
        """The entry of ``[dbc.bind]`` for a signal of the file."""
        key = next((key for key in copy.bind_keys(signal) if key in self.bind), None)
        if key is None:
            return None
        self.used.add(key)
        return self.bind[key]

    def escs_of(self, message: "Message") -> set[int | None]:
        """The ESCs that a message has values of, by index; None: of one that is not named."""
        escs = set()
        for signal in message.signals:
            bound = self.bound(Copy(message), signal.name)
            found = self.by_name(bound if isinstance(bound, str) else signal.name)
            if found and found[0].group is not Group.GATEWAY:
                escs.add(found[1])
        return escs

    def suggestions(self, name: str) -> str:
        """A sentence with the nearest known names, or an empty string."""
        key = normalize(name)
        for prefix, _ in self._prefixes:
            key = key.removeprefix(prefix) or key
        return did_you_mean(
            key, VALUES_BY_KEY, 0.5, show=lambda near: VALUES_BY_KEY[near].name, count=3
        )
