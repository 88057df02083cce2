"""The golden set: what 0.5.0 made of twenty inputs, and what is made of them now. `make golden` records it anew; see README.md."""

from pathlib import Path

import pytest
import record


@pytest.mark.parametrize("file", record.files(), ids=lambda file: str(file.relative_to(record.HERE)))
def test_nothing_has_changed(file: Path) -> None:
    found = record.changes(file, record.made(file))
    assert not found, "\n".join([*found, "If this is meant: make golden, and commit what it says with the change."])
