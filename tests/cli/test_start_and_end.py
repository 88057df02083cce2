"""Problems before a command begins or after it: signals, and too few open files.

They never cause a traceback.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from kontronik_can_gw import cli
from kontronik_can_gw.cli.common import stopping_on_signals
from kontronik_can_gw.cli.output import interrupt

pytestmark = pytest.mark.promise("closed-ends")

LIMITED = 'ulimit -n "$0" && exec "$@"'
INTERRUPTED = """
import os, runpy, signal, sys

class Interrupt:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.{signal})

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
def test_ctrl_c_while_modules_are_loaded_ends_silently(
    module: str,
    words: list[str],
    start: str,
    folder: Path,
) -> None:
    code = INTERRUPTED.format(
        signal="SIGINT",
        module=module,
        words=words,
        start=start,
        loaded=["argparse"],
    )
    done = run(sys.executable, "-c", code, folder=folder)
    assert (done.returncode, done.stderr) in ((-signal.SIGINT, ""), (130, ""))


def test_ignored_ctrl_c_does_not_end_the_program(folder: Path) -> None:
    """Ctrl-C is ignored as in background jobs of a shell script."""
    code = "import signal; signal.signal(2, signal.SIG_IGN)\n" + INTERRUPTED
    code = code.format(
        signal="SIGINT",
        module="kontronik_can_gw.cli",
        words=["schema"],
        start=AS_MODULE,
        loaded=[],
    )
    done = run(sys.executable, "-c", code, folder=folder)
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.parametrize("start", [AS_MODULE, AS_PROGRAM])
@pytest.mark.parametrize("module", ["kontronik_can_gw.cli", "argparse", "kontronik_can_gw.cli.run"])
def test_signal_usr1_before_the_gateway_runs_does_not_end_it(
    module: str,
    start: str,
    folder: Path,
) -> None:
    code = INTERRUPTED.format(
        signal="SIGUSR1",
        module=module,
        words=["run", "-c", "missing.toml"],
        start=start,
        loaded=["argparse"],
    )
    done = run(sys.executable, "-c", code, folder=folder)
    assert done.returncode == 2
    assert done.stderr.startswith("kontronik-can-gw run: missing.toml: cannot be read")


def test_signal_usr1_after_the_gateway_ran_does_not_kill_the_process(folder: Path) -> None:
    code = (
        "import atexit, os, signal\natexit.register(lambda: os.kill(os.getpid(), signal.SIGUSR1))\n"
        + INTERRUPTED
    )
    code = code.format(
        signal="SIGUSR1",
        module="never loaded",
        words=["run", "-c", "missing.toml"],
        start=AS_MODULE,
        loaded=[],
    )
    done = run(sys.executable, "-c", code, folder=folder)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1


def test_too_few_open_files_are_reported_in_one_line(folder: Path) -> None:
    command = [sys.executable, "-m", "kontronik_can_gw", "simulate", "--esc", "40"]
    done = run("sh", "-c", LIMITED, "40", *command, folder=folder)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "Too many open files" in done.stderr


def test_ctrl_c_while_a_mistake_is_reported_causes_no_traceback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "say", interrupted)
    assert cli.main(["check", "-c", "missing.toml"]) == 130


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_a_gateway_that_waits_for_its_configuration(
    number: signal.Signals,
    folder: Path,
) -> None:
    """A pipe without a writer is like a file on a server that does not answer."""
    pipe = folder / "pipe"
    os.mkfifo(pipe)
    process = subprocess.Popen(
        [sys.executable, "-m", "kontronik_can_gw", "run", str(pipe)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stderr=subprocess.PIPE,
        text=True,
    )
    writer = None
    try:
        while writer is None:
            assert process.poll() is None
            time.sleep(0.01)
            with contextlib.suppress(OSError):  # until the gateway opens the pipe
                writer = os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
        if writer is not None:
            os.close(writer)
    assert (process.returncode, said) == (0, "")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_signal_that_arrives_in_a_finalizer_still_ends_the_command(
    number: signal.Signals, capfd: pytest.CaptureFixture[str]
) -> None:
    """Python ignores an exception there, so the signal would be lost."""

    class Finalized:
        def __del__(self) -> None:
            signal.raise_signal(number)

    def wait() -> None:
        with stopping_on_signals(interrupt):
            Finalized()
            time.sleep(60)
            pytest.fail("the signal was lost")

    with pytest.raises(KeyboardInterrupt):
        wait()
    assert capfd.readouterr().err == ""
