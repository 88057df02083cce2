"""Formats times, durations, numbers and names for people."""

import re
from datetime import UTC, datetime

from kontronik_can_gw.times import SECOND

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W_]")
"""An acronym, a word, a number, or a single character."""


def clock(time_ns: int) -> str:
    """Return a time of the recording as 1:02.5 or 1:00:02.5."""
    tenths = round(time_ns * 10 / SECOND)
    seconds, tenth = divmod(abs(tenths), 10)
    minutes, seconds = divmod(seconds, 60)
    hours, minutes = divmod(minutes, 60)
    text = f"{minutes}:{seconds:02}"
    if hours:
        text = f"{hours}:{minutes:02}:{seconds:02}"
    if tenths < 0:
        text = f"−{text}"
    return f"{text}.{tenth}"


def duration(length_ns: int) -> str:
    """Return a duration as 12.5 s, 4 min 05 s, 1 h 02 min 05 s, or 19675 days 17 h."""
    if length_ns >= 100 * 3600 * SECOND:
        days, hours = divmod(round(length_ns / (3600 * SECOND)), 24)
        return f"{days} days {hours} h"
    if length_ns < 60 * SECOND:
        return f"{length_ns / SECOND:.1f} s"
    minutes, seconds = divmod(round(length_ns / SECOND), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02} min {seconds:02} s"
    return f"{minutes} min {seconds:02} s"


def number(value: float, digits: int) -> str:
    """Return a number with a minus sign and a thin space between thousands."""
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def wall_clock(wall_ns: int) -> str:
    """Return a Unix time as UTC. Times that a date cannot express are returned in seconds."""
    try:
        return datetime.fromtimestamp(wall_ns // SECOND, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, OSError, ValueError):
        return f"{wall_ns // SECOND} s of Unix time"


def words(text: str) -> str:
    """Return a name as separate words.

    ``SpoolUpFromStill`` becomes ``spool up from still``, ``RpmControl`` becomes ``RPM control``.
    """
    parts = []
    for part in _WORD.findall(text):
        is_acronym = len(part) > 1 and part.isupper()
        if not is_acronym:
            part = part.lower()
        parts.append(part)
    return " ".join(parts).replace("rpm", "RPM")
