"""Checks the numbers in a DBC before cantools reads it.

Without these limits a single number could cost gigabytes of memory or a minute. cantools makes an
object for each group of a multiplexer, builds masks of one character per bit, and expands ranges.
It uses numbers only after it has parsed the whole file, so the patterns need to be exact only for
well-formed text.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, islice
from math import prod

from kontronik_can_gw.errors import UserError

MAX_BYTES = 8_000_000
"""The largest of 130 real files has 0.8 MB, mostly comments."""
_MAX_TOKENS = 500_000
"""The largest real file has 182 000 words and numbers."""
_MAX_DIGITS = 400
_MAX_MESSAGE_BYTES = 4095
"""The limit of ISO 15765-2 with classic frames.

The limit of SAE J1939's transport protocol is 1785, of a CAN FD frame 64.
"""
_MAX_BITS = _MAX_MESSAGE_BYTES * 8
_MAX_NESTING = 8
_PAGES = "total number of multiplexer values"
_PAGE = "multiplexer value"
_TABLES = "total length of the value tables of VAL_, in characters"
_LIMITS = {
    "CAN id": 0xFFFF_FFFF,
    "length in bytes": _MAX_MESSAGE_BYTES,
    "start bit": _MAX_BITS - 1,
    "length in bits": _MAX_BITS,
    "number of messages": 10_000,
    "number of nodes": 2_000,
    "number of signals": 4_096,
    "exponent": 4_200,
    "depth of multiplexers": _MAX_NESTING,
    _PAGE: 0xFFFF_FFFF,
    _PAGES: 65_536,
    _TABLES: MAX_BYTES,
}
"""The largest number of each kind. The smallest is 0."""
_Numbers = Iterator[tuple[str, int, str]]
"""Kind, number, and place, which is for example "Msg.Signal: ", or empty."""

STRING = r'"(?:\\"|[^"])*"'
_TEXT = re.compile(rf"{STRING}|//[^\n]*")
_TOKEN = re.compile(r"\w+|[^\w\s]")
_MANY_DIGITS = re.compile(rf"\d[\d_]{{{_MAX_DIGITS}}}")
_POWER = re.compile(r"(?<![\w.])[\d_.]+[eE][-+]?([\d_]+)")
_NUMBER_TEXT = re.compile(r'"\s*[-+]?[\d_.]+(?:[eE][-+]?[\d_]+)?\s*"')
"""cantools also reads a number from the string of an attribute."""
_INTEGER = re.compile(r"[-+]?\d+")
_NUMBER = r"([-+]?\d+)"
_NODE_LIST = re.compile(r"BU_\s*:(?=([\w\s]*))")
_MESSAGE_OR_SIGNAL = re.compile(
    rf"BO_\s*{_NUMBER}\s*(\w+)\s*:\s*{_NUMBER}|"
    rf"SG_\s+(\w+)(?:\s+(\w+))?\s*:\s*{_NUMBER}\s*\|\s*{_NUMBER}"
)
_RANGES = re.compile(rf"SG_MUL_VAL_\s*{_NUMBER}\s*(\w+)\s+(\w+)([^;]*)")
_VALUE_TABLE = re.compile(r"VAL_TABLE_\s+(\w+)([^;]*)")
_VALUES = re.compile(rf"VAL_\s*{_NUMBER}\s*(\w+)([^;]*)")
_TABLE_NAME = re.compile(r"\s*([A-Za-z_]\w*)\s*\Z")


def check_bounds(text: str, path: str) -> None:
    """Raise UserError for the first number of a DBC that exceeds its limits.

    The error has the place of the number, its value and the limits.
    """
    text = _TEXT.sub(_masked, text)
    if len(text) > _MAX_TOKENS:
        tokens = _TOKEN.finditer(text)
        if next(islice(tokens, _MAX_TOKENS, None), None):
            raise UserError(
                f"{path}: has more than {_MAX_TOKENS} words and numbers. "
                "Remove messages that are not needed."
            )
    found = _MANY_DIGITS.search(text)
    if found:
        raise UserError(
            f"{path}: line {_line(text, found)}: a number has more than {_MAX_DIGITS} digits. "
            "Correct it."
        )
    for kind, number, where in _numbers(text):
        if not 0 <= number <= _LIMITS[kind]:
            raise UserError(
                f"{path}: {where}{kind} is {number}, but must be 0 to {_LIMITS[kind]}. Correct it."
            )


def _masked(found: re.Match[str]) -> str:
    """Return a blank for a comment, and a string without its content.

    The string keeps its length, by which value tables are measured.
    """
    if found[0].startswith("//"):
        return " "
    if _NUMBER_TEXT.fullmatch(found[0]):
        return found[0]
    content = "_" * (len(found[0]) - 2)
    return f'"{content}"'


def _line(text: str, found: re.Match[str]) -> int:
    return text.count("\n", 0, found.start()) + 1


@dataclass
class _Multiplexing:
    """The multiplexing of a message, by names of signals."""

    name: str
    multiplexers: set[str] = field(default_factory=set)
    values: Counter[str] = field(default_factory=Counter)
    """Number of groups of each signal."""
    parents: dict[str, str] = field(default_factory=dict)
    """The multiplexer of a signal in SG_MUL_VAL_."""
    texts: Counter[str] = field(default_factory=Counter)
    """Sizes of value tables. Each text in a multiplexer's table makes a group."""

    def pages(self) -> tuple[int, int]:
        """Return the nesting depth of multiplexers, and the number of their groups and signals."""
        depth = 0
        total = 0
        for name in self.multiplexers | self.values.keys():
            chain = self._chain(name)
            copies = prod(self.values[each] for each in chain[:-1])
            if len(chain) > 1:
                total += copies
            if name in self.multiplexers:
                depth = max(depth, len(chain))
                total += copies * self.texts[name]
        return depth, total

    def _chain(self, name: str) -> list[str]:
        """Return a signal and the multiplexers around it, innermost first, as cantools does.

        The chain is at most one element longer than the limit.
        """
        chain = [name]
        parent = self._parent(name)
        while parent is not None and len(chain) <= _MAX_NESTING:
            chain.append(parent)
            parent = self._parent(parent)
        return chain

    def _parent(self, name: str) -> str | None:
        """Return the multiplexer of a signal.

        A single multiplexer applies to all signals. Of several, SG_MUL_VAL_ selects one.
        """
        if len(self.multiplexers) > 1:
            parent = self.parents.get(name)
            return parent if parent in self.multiplexers else None
        return next((only for only in self.multiplexers if only != name), None)


