"""The format of a CAN log, by its content, and what reads it."""

from collections.abc import Callable

from kontronik_can_gw.desk.recordings.can_logs import text

SUFFIXES = {
    ".log": "candump",
    ".candump": "candump",
    ".asc": "asc",
    ".blf": "blf",
    ".trc": "trc",
    ".mf4": "mf4",
    ".mdf": "mf4",
}
NAMES = {
    "candump": "CAN log (candump)",
    "asc": "ASC log",
    "blf": "BLF file",
    "trc": "TRC file",
    "mf4": "MF4 file",
}
"""What people call the formats."""
_HEAD_LINES = 2000
_LINES: dict[str, Callable[[bytes], object]] = {
    "candump": text.candump_line,
    "asc": text.asc_line,
    "trc": text.trc_line,
}
_BEGINNINGS = {b"LOGG": "blf", b"MDF     ": "mf4", b"UnFinMF ": "mf4"}


def log_format(head: bytes, suffix: str) -> str | None:
    """The format of a log by its first bytes; None: no log. an empty one has that of its ``suffix``."""
    for magic, found in _BEGINNINGS.items():
        if head.startswith(magic):
            return found
    for line in head.removeprefix(b"\xef\xbb\xbf").split(b"\n", _HEAD_LINES)[:_HEAD_LINES]:
        for found, is_line in _LINES.items():
            if is_line(line):
                return found
    return None if head.strip() else SUFFIXES.get(suffix.lower())


def reader_of(format_: str) -> Callable[..., text.LogReader]:
    """What reads a format, made from an open file; RunError where a library is missing."""
    if format_ in _LINES:
        return {"candump": text.CandumpReader, "asc": text.AscReader}.get(format_, text.TrcReader)
    from kontronik_can_gw.desk.recordings.can_logs import library

    return {"blf": library.BlfReader, "mf4": library.Mf4Reader}[format_]
