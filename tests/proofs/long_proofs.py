"""The proofs that need longer than `make prove` allows: a step of `make release`.

python -m pytest -s tests/proofs/long_proofs.py
"""

from pathlib import Path

from scaled_frames import WHOLE_PREFIX
from test_small_scope import SYMBOLS_IN_C, prove_in_c


def test_all_short_streams_give_the_frames_of_brute_force_with_the_whole_prefix(
    tmp_path: Path,
) -> None:
    prove_in_c(tmp_path, WHOLE_PREFIX, SYMBOLS_IN_C)
