"""The tests do not depend on how they were started.

They may run under nohup, in the background, or without a session.
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from built import ASK, PROGRAMS, there

from kontronik_can_gw.runtime.system.folders import runtime_folder

pytestmark = pytest.mark.promise("independent-tests")

TESTS = Path(__file__).parent
IGNORING = ["sh", "-c", 'trap "" HUP INT QUIT; exec "$@"', "sh", sys.executable, "-c"]
"""Command that starts Python as nohup and a shell's background job do: it ignores signals."""
HUP = 1
INT = 2
QUIT = 3


def run_ignoring(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*IGNORING, script],
        cwd=TESTS,
        env=os.environ | {"KCG_VCAN": "1", "CI": ""},  # KCG_VCAN: conftest imports no libraries
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_compiler_is_missing_in_a_test_that_does_not_ask_for_it() -> None:
    """So a machine without a compiler needs no run to show that such a test asks for one."""
    for name in PROGRAMS:
        done = subprocess.run([name, "--version"], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (1, f"{ASK}\n")
        with pytest.raises(pytest.fail.Exception, match="c_compiler"):
            there(name)


def test_compiler_is_usable_in_a_test_that_asks_for_it(
    c_compiler: Callable[..., str],
    tmp_path: Path,
) -> None:
    source = tmp_path / "seven.c"
    source.write_text("int main(void) { return 7; }\n")
    subprocess.run([c_compiler(), "-o", tmp_path / "seven", source], check=True)
    assert subprocess.run([tmp_path / "seven"], check=False).returncode == 7


@pytest.mark.parametrize(
    ("hangs", "options", "name"),
    [
        ("while True: pass", ["--timeout=1"], "FAILED test_two.py::test_hangs - Failed: Timeout"),
        (
            "sum(itertools.repeat(0))",
            ["-n1", "-o", "faulthandler_timeout=1"],
            "crashed while running 'test_two.py::test_hangs'",
        ),
    ],
    ids=["in Python", "in C"],
)
def test_hanging_test_is_named_and_the_next_one_runs(
    hangs: str,
    options: list[str],
    name: str,
    tmp_path: Path,
) -> None:
    (tmp_path / "test_two.py").write_text(
        f"import itertools\ndef test_hangs():\n    {hangs}\ndef test_next():\n    pass\n"
    )
    settings = ["-c", str(TESTS.parent / "pyproject.toml"), "--rootdir", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *settings, *options, "test_two.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert name in done.stdout, done.stdout + done.stderr
    assert "1 failed, 1 passed" in done.stdout


def test_children_of_tests_have_default_signals_under_nohup() -> None:
    script = "import conftest, subprocess; subprocess.run(['cat', '/proc/self/status'])"
    done = run_ignoring(script)
    assert done.returncode == 0, done.stderr
    for mask in ("SigIgn", "SigBlk"):
        found = re.search(rf"^{mask}:\s*([0-9a-f]+)$", done.stdout, re.MULTILINE)
        assert found is not None
        assert not any(int(found[1], 16) >> (number - 1) & 1 for number in (HUP, INT, QUIT))


def test_tests_still_ignore_a_hangup_under_nohup() -> None:
    script = "import conftest, os, signal; os.kill(os.getpid(), signal.SIGHUP); print('alive')"
    assert run_ignoring(script).stdout == "alive\n"


@pytest.mark.parametrize(
    ("ignored", "code"),
    [
        (True, 0),
        (False, 128 + HUP),
    ],
)
def test_make_test_continues_after_a_hangup_only_under_nohup(ignored: bool, code: int) -> None:
    script = (
        "import run, sys; run.STEPS['lint'] = 'kill -HUP $PPID; sleep 0.1'; "
        "sys.argv = ['run.py', 'test', '--only', 'lint']; sys.exit(run.main())"
    )
    if ignored:
        done = run_ignoring(script)
        assert done.stdout.endswith("1 passed, 0 failed, 0 skipped\n")
    else:
        command = [sys.executable, "-c", script]
        done = subprocess.run(
            command,
            cwd=TESTS,
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == code, done.stderr


def test_variables_of_a_service_and_its_time_zone_do_not_reach_tests() -> None:
    script = (
        "import os; os.umask(0o077); "
        "import conftest, os, pytest, time; conftest.clear_environment(pytest.MonkeyPatch()); "
        "print({'NOTIFY_SOCKET', 'STATE_DIRECTORY', 'COLUMNS'} & os.environ.keys(), "
        "time.localtime(0).tm_hour, os.umask(0))"
    )
    outside = {"NOTIFY_SOCKET": "/x", "STATE_DIRECTORY": "/x", "COLUMNS": "9", "TZ": "Asia/Tokyo"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=TESTS,
        env=os.environ | outside | {"KCG_VCAN": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "set() 5 18\n", done.stderr
    assert not {"NOTIFY_SOCKET", "STATE_DIRECTORY", "COLUMNS"} & os.environ.keys()
    assert os.environ["TZ"] == "IST-5:30"


@pytest.mark.rights
def test_locks_of_tests_are_in_a_folder_that_every_user_can_write() -> None:
    """Without a session a user has no /run/user/UID."""
    folder = runtime_folder("lock")
    assert not folder.is_relative_to("/run")
    folder.mkdir(parents=True, exist_ok=True)
    assert os.access(folder, os.W_OK)
    assert Path(os.environ["XDG_RUNTIME_DIR"], "kontronik-can-gw", "lock") == folder
    script = (
        "from kontronik_can_gw.runtime.system import folders; print(folders.runtime_folder('lock'))"
    )
    child = [sys.executable, "-c", script]
    found = subprocess.run(child, capture_output=True, text=True, check=True).stdout
    assert found == f"{folder}\n", "also a child of root, which must not use /run"
