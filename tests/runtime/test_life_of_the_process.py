"""The whole program as a service manager meets it: ready, alive, ended; where it cannot start; and with closed standard streams."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from kontronik_can_gw.desk.pty import PtyEsc

LIMIT_S = 120
"""For what comes; nothing is judged by how long it takes."""


def test_it_is_ready_and_alive_outlives_a_hang_up_and_says_that_it_ends(tmp_path: Path) -> None:
    config, file, errors = (tmp_path / name for name in ("g.toml", "status.json", "errors"))
    manager = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
    environment = os.environ | manager | {"RUNTIME_DIRECTORY": str(tmp_path)}
    environment.pop("WATCHDOG_PID", None)
    command = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(config), "--wait"]
    with (
        PtyEsc() as esc,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening,
        errors.open("w") as log,
    ):
        config.write_text(f'[can]\ninterface = "virtual"\n[[esc]]\nport = "{esc.path}"\n')
        listening.bind(manager["NOTIFY_SOCKET"])
        listening.settimeout(LIMIT_S)
        process = subprocess.Popen(command, stderr=log, env=environment)
        try:
            said, end = "", time.monotonic() + LIMIT_S

            def heard(text: str) -> str:
                nonlocal said
                while text not in said:
                    assert time.monotonic() < end, f"{text} was never said"
                    said += listening.recv(4096).decode() + "\n"
                return said.partition(text)[0]

            assert "WATCHDOG" not in heard("READY=1")
            heard("STATUS=")
            process.send_signal(signal.SIGHUP)
            before = said.count("WATCHDOG=1")
            while said.count("WATCHDOG=1") < before + 4 or not file.exists():
                assert time.monotonic() < end, "no signs of life, or no status file"
                said += listening.recv(4096).decode() + "\n"
            assert json.loads(file.read_text())["escs"][0]["name"] == "esc1"
            process.terminate()
            heard("STOPPING=1")
            assert process.wait(LIMIT_S) == 0
        finally:
            process.kill()
            process.wait()
        esc.check()
        assert esc.received == 0, "the gateway wrote to the ESC"
    assert not file.exists()
    assert "SIGHUP is ignored: the configuration is read at the start only." in errors.read_text()


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
