"""The plug is pulled at every write: real file systems, in User Mode Linux.

KCG_PLUG_STATES is the number of states of all file systems together.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.promise("parameters", "captures", "unstoppable")

PROJECT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.usefixtures("c_compiler")  # for the time of the virtual machine
STATES = int(os.environ.get("KCG_PLUG_STATES", "200"))
SHARES = {"ext4": 0.4, "f2fs": 0.4, "vfat": 0.2}
SECONDS_A_STATE = 2


@pytest.mark.parametrize("system", SHARES)
def test_each_state_after_a_loss_of_power_is_good(system: str, tmp_path: Path) -> None:
    states = round(STATES * SHARES[system])
    words = [
        sys.executable,
        PROJECT / "tests/vm/vm_run.py",
        "--backend=uml",
        f"--timeout={300 + SECONDS_A_STATE * states}",
        f"--rw={tmp_path}",
        "--",
        sys.executable,
        "-B",
        PROJECT / "tests/plug/cuts.py",
        system,
        f"--states={states}",
        f"--folder={tmp_path}",
    ]
    folders = [str(PROJECT), str(PROJECT / "tests/faults")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    # The output appears while it runs, because it takes long.
    done = subprocess.run(
        list(map(str, words)),
        cwd=PROJECT,
        env=environment,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    file = tmp_path / f"{system}.json"
    assert file.exists(), "the virtual machine ended too early, see the output"
    figures = json.loads(file.read_text())
    assert figures["bad"] == 0, "\n".join(figures["shown"])
    assert figures["states"] >= states
    assert done.returncode == 0
