"""What is read through pipes, what is no recording, and what is said where a log is of more ESCs than its DBC."""

import os
import subprocess
import sys
from pathlib import Path

import asammdf
import numpy as np
import pytest
from command_line import refused, run
from recordings import candump_log, capture_bytes, convert
from simulated_bus import flight, layout_of, write_log


def program(command: str, cwd: Path) -> "subprocess.CompletedProcess[bytes]":
    """A line of bash; ``gw`` is the program."""
    line = f'gw() {{ "{sys.executable}" -m kontronik_can_gw "$@"; }}; {command}'
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    bash = ["bash", "-c", line]
    return subprocess.run(bash, capture_output=True, timeout=60, check=False, cwd=cwd, env=env)


@pytest.mark.parametrize("command", ["cat {} | gw convert - o.csv", "gw convert <(cat {}) o.csv"])
@pytest.mark.parametrize("kind", ["kcap", "blf", "mf4"])
def test_a_pipe_gives_what_the_file_gives(tmp_path: Path, kind: str, command: str) -> None:
    path = tmp_path / f"a.{kind}"
    if kind == "kcap":
        path.write_bytes(capture_bytes())
    else:
        log = candump_log(tmp_path / "a.log")
        assert convert(log, path, "--to", kind.replace("mf4", "mf4-log")) == 0
    assert convert(path, tmp_path / "file.csv") == 0
    done = program(command.format(path.name), cwd=tmp_path)
    assert (done.returncode, b"Traceback" in done.stderr) == (0, False), done.stderr
    assert (tmp_path / "o.csv").read_bytes() == (tmp_path / "file.csv").read_bytes()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("gw convert - o.csv < /dev/null", "standard input: is empty"),
        ("gw convert /dev/zero o.csv", "/dev/zero: is a terminal or another device."),
        ("gw convert - o.csv < /dev/zero", "standard input: is a terminal or another device."),
        ("echo rubbish | gw convert - o.csv", "standard input: is no capture, no CAN log"),
    ],
)
def test_a_stream_without_a_recording_is_one_line(tmp_path: Path, command: str, said: str) -> None:
    done = program(command, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.decode().startswith(f"kontronik-can-gw convert: {said}")
    assert done.stderr.count(b"\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_frames_that_the_dbc_does_not_have_are_counted_and_the_remedy_is_said(
    tmp_path: Path,
) -> None:
    log = write_log(tmp_path / "bus.log", flight(layout_of(["a", "b", "c"]), 2))
    for words in (
        ("convert", log, tmp_path / "o.csv"),
        ("convert", "-q", log, tmp_path / "q.csv"),
        ("report", log, "-o", tmp_path / "o.html"),
        ("monitor", "--once", log),
    ):
        said = run(*words).err
        left_out = "frames left out that kontronik_esc.dbc does not have (-c or --dbc gives"
        assert left_out in said, words
    assert "left out" not in run("convert", log, tmp_path / "o.blf").err, "which holds all of them"


def test_a_table_in_mf4_is_told_from_a_log(tmp_path: Path) -> None:
    table = tmp_path / "table.mf4"
    values = np.array([1.0, 2.0])
    with asammdf.MDF() as mdf:
        mdf.append(asammdf.Signal(values, timestamps=values, name="BatteryVoltage"))
        mdf.save(table)
    said = refused(2, "convert", table, tmp_path / "o.csv")
    assert "table.mf4: is a table of values (an MF4 measurement), no log of a CAN bus." in said
