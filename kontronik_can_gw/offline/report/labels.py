"""Where the texts of marks stand above a plot. Pure; as page.js does it, so that a picture has the same labels as the page.

Each text begins at its mark, in the lowest row with room, and no line that leads from a mark up to its text runs through another text.
Where not all find room each mark has a number in the lowest row, and what still finds room its text above; who is without is told below.
"""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass
class Label:
    """A mark at ``x``. ``width``: of its text, ``badge``: of its number; ``rank``: lower ones get their text first. Lengths in pixels."""

    x: float
    width: float
    badge: float
    rank: int = 0
    row: int | None = None
    """Of the text, from below; None: no room."""
    left: float = 0.0
    """Where the text begins."""
    badge_left: float | None = None
    """Where the number begins, in the lowest row; None: it has none."""


class _Rows:
    """What stands in the rows: texts and numbers from..to, and leading lines."""

    def __init__(self, count: int, low: float, high: float) -> None:
        self._low, self._high = low, high
        self._texts: list[list[tuple[float, float]]] = [[] for _ in range(count)]
        self._lines: list[list[float]] = [[] for _ in range(count)]

    def is_free(self, row: int, left: float, right: float) -> bool:
        return all(right <= begin or left >= end for begin, end in self._texts[row])

    def take(self, row: int, left: float, right: float) -> None:
        self._texts[row].append((left, right))

    def put(self, label: Label, first: int) -> bool:
        """The text into the lowest row from ``first`` on; False: no room."""
        left = max(label.x, self._low) + 4
        right = left + label.width + 6
        if right > self._high:
            return False
        leads = label.x >= self._low
        for row in range(first, len(self._texts)):
            if not self.is_free(row, left, right) or any(left < x < right for x in self._lines[row]):
                continue
            if leads and not all(self.is_free(below, label.x - 1, label.x + 1) for below in range(row)):
                return False
            self.take(row, left, right)
            if leads:
                for below in range(row):
                    self._lines[below].append(label.x)
            label.row, label.left = row, left
            return True
        return False


def place(labels: Sequence[Label], low: float, high: float, rows: int) -> None:
    """Give the labels, in order of ``x``, their places between low and high."""
    found = _Rows(rows, low, high)
    backwards = list(reversed(labels))  # an earlier text that has no room beside a later one stands above it
    if all(found.put(label, 0) for label in backwards):
        return
    found = _Rows(rows, low, high)
    for label in labels:
        label.row = None
        left = min(max(label.x, low) + 2, high - label.badge)
        last = left + 3 * label.badge
        while left <= last and not found.is_free(0, left, left + label.badge):
            left += 1
        if left <= last and left + label.badge <= high:
            found.take(0, left, left + label.badge)
            label.badge_left = left
    for label in sorted(backwards, key=lambda label: label.rank):
        found.put(label, 1)
