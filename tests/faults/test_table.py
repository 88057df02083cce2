"""The table in docs/fault-programme.md is the programme's own: it names every fault there is, and shows no wrong and no lost value."""

from pathlib import Path

from fault_report import FAULTS, Row, in_order
from table import BEGIN, END, parse, put, table

PAGE = Path(__file__).resolve().parents[2] / "docs" / "fault-programme.md"


def test_the_page_names_exactly_the_faults_that_the_programme_has() -> None:
    shown = [(row["machine"], row["fault"]) for row in parse(PAGE.read_text())]
    assert shown == [(fault.machine, str(fault)) for fault in in_order()]


def test_the_page_shows_that_all_were_healed_without_a_wrong_or_lost_value() -> None:
    found = parse(PAGE.read_text())
    assert found
    for row in found:
        assert int(row["injected"]) > 0, row
        assert row["recovered"] == row["injected"], row
        assert (row["wrong values"], row["values lost"], row["state"]) == ("0", "0", "good"), row


def test_a_table_is_put_between_the_markers_and_read_again() -> None:
    rows = [Row(f.machine, f.area, f.name, f.limit_s, 3, 3, 0.25) for f in reversed(FAULTS)]
    text = put(f"before\n{BEGIN}\nold\n{END}\nafter\n", table(rows))
    assert text.startswith(f"before\n{BEGIN}\n| machine |")
    assert text.endswith(f"{END}\nafter\n")
    assert "old" not in text
    assert [row["fault"] for row in parse(text)] == [str(f) for f in in_order()]


def test_what_went_wrong_is_shown_and_not_good() -> None:
    row = Row("UML", "Serial", "x", 2.0, injected=3, recovered=3, worst_s=0.1, wrong=1)
    assert not row.good
    assert "| 1 | 0 | failed |" in table([row])
    assert not Row("UML", "Serial", "x", 2.0, injected=3, recovered=2).good
    assert not Row("UML", "Serial", "x", 2.0).good, "never injected"
