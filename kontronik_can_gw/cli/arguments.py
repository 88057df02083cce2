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
    (
        "service",
        "--prometheus",
    ): "Type kontronik-can-gw service install --metrics: a service of its own"
    " serves /metrics, and the gateway listens on nothing.",
    (
        "service",
        "--dry-run",
    ): "Give install --root DIR: the files are written below DIR and nothing else is done. uninstall prints what it removes.",
    (
        "service",
        "--print",
    ): "Give install --root DIR: the files are written below DIR and nothing else is done. uninstall prints what it removes.",
    (
        "service",
        "--force",
    ): "Leave it out: a file that was changed by hand stays. Remove it to have it written anew.",
    ("report", "--png"): "Give -o FILE: the page has the same plots, and prints them.",
    ("report", "--to"): "Type --until S.",
}
"""Removed options by command, as ("report", "--png"), and a sentence that says what to type instead.

A removed choice is written with its option: ("describe", "--format html"). Entries may be deleted a year after the removal.
"""


def number_from(
    low: float,
    high: float,
    what: str = "number of seconds",
    *,
    kind: Callable[[str], float] = float,
    problem: str | None = None,
) -> Callable[[str], float]:
    """An argparse type: a number within a range. ``kind``: ``int`` for whole ones; ``problem``: what is said of another text."""
    said = f"is not a {what}, {low:g} to {high:g}" if problem is None else problem

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} {said}")
        return value

    return read


rate = number_from(0.001, 1e6, problem="is no rate between 0.001 and 1000000")
"""A type for argparse: a rate in Hz."""


def seconds_ns(text: str) -> int:
    """A type for argparse: seconds as ns."""
    from decimal import Decimal, InvalidOperation

    try:
        number = Decimal(text)
        if number.is_finite() and 0 <= number < 10**9:
            return int(number * 10**9)
    except InvalidOperation:
        pass
    raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds")


def names(text: str) -> list[str]:
    """A type for argparse: names with commas between."""
    found = [name.strip() for name in text.split(",") if name.strip()]
    if not found:
        raise argparse.ArgumentTypeError("give names of signals, with commas between")
    return found


def refuse_removed_options(command: str | None, words: Sequence[str], rejected: str = "") -> None:
    """UserError with the replacement where a command line has a removed option.

    ``rejected``: argparse's message about the command line: the beginning of a removed option that is named in it counts too.
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
