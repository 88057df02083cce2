"""Proves the DBCs of real cars that `check` accepts: a step of `make release`.

python -m pytest tests/proofs/real_dbcs.py
"""

from pathlib import Path

import pytest
from test_corpus import ESCS, FILES, accepted

from kontronik_can_gw.desk.proof.proof import Proof


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_each_real_dbc_is_proven_except_floats_and_crcs(file: Path) -> None:
    """For each node of a DBC that ``check`` accepts, with signals bound by their units."""
    for database, layout, settings in accepted(file):
        findings = Proof(database, layout, ESCS, settings).complete()
        assert findings.refuted == []
        assert findings.refuted_signals == []
        for line in findings.unproven:
            assert line.endswith((": a float", "data id are compared"))
