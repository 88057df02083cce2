"""Unit texts of DBC files, and exact conversion between units of one quantity.

The units are listed in ``units.tsv``.
"""

from collections import defaultdict
from collections.abc import Mapping
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import NamedTuple


class Unit(NamedTuple):
    """A unit of a quantity: ``value in the base unit = value * scale + shift``."""

    quantity: str
    scale: Fraction
    shift: Fraction = Fraction(0)


Spellings = Mapping[str, Mapping[str, Unit]]
"""For the key of each spelling, its possible units by quantity."""
_FILE = Path(__file__).with_name("units.tsv")
_NONE = "none"
"""The quantity of spellings that mean "no unit"."""
_MOJIBAKE = (("Â", ""), ("Î¼", "µ"))
"""Repairs of UTF-8 texts that were read as Windows-1252."""
_LETTERS = str.maketrans(
    {
        "µ": "u",
        "μ": "u",
        "°": "deg",
        "º": "deg",
        "˚": "deg",
        "⁻": "-",
        "¹": "1",
        "·": "*",
    }
    | dict.fromkeys("()[]_. ")
)


def _key(text: str) -> str:
    """Return the text by which a spelling is looked up. Its case is unchanged."""
    for wrong, right in _MOJIBAKE:
        text = text.replace(wrong, right)
    text = text.strip()
    if text[:5].casefold() == "unit_":
        text = text[5:]
    return text.translate(_LETTERS)


@cache
def _tables() -> tuple[Spellings, Spellings, tuple[tuple[str, str], ...]]:
    """Read the file. Returns three tables:

    1. the spellings whose case matters,
    2. the spellings whose case does not matter,
    3. quantity and spelling to show of each unit.
    """
    exact: defaultdict[str, dict[str, Unit]] = defaultdict(dict)
    loose: defaultdict[str, dict[str, Unit]] = defaultdict(dict)
    shown = []
    for line in _FILE.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        quantity, scale, shift, cased, uncased = line.split("\t")
        unit = Unit(quantity, Fraction(scale), Fraction(shift))
        for text in filter(None, cased.split("|")):
            key = _key(text) or text
            exact[key][quantity] = unit
        for text in filter(None, uncased.split("|")):
            key = _key(text) or text
            loose[key.casefold()][quantity] = unit
        spellings = cased or uncased
        first, _, _ = spellings.partition("|")
        shown.append((quantity, first))
    return exact, loose, tuple(shown)


def meanings(text: str) -> Mapping[str, Unit]:
    """Return the possible units of a text by quantity. Empty if the text is unknown."""
    exact, loose, _ = _tables()
    key = _key(text) or text.strip()
    return exact.get(key) or loose.get(key.casefold(), {})


def says_nothing(text: str) -> bool:
    """Return True for an empty text, and for a text that means "no unit"."""
    return not text.strip() or _NONE in meanings(text)


def conversion(source: str, target: str) -> tuple[Fraction, Fraction] | None:
    """Return (m, b), so that ``value in target = value in source * m + b``.

    None if the two are not units of one quantity. A target without a unit means the source's unit.
    """
    if target == source or says_nothing(target):
        return Fraction(1), Fraction(0)
    source_units = meanings(source or "count")
    for quantity, target_unit in meanings(target).items():
        source_unit = source_units.get(quantity)
        if source_unit is not None:
            factor = source_unit.scale / target_unit.scale
            offset = (source_unit.shift - target_unit.shift) / target_unit.scale
            return factor, offset
    return None


def texts_like(source: str) -> list[str]:
    """Return a spelling of each unit to which a source's unit can be converted, for messages."""
    known = meanings(source or "count")
    return [text for quantity, text in _tables()[2] if quantity in known]


def shown(text: str) -> dict[str, str]:
    """Return the spelling to show of each possible unit of a text, by quantity."""
    found = {}
    for quantity, unit in meanings(text).items():
        for other, spelling in _tables()[2]:
            if other == quantity and meanings(spelling).get(quantity) is unit:
                found[quantity] = spelling
    return found


def names() -> tuple[str, ...]:
    """Return the spelling to show of every unit."""
    return tuple(dict.fromkeys(text for _, text in _tables()[2]))
