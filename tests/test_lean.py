"""What is imported with python-can and cantools, each in a fresh interpreter; and that cantools is whole for who asks for more of it."""

import subprocess
import sys

import pytest

LEAN = "import sys; from kontronik_can_gw.lean import without_asammdf\n"
DATABASE = f"{LEAN}with without_asammdf(): import cantools.database\n"
WHOLE = f"""{DATABASE}
import cantools
before = cantools.database
from cantools import Error, database
print('can' in sys.modules, hasattr(cantools, 'nothing_of_this_name'), Error.__name__)
print(cantools.tester.Tester.__name__, before is cantools.database, 'can' in sys.modules)
"""


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (WHOLE, "True False Error\nTester True True"),
        (f"import cantools; before = cantools\n{DATABASE}print(before is cantools)", "True"),
        (
            f"{LEAN}with without_asammdf(): import can\nprint('asammdf' in sys.modules); import asammdf",
            "False",
        ),
    ],
    ids=[
        "cantools is whole for who asks for more",
        "a cantools that is there already stays",
        "asammdf can be imported afterwards",
    ],
)
def test_libraries_come_alone_and_whole(code: str, said: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, said), done.stderr
