"""FaultLog writes a line when a condition begins and one when it ends. Time is passed in."""

import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.runtime.system.fault_log import FLAPPING, MINUTE, FaultLog
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("fault-log")

NAME = "kontronik_can_gw"


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO, NAME)
    return caplog


def test_condition_is_logged_when_it_begins_and_when_it_ends(
    told: pytest.LogCaptureFixture,
) -> None:
    conditions = FaultLog()
    for now in range(10):
        conditions.begin("port", "gone", now * SECOND)
    assert conditions.is_on("port")
    assert conditions.reason("port") == "gone"
    conditions.end("port", "back", 75 * SECOND, "; 3 errors")
    conditions.end("port", "back", 76 * SECOND)
    assert told.messages == ["gone", "back, after 75.0 s; 3 errors"]
    assert [record.levelname for record in told.records] == ["WARNING", "INFO"]
    assert not conditions.is_on("port")
    assert conditions.reason("port") == ""


def test_flapping_condition_is_logged_again_when_it_is_stable(
    told: pytest.LogCaptureFixture,
) -> None:
    conditions = FaultLog()
    now = 0
    for _ in range(300):  # ten minutes: lost for a second, then back for a second
        conditions.begin(NAME, "lost", now)
        conditions.end(NAME, "ok", now + SECOND)
        now += 2 * SECOND
        conditions.advance(now)
    assert told.messages[-1].startswith("lost. This happens often.")
    assert len(told.messages) == 2 * FLAPPING - 1
    conditions.advance(now + MINUTE)
    assert told.messages[-1] == (
        f"{NAME}: happened 294 more times, but no longer often. It has ended."
    )
    conditions.begin(NAME, "lost", now + MINUTE)
    assert told.messages[-1] == "lost"


@given(st.lists(st.tuples(st.sampled_from("ab"), st.booleans(), st.integers(1, 20)), max_size=400))
def test_flapping_condition_logs_a_bounded_number_of_lines(
    happenings: list[tuple[str, bool, int]],
) -> None:
    conditions = FaultLog()
    now = 0
    lines = 0
    conditions.keep_back()
    for name, begins, seconds in happenings:
        now += seconds * SECOND
        if begins:
            conditions.begin(name, "bad", now)
        else:
            conditions.end(name, "good", now)
        conditions.advance(now)
    assert conditions._held is not None
    lines = len(conditions._held)
    assert lines <= 2 * (now // MINUTE + 1) * (2 * FLAPPING + 1)
