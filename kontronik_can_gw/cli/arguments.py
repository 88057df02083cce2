"""Checks of options that several commands share."""

import argparse
from collections.abc import Callable, Sequence
from itertools import pairwise

from kontronik_can_gw.errors import UserError

REMOVED_OPTIONS: dict[tuple[str, str], str] = {
    (
        "describe",
        "--format html",
    ): "Type kontronik-can-gw describe -o bus.md; pandoc -s bus.md -o bus.html makes a page of it.",
    (
        "describe",
        "--format man",
    ): "Type kontronik-can-gw --help, or kontronik-can-gw COMMAND --help.",
    ("report", "--png"): "Give -o FILE: the page has the same plots, and prints them.",
}
"""Removed options by command, as ("report", "--png"), and a sentence that says what to type instead.

A removed choice is written with its option: ("describe", "--format html"). Entries may be deleted a year after the removal.
"""


def number_from(low: float, high: float, what: str = "number of seconds") -> Callable[[str], float]:
    """An argparse type: a number within a range."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {what}, {low:g} to {high:g}")
        return value

    return read


def refuse_removed_options(command: str | None, words: Sequence[str]) -> None:
    """UserError with the replacement where a command line has a removed option."""
    options = words[: words.index("--")] if "--" in words else words
    parts = [
        part
        for word in options
        for part in (word.split("=", 1) if word.startswith("--") else [word])
    ]
    for part, value in pairwise([*parts, ""]):
        for option in (part, f"{part} {value}"):
            if advice := REMOVED_OPTIONS.get((command or "", option)):
                raise UserError(f"{option}: was removed. {advice}")
