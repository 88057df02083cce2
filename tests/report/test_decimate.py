"""Decimation keeps every extreme exactly and never joins over a gap, however the rows are cut into chunks."""

from collections.abc import Sequence
from itertools import accumulate, pairwise

from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.desk.report.decimate import MIN_POINTS, Decimator
from kontronik_can_gw.desk.report.flight import Number

NUMBERS = st.one_of(st.none(), st.integers(-50, 50))
ROWS = st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=300)
STEPS = st.lists(st.integers(1, 5), min_size=300, max_size=300)


def assert_gaps_are_kept(
    rows: Sequence[Sequence[Number]], times: list[int], found: tuple[list[int], list[list[Number]]]
) -> None:
    """No line is drawn over, from or to the time of a row without value; each value that is drawn is one of its rows."""
    drawn, columns = found
    for before, after in zip(zip(*rows, strict=True), columns, strict=True):
        lines = [
            (drawn[at], drawn[at + 1])
            for at, (a, b) in enumerate(pairwise(after))
            if a is not None and b is not None
        ]
        for time, value in zip(times, before, strict=True):
            if value is None:
                assert not [line for line in lines if line[0] <= time <= line[1]], time
        if None not in before:
            assert None not in after
        known = [value for value in before if value is not None]
        kept = [value for value in after if value is not None]
        assert set(kept) <= set(known)
        if known:
            assert (min(kept), max(kept)) == (min(known), max(known))


@given(
    ROWS,
    STEPS,
    st.integers(1, 64),
    st.lists(st.integers(0, 40), max_size=10),
)
def test_gaps_and_extremes_are_kept_however_the_rows_are_cut(
    rows: list[tuple[Number, Number]], steps: list[int], points: int, cuts: list[int]
) -> None:
    times = list(accumulate(steps[: len(rows) - 1], initial=0))
    decimator = Decimator(2, points)
    at = 0
    for cut in [*cuts, len(rows)]:
        if part := rows[at : at + cut]:
            decimator.feed(times[at : at + len(part)], list(zip(*part, strict=True)))
        at += len(part)
    found = decimator.times, decimator.columns
    assert_gaps_are_kept(rows, times, found)
    drawn, _ = found
    assert all(a <= b for a, b in pairwise(drawn))
    assert (drawn[0], drawn[-1]) == (times[0], times[-1])
    edges = sum(
        (a is None) is not (b is None) for one in zip(*rows, strict=True) for a, b in pairwise(one)
    )
    assert len(drawn) <= max(points, MIN_POINTS) + 2 * edges
