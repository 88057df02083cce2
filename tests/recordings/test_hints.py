"""What is no recording, and what is said where a log is of more ESCs than its DBC."""

import os
from pathlib import Path

import asammdf
import numpy as np
import pytest
from command_line import refused, run
from simulated_bus import flight, layout_of, write_log


@pytest.mark.parametrize("command", ["convert", "decode"])
def test_a_pipe_or_a_device_is_refused_and_not_opened(tmp_path: Path, command: str) -> None:
    """To open a fifo would wait for its other end."""
    os.mkfifo(fifo := tmp_path / "fifo")
    for path in ("-", fifo, "/dev/zero"):
        words = [command, path, *([tmp_path / "o.csv"] if command == "convert" else [])]
        assert refused(2, *words).startswith(f"{path}: is no file.")
    assert [*tmp_path.iterdir()] == [fifo]


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
