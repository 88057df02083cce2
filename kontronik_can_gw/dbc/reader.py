"""Reads a DBC file with cantools: checked first for size and numbers, and rewritten where other tools write what cantools refuses."""

import fnmatch
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.dbc.bounds import MAX_BYTES, STRING, check_bounds
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.light_imports import without_asammdf

if TYPE_CHECKING:
    from cantools.database.can import Database

_MAX_REASON = 300
"""Maximum length of a reason in characters: cantools may quote the whole file."""
_PAIRS = r'(?:[^\s";]+\s+"\0\d+\0"\s*)*'
"""Values and their masked texts. Not simply up to a semicolon: NS_ lists keywords without one."""
_BAUD_RATE = re.compile(
    r"^([ \t]*BS_[ \t]*:)[ \t]*\d+[ \t]*:[ \t]*\d+[ \t]*,[ \t]*\d+[ \t]*;?", re.MULTILINE
)
"""The bit timing of a bus. The grammar allows it; cantools knows the empty form only."""
_BYTE_ORDER = re.compile(
    r"(?:\bBO_\s+\d+\s+(?P<message>\w+)\s*:)|"
    r"\bSG_\s+(?P<signal>\w+)(?:\s+\w+)?\s*:\s*\d+\s*\|\s*\d+\s*@\s*(?P<order>\d+)"
)
NO_NODE = "Vector__XXX"
"""What a DBC names as transmitter of a message that has none."""
_NAME = r'("\0\d+\0")'
"""A masked string, such as an attribute's name."""
_MASKED = re.compile(r'"\0(\d+)\0"')
_TABLE = re.compile(rf"^[ \t]*VAL_TABLE_\s+(\w+)\s+({_PAIRS});", re.MULTILINE)
_MESSAGE_OR_SIGNAL = re.compile(r"^[ \t]*(?:BO_\s+0*(\d+)\s+\w+\s*:|SG_\s+(\w+))", re.MULTILINE)
_OF_SIGNAL = re.compile(
    r"^(?P<head>[ \t]*(?P<keyword>VAL_|SIG_VALTYPE_)\s+(?:(?P<message>\d+)\s+)?(?P<signal>[A-Za-z_]\w*+)\s*+)"
    rf"(?P<body>{_PAIRS}|[A-Za-z_]\w*\s*|:?\s*\d+\s*);",
    re.MULTILINE,
)
_DEFINITION = re.compile(rf"^[ \t]*BA_DEF_\s+(?:\w+\s+)?{_NAME}", re.MULTILINE)
_ATTRIBUTE = re.compile(rf"^[ \t]*(BA_|BA_DEF_DEF_)\s+{_NAME}[^;\n]*;", re.MULTILINE)
_ENUMERATION = re.compile(
    rf"^[ \t]*BA_DEF_\s+(?:BO_\s+|SG_\s+|BU_\s+|EV_\s+)?{_NAME}\s+ENUM\s+([^;]*)", re.MULTILINE
)
_INTEGER_DEFINITION = re.compile(
    rf"^([ \t]*BA_DEF_\s+(?:BO_\s+|SG_\s+|BU_\s+|EV_\s+)?{_NAME}\s+)INT\b", re.MULTILINE
)
_FRACTION = re.compile(
    rf"^[ \t]*BA_(?:DEF_DEF_)?\s+{_NAME}[^;\n]*?\s-?\d*\.\d*[1-9]\d*\s*;", re.MULTILINE
)
_TEXT_VALUE = re.compile(rf"^([ \t]*BA_\s+){_NAME}(\s[^\";]*){_NAME}(\s*;)", re.MULTILINE)


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
    if len(raw) > MAX_BYTES:
        raise UserError(
            f"{path}: is larger than {MAX_BYTES // 1_000_000} MB. Is it a DBC? Give one with fewer comments."
        )
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

    rewriting = _Rewriting(text, path)
    if warnings is not None:
        warnings += [
            f"{path}: ignored, {reason}: {listed(entries)}"
            for reason, entries in rewriting.ignored.items()
        ]
    try:
        database = cantools.database.load_string(
            rewriting.result, database_format="dbc", strict=False, sort_signals=None
        )
    except Exception as error:  # cantools raises errors of many types for text that is no DBC
        reason = " ".join(str(error)[:_MAX_REASON].split()) or type(error).__name__
        raise UserError(f"{path}: is not a DBC that can be read: {reason}") from None
    if not isinstance(database, cantools.database.Database):
        raise UserError(f"{path}: is not a CAN database")
    if not database.messages:
        raise UserError(f"{path}: has no message; is it a DBC file?")
    return database


