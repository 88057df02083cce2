"""What can go wrong before a command has begun: Ctrl-C while modules are loaded, too few open files. Never a traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

LIMITED = 'ulimit -n "$0" && exec "$@"'
INTERRUPTED = """
import os, runpy, signal, sys

class Interrupt:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

for name in {loaded}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Interrupt())
sys.argv = ["kontronik-can-gw", *{words!r}]
{start}
"""
AS_MODULE = 'runpy.run_module("kontronik_can_gw", run_name="__main__", alter_sys=True)'
AS_PROGRAM = "from kontronik_can_gw.__main__ import main; sys.exit(main())"


def run(*command: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    where: Any = {"cwd": folder, "env": environment, "stdin": subprocess.DEVNULL}
    return subprocess.run(command, capture_output=True, text=True, timeout=60, **where)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "gateway.toml").write_text(
        '[can]\ninterface = "virtual"\n[[esc]]\nport = "nowhere"\n'
    )
    return tmp_path


@pytest.mark.parametrize("start", [AS_MODULE, AS_PROGRAM])
@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("kontronik_can_gw.cli", ["check", "-c", "gateway.toml"]),
        ("argparse", ["check", "-c", "gateway.toml"]),
        ("cantools.database", ["check", "-c", "gateway.toml"]),
        ("kontronik_can_gw.cli.run", ["run", "-c", "gateway.toml"]),
    ],
)
def test_ctrl_c_while_modules_are_loaded_ends_it_without_a_word(
    module: str, words: list[str], start: str, folder: Path
) -> None:
    code = INTERRUPTED.format(module=module, words=words, start=start, loaded=["argparse"])
    done = run(sys.executable, "-c", code, folder=folder)
    assert (done.returncode, done.stderr) in ((-signal.SIGINT, ""), (130, ""))


def test_who_has_ctrl_c_ignored_is_not_ended_by_it(folder: Path) -> None:
    """As of a shell script's background jobs."""
    code = "import signal; signal.signal(2, signal.SIG_IGN)\n" + INTERRUPTED
    code = code.format(module="kontronik_can_gw.cli", words=["schema"], start=AS_MODULE, loaded=[])
    done = run(sys.executable, "-c", code, folder=folder)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "words",
    ["run --wait -c gateway.toml", "check -c gateway.toml", "status"],
)
@pytest.mark.parametrize("limit", [5, 63])
def test_too_few_open_files_are_one_line(limit: int, words: str, folder: Path) -> None:
    command = [sys.executable, "-m", "kontronik_can_gw", *words.split()]
    done = run("sh", "-c", LIMITED, str(limit), *command, folder=folder)
    assert done.stderr.count("\n") == 1, done.stderr
    assert "`ulimit -n 64` or more" in done.stderr
    assert (done.returncode, done.stdout) == (1, "")


def test_each_esc_needs_files_too_and_a_soft_limit_is_raised(folder: Path) -> None:
    command = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", "gateway.toml"]
    assert (
        "`ulimit -n 66` or more" in run("sh", "-c", LIMITED, "65", *command, folder=folder).stderr
    )
    for limit in ("66", "-S 20"):
        done = run("sh", "-c", LIMITED.replace('"$0"', "$0"), limit, *command, folder=folder)
        assert "nowhere: no such serial port" in done.stderr
