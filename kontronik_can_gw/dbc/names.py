"""Finds the meaning of names in a DBC: a frame counter, a checksum, or the value of a signal."""

import re
from collections.abc import Mapping, Sequence
from itertools import combinations
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
"""Number of characters in a name that every tool supports."""

_E2E = {
    Role.ALIVE: "alive alivecount livecounter messagecounter rollingcounter sequencecounter",
    Role.CRC: "crc crc8 checksum",
}
"""Endings that together in a message mean AUTOSAR E2E profile 1 without configuration.

They are the endings that the first versions of the gateway supported.
"""
_FURTHER = {
    Role.ALIVE: "livecnt livecntr alivectr messagecount msgcounter msgcount msgcntr msgcnt msgctr "
    "botschaftszaehler rollingcount rollingcnt rollcounter rollcnt rollctr sequencecount "
    "seqcounter seqcnt seqctr",
    Role.CRC: "chksum chksm cksum pruefsumme",
}
_E2E_ENDINGS: dict[Role, tuple[str, ...]] = {}
_ENDINGS: dict[Role, tuple[str, ...]] = {}
for _role, _texts in _E2E.items():
    _E2E_ENDINGS[_role] = tuple(_texts.split())
    _ENDINGS[_role] = _E2E_ENDINGS[_role] + tuple(_FURTHER[_role].split())
_LAST_WORDS = {
    Role.ALIVE: {"bz", "sqc"},
    Role.CRC: {"cs", "cks", "chk"},
}
"""Words that are too short to be endings, because other words end with them, too."""
_WHOLE = {"counter", "cntr", "cnt", "ctr"}
"""Names that mean a frame counter only without a prefix. An ErrorCounter does not count frames."""
BOUND = {Role.ALIVE: "alive", Role.CRC: "crc"}
"""Names in [dbc.bind] of a frame counter and a checksum."""
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_PARTS = {
    Role.ALIVE: {"aliv", "alivecnt", "alivecounter", "alivcnt", "cntalive", *_ENDINGS[Role.ALIVE]},
    Role.CRC: {"chks", *_ENDINGS[Role.CRC]},
}
"""Words that anywhere in a name suggest a frame counter or a checksum."""


def esc_prefix(name: str) -> str:
    """Return an ESC's name as the prefix of messages and signals.

    ``left_front`` becomes ``LeftFront``.
    """
    parts = re.split(r"[^A-Za-z0-9]+", name)
    return "".join(part[:1].upper() + part[1:] for part in parts)


def protection(name: str) -> Role | None:
    """Return ALIVE or CRC if a signal's name or binding has this meaning."""
    letters = normalize(name)
    words = _WORD.findall(name)
    last = words[-1].casefold() if words else ""
    for role, endings in _ENDINGS.items():
        if letters.endswith(endings) or last in _LAST_WORDS[role]:
            return role
    return Role.ALIVE if letters in _WHOLE else None


def likely_protection(name: str) -> Role | None:
    """Return ALIVE or CRC if some adjacent words of a signal's name suggest this meaning."""
    words = _WORD.findall(name)
    for role, parts in _PARTS.items():
        for first, last in combinations(range(len(words) + 1), 2):
            if "".join(words[first:last]).casefold() in parts:
                return role
    return None


def is_data_id(name: str) -> bool:
    """Return True if a signal's name or binding means 4 bits of an E2E data ID."""
    return normalize(name).endswith(("dataid", "dataidnibble"))


def is_e2e(crc: str, counter: str) -> bool:
    """Return True for a pair of names that means AUTOSAR E2E profile 1."""
    if not normalize(crc).endswith(_E2E_ENDINGS[Role.CRC]):
        return False
    return normalize(counter).endswith(_E2E_ENDINGS[Role.ALIVE])


class Binder:
    """Finds the value that a signal is bound to: by its name, the ESC's prefix, or [dbc.bind]."""

    def __init__(self, escs: Sequence[EscSettings], bind: Mapping[str, str | float]) -> None:
        self.escs = escs
        self.bind = bind
        self.used: set[str] = set()
        """Keys of [dbc.bind] that were found for a signal."""
        self._known: list[dict[str, Value]] = []
        """Values of each ESC by normalized name."""
        self._prefixes: list[tuple[str, int]] = []
        """Normalized name and index of each ESC, the longest name first."""
        for index, esc in enumerate(escs):
            known = {}
            for name, value in values_of_esc(esc).items():
                known[normalize(name)] = value
            self._known.append(known)
            self._prefixes.append((normalize(esc.name), index))
        self._prefixes.sort(key=lambda prefix: -len(prefix[0]))

    def by_name(self, name: str, esc: int | None = None) -> tuple[Value, int | None] | None:
        """Return the value and the ESC of a signal's name or a bound name.

        The ESC is None if the name does not contain it, and for values of the gateway. ``esc`` is
        the ESC of a name that does not contain one.
        """
        key = normalize(name)
        if esc is None and len(self.escs) == 1:
            esc = 0
        candidates: list[tuple[int | None, str]] = []
        if esc is not None:
            candidates.append((esc, key))
        for prefix, index in self._prefixes:
            if key.startswith(prefix):
                candidates.append((index, key.removeprefix(prefix)))
        candidates.append((None, key))
        for candidate, rest in candidates:
            known = VALUES_BY_KEY if candidate is None else self._known[candidate]
            value = known.get(rest, known.get(rest.removesuffix("percent")))
            if value is None:
                continue
            if value.group is Group.GATEWAY:
                return value, None
            return value, candidate
        return None

    def bound(self, copy: Copy, signal: str) -> str | float | None:
        """Return the entry of ``[dbc.bind]`` for a signal of the file. None if there is none."""
        for key in copy.bind_keys(signal):
            if key in self.bind:
                self.used.add(key)
                return self.bind[key]
        return None

    def escs_of(self, message: "Message") -> set[int | None]:
        """Return the ESCs whose values a message contains. None stands for an unnamed ESC."""
        escs = set()
        for signal in message.signals:
            bound = self.bound(Copy(message), signal.name)
            name = bound if isinstance(bound, str) else signal.name
            found = self.by_name(name)
            if found is None:
                continue
            value, esc = found
            if value.group is not Group.GATEWAY:
                escs.add(esc)
        return escs

    def suggestions(self, name: str) -> str:
        """Return a sentence with the closest known names, or an empty string."""
        for prefix, _ in self._prefixes:
            if name.casefold().startswith(prefix) and len(name) > len(prefix):
                name = name[len(prefix) :]
        return did_you_mean(name, [value.name for value in VALUES_BY_KEY.values()], count=3)
