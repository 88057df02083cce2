"""The table in docs/fault-programme.md is the programme's own: it names every fault there is, and shows no wrong and no lost value."""

import programme  # noqa: F401  registers the faults
from fault_report import FAULTS, PAGE, Report, Row, in_order, put, shown


def test_the_page_shows_each_fault_healed_without_a_wrong_or_lost_value() -> None:
    found = shown(PAGE.read_text())
    assert list(found) == [str(fault) for fault in in_order()]
    assert len(set(map(str, FAULTS))) == len(FAULTS)
    for fault, injected, recovered, _, *rest in found.values():
        assert int(injected) > 0 and recovered == injected, fault
        assert rest == ["0", "0", "good"], fault


def test_rows_that_were_run_take_the_place_of_older_ones_whatever_they_show() -> None:
    before = PAGE.read_text()
    fault = in_order()[3]
    row = Row(str(fault), 2.0, injected=3, recovered=3, worst_s=0.1, wrong=1)
    after = put(before, Report({str(fault): row}))
    changed = {key: cells for key, cells in shown(after).items() if shown(before)[key] != cells}
    assert changed == {str(fault): [str(fault), "3", "3", "0.10 s (limit 2 s)", "1", "0", "failed"]}
    assert put(before, Report()) == before
