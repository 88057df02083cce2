"""What several commands ask of their options."""

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
"""Command and option of earlier versions, as ("report", "--png"), and what to type instead, as a sentence.

A choice of an option that stays is written with it: ("describe", "--format html"). Each may go a year after its removal.
"""


def number_from(low: float, high: float, what: str = "number of seconds") -> Callable[[str], float]:
    """A type for argparse: a number within a range."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {what}, {low:g} to {high:g}")
        return value

    return read


def refuse_removed_options(command: str | None, words: Sequence[str], rejected: str = "") -> None:
    """UserError with what to type instead, where a command line has an option that was removed.

    ``rejected``: what argparse says of the command line: the beginning of a removed option that is named in it counts too.
    """
    options = words[: words.index("--")] if "--" in words else words
    parts = [
        part
        for word in options
        for part in (word.split("=", 1) if word.startswith("--") else [word])
    ]
    for part, value in pairwise([*parts, ""]):
        for (of, option), advice in REMOVED_OPTIONS.items():
            name, _, choice = option.partition(" ")
            is_short = len(part) > 2 and name.startswith(part) and (choice or part) in rejected
            if of == command and (part == name or is_short) and choice in ("", value):
                raise UserError(f"{option}: was removed. {advice}")
