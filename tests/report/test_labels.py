"""Labels above a plot: none over another, no line through a text, each with its text where there is room."""

from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.offline.report.labels import Label, place

LABELS = st.lists(
    st.builds(Label, st.integers(-50, 1100), st.integers(20, 300), st.integers(8, 20), st.integers(0, 2)), max_size=30
).map(lambda labels: sorted(labels, key=lambda label: label.x))


@given(LABELS, st.integers(1, 4))
def test_labels_never_stand_over_each_other(labels: list[Label], rows: int) -> None:
    place(labels, 0, 1000, rows)
    boxes = []
    for label in labels:
        if label.row is not None:
            assert 0 <= label.row < rows
            boxes.append((label.row, label.left, label.left + label.width))
        if label.badge_left is not None:
            boxes.append((0, label.badge_left, label.badge_left + label.badge))
    assert all(left >= 0 and right <= 1000 for _, left, right in boxes)
    for at, (row, left, right) in enumerate(boxes):
        assert not [b for b in boxes[:at] if b[0] == row and b[1] < right and left < b[2]]
    for label in labels:
        if label.row is not None and label.x >= 0:
            assert not [b for b in boxes if b[0] < label.row and b[1] < label.x < b[2]]


@given(st.lists(st.integers(0, 9), min_size=1, max_size=10, unique=True), st.integers(1, 4))
def test_all_have_their_text_where_there_is_room(places: list[int], rows: int) -> None:
    labels = [Label(100 * at, 85, 10) for at in sorted(places)]
    place(labels, 0, 1000, rows)
    assert all(label.row == 0 and label.badge_left is None for label in labels)


def test_texts_that_overlap_stand_in_steps_and_the_last_ones_lowest() -> None:
    labels = [Label(100, 200, 10), Label(100, 200, 10), Label(250, 200, 10), Label(250, 200, 10)]
    place(labels, 0, 1000, 4)
    assert [label.row for label in labels] == [3, 2, 1, 0]


def test_without_room_errors_have_their_text_before_warnings_and_all_have_numbers() -> None:
    labels = [Label(100, 200, 10, 1), Label(150, 200, 10, 0), Label(200, 200, 10, 1), Label(950, 200, 10, 1)]
    place(labels, 0, 1000, 2)
    assert [label.row for label in labels] == [None, 1, None, None]
    assert all(label.badge_left is not None for label in labels)
