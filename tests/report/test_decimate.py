"""Decimation keeps every extreme exactly and never joins over a gap, however the rows are cut into chunks."""

from collections.abc import Sequence
from itertools import accumulate, pairwise

from hypothesis import given, settings
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


SPARSE = st.lists(st.tuples(st.integers(0, 3999), st.integers(0, 2)), max_size=60)


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
    found = decimator.finish()
    assert_gaps_are_kept(rows, times, found)
    drawn, _ = found
    assert all(a <= b for a, b in pairwise(drawn))
    assert (drawn[0], drawn[-1]) == (times[0], times[-1])
    edges = sum(
        (a is None) is not (b is None) for one in zip(*rows, strict=True) for a, b in pairwise(one)
    )
    assert len(drawn) <= max(points, MIN_POINTS) + 2 * edges


@settings(max_examples=40, deadline=None)
@given(SPARSE, st.integers(1, 400), st.integers(1, 4000))
def test_a_single_row_without_a_value_is_a_gap_among_thousands(
    gaps: list[tuple[int, int]], points: int, chunk: int
) -> None:
    """Telemetry that is lost is one row with None: the next comes when it is back, seconds later."""
    columns: list[list[Number]] = [[(at * step) % 977 for at in range(4000)] for step in (1, 0, 7)]
    times, now = [], 0
    rows_lost = {at for at, _ in gaps}
    for at in range(4000):
        times.append(now)
        now += 2_800_000_000 if at in rows_lost else 10_000_000
    for at, column in gaps:
        columns[column][at] = None
    decimator = Decimator(3, points)
    for at in range(0, 4000, chunk):
        decimator.feed(times[at : at + chunk], [column[at : at + chunk] for column in columns])
    found = decimator.finish()
    assert_gaps_are_kept(list(zip(*columns, strict=True)), times, found)
    assert len(found[0]) <= max(points, MIN_POINTS) + 4 * len(gaps) + 2
