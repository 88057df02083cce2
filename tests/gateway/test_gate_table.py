"""The gate's table in the docs is the one of the code, and no row hides another.

python tests/gateway/test_gate_table.py      prints the rows of the docs
"""

from pathlib import Path

import pytest

from kontronik_can_gw.gateway.gate_table import (
    NO_PORT,
    PASSING,
    TABLE,
    WAITING,
    If,
    Row,
    State,
)

pytestmark = pytest.mark.promise("gate")

DESIGN = Path(__file__).parents[2] / "docs" / "design.md"
HEAD = "| state | event | condition | next state | acts |"
GROUPS = {"*passing*": PASSING, "*stopped*": WAITING, "*unusable*": NO_PORT}
"""Groups of states, by their names in the docs."""


def names(states: tuple[State, ...]) -> str:
    """Return the states as the docs list them."""
    return ", ".join(state.value for state in states)


def line_of(row: Row) -> str:
    """Return a row of the table as Markdown."""
    states = names(row.states)
    for group, members in GROUPS.items():
        states = states.replace(names(members), group)
    after = row.after.value if row.after else ""
    acts = "; ".join(act.value for act in row.acts)
    cells = [states, row.event.value, row.condition.value, after, acts]
    return " ".join(["|", *[f"{cell} |" if cell else "|" for cell in cells]])


def lines_in_the_docs() -> list[str]:
    """Return the rows of all tables with this head."""
    found = []
    is_row = False
    for line in DESIGN.read_text(encoding="utf-8").splitlines():
        is_row = line == HEAD or (is_row and line.startswith("|"))
        if is_row and line != HEAD and not line.startswith("|---"):
            found.append(line)
    return found


def test_table_of_the_gate_in_the_docs_is_the_one_of_the_code() -> None:
    assert lines_in_the_docs() == [line_of(row) for row in TABLE]


@pytest.mark.parametrize("group", GROUPS)
def test_group_of_states_in_the_docs_is_the_one_of_the_code(group: str) -> None:
    assert f"\n| {group} | {names(GROUPS[group])} |" in DESIGN.read_text(encoding="utf-8")


def test_no_row_follows_another_that_is_always_true() -> None:
    seen: set[tuple[State, object]] = set()
    for row in TABLE:
        for state in row.states:
            assert (state, row.event) not in seen, f"never followed: {row}"
            if row.condition is If.ALWAYS:
                seen.add((state, row.event))


if __name__ == "__main__":
    print("\n".join(line_of(row) for row in TABLE))
