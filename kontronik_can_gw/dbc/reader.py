"""Reads a DBC file with cantools.

The file is first checked for its size and numbers. Text that other tools write but cantools refuses
is rewritten.
"""

import fnmatch
import logging
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

from kontronik_can_gw.dbc.bounds import MAX_BYTES, STRING, check_bounds
from kontronik_can_gw.errors import UserError
from kontronik_can_gw.light_imports import without_asammdf

if TYPE_CHECKING:
    from cantools.database.can import Database

_MAX_REASON = 300
"""Greatest length of a reason in characters, because cantools may quote the whole file."""
_PAIRS = r'(?:[^\s";]+\s+"\0\d+\0"\s*)*'
"""Values and their masked texts.

It does not match everything up to a semicolon, because NS_ lists keywords without a semicolon.
"""
_BAUD_RATE = re.compile(
    r"^([ \t]*BS_[ \t]*:)[ \t]*\d+[ \t]*:[ \t]*\d+[ \t]*,[ \t]*\d+[ \t]*;?", re.MULTILINE
)
"""The bit timing of a bus. The grammar allows it, but cantools supports only the empty form."""
_BYTE_ORDER = re.compile(
    r"(?:\bBO_\s+\d+\s+(?P<message>\w+)\s*:)|"
    r"\bSG_\s+(?P<signal>\w+)(?:\s+\w+)?\s*:\s*\d+\s*\|\s*\d+\s*@\s*(?P<order>\d+)"
)
_MESSAGE = re.compile(
    r"^[ \t]*BO_\s+(?P<number>\d+)\s+(?P<name>\w+)\s*:\s*\d+\s+(?P<sender>\w+)[^\n]*"
    r"(?P<signals>(?:\s*^[ \t]*SG_\s[^\n]*)*)",
    re.MULTILINE,
)
"""A message with its signals."""
_EMPTY_SIGNAL = re.compile(r"SG_\s+(\w+)(?:\s+\w+)?\s*:\s*\d+\s*\|\s*0+\s*@")
_NO_MESSAGE = "VECTOR__INDEPENDENT_SIG_MSG"
"""The name under which tools keep signals without a message. cantools ignores it."""
NO_NODE = "Vector__XXX"
"""The transmitter in a DBC of a message that has no transmitter."""
_NAME = r'("\0\d+\0")'
"""A masked string, such as an attribute's name."""
_MASKED = re.compile(r'"\0(\d+)\0"')
_TABLE = re.compile(rf"^[ \t]*VAL_TABLE_\s+(\w+)\s+({_PAIRS});", re.MULTILINE)
_MESSAGE_OR_SIGNAL = re.compile(r"^[ \t]*(?:BO_\s+0*(\d+)\s+\w+\s*:|SG_\s+(\w+))", re.MULTILINE)
_OF_SIGNAL = re.compile(
    r"^(?P<head>[ \t]*(?P<keyword>VAL_|SIG_VALTYPE_)\s+"
    r"(?:(?P<message>\d+)\s+)?(?P<signal>[A-Za-z_]\w*+)\s*+)"
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


_OTHER_FORMATS = (
    ("FormatVersion", "=", "a PCAN Symbol file (.sym)", "cantools convert"),
    ("<", "NetworkDefinition", "a KCD", "cantools convert"),
    ("<", "AUTOSAR", "an ARXML", "canconvert"),
    ("", "[DATABASE_VERSION]", "a DBF of BUSMASTER", "canconvert"),
)
"""Beginnings of databases in other formats, a text near it, their names, and their converters."""
_NEAR = 2000


class LeftOut(NamedTuple):
    """A message that cannot exist on a bus, so it was left out of a DBC."""

    name: str
    sender: str
    reason: str


_LEFT_OUT: "WeakKeyDictionary[Database, list[LeftOut]]" = WeakKeyDictionary()


def load_database(path: Path, warnings: list[str] | None = None) -> "Database":
    """Read a DBC file with ``parse_database``.

    Raises UserError with one line if it cannot be read or is not a DBC.
    """
    return parse_database(read_dbc(path), str(path), warnings)


def read_dbc(path: Path) -> bytes:
    """Return the bytes of a DBC file. Raises UserError with one line if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES + 1)  # one byte more shows that it is too large
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None


def parse_database(
    raw: bytes,
    path: str,
    warnings: list[str] | None = None,
) -> "Database":
    """Parse the bytes of a DBC file.

    Entries that refer to missing signals, tables or attributes are ignored, and messages that
    cannot exist are left out, each with a line in ``warnings``. Raises UserError with one line that
    begins with ``path`` if it is not a DBC.
    """
    if len(raw) > MAX_BYTES:
        raise UserError(
            f"{path}: is larger than {MAX_BYTES // 1_000_000} MB. "
            "Is it a DBC? If so, remove comments."
        )
    if b"\0" in raw:
        raise UserError(f"{path}: is a binary file, not a DBC")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
    if not text.strip():
        raise UserError(f"{path}: is empty, not a DBC")
    _refuse_other_formats(text, path)
    check_bounds(text, path)
    with without_asammdf():
        from cantools.database.can import Database

    logging.getLogger("cantools").addHandler(logging.NullHandler())  # _equal_messages reports them
    rewriting = _Rewriting(text, path)
    database = Database(strict=False, sort_signals=None)
    try:
        database.add_dbc_string(rewriting.result)
    except Exception as error:  # cantools raises errors of many types for other text than a DBC
        raise UserError(f"{path}: {_reason(error)}") from None
    if not database.messages and not rewriting.left_out:
        raise UserError(f"{path}: has no messages. Is it a DBC?")
    _LEFT_OUT[database] = rewriting.left_out
    if warnings is not None:
        for reason, entries in rewriting.removed.items():
            warnings.append(f"{path}: {reason}: {listed(entries)}")
        warnings += (f"{path}: {text}" for text in _equal_messages(database))
    return database


_SYNTAX = r'Invalid syntax at (line \d+, column \d+): "([A-Z_]*)'
"""An error of cantools: its place, and the keyword at the beginning of the line."""


def _reason(error: Exception) -> str:
    """Return the reason of an error of cantools, in one line."""
    text = " ".join(str(error)[:_MAX_REASON].split()) or type(error).__name__
    found = re.match(_SYNTAX, text)
    if found is None:
        return f"cannot be read as a DBC: {text}"
    where, keyword = found.groups()
    # the rest of the line is not shown, because it may hold a secret, and a support bundle has this
    entry = f", in the entry {keyword}" if keyword else ""
    return f"{where}: is not as in a DBC{entry}. Correct it."


def _refuse_other_formats(text: str, path: str) -> None:
    """Raise UserError with the converter for a database in another format."""
    start = text.lstrip()[:_NEAR]
    for beginning, near, name, program in _OTHER_FORMATS:
        if start.startswith(beginning) and near in start:
            package = "cantools" if program.startswith("cantools") else "canmatrix"
            raise UserError(
                f"{path}: is {name}, not a DBC. Convert it with the Python package {package}: "
                f"{program} {Path(path).name} {Path(path).stem}_converted.dbc"
            )


def _equal_messages(database: "Database") -> Iterator[str]:
    """Yield a line about names, and a line about ids, that several messages have."""
    names = Counter(message.name for message in database.messages)
    equal = [name for name, count in names.items() if count > 1]
    if equal:
        yield f"several messages have the same name: {listed(equal)}"
    keys = Counter((each.frame_id, each.is_extended_frame) for each in database.messages)
    ids = [f"{can_id:X}h" for (can_id, _), count in keys.items() if count > 1]
    if ids:
        yield f"several messages have the same id: {listed(ids)}"


def own_left_out(
    database: "Database", node: str, file: str, patterns: Sequence[str] = ()
) -> list[str]:
    """Return a line for each message of the gateway's node that was left out of the DBC.

    ``patterns`` are the names of the messages to send. Empty: all messages of the node. Raises
    UserError if no other message of the node is left.
    """
    problems = []
    for name, sender, reason in _LEFT_OUT.get(database, ()):
        if sender == node and is_matched(name, patterns or "*"):
            problems.append(f"{name}: {reason}. Correct it.")
    if problems and not any(node in message.senders for message in database.messages):
        raise UserError(*(f"{file}: {problem}" for problem in problems))
    return problems


class _Rewriting:
    """The text of a DBC, rewritten for cantools.

    1. A VAL_ with the name of a VAL_TABLE_ gets the values of the table.
    2. The text of an enumeration attribute is replaced by its number.
    3. Entries for missing signals, tables and attributes are removed, because cantools would refuse
       the whole file.
    4. For the same reason, messages with an impossible id or a signal of 0 bits are removed.

    Strings are masked during the changes, so that comments and texts of values are not changed.
    Lines keep their numbers. Raises UserError for a text that is not in an attribute's enumeration.
    """

    def __init__(self, text: str, path: str) -> None:
        self._path = path
        self._strings: list[str] = []
        self.removed: dict[str, list[str]] = {}
        """The removed entries by reason."""
        self.left_out: list[LeftOut] = []
        self._left_out_numbers: set[str] = set()
        text = re.sub(STRING, self._mask, text)
        text = _BAUD_RATE.sub(r"\1", text)
        self._check_byte_orders(text)
        text = _MESSAGE.sub(self._without_impossible, text)
        text = self._with_tables(text)
        text = self._without_undefined_attributes(text)
        text = self._with_fractions(text)
        text = self._with_numbers(text)
        self.result = self._unmask(text)

    def _check_byte_orders(self, text: str) -> None:
        """Raise UserError for a byte order except 0 and 1. cantools would use 1 for it."""
        message = ""
        for found in _BYTE_ORDER.finditer(text):
            message = found["message"] or message
            if found["signal"] and found["order"] not in ("0", "1"):
                raise UserError(
                    f"{self._path}: {message}.{found['signal']}: "
                    f"byte order {found['order']} is neither 0 (Motorola) nor "
                    "1 (Intel). Write @0 or @1. SIG_VALTYPE_ declares floats."
                )

    def _without_impossible(self, found: re.Match[str]) -> str:
        """Return a message unchanged, or the line ends of a message that is left out."""
        number, name, sender, signals = found.group("number", "name", "sender", "signals")
        empty = _EMPTY_SIGNAL.search(signals)
        can_id = int(number) & 0x7FFFFFFF
        limit = 0x1FFFFFFF if int(number) >> 31 else 0x7FF
        if empty:
            reason = f"has a signal of 0 bits, {empty[1]}"
        elif can_id > limit:
            reason = f"has the id {can_id:X}h, which is beyond {limit:X}h"
            if limit == 0x7FF and can_id <= 0x1FFFFFFF:
                reason += f" (a 29-bit id is written with bit 31 set: {can_id | 1 << 31})"
        else:
            return found[0]
        if name == _NO_MESSAGE:
            return found[0]
        self.left_out.append(LeftOut(name, sender, reason))
        self._left_out_numbers.add(number.lstrip("0") or "0")
        entry = f"{name} ({sender}) {reason}"
        return self._remove(found, "left out messages that cannot be sent", entry)

    def _mask(self, found: re.Match[str]) -> str:
        self._strings.append(found[0])
        return f'"\0{len(self._strings) - 1}\0"'

    def _unmask(self, masked: str) -> str:
        """Return a text with its strings."""
        return _MASKED.sub(lambda found: self._strings[int(found[1])], masked)

    def _remove(self, entry: re.Match[str], reason: str, name: str) -> str:
        """Record a removed entry. Return its line ends, which replace it."""
        self.removed.setdefault(reason, []).append(self._unmask(name))
        return "\n" * entry[0].count("\n")

    def _with_tables(self, text: str) -> str:
        """Replace the names of value tables by the tables.

        Entries for signals and tables that are not in the file are removed.
        """
        tables = dict(_TABLE.findall(text))
        signals: set[tuple[str, str]] = set()
        message = ""
        for found in _MESSAGE_OR_SIGNAL.finditer(text):
            message = found[1] or message
            signals.add((message, found[2]))

        def rewritten(found: re.Match[str]) -> str:
            keyword, number, name, body = found.group("keyword", "message", "signal", "body")
            entry = f"{keyword} {name}"
            if number is not None:
                entry = f"{keyword} {number} {name}"
                key = (str(int(number)), name)
                if key not in signals and key[0] in self._left_out_numbers:
                    return "\n" * found[0].count("\n")
                if key not in signals:
                    reason = "ignored entries for signals that are not in the file"
                    return self._remove(found, reason, entry)
            table = body.strip()
            if keyword != "VAL_" or not re.fullmatch(r"[A-Za-z_]\w*", table):
                return found[0]
            if table not in tables:
                reason = "ignored entries that name a VAL_TABLE_ that is not in the file"
                return self._remove(found, reason, f"{entry} {table}")
            return f"{found['head']}{tables[table]};"

        return _OF_SIGNAL.sub(rewritten, text)

    def _without_undefined_attributes(self, text: str) -> str:
        """Remove values and defaults of attributes that have no BA_DEF_."""
        defined = {self._unmask(name) for name in _DEFINITION.findall(text)}

        def rewritten(found: re.Match[str]) -> str:
            if self._unmask(found[2]) in defined:
                return found[0]
            reason = "ignored entries of attributes without a BA_DEF_"
            return self._remove(found, reason, f"{found[1]} {found[2]}")

        return _ATTRIBUTE.sub(rewritten, text)

    def _with_fractions(self, text: str) -> str:
        """Declare INT attributes as FLOAT if a value has a fraction, which would be cut off."""
        names = {self._unmask(name) for name in _FRACTION.findall(text)}

        def rewritten(found: re.Match[str]) -> str:
            if self._unmask(found[2]) in names:
                return f"{found[1]}FLOAT"
            return found[0]

        return _INTEGER_DEFINITION.sub(rewritten, text)

    def _with_numbers(self, text: str) -> str:
        """Replace the texts of enumeration attributes by their numbers."""
        numbers: dict[str, dict[str, int]] = {}
        for name, values in _ENUMERATION.findall(text):
            number_of = {}
            for number, value in enumerate(_MASKED.finditer(values)):
                number_of[self._unmask(value[0])] = number
            numbers[self._unmask(name)] = number_of

        def rewritten(found: re.Match[str]) -> str:
            name = self._unmask(found[2])
            value = self._unmask(found[4])
            if name not in numbers:
                return found[0]
            if value not in numbers[name]:
                known = listed(numbers[name])
                raise UserError(
                    f"{self._path}: attribute {name}: {value} is not one of its values: {known}"
                )
            return f"{found[1]}{found[2]}{found[3]}{numbers[name][value]}{found[5]}"

        return _TEXT_VALUE.sub(rewritten, text)


def is_matched(name: str, patterns: Iterable[str]) -> bool:
    """Return True if a message's name matches one of these patterns of a configuration."""
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def listed(names: Iterable[str], limit: int = 6) -> str:
    """Return the first ``limit`` names, each once, and the number of further names."""
    names = list(dict.fromkeys(names))
    text = ", ".join(names[:limit])
    if len(names) > limit:
        text += f" and {len(names) - limit} more"
    return text


def choose_node(
    database: "Database",
    wanted: str | None,
    file: str,
    patterns: Sequence[str] = (),
) -> str:
    """Return the transmitter node whose messages the gateway sends.

    If no message of the file has a transmitter, ``patterns`` alone select messages. They get
    NO_NODE as their transmitter. Raises UserError if the node is missing or ambiguous.
    """
    if wanted is None and patterns and not any(each.senders for each in database.messages):
        for message in database.messages:
            if is_matched(message.name, patterns):
                message.senders.append(NO_NODE)
        return NO_NODE
    senders = {each.sender for each in _LEFT_OUT.get(database, ())} - {NO_NODE}
    senders.update(*(message.senders for message in database.messages))
    text = ", ".join(sorted(senders))
    node = wanted or (text if len(senders) == 1 else "KontronikGateway")
    if node in senders:
        return node
    if wanted is not None:
        raise UserError(
            f"{file}: node {wanted!r} sends no messages. "
            f"Nodes that send messages: {text or 'none'}."
        )
    if not senders:
        raise UserError(
            f"{file}: no message has a transmitter, so none is sent. "
            "Choose messages with dbc.messages, or name a transmitter in the DBC (BU_ and BO_)."
        )
    raise UserError(f"{file}: several nodes send messages: {text}. Set dbc.node to the gateway's.")


def attribute(owner: Any, name: str, database: "Database") -> Any:
    """Return an attribute's value, or its default. None if it is not defined.

    The value of an enumeration is its text.
    """
    definition = database.dbc.attribute_definitions.get(name) if database.dbc else None
    if definition is None:
        return None
    own = owner.dbc.attributes.get(name) if owner.dbc else None
    value = definition.default_value if own is None else own.value
    choices = definition.choices
    if choices and isinstance(value, int):
        return choices[value] if 0 <= value < len(choices) else None
    return value
