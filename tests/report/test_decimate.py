"""Decimation keeps every extreme exactly and never joins over a gap, however the rows are cut into chunks."""

from itertools import accumulate, pairwise

from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.desk.report.esc import Number
from kontronik_can_gw.desk.report.flight import MIN_POINTS, Decimator

NUMBERS = st.one_of(st.none(), st.integers(-50, 50))
ROWS = st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=300)
STEPS = st.lists(st.integers(1, 5), min_size=300, max_size=300)


@given(ROWS, STEPS, st.integers(1, 64), st.lists(st.integers(0, 40), max_size=10))
def test_gaps_and_extremes_are_kept_for_any_blocks_of_rows(
    rows: list[tuple[Number, Number]], steps: list[int], points: int, cuts: list[int]
) -> None:
    times = list(accumulate(steps[: len(rows) - 1], initial=0))
    decimator = Decimator(2, points)
    at = 0
    for cut in [*cuts, len(rows)]:
        if part := rows[at : at + cut]:
            decimator.feed(times[at : at + len(part)], list(zip(*part, strict=True)))
        at += len(part)
    drawn = decimator.times
    assert drawn == sorted(drawn)
    assert (drawn[0], drawn[-1]) == (times[0], times[-1])
    for before, after in zip(zip(*rows, strict=True), decimator.columns, strict=True):
        pairs = pairwise(zip(drawn, after, strict=True))
        lines = [(t0, t1) for (t0, a), (t1, b) in pairs if a is not None and b is not None]
        # no line is drawn over, from or to the time of a row without value
        missing = [time for time, value in zip(times, before, strict=True) if value is None]
        assert not [at for at in missing for begin, end in lines if begin <= at <= end]
        assert missing or None not in after
        known, kept = ([v for v in values if v is not None] for values in (before, after))
        assert set(kept) <= set(known)
        assert not known or (min(kept), max(kept)) == (min(known), max(known))
    edges = sum(
        (a is None) is not (b is None) for one in zip(*rows, strict=True) for a, b in pairwise(one)
    )
    assert len(drawn) <= max(points, MIN_POINTS) + 2 * edges
