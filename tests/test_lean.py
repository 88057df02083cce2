"""What is imported with python-can and cantools, each in a fresh interpreter; and that cantools is whole for who asks for more of it."""

import subprocess
import sys


def result(code: str) -> str:
    """What a program prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


LEAN = "import sys; from kontronik_can_gw.lean import without_asammdf\n"
DATABASE = f"{LEAN}with without_asammdf(): import cantools.database\n"


def test_the_database_of_cantools_comes_without_python_can() -> None:
    assert (
        result(
            f"{DATABASE}print([m for m in ('can', 'asammdf', 'asyncio', 'cantools.tester') if m in sys.modules])"
        )
        == "[]"
    )


def test_cantools_is_whole_for_who_asks_for_more() -> None:
    code = (
        "import cantools; before = cantools.database; from cantools import Error, database\n"
        "print('can' in sys.modules, hasattr(cantools, 'nothing_of_this_name'), Error.__name__, database.Database.__name__)\n"
        "print(cantools.tester.Tester.__name__, cantools.__version__ > '4', before is cantools.database, 'can' in sys.modules)"
    )
    assert result(f"{DATABASE}{code}") == "True False Error Database\nTester True True True"


def test_a_cantools_that_is_there_already_stays() -> None:
    code = "import cantools; before = cantools\nfrom kontronik_can_gw.lean import without_asammdf\n"
    assert (
        result(f"{code}with without_asammdf(): import cantools.database\nprint(before is cantools)")
        == "True"
    )


def test_a_database_is_read_as_ever() -> None:
    code = "from pathlib import Path; from kontronik_can_gw.config.keys import shipped; from kontronik_can_gw.dbc import reader\n"
    code += "database = reader.load_database(shipped('dbc/kontronik_esc.dbc')); import cantools.database, sys\n"
    code += "whole = cantools.database.load_file(shipped('dbc/kontronik_esc.dbc'))\n"
    code += "print(len(database.messages) == len(whole.messages) > 5, 'can' in sys.modules)"
    assert result(code) == "True False"


def test_asammdf_can_be_imported_afterwards() -> None:
    assert (
        result(
            f"{LEAN}with without_asammdf(): import can\nprint('asammdf' in sys.modules); import asammdf"
        )
        == "False"
    )
