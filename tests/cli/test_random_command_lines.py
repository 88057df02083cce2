"""No command line ends with a traceback or an exit code that docs/operation.md does not list."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.promise("one-line")

SEED = 41
COUNT = 2000
PARTS = 2
"""Each imports all libraries, which takes as long as a hundred command lines."""


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """Return a folder in which an ordinary user can write, even if this is root."""
    folder = Path(tempfile.mkdtemp(prefix="kcg-lines.", dir="/tmp"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder)


@pytest.mark.parametrize("part", range(PARTS))
def test_random_command_lines_end_with_a_listed_code(part: int, open_folder: Path) -> None:
    number = COUNT // PARTS
    script = Path(__file__).with_name("random_command_lines.py")
    words = [open_folder, SEED, part * number, number]
    done = subprocess.run(
        [sys.executable, script, *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
