"""Decimation keeps every extreme exactly and never joins over a gap, however the rows are cut into chunks."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.offline.report.decimate import LEAST_POINTS, Decimator, Number, Points

NUMBERS = st.one_of(st.none(), st.integers(-50, 50))
ROWS = st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=300)
STEPS = st.lists(st.integers(0, 5), min_size=300, max_size=300)


def decimated(rows: list[tuple[Number, Number]], times: list[int], points: int, cuts: list[int]) -> tuple[Points, int]:
    decimator = Decimator(2, points)
    at = 0
    for cut in [*cuts, len(rows)]:
        part = rows[at : at + cut]
        if part:
            decimator.feed(times[at : at + len(part)], list(zip(*part, strict=True)))
        at += len(part)
    return decimator.finish(), decimator.rows_in_bucket


def times_of(rows: list[tuple[Number, Number]], steps: list[int]) -> list[int]:
    times = [0]
    for step in steps[: len(rows) - 1]:
        times.append(times[-1] + step)
    return times


@given(ROWS, STEPS, st.integers(1, 64), st.lists(st.integers(0, 40), max_size=10))
def test_extremes_survive_exactly(
    rows: list[tuple[Number, Number]], steps: list[int], points: int, cuts: list[int]
) -> None:
    found, _ = decimated(rows, times_of(rows, steps), points, cuts)
    for before, after in zip(zip(*rows, strict=True), found.columns, strict=True):
        known = [value for value in before if value is not None]
        kept = [value for value in after if value is not None]
        assert bool(known) == bool(kept)
        if known:
            assert (min(kept), max(kept)) == (min(known), max(known))
        assert set(kept) <= set(known)


@given(ROWS, STEPS, st.integers(1, 64), st.lists(st.integers(0, 40), max_size=10))
def test_times_never_fall_and_span_the_whole(
    rows: list[tuple[Number, Number]], steps: list[int], points: int, cuts: list[int]
) -> None:
    times = times_of(rows, steps)
    found, bucket = decimated(rows, times, points, cuts)
    assert all(a <= b for a, b in pairwise(found.times))
    assert (found.times[0], found.times[-1]) == (times[0], times[-1])
    assert all(len(column) == len(found.times) for column in found.columns)
    most = max(points, LEAST_POINTS)
    assert len(found.times) <= (most if bucket == 1 else 2 * most)


@given(ROWS, STEPS, st.integers(1, 64), st.lists(st.integers(0, 40), max_size=10))
def test_a_gap_is_never_joined(
    rows: list[tuple[Number, Number]], steps: list[int], points: int, cuts: list[int]
) -> None:
    """Wherever rows have a None, the points have one between the values before and behind it, at most a bucket beside its place."""
    times = list(range(len(rows)))
    found, bucket = decimated(rows, times, points, cuts)
    for before, after in zip(zip(*rows, strict=True), found.columns, strict=True):
        gaps = [at for at, value in enumerate(after) if value is None]
        for at, value in enumerate(before):
            if value is None:
                assert any(abs(found.times[gap] - times[at]) < bucket for gap in gaps), at
        if None not in before:
            assert None not in after


@given(ROWS, STEPS, st.integers(1, 64), st.lists(st.integers(0, 40), max_size=10))
def test_chunks_do_not_matter(
    rows: list[tuple[Number, Number]], steps: list[int], points: int, cuts: list[int]
) -> None:
    times = times_of(rows, steps)
    one, _ = decimated(rows, times, points, [])
    many, _ = decimated(rows, times, points, cuts)
    assert (one.times, one.columns) == (many.times, many.columns)


@given(ROWS, STEPS)
def test_nothing_changes_where_there_is_room(rows: list[tuple[Number, Number]], steps: list[int]) -> None:
    times = times_of(rows, steps)
    found, bucket = decimated(rows, times, 300, [])
    assert bucket == 1
    assert found.times == times
    assert list(zip(*found.columns, strict=True)) == rows


def test_the_values_of_a_bucket_keep_their_order() -> None:
    decimator = Decimator(1, 8)
    decimator.feed(range(64), [[*range(32), *range(32, 0, -1)]])
    points = decimator.finish()
    assert points.columns[0] == [*(v for v in range(32) if v % 16 in (0, 15)), 32, 17, 16, 1]
    assert points.times == [0, 15, 16, 31, 32, 47, 48, 63]
