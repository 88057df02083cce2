"""examples/receiver, the pattern for tests of a receiver, runs as docs/testing-your-receiver.md has it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples/receiver"
pytestmark = pytest.mark.extended


def test_the_example_passes(vcan: str) -> None:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull]
    done = subprocess.run(
        [*command, "--rootdir", ".", "."],
        cwd=FOLDER,
        env=os.environ | {"CAN_CHANNEL": vcan, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "5 passed" in done.stdout
