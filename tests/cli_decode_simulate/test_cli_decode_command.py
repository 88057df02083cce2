"""``kontronik-can-gw decode`` as a process: streams, files, exit codes, one clear line per mistake."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from kontronik_can_gw.cli import main
from kontronik_can_gw.offline.decode import COLUMNS, Decoder, json_lines
from kontronik_can_gw.simulator import SimulatedEsc

# Recorded from a JIVE PRO 120, firmware 1.14, idle.
LIVE = bytes.fromhex("4B4F444C000000008A0900000000000000000000581FE90300001D20000002000C0039234C14")
COMMAND = [sys.executable, "-m", "kontronik_can_gw", "decode"]


def decode(*words: str, data: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([*COMMAND, *words], input=data, capture_output=True, timeout=60)


@pytest.fixture(scope="module")
def flight() -> bytes:
    return b"".join(sent.wire for sent in SimulatedEsc().frames_until(20 * 10**9))


def test_a_file_is_decoded_to_json_lines(tmp_path: Path, flight: bytes) -> None:
    file = tmp_path / "flight.bin"
    file.write_bytes(flight)
    result = decode(str(file))
    assert result.returncode == 0
    assert result.stdout.decode("ascii") == json_lines(Decoder().feed(flight))
    assert result.stderr.decode() == (
        f"{len(flight)} bytes: 2001 live and 20 info frames (2021 v4), 0 bytes dropped, 0 CRC errors\n"
    )


def test_standard_input_gives_the_same_as_a_file(flight: bytes) -> None:
    result = decode("-", data=flight)
    assert result.returncode == 0
    assert result.stdout.decode("ascii") == json_lines(Decoder().feed(flight))


def test_csv_has_one_header_and_a_row_per_frame(flight: bytes) -> None:
    lines = decode("-", "--csv", data=flight).stdout.decode("ascii").splitlines()
    assert lines[0] == ",".join(COLUMNS)
    assert len(lines) == 2022
    assert {line.count(",") for line in lines} == {len(COLUMNS) - 1}


def test_a_stream_is_decoded_as_it_comes() -> None:
    with subprocess.Popen([*COMMAND, "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin
        assert process.stdout
        for number in range(3):
            process.stdin.write(LIVE)
            process.stdin.flush()
            assert json.loads(process.stdout.readline())["offset"] == number * 38  # while the input is still open
        process.stdin.close()
        assert process.stdout.read() == b""
    assert process.returncode == 0


def test_statistics_are_written_as_json(tmp_path: Path) -> None:
    stats = tmp_path / "stats.json"
    assert decode("-", "--stats", str(stats), data=b"xx" + LIVE).returncode == 0
    counters = json.loads(stats.read_text())
    assert counters["live"] == counters["live_legacy"] == 1
    assert counters["info"] == counters["crc_errors"] == 0
    assert (counters["bytes"], counters["dropped_bytes"]) == (40, 2)


def test_where_no_frame_is_found_a_line_says_why_and_the_exit_code_is_0(tmp_path: Path) -> None:
    stats = tmp_path / "stats.json"
    result = decode("-", "--stats", str(stats), data=b"\xaa" * 500)
    assert result.returncode == 0
    assert result.stdout == b""
    assert "no frame found: bytes but never KOD: wrong parity" in result.stderr.decode()
    assert json.loads(stats.read_text())["dropped_bytes"] == 500


def test_an_empty_file_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    result = decode(str(tmp_path / "empty"))
    assert (result.returncode, result.stdout) == (0, b"")
    assert result.stderr == b"0 bytes: the input is empty\n"


def test_what_cannot_be_opened_gives_one_clear_line_and_exit_code_1(tmp_path: Path) -> None:
    file = tmp_path / "flight.bin"
    file.write_bytes(LIVE)
    missing = str(tmp_path / "missing")
    for words, expected in [
        ([missing], f"{missing}: cannot be opened: No such file or directory."),
        ([str(tmp_path)], f"{tmp_path}: is a directory."),
        ([str(file), "--stats", f"{missing}/s.json"], f"--stats {missing}/s.json: cannot be written: No such file"),
        ([str(file), "--stats", str(tmp_path)], f"--stats {tmp_path}: cannot be written: Is a directory"),
    ]:
        result = decode(*words)
        assert result.returncode == 1
        assert result.stdout == b""
        assert result.stderr.decode().startswith(f"kontronik-can-gw decode: {expected}")
        assert result.stderr.count(b"\n") == 1


def test_an_unreadable_file_gives_one_clear_line_and_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within this process, so that root can lay its rights down for the moment: root may read everything."""
    file = tmp_path / "secret"
    file.touch(0)
    main(["decode", os.devnull])  # imports what it needs, while that can be read
    capsys.readouterr()
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        code = main(["decode", str(file)])
    finally:
        os.seteuid(user)
    said = capsys.readouterr()
    assert (code, said.out) == (1, "")
    assert "Permission denied" in said.err
    assert said.err.count("\n") == 1


def test_the_input_is_never_overwritten_by_the_statistics(tmp_path: Path) -> None:
    file = tmp_path / "flight.bin"
    file.write_bytes(LIVE)
    result = decode(str(file), "--stats", str(file))
    assert result.returncode == 2
    assert b"is the input" in result.stderr
    assert file.read_bytes() == LIVE


def test_wrong_usage_has_exit_code_2() -> None:
    assert decode().returncode == 2
    assert decode("a", "b").returncode == 2


def test_a_reader_that_leaves_early_causes_no_traceback(flight: bytes, tmp_path: Path) -> None:
    file = tmp_path / "flight.bin"
    file.write_bytes(flight * 20)
    with subprocess.Popen([*COMMAND, str(file)], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_gives_one_clear_line(flight: bytes) -> None:
    with Path("/dev/full").open("wb") as full:
        result = subprocess.run([*COMMAND, "-"], input=flight, stdout=full, stderr=subprocess.PIPE, timeout=60)
    assert result.returncode == 1
    assert result.stderr == b"kontronik-can-gw decode: standard output: cannot be written: No space left on device.\n"


def test_a_bar_is_shown_only_to_a_person_who_does_not_see_the_output(flight: bytes, tmp_path: Path) -> None:
    file = tmp_path / "flight.bin"
    file.write_bytes(flight)
    shown = {}
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "120"}
    for output in ("file", "terminal"):
        master, slave = os.openpty()
        stdout = slave if output == "terminal" else subprocess.DEVNULL
        words = [*COMMAND, str(file), "--csv"] if output == "file" else [*COMMAND, os.devnull]
        subprocess.run(words, stdout=stdout, stderr=slave, env=environment, timeout=60, check=True)
        shown[output] = os.read(master, 65536)
        os.close(slave)
        os.close(master)
    assert b"flight.bin" in shown["file"]
    assert b"\x1b" in shown["file"]
    assert shown["terminal"] == b"0 bytes: the input is empty\r\n"
