"""Recognizes frame counters and checksums by the names of signals.

Long endings are sufficient; short ones count only as a whole word, because they end other words too: an ErrorCounter counts no frames.
"""

import re
from enum import Enum

from kontronik_can_gw.dbc.names import normalize


class Kind(Enum):
    COUNTER = "alive counter"
    CHECKSUM = "checksum"


_E2E_COUNTERS = (
    *(
        "alive",
        "alivecounter",
        "alivecount",
        "livecounter",
        "messagecounter",
        "rollingcounter",
        "sequencecounter",
    ),
)
_E2E_CHECKSUMS = ("crc", "crc8", "checksum")
"""Together in a message they mean AUTOSAR E2E profile 1 without configuration, as in the first versions."""
_ENDINGS = {
    Kind.COUNTER: (
        *(*_E2E_COUNTERS, "alivecnt", "alivecntr", "alivectr", "livecnt", "livecntr"),
        *(
            "messagecount",
            "msgcounter",
            "msgcount",
            "msgcntr",
            "msgcnt",
            "msgctr",
            "botschaftszaehler",
        ),
        *("rollingcount", "rollingcnt", "rollcounter", "rollcnt", "rollctr"),
        *("sequencecount", "seqcounter", "seqcnt", "seqctr"),
    ),
    Kind.CHECKSUM: (*_E2E_CHECKSUMS, "chksum", "chksm", "cksum", "pruefsumme"),
}
_WORDS = {Kind.COUNTER: frozenset({"bz", "sqc"}), Kind.CHECKSUM: frozenset({"cs", "cks", "chk"})}
"""Last words of a name."""
_WHOLE = {"counter": Kind.COUNTER, "cntr": Kind.COUNTER, "cnt": Kind.COUNTER, "ctr": Kind.COUNTER}
_SUSPECTS = {
    Kind.COUNTER: re.compile("alive|cntr|cnt|ctr|counter|zaehler|rolling", re.IGNORECASE),
    Kind.CHECKSUM: re.compile("crc|chk|check|cksum|pruefsumme", re.IGNORECASE),
}


def kind(name: str) -> Kind | None:
    """The kind that a signal's name or binding means; None for others."""
    letters = normalize(name)
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)
    last = words[-1].casefold() if words else ""
    for found, endings in _ENDINGS.items():
        if letters.endswith(endings) or last in _WORDS[found]:
            return found
    return _WHOLE.get(letters)


def is_e2e(checksum: str, counter: str) -> bool:
    """True for a pair of names that means AUTOSAR E2E profile 1."""
    return normalize(checksum).endswith(_E2E_CHECKSUMS) and normalize(counter).endswith(
        _E2E_COUNTERS
    )


def suspect(name: str) -> Kind | None:
    """The kind that a name might mean, for hints in messages."""
    return next((found for found, pattern in _SUSPECTS.items() if pattern.search(name)), None)
