"""Names in a DBC: their length, how they are compared, and which of them mean a frame counter or a checksum."""

import re

from kontronik_can_gw.signals.plan import Role

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


def normalize(name: str) -> str:
    """Letters and digits of a name, in lower case."""
    return "".join(c for c in name.casefold() if c.isalnum())


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
