"""``kontronik-can-gw decode`` as a process: streams, files, exit codes, one clear line per mistake."""

import json
import os
import subprocess
import sys
from pathlib import Path

from command_line import refused, run

# Recorded from a JIVE PRO 120, firmware 1.14, idle.
LIVE = bytes.fromhex("4B4F444C000000008A0900000000000000000000581FE90300001D20000002000C0039234C14")
COMMAND = [sys.executable, "-m", "kontronik_can_gw", "decode"]


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
