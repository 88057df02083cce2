"""Unit texts as they are met in DBC files, and exact conversion between those of one quantity. The units stand in ``units.tsv``."""

from collections.abc import Mapping
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import NamedTuple


class Unit(NamedTuple):
    """``base value = value * scale + shift`` within one quantity."""

    quantity: str
    scale: Fraction
    shift: Fraction = Fraction(0)


Spellings = Mapping[str, Mapping[str, Unit]]
"""Key of a spelling -> by quantity the unit that it means."""
_NONE = "none"
_MOJIBAKE = (("Â", ""), ("Î¼", "µ"))
"""UTF-8 read as Windows-1252, as it stands in files that went through both."""
_LETTERS = str.maketrans(
    {"µ": "u", "μ": "u", "°": "deg", "º": "deg", "˚": "deg", "⁻": "-", "¹": "1", "·": "*"}
    | dict.fromkeys("()[]_. ")
)


def _key(text: str) -> str:
    """A spelling as it is compared where case matters."""
    for wrong, right in _MOJIBAKE:
        text = text.replace(wrong, right)
    text = text.strip()
    return (text[5:] if text[:5].casefold() == "unit_" else text).translate(_LETTERS)


@cache
def _tables() -> tuple[Spellings, Spellings, tuple[tuple[str, str], ...]]:
    """Spellings whose case matters, those in any case, and of each row quantity and the spelling to show."""
    exact: dict[str, dict[str, Unit]] = {}
    loose: dict[str, dict[str, Unit]] = {}
    shown = []
    for line in (Path(__file__).parent / "units.tsv").read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        quantity, scale, shift, cased, uncased = line.split("\t")
        unit = Unit(quantity, Fraction(scale), Fraction(shift))
        for text in filter(None, cased.split("|")):
            exact.setdefault(_key(text) or text, {})[quantity] = unit
        for text in filter(None, uncased.split("|")):
            loose.setdefault((_key(text) or text).casefold(), {})[quantity] = unit
        shown.append((quantity, (cased or uncased).split("|")[0]))
    return exact, loose, tuple(shown)


def meanings(text: str) -> Mapping[str, Unit]:
    """By quantity what a unit text can mean; empty for an unknown one."""
    exact, loose, _ = _tables()
    key = _key(text) or text.strip()
    return exact.get(key) or loose.get(key.casefold(), {})


def says_nothing(text: str) -> bool:
    """True for no text, and for one that says that there is no unit."""
    return not text.strip() or _NONE in meanings(text)


def conversion(source: str, target: str) -> tuple[Fraction, Fraction] | None:
    """(m, b) with ``value in target = value in source * m + b``; None where the two are not of one quantity.

    A target that says nothing means the source's own unit.
    """
    if target == source or says_nothing(target):
        return Fraction(1), Fraction(0)
    of_source = meanings(source or "count")
    for quantity, b in meanings(target).items():
        if (a := of_source.get(quantity)) is not None:
            return a.scale / b.scale, (a.shift - b.shift) / b.scale
    return None


def texts_like(source: str) -> list[str]:
    """A spelling of each unit that a source's unit can be converted to, for messages to people."""
    known = meanings(source or "count")
    return [text for quantity, text in _tables()[2] if quantity in known]


def names() -> tuple[str, ...]:
    """The spelling to show of every unit."""
    return tuple(dict.fromkeys(text for _, text in _tables()[2]))
