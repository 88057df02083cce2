"""Reads a DBC file with cantools, after rewriting what other tools write and cantools does not understand."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc.bounds import MAX_BYTES, check_bounds, check_size
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

    text, ignored = _spelled_out(text, path)
    if warnings is not None:
        warnings += ignored
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


_STRING = re.compile(r'"(?:\\"|[^"])*"')

_PAIRS = r'(?:[^\s";]+\s+"\0\d+\0"\s*)*'
"""Values and their masked texts. Not simply up to a semicolon: NS_ lists keywords without one."""

_MASKED = re.compile(r'"\0(\d+)\0"')


def _spelled_out(text: str, path: str) -> tuple[str, list[str]]:
    """Rewrite what cantools does not read: a VAL_ that names a VAL_TABLE_, and enumeration attributes given by text.

    Entries for missing signals, tables and attributes are removed, each kind with a warning; cantools would refuse the whole file. Strings
    are masked meanwhile, so that comments and value texts stay unchanged and lines keep their numbers.
    """
    strings: list[str] = []

    def mask(found: re.Match[str]) -> str:
        strings.append(found[0])
        return f'"\0{len(strings) - 1}\0"'

    def shown(masked: str) -> str:
        return _MASKED.sub(lambda found: strings[int(found[1])], masked)

    text = _STRING.sub(mask, text)
    ignored: dict[str, list[str]] = {}

    def without(entry: re.Match[str], reason: str, what: str) -> str:
        ignored.setdefault(reason, []).append(shown(what))
        return "\n" * entry[0].count("\n")

    tables = dict(re.findall(rf"^[ \t]*VAL_TABLE_\s+(\w+)\s+({_PAIRS});", text, re.MULTILINE))
    signals: set[tuple[str, str]] = set()
    message = ""
    for found in re.finditer(r"^[ \t]*(?:BO_\s+0*(\d+)\s+\w+\s*:|SG_\s+(\w+))", text, re.MULTILINE):
        message = found[1] or message
        signals.add((message, found[2]))

    def of_signal(found: re.Match[str]) -> str:
        keyword, number, name, body = (
            found["keyword"],
            found["message"],
            found["signal"],
            found["body"],
        )
        what = f"{keyword} {number or ''} {name}".replace("  ", " ")
        if number is not None and (number.lstrip("0") or "0", name) not in signals:
            return without(found, "for signals that are not in the file", what)
        if keyword != "VAL_" or not re.fullmatch(r"[A-Za-z_]\w*", body.strip()):
            return found[0]
        if (table := tables.get(body.strip())) is None:
            return without(
                found, "naming a VAL_TABLE_ that is not in the file", f"{what} {body.strip()}"
            )
        return f"{found['head']}{table};"

    text = re.sub(
        r"^(?P<head>[ \t]*(?P<keyword>VAL_|SIG_VALTYPE_)\s+(?:(?P<message>\d+)\s+)?(?P<signal>[A-Za-z_]\w*+)\s*+)"
        rf"(?P<body>{_PAIRS}|[A-Za-z_]\w*\s*|:?\s*\d+\s*);",
        of_signal,
        text,
        flags=re.MULTILINE,
    )
    defined = set(
        map(shown, re.findall(r"^[ \t]*BA_DEF_\s+(?:\w+\s+)?(\"\0\d+\0\")", text, re.MULTILINE))
    )
    text = re.sub(
        r"^[ \t]*(BA_|BA_DEF_DEF_)\s+(\"\0\d+\0\")[^;\n]*;",
        lambda found: (
            found[0]
            if shown(found[2]) in defined
            else without(found, "of attributes that no BA_DEF_ defines", f"{found[1]} {found[2]}")
        ),
        text,
        flags=re.MULTILINE,
    )
    enumerations = re.findall(
        r"^[ \t]*BA_DEF_\s+(?:BO_\s+|SG_\s+|BU_\s+|EV_\s+)?(\"\0\d+\0\")\s+ENUM\s+([^;]*)",
        text,
        re.MULTILINE,
    )
    numbers = {
        shown(name): {
            shown(value[0]): str(n) for n, value in enumerate(re.finditer(_MASKED, values))
        }
        for name, values in enumerations
    }

    def number(found: re.Match[str]) -> str:
        name, value = shown(found[2]), shown(found[4])
        if name in numbers and value not in numbers[name]:
            raise UserError(
                f"{path}: attribute {name}: {value} is none of its values {', '.join(numbers[name])}"
            )
        return (
            f"{found[1]}{found[2]}{found[3]}{numbers.get(name, {}).get(value, found[4])}{found[5]}"
        )

    text = re.sub(
        r"^([ \t]*BA_\s+)(\"\0\d+\0\")(\s[^\";]*)(\"\0\d+\0\")(\s*;)",
        number,
        text,
        flags=re.MULTILINE,
    )
    return shown(text), [
        f"{path}: ignored, {reason}: {listed(found)}" for reason, found in ignored.items()
    ]


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