class _Rewriting:
    """The text of a DBC for cantools: a VAL_ that names a VAL_TABLE_, and enumeration attributes given by text, are written out.

    Entries for missing signals, tables and attributes are removed (cantools would refuse the whole file). Strings are masked
    meanwhile, so that comments and value texts stay unchanged; lines keep their numbers. UserError for a text that an attribute's
    enumeration lacks.
    """

    def __init__(self, text: str, path: str) -> None:
        self._path = path
        self._strings: list[str] = []
        self.ignored: dict[str, list[str]] = {}
        """Reason to what was removed for it."""
        text = _BAUD_RATE.sub(r"\1", re.sub(STRING, self._mask, text))
        self._check_byte_orders(text)
        text = self._with_tables(text)
        self.result = self._shown(self._numbered(self._with_fractions(self._defined(text))))

    def _check_byte_orders(self, text: str) -> None:
        """UserError for a byte order other than 0 and 1, which cantools takes for 1."""
        message = ""
        for found in _BYTE_ORDER.finditer(text):
            message = found["message"] or message
            if found["signal"] and found["order"] not in ("0", "1"):
                raise UserError(
                    f"{self._path}: {message}.{found['signal']}: byte order {found['order']} is neither 0 (Motorola) nor "
                    "1 (Intel). Write @0 or @1; a float is declared by SIG_VALTYPE_."
                )

    def _mask(self, found: re.Match[str]) -> str:
        self._strings.append(found[0])
        return f'"\0{len(self._strings) - 1}\0"'

    def _shown(self, masked: str) -> str:
        """A text with its strings."""
        return _MASKED.sub(lambda found: self._strings[int(found[1])], masked)

    def _without(self, entry: re.Match[str], reason: str, what: str) -> str:
        self.ignored.setdefault(reason, []).append(self._shown(what))
        return "\n" * entry[0].count("\n")

    def _with_tables(self, text: str) -> str:
        """Names of value tables replaced by the tables, entries of signals and tables that are not in the file removed."""
        tables = dict(_TABLE.findall(text))
        signals: set[tuple[str, str]] = set()
        message = ""
        for found in _MESSAGE_OR_SIGNAL.finditer(text):
            message = found[1] or message
            signals.add((message, found[2]))

        def rewritten(found: re.Match[str]) -> str:
            keyword, number, name, body = found.group("keyword", "message", "signal", "body")
            what = f"{keyword} {number or ''} {name}".replace("  ", " ")
            if number is not None and (number.lstrip("0") or "0", name) not in signals:
                return self._without(found, "for signals that are not in the file", what)
            table = body.strip()
            if keyword != "VAL_" or not re.fullmatch(r"[A-Za-z_]\w*", table):
                return found[0]
            if table not in tables:
                reason = "naming a VAL_TABLE_ that is not in the file"
                return self._without(found, reason, f"{what} {table}")
            return f"{found['head']}{tables[table]};"

        return _OF_SIGNAL.sub(rewritten, text)

    def _defined(self, text: str) -> str:
        """Values and defaults of attributes removed that have no BA_DEF_."""
        defined = {self._shown(name) for name in _DEFINITION.findall(text)}

        def rewritten(found: re.Match[str]) -> str:
            if self._shown(found[2]) in defined:
                return found[0]
            reason = "of attributes that no BA_DEF_ defines"
            return self._without(found, reason, f"{found[1]} {found[2]}")

        return _ATTRIBUTE.sub(rewritten, text)

    def _with_fractions(self, text: str) -> str:
        """Declares INT attributes as FLOAT if they have a value with a fraction, which would be cut off."""
        names = {self._shown(name) for name in _FRACTION.findall(text)}

        def rewritten(found: re.Match[str]) -> str:
            return f"{found[1]}FLOAT" if self._shown(found[2]) in names else found[0]

        return _INTEGER_DEFINITION.sub(rewritten, text)

    def _numbered(self, text: str) -> str:
        """Texts of enumeration attributes replaced by their numbers."""
        numbers = {
            self._shown(name): {
                self._shown(value[0]): number
                for number, value in enumerate(_MASKED.finditer(values))
            }
            for name, values in _ENUMERATION.findall(text)
        }

        def rewritten(found: re.Match[str]) -> str:
            name, value = self._shown(found[2]), self._shown(found[4])
            if name not in numbers:
                return found[0]
            if value not in numbers[name]:
                known = listed(numbers[name])
                raise UserError(
                    f"{self._path}: attribute {name}: {value} is none of its values {known}"
                )
            return f"{found[1]}{found[2]}{found[3]}{numbers[name][value]}{found[5]}"

        return _TEXT_VALUE.sub(rewritten, text)


def listed(names: Iterable[str], limit: int = 6) -> str:
    """The first ``limit`` names, each once, and the number of further ones."""
    names = list(dict.fromkeys(names))
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def choose_node(
    database: "Database", wanted: str | None, file: str, patterns: Sequence[str] = ()
) -> str:
    """Returns the transmitter node whose messages the gateway sends.

    If no message of the file has a transmitter, ``patterns`` alone select messages: those get
    NO_NODE as their transmitter. UserError if the node is missing or ambiguous.
    """
    if wanted is None and patterns and not any(each.senders for each in database.messages):
        for message in database.messages:
            if any(fnmatch.fnmatchcase(message.name, pattern) for pattern in patterns):
                message.senders.append(NO_NODE)
        return NO_NODE
    senders = sorted({sender for message in database.messages for sender in message.senders})
    if wanted is not None:
        if wanted in senders:
            return wanted
        raise UserError(
            f"{file}: no message is sent by node {wanted!r}; nodes that send: {', '.join(senders) or 'none'}. "
            f"Set dbc.node to one of them."
        )
    if not senders:
        raise UserError(
            f"{file}: no message has a transmitter, so none is ours. Select messages by dbc.messages, or name a transmitter "
            "in the DBC (BU_ and BO_)."
        )
    if len(senders) == 1:
        return senders[0]
    if "KontronikGateway" in senders:
        return "KontronikGateway"
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
