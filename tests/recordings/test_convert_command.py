"""Messages of ``kontronik-can-gw convert``, and the files that remain if it fails.

Its output is tested in test_tables.py and in tests/golden/commands/convert.txt.
"""

import io
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from command_line import refused
from recordings import candump_log, dump_bytes

from kontronik_can_gw.cli.desk import watched

pytestmark = pytest.mark.promise("outputs-of-commands")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw", "convert"]


def program(*words: object, **options: object) -> "subprocess.CompletedProcess[str]":
    """Run ``convert`` in a new process."""
    command = [*PROGRAM, *map(str, words)]
    every: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 60, **options}
    done: subprocess.CompletedProcess[str] = subprocess.run(command, check=False, **every)
    return done


@pytest.fixture
def dump(tmp_path: Path) -> Path:
    path = tmp_path / "esc.bytes"
    path.write_bytes(dump_bytes())
    return path


@pytest.mark.parametrize(
    "form",
    [
        "csv",
        "jsonl",
        "parquet",
        "candump",
        "blf",
        "mf4-log",
    ],
)
def test_input_without_frames_is_refused_and_leaves_no_file(tmp_path: Path, form: str) -> None:
    source = tmp_path / "other.log"
    is_table = form in ("csv", "jsonl", "parquet")
    foreign_frame = "(1700000000.000000) can0 123#00\n"
    empty = "base hex  timestamps absolute\n"
    source.write_text(foreign_frame if is_table else empty)
    said = refused(1, "convert", source, tmp_path / "out", "--to", form)
    assert "so there is nothing to convert" in said
    assert "--dbc" in said or not is_table
    assert [path.name for path in tmp_path.iterdir()] == ["other.log"]


@pytest.mark.parametrize(
    ("module", "form", "needed"),
    [
        ("pyarrow", "parquet", "Parquet needs pyarrow>=15. "),
        ("asammdf", "mf4-log", "MF4 needs asammdf>=8. "),
    ],
)
def test_missing_library_is_named_with_the_command_that_installs_it(
    dump: Path,
    tmp_path: Path,
    module: str,
    form: str,
    needed: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    said = refused(1, "convert", dump, tmp_path / "out", "--to", form)
    assert needed + "Install it: " in said
    assert module in said.partition("Install it: ")[2]
    assert [path.name for path in tmp_path.iterdir()] == ["esc.bytes"]


@pytest.mark.parametrize("form", ["csv", "parquet", "asc", "blf", "mf4-log"])
def test_full_disk_is_reported_in_one_line_and_leaves_no_file(
    dump: Path,
    tmp_path: Path,
    form: str,
) -> None:
    def small() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300))

    # the disk is full in the middle of the file, or when Python flushes its buffer at the end
    for more in ([], ["--until", "0.3"]):
        done = program(dump, tmp_path / "out", "--to", form, *more, preexec_fn=small)
        assert done.returncode == 1, done.stderr
        said = f"kontronik-can-gw convert: {tmp_path / 'out'}: cannot be written: File too large.\n"
        assert done.stderr == said
        assert [path.name for path in tmp_path.iterdir()] == ["esc.bytes"]


@pytest.mark.parametrize(
    ("form", "number"),
    [("csv", signal.SIGINT), ("parquet", signal.SIGTERM), ("blf", signal.SIGINT)],
)
def test_signal_leaves_no_incomplete_file(
    tmp_path: Path,
    form: str,
    number: signal.Signals,
) -> None:
    """The disk never finishes writing the file, so the signal always arrives before the end."""
    folder = tmp_path / "folder"
    folder.mkdir()
    source = candump_log(folder / "some.log", 1)
    slow_disk = "import os, time\nos.fsync = lambda descriptor: time.sleep(600)\n"
    (tmp_path / "sitecustomize.py").write_text(slow_disk)
    python_path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    command = [*PROGRAM, str(source), str(folder / "out"), "--to", form]
    process = subprocess.Popen(
        command,
        env=os.environ | {"PYTHONPATH": python_path},
        stderr=subprocess.PIPE,
        text=True,
    )
    while process.poll() is None and not (folder / "out.part").exists():
        time.sleep(0.001)
    process.send_signal(number)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert said == "kontronik-can-gw convert: stopped: nothing was written\n"
    assert [path.name for path in folder.iterdir()] == ["some.log"]


def test_long_conversion_shows_its_progress_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    for on_terminal in (True, False):
        screen = io.StringIO()
        monkeypatch.setattr(screen, "isatty", lambda shown=on_terminal: shown)
        monkeypatch.setattr(sys, "stderr", screen)
        blocks = [[1, 2], [3]]
        assert [*watched(blocks, "flight.kcap to csv:", data_on_screen=False)] == blocks
        shown = re.search(r"flight\.kcap to csv: \D*3\b", screen.getvalue())
        if on_terminal:
            assert shown
        else:
            assert not screen.getvalue()
