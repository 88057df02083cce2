"""The gate's table in the docs is the one of the code, and no row hides another."""

from pathlib import Path

import pytest

from kontronik_can_gw.gateway.gate_table import TABLE, If, State

pytestmark = pytest.mark.promise("gate")

DESIGN = Path(__file__).parents[2] / "docs" / "design.md"
HEAD = ["| state | event | condition | next state | acts |", "|---|---|---|---|---|"]


def table() -> list[str]:
    """Return the lines of the table as Markdown."""
    lines = [*HEAD]
    for row in TABLE:
        states = ", ".join(state.value for state in row.states)
        after = row.after.value if row.after else ""
        acts = "; ".join(act.value for act in row.acts)
        cells = [states, row.event.value, row.condition.value, after, acts]
        lines.append(" ".join(["|", *[f"{cell} |" if cell else "|" for cell in cells]]))
    return lines


def test_table_of_the_gate_in_the_docs_is_the_one_of_the_code() -> None:
    lines = [*DESIGN.read_text().splitlines(), ""]
    begin = lines.index(HEAD[0])
    end = begin + lines[begin:].index("")
    assert lines[begin:end] == table()


def test_no_row_follows_another_that_is_always_true() -> None:
    seen: set[tuple[State, object]] = set()
    for row in TABLE:
        for state in row.states:
            assert (state, row.event) not in seen, f"never followed: {row}"
            if row.condition is If.ALWAYS:
                seen.add((state, row.event))


if __name__ == "__main__":
    print("\n".join(table()))
