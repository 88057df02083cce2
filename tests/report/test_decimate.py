"""Decimation keeps every extreme exactly and never draws over a gap, for any chunks of rows."""

from collections.abc import Sequence
from itertools import accumulate, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.desk.report.esc import Number
from kontronik_can_gw.desk.report.flight import MIN_POINTS, Decimator

pytestmark = pytest.mark.promise("report")

NUMBERS = st.one_of(st.none(), st.integers(-50, 50))
ROWS = st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=300)
STEPS = st.lists(st.integers(1, 5), min_size=300, max_size=300)


@given(
    ROWS,
    STEPS,
    st.integers(1, 64),
    st.lists(st.integers(0, 40), max_size=10),
)
def test_gaps_and_extremes_are_kept_for_any_blocks_of_rows(
    rows: list[tuple[Number, Number]],
    steps: list[int],
    points: int,
    cuts: list[int],
) -> None:
    times = list(accumulate(steps[: len(rows) - 1], initial=0))
    decimator = Decimator(2, points)
    at = 0
    for cut in [*cuts, len(rows)]:
        part = rows[at : at + cut]
        end = at + len(part)
        if part:
            decimator.feed(times[at:end], list(zip(*part, strict=True)))
        at = end
    drawn = decimator.times
    assert drawn == sorted(drawn)
    assert drawn[0] == times[0]
    assert drawn[-1] == times[-1]
    columns = list(zip(*rows, strict=True))
    for before, after in zip(columns, decimator.columns, strict=True):
        check_column(times, before, drawn, after)
    edges = sum(map(edges_of, columns))
    assert len(drawn) <= max(points, MIN_POINTS) + 2 * edges


def check_column(
    times: Sequence[int],
    before: Sequence[Number],
    drawn: Sequence[int],
    after: Sequence[Number],
) -> None:
    """Compare a column with its decimated form: times and values before and after."""
    lines = []
    points = zip(drawn, after, strict=True)
    for (begin, first), (end, last) in pairwise(points):
        if first is not None and last is not None:
            lines.append((begin, end))
    missing = [time for time, value in zip(times, before, strict=True) if value is None]
    for time in missing:
        # no line is drawn over, from or to the time of a row without a value
        assert not any(begin <= time <= end for begin, end in lines)
    assert missing or None not in after
    known = [value for value in before if value is not None]
    kept = [value for value in after if value is not None]
    assert set(kept) <= set(known)
    if known:
        assert min(kept) == min(known)
        assert max(kept) == max(known)


def edges_of(column: Sequence[Number]) -> int:
    """Count the changes between a value and a missing value."""
    is_missing = [value is None for value in column]
    return sum(before is not after for before, after in pairwise(is_missing))
