"""Messages about files that are not recordings, and about logs with more ESCs than their DBC."""

import bz2
import gzip
import lzma
from collections.abc import Callable
from pathlib import Path

import asammdf
import numpy as np
import pytest
from command_line import refused, run
from simulated_bus import flight, layout_of, write_log

pytestmark = pytest.mark.promise("one-line")


def test_frames_missing_in_the_dbc_are_counted_and_a_remedy_is_named(
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
        left_out = "frames left out that are not in kontronik_esc.dbc (for another DBC give -c"
        assert left_out in said, words
    assert "left out" not in run("convert", log, tmp_path / "o.blf").err, "which holds all of them"


@pytest.mark.parametrize(
    ("compress", "command"),
    [(gzip.compress, "zcat"), (bz2.compress, "bzcat"), (lzma.compress, "xzcat")],
)
def test_compressed_log_gets_the_command_that_reads_it(
    tmp_path: Path, compress: Callable[[bytes], bytes], command: str
) -> None:
    log = write_log(tmp_path / "bus.log", flight(layout_of(["a"]), 1))
    packed = tmp_path / "bus.kcap.packed"
    packed.write_bytes(compress(log.read_bytes()))
    for words in (("convert", packed, tmp_path / "o.csv"), ("report", packed, "-o", "o.html")):
        said = refused(2, *words)
        assert f"{packed}: is compressed with " in said
        assert f"{command} {packed} | kontronik-can-gw COMMAND -" in said


def test_format_may_be_given_by_its_suffix(tmp_path: Path) -> None:
    log = write_log(tmp_path / "bus.log", flight(layout_of(["a"]), 1))
    as_suffix = run("convert", log, "-", "--to", "log")
    assert as_suffix.code == 0
    assert as_suffix.data == run("convert", log, "-", "--to", "candump").data
    said = refused(2, "convert", log, tmp_path / "o.mf4")
    assert "o.mf4: .mf4 may be a table or a log. Type --to parquet (or csv)" in said


def test_table_in_mf4_is_distinguished_from_a_log(tmp_path: Path) -> None:
    table = tmp_path / "table.mf4"
    values = np.array([1.0, 2.0])
    with asammdf.MDF() as mdf:
        mdf.append(asammdf.Signal(values, timestamps=values, name="BatteryVoltage"))
        mdf.save(table)
    said = refused(2, "convert", table, tmp_path / "o.csv")
    assert "table.mf4: is a table of values (an MF4 measurement), not a log of a CAN bus." in said


@pytest.mark.parametrize(
    "line",
    [
        "(1700000000.123456)  vcan0  688   [8]  00 00 00 C4 09 00 14 00",
        " (000.000000)  vcan0  00012345   [2]  11 22",
        " (2023-11-14 22:13:20.123456)  vcan0  688  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B",
        "  vcan0  RX - -  688   [8]  00 00 00 C4 09 00 14 00",
        "  vcan0  688   [8]  remote request",
        "  vcan0  688   [0] ",
    ],
)
def test_candumps_screen_output_is_refused_with_the_right_command(
    tmp_path: Path, line: str
) -> None:
    log = tmp_path / "screen.txt"
    log.write_text(f"{line}\n" * 3)
    for words in (
        ("convert", log, tmp_path / "o.csv"),
        ("decode", log),
        ("report", log, "-o", tmp_path / "o.html"),
        ("monitor", "--once", log),
        ("replay", log, "--on", "pty"),
    ):
        said = refused(2, *words)
        assert said.startswith(f"{log}: is the output of candump for the screen.")
        assert said.endswith("candump -L vcan0 > FILE (or candump -l vcan0).")


def test_decode_refuses_files_that_are_not_the_bytes_of_an_esc(tmp_path: Path) -> None:
    noise = tmp_path / "noise.bin"
    empty = tmp_path / "empty.bin"
    log = write_log(tmp_path / "bus.log", flight(layout_of(["a"]), 1))
    noise.write_bytes(b"no recording" * 9)
    empty.touch()
    said = refused(2, "decode", noise)
    assert said.startswith(f"{noise}: is neither a capture nor a CAN log")
    assert "bytes but never KOD: wrong parity" in said
    assert refused(2, "decode", empty) == f"{empty}: is empty"
    said = refused(2, "decode", log)
    assert said.startswith(f"{log}: is a candump recording, not the bytes of an ESC.")
    for command in (["convert"], ["decode", "--csv"]):
        missing = tmp_path / "none"
        said = refused(2, *command, missing, "-o", tmp_path / "o.csv")
        assert said == f"{missing}: does not exist."
