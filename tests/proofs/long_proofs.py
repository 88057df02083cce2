"""The proofs that need longer than `make prove` allows: a step of `make release`.

python -m pytest -s tests/proofs/long_proofs.py
"""

from pathlib import Path

import pytest
from every_value import compare_values
from scaled_frames import WHOLE_PREFIX
from test_dbc_proof import ONE_ESC
from test_every_value import configuration
from test_small_scope import SYMBOLS_IN_C, prove_in_c

pytestmark = [
    pytest.mark.promise("proven-dbc"),
    pytest.mark.usefixtures("c_compiler"),
]


@pytest.mark.promise("brute-force")
def test_all_short_streams_give_the_frames_of_brute_force_with_the_whole_prefix(
    tmp_path: Path,
) -> None:
    prove_in_c(tmp_path, WHOLE_PREFIX, SYMBOLS_IN_C)


def test_every_electrical_speed_is_packed_as_the_dbc_demands(tmp_path: Path) -> None:
    assert compare_values(configuration(tmp_path, ONE_ESC), "speed").values == (1 << 32) + 1


def test_every_power_is_packed_as_the_dbc_demands(tmp_path: Path) -> None:
    """Every battery voltage with every battery current."""
    assert compare_values(configuration(tmp_path, ONE_ESC), "power").values == (1 << 32) + 1
