"""What several commands ask of their options."""

import argparse
from collections.abc import Callable


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
