"""Finds the format of a recording in its first bytes."""

from kontronik_can_gw.capture.format import MAGIC
from kontronik_can_gw.desk.recordings.log_input import candump_advice, log_format
from kontronik_can_gw.desk.recordings.stream import HEAD
from kontronik_can_gw.errors import UserError

CAPTURE = "capture"
BYTES = "bytes"
"""The formats that ``log_format`` does not find."""
UART_MAGIC = b"KOD"
"""The first bytes of every telemetry frame."""
_COMPRESSED = {
    b"\x1f\x8b": ("gzip", "zcat"),
    b"BZh": ("bzip2", "bzcat"),
    b"\xfd7zXZ": ("xz", "xzcat"),
    b"(\xb5/\xfd": ("zstd", "zstdcat"),
    b"PK\x03\x04": ("zip", "unzip -p"),
}
"""Name of a compression and the command that undoes it, by the first bytes of a file."""


def format_of(
    head: bytes,
    name: str,
    *,
    is_capture: bool = False,
    diagnosis: str | None = None,
) -> str:
    """Return the format of a recording with this head. Raises UserError if it is no recording.

    ``diagnosis``: the reason why the bytes are not an ESC's, for the error.
    """
    if not head.strip():
        raise UserError(f"{name}: is empty")
    for magic, (kind, command) in _COMPRESSED.items():
        if head.startswith(magic):
            raise UserError(
                f"{name}: is compressed with {kind}. Give its content through a pipe: "
                f"{command} {name} | kontronik-can-gw COMMAND -"
            )
    if is_capture or MAGIC in head:
        return CAPTURE
    log = log_format(head)
    if log is not None:
        return log
    if UART_MAGIC in head:
        return BYTES
    advice = candump_advice(head)
    if advice is not None:
        raise UserError(f"{name}: {advice}")
    reason = "" if diagnosis is None else f" ({diagnosis})"
    raise UserError(
        f"{name}: is neither a capture nor a CAN log (candump, ASC, BLF, TRC, MF4), "
        f"and has no ESC telemetry in its first {HEAD // 1024} kB{reason}"
    )
