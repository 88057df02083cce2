"""The whole program where it cannot start as a service, and with closed standard streams."""

import os
import socket
import subprocess
import sys
from pathlib import Path

LIMIT_S = 120
"""For what comes; nothing is judged by how long it takes."""


def test_a_service_that_cannot_start_says_why_and_waits_before_it_ends(tmp_path: Path) -> None:
    config = tmp_path / "gateway.toml"
    config.write_text("nonsense")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(LIMIT_S)
        process = subprocess.Popen(
            [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(config)],
            stderr=subprocess.PIPE,
            env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")},
        )
        said = listening.recv(4096).decode()
        assert said.startswith("STATUS=cannot start: ")
        assert process.poll() is None
        process.terminate()
        _, errors = process.communicate(timeout=LIMIT_S)
    assert b"is not valid TOML" in errors
    assert b"Traceback" not in errors


def test_closed_standard_streams_never_lend_their_number_to_a_port(tmp_path: Path) -> None:
    """With descriptor 2 closed a port could get that number, and what is written to standard error would go to the ESC."""
    code = (
        "import os; [os.close(n) for n in (0, 1, 2)]\n"
        "from kontronik_can_gw.cli import main\n"
        "code = main(['schema'])\n"
        f"fd = os.open({str(tmp_path / 'x')!r}, os.O_CREAT | os.O_WRONLY)\n"
        "os.write(fd, b'%d %d' % (fd, code))\n"
    )
    subprocess.run([sys.executable, "-c", code], check=False, timeout=LIMIT_S)
    fd, exit_code = (tmp_path / "x").read_text().split()
    assert int(fd) > 2
    assert exit_code == "0"
