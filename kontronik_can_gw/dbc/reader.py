"""Reads a DBC file with cantools, after checks of its size and numbers and the rewriting of ``spelling.py``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc.bounds import MAX_BYTES, check_bounds, check_size
from kontronik_can_gw.dbc.spelling import spelled_out
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.lean import without_asammdf

if TYPE_CHECKING:
    from cantools.database.can import Database


_MAX_REASON = 300
"""Maximum length of a reason in characters: cantools may quote the whole file."""


def load_database(path: Path, warnings: list[str] | None = None) -> "Database":
    """Read a DBC file with ``parse_database``. UserError with one line for a file that cannot be read or is no DBC."""
    return parse_database(read_dbc(path), str(path), warnings)


def read_dbc(path: Path) -> bytes:
    """The bytes of a DBC file. UserError with one line where it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES + 1)  # one byte more shows that it is too large
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None


def parse_database(raw: bytes, path: str, warnings: list[str] | None = None) -> "Database":
    """Parse the bytes of a DBC file. UserError with one line that names ``path`` where it is no DBC.

    Entries that refer to missing signals, tables or attributes are ignored, with a line in ``warnings``.
    """
    check_size(len(raw), path)
    if b"\0" in raw:
        raise UserError(f"{path}: is a binary file, not a DBC")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
    if not text.strip():
        raise UserError(f"{path}: is empty, not a DBC")
    check_bounds(text, path)
    with without_asammdf():
        import cantools.database

    text, ignored = spelled_out(text, path)
    if warnings is not None:
        warnings += [
            f"{path}: ignored, {reason}: {listed(entries)}" for reason, entries in ignored.items()
        ]
    try:
        database = cantools.database.load_string(
            text, database_format="dbc", strict=False, sort_signals=None
        )
    except Exception as error:  # cantools raises errors of many types for text that is no DBC
        reason = " ".join(str(error)[:_MAX_REASON].split()) or type(error).__name__
        raise UserError(f"{path}: is not a DBC that can be read: {reason}") from None
    if not isinstance(database, cantools.database.Database):
        raise UserError(f"{path}: is not a CAN database")
    if not database.messages:
        raise UserError(f"{path}: has no message; is it a DBC file?")
    return database


def listed(names: Sequence[str], limit: int = 6) -> str:
    """The first ``limit`` names, each once, and the number of further ones."""
    names = list(dict.fromkeys(names))
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def choose_node(database: "Database", wanted: str | None, file: str) -> str:
    """The transmitter node whose messages we send. UserError where it is missing or ambiguous."""
    senders = sorted({sender for message in database.messages for sender in message.senders})
    if wanted is not None:
        if wanted in senders:
            return wanted
        raise UserError(
            f"{file}: no message is sent by node {wanted!r}; nodes that send: {', '.join(senders) or 'none'}. "
            f"Set dbc.node to one of them."
        )
    if len(senders) == 1:
        return senders[0]
    gateways = [sender for sender in senders if sender == "KontronikGateway"]
    if gateways:
        return gateways[0]
    if not senders:
        raise UserError(
            f"{file}: no message has a transmitter, so none is ours. Name one in the DBC (BU_ and BO_)."
        )
    raise UserError(
        f"{file}: several nodes send: {', '.join(senders)}. Set dbc.node to the gateway's."
    )


def attribute(owner: Any, name: str, database: "Database") -> Any:
    """An attribute's value, else its default; None where it is not defined. Enumerations as text."""
    definition = database.dbc.attribute_definitions.get(name) if database.dbc else None
    if definition is None:
        return None
    own = owner.dbc.attributes.get(name) if owner.dbc else None
    value = definition.default_value if own is None else own.value
    choices = definition.choices
    if choices and isinstance(value, int):
        return choices[value] if 0 <= value < len(choices) else None
    return value
