"""``kontronik-can-gw decode`` as a process: streams, files, exit codes, one clear line per mistake."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refused, run, written

from kontronik_can_gw.desk.recordings.decode import COLUMNS, Decoder, json_lines
from kontronik_can_gw.esc.kontronik.simulator import SimulatedEsc

# Recorded from a JIVE PRO 120, firmware 1.14, idle.
LIVE = bytes.fromhex("4B4F444C000000008A0900000000000000000000581FE90300001D20000002000C0039234C14")
COMMAND = [sys.executable, "-m", "kontronik_can_gw", "decode"]


@pytest.fixture(scope="module")
def flight() -> bytes:
    return b"".join(sent.wire for sent in SimulatedEsc().frames_until(20 * 10**9))


def test_a_file_is_decoded_to_json_lines(tmp_path: Path, flight: bytes) -> None:
    result = run("decode", written(tmp_path / "flight.bin", flight))
    assert result.code == 0
    assert result.out == json_lines(Decoder().feed(flight))
    assert result.err == (
        f"{len(flight)} bytes: 2001 live and 20 info frames (2021 v4), 0 bytes dropped, 0 CRC errors\n"
    )


def test_standard_input_gives_the_same_as_a_file(flight: bytes) -> None:
    done = subprocess.run([*COMMAND, "-"], input=flight, capture_output=True, check=True)
    assert done.stdout.decode("ascii") == json_lines(Decoder().feed(flight))


def test_csv_has_one_header_and_a_row_per_frame(tmp_path: Path, flight: bytes) -> None:
    lines = run("decode", written(tmp_path / "flight.bin", flight), "--csv").out.splitlines()
    assert lines[0] == ",".join(COLUMNS)
    assert len(lines) == 2022
    assert {line.count(",") for line in lines} == {len(COLUMNS) - 1}


def test_a_stream_is_decoded_as_it_comes() -> None:
    with subprocess.Popen(
        [*COMMAND, "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin
        assert process.stdout
        for number in range(3):
            process.stdin.write(LIVE)
            process.stdin.flush()
            # while the input is still open
            assert json.loads(process.stdout.readline())["offset"] == number * 38
        process.stdin.close()
        assert process.stdout.read() == b""
    assert process.returncode == 0


def test_statistics_are_written_as_json(tmp_path: Path) -> None:
    stats = tmp_path / "stats.json"
    file = written(tmp_path / "x.bin", b"xx" + LIVE)
    assert run("decode", file, "--stats", stats).code == 0
    known = {
        "live": 1,
        "live_legacy": 1,
        "info": 0,
        "crc_errors": 0,
        "bytes": 40,
        "dropped_bytes": 2,
    }
    assert json.loads(stats.read_text()).items() >= known.items()


def test_an_unreadable_file_gives_one_clear_line_and_exit_code_1(tmp_path: Path) -> None:
    """Within this process, so that root can lay its rights down for the moment: root may read everything."""
    file = tmp_path / "secret"
    file.touch(0)
    run("decode", os.devnull)  # imports what it needs, while that can be read
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        said = refused(1, "decode", file)
    finally:
        os.seteuid(user)
    assert "Permission denied" in said
