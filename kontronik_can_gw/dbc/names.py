"""Names in a DBC: how they are compared, which mean a frame counter or a checksum, and the values that others are bound to."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from kontronik_can_gw.dbc.copies import Copy
from kontronik_can_gw.errors import did_you_mean
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.esc.value_names import VALUES_BY_KEY, normalize
from kontronik_can_gw.esc.values import Group, Value, values_of_esc
from kontronik_can_gw.signals.plan import Role

if TYPE_CHECKING:
    from cantools.database.can import Message

MAX_NAME = 32
"""Characters that every tool takes."""

_E2E = {
    Role.ALIVE: "alive alivecount livecounter messagecounter rollingcounter sequencecounter",
    Role.CRC: "crc crc8 checksum",
}
"""Endings that together in a message mean AUTOSAR E2E profile 1 without configuration, as in the first versions."""
_FURTHER = {
    Role.ALIVE: "livecnt livecntr alivectr messagecount msgcounter msgcount msgcntr msgcnt msgctr botschaftszaehler "
    "rollingcount rollingcnt rollcounter rollcnt rollctr sequencecount seqcounter seqcnt seqctr",
    Role.CRC: "chksum chksm cksum pruefsumme",
}
_E2E_ENDINGS = {role: tuple(texts.split()) for role, texts in _E2E.items()}
_ENDINGS = {role: (*_E2E_ENDINGS[role], *texts.split()) for role, texts in _FURTHER.items()}
_LAST_WORDS = {Role.ALIVE: {"bz", "sqc"}, Role.CRC: {"cs", "cks", "chk"}}
"""Too short for endings: they end other words too."""
_WHOLE = {"counter", "cntr", "cnt", "ctr"}
"""Only as a whole name: an ErrorCounter counts no frames."""


def esc_prefix(name: str) -> str:
    """An ESC's name as the beginning of message and signal names: ``left_front`` becomes ``LeftFront``."""
    return "".join(part[:1].upper() + part[1:] for part in re.split(r"[^A-Za-z0-9]+", name) if part)


def protection(name: str) -> Role | None:
    """ALIVE or CRC where a signal's name or binding means one of them."""
    letters = normalize(name)
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    last = words[-1].casefold() if words else ""
    for role, endings in _ENDINGS.items():
        if letters.endswith(endings) or last in _LAST_WORDS[role]:
            return role
    return Role.ALIVE if letters in _WHOLE else None


def is_e2e(crc: str, counter: str) -> bool:
    """True for a pair of names that means AUTOSAR E2E profile 1."""
    pairs = ((crc, Role.CRC), (counter, Role.ALIVE))
    return all(normalize(name).endswith(_E2E_ENDINGS[role]) for name, role in pairs)


class Binder:
    """Finds the value that a signal is bound to: by its name, the ESC's prefix, or [dbc.bind]."""

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
