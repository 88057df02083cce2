"""Proves the DBCs of real cars that `check` accepts: a step of `make release`.

python -m pytest -s tests/proofs/real_dbcs.py
"""

from pathlib import Path

import pytest
from dbc_proof.proof import IS_CRC, IS_FLOAT, Proof
from test_corpus import ESCS, FILES, accepted

from kontronik_can_gw.signals.plan import Role

pytestmark = pytest.mark.promise("proven-dbc")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_each_real_dbc_is_proven_except_floats_and_crcs(file: Path) -> None:
    """For each node of a DBC that ``check`` accepts, with signals bound by their units."""
    for database, layout, settings in accepted(file):
        findings = Proof(database, layout, ESCS, settings).complete()
        assert findings.refuted == []
        assert findings.refuted_signals == []
        for line in findings.unproven:
            assert line.partition(": ")[2] in (IS_FLOAT, IS_CRC)


def test_enough_real_dbcs_and_bound_signals_are_proven() -> None:
    """Without this test, all others would pass if ``check`` refused every DBC."""
    files: set[Path] = set()
    layouts = bound = signals = 0
    for file in FILES:
        for _, layout, _ in accepted(file):
            files.add(file)
            layouts += 1
            for message in layout.messages:
                signals += len(message.signals)
                bound += sum(signal.role is Role.SOURCE for signal in message.signals)
    print(
        f"{len(files)} of {len(FILES)} DBCs of real cars have a node that check accepts: "
        f"{layouts} nodes with {signals} signals, {bound} of them bound to values"
    )
    assert len(files) >= 60
    assert layouts >= 250
    assert bound >= 1000