def _numbers(text: str) -> _Numbers:
    """Yield each number with its kind and its place."""
    for found in _POWER.finditer(text):
        exponent = found[1].replace("_", "")
        yield "exponent", int("0" + exponent), f"line {_line(text, found)}: "
    for found in _NODE_LIST.finditer(text):
        yield "number of nodes", len(found[1].split()), ""
    messages: defaultdict[int, list[_Multiplexing]] = defaultdict(list)
    message = _Multiplexing("")
    signals = 0
    count = 0
    for found in _MESSAGE_OR_SIGNAL.finditer(text):
        if found[1]:
            message = _Multiplexing(found[2])
            signals = 0
            count += 1
            messages[int(found[1])].append(message)
            yield "number of messages", count, ""
            yield "CAN id", int(found[1]), f"{message.name}: "
            yield "length in bytes", int(found[3]), f"{message.name}: "
            continue
        name = found[4]
        mark = found[5] or ""
        signals += 1
        yield "number of signals", signals, f"{message.name}: "
        yield "start bit", int(found[6]), f"{message.name}.{name}: "
        yield "length in bits", int(found[7]), f"{message.name}.{name}: "
        if mark.endswith("M"):
            message.multiplexers.add(name)
        page = _INTEGER.search(mark)
        if mark.startswith("m") and page:
            yield _PAGE, int(page[0]), f"{message.name}.{name}: "
            message.values[name] += 1
    yield from _ranges(text, messages)
    yield from _value_tables(text, messages)
    total = 0
    for message in chain.from_iterable(messages.values()):
        nesting, pages = message.pages()
        total += pages
        yield "depth of multiplexers", nesting, f"{message.name}: "
        yield _PAGES, total, f"{message.name}: "


def _ranges(text: str, messages: Mapping[int, list[_Multiplexing]]) -> _Numbers:
    """Yield the numbers in the ranges of SG_MUL_VAL_.

    As in cantools, any single character separates the two numbers of a range.
    """
    total = 0
    for found in _RANGES.finditer(text):
        can_id = int(found[1])
        name = found[2]
        parent = found[3]
        numbers = _INTEGER.findall(found[4])
        values = 0
        for first, last in zip(numbers[::2], numbers[1::2], strict=False):
            low = int(first)
            high = int(last[1:] or "0")
            yield _PAGE, low, f"SG_MUL_VAL_ of {name}: "
            yield _PAGE, high, f"SG_MUL_VAL_ of {name}: "
            values += max(0, high - low + 1)
        total += values
        yield _PAGES, total, f"SG_MUL_VAL_ of {name}: "
        for message in messages.get(can_id, ()):
            message.values[name] += values
            message.parents[name] = parent


def _count_texts(table: str) -> int:
    return table.count('"') // 2


def _value_tables(text: str, messages: Mapping[int, list[_Multiplexing]]) -> _Numbers:
    """Yield the sizes of value tables. A table counts once for each signal that uses it."""
    tables: dict[str, tuple[int, int]] = {}
    """Length and number of texts of each table."""
    for found in _VALUE_TABLE.finditer(text):
        tables[found[1]] = (len(found[2]), _count_texts(found[2]))
    size = 0
    for found in _VALUES.finditer(text):
        named = _TABLE_NAME.match(found[3])
        if named:
            length, texts = tables.get(named[1], (0, 0))
        else:
            length = 0
            texts = _count_texts(found[3])
        size += length
        yield _TABLES, size, f"VAL_ of {found[2]}: "
        for message in messages.get(int(found[1]), ()):
            message.texts[found[2]] = texts
