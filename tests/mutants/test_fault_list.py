"""The list of faults fits the present code."""

import pytest
from put_in_faults import PROJECT, Fault, faults


@pytest.mark.parametrize("fault", faults(), ids=lambda fault: fault.what)
def test_each_fault_of_the_list_can_be_put_in(fault: Fault) -> None:
    file, changed = fault.put_in()
    assert changed != file.read_text()
    for tests in fault.seen_by:
        path, _, name = tests.partition("::")
        assert (PROJECT / path).exists()
        assert not name or f"def {name}(" in (PROJECT / path).read_text(encoding="utf-8")
