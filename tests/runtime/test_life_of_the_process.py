"""The whole program under a stand-in of the service manager: ready, alive, ended."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from kontronik_can_gw.desk.pty import PtyEsc
from kontronik_can_gw.esc.kontronik.codec import Layout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData

LIVE = encode(LiveData(electrical_speed=12_345, battery_voltage=2442), Layout.V4)
LIMIT_S = 120
"""For what comes; nothing is judged by how long it takes."""
WATCHDOG_S = 1.0
"""What the program is told; nobody enforces it here."""


class Manager:
    """What systemd hears of a unit of Type=notify with WatchdogSec=."""

    def __init__(self, folder: Path, config: Path) -> None:
        self.config = config
        self.path = folder / "notify"
        self.messages: list[dict[str, str]] = []
        self.lines: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        self._socket.settimeout(0.05)
        self._folder = folder
        self._ending = False
        self.process = self._start()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _start(self) -> subprocess.Popen[str]:
        environment = {
            **os.environ,
            "NOTIFY_SOCKET": str(self.path),
            "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6)),
            "RUNTIME_DIRECTORY": str(self._folder),
        }
        environment.pop("WATCHDOG_PID", None)
        process = subprocess.Popen(
            [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(self.config), "--wait"],
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        threading.Thread(target=self._read, args=(process,), daemon=True).start()
        return process

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        with process.stderr:
            for line in process.stderr:
                self.lines.append(line.rstrip())

    def _watch(self) -> None:
        while True:
            try:
                message = dict(
                    line.split("=", 1) for line in self._socket.recv(4096).decode().splitlines()
                )
                self.messages.append(message)
            except TimeoutError:
                if self._ending:  # and nothing is left to be read
                    return

    def said(self, key: str) -> list[str]:
        return [message[key] for message in list(self.messages) if key in message]

    def heard_to_the_end(self, key: str) -> list[str]:
        """What was said by a process that has ended."""
        self._ending = True
        self._thread.join()
        return self.said(key)

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < end and self.process.poll() is None, (
                f"{what}: never\n" + "\n".join(self.lines)
            )
            time.sleep(0.01)

    def logged(self, text: str) -> None:
        self.wait(lambda: any(text in line for line in list(self.lines)), text)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._ending = True
        self._thread.join(LIMIT_S)
        self._socket.close()


def configuration(port: str, channel: str, more: str = "") -> str:
    return f'[can]\ninterface = "virtual"\nchannel = "{channel}"\n{more}\n[[esc]]\nport = "{port}"\npole_pairs = 7\n'


@contextmanager
def talking(esc: PtyEsc) -> Iterator[None]:
    """Live frames come inside: of a single one a slow machine could say that it is old."""
    stop = threading.Event()

    def talk() -> None:
        while not stop.wait(0.02):
            esc.write(LIVE)

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@pytest.fixture
def esc() -> Iterator[PtyEsc]:
    with PtyEsc() as made:
        yield made
        assert made.received == 0, "the gateway wrote to the ESC"


@pytest.fixture
def manager(tmp_path: Path, esc: PtyEsc) -> Iterator[Manager]:
    config = tmp_path / "gateway.toml"
    config.write_text(configuration(esc.path, "life"))
    made = Manager(tmp_path, config)
    try:
        made.wait(lambda: made.said("READY") == ["1"], "READY")
        yield made
    finally:
        made.close()


def test_it_is_ready_alive_and_tells_how_it_is_until_it_says_that_it_ends(
    manager: Manager, esc: PtyEsc
) -> None:
    manager.wait(lambda: len(manager.said("WATCHDOG")) > 4, "signs of life")
    assert "esc1: telemetry never-seen" in manager.said("STATUS")[0]
    with talking(esc):
        manager.wait(
            lambda: "esc1: telemetry ok" in manager.said("STATUS")[-1], "telemetry in the status"
        )
        file = manager.path.parent / "status.json"
        manager.wait(file.exists, "the status file")
        document = json.loads(file.read_text())
        assert document["escs"][0]["name"] == "esc1"
    manager.process.send_signal(signal.SIGTERM)
    assert manager.process.wait(LIMIT_S) == 0
    assert manager.heard_to_the_end("STOPPING") == ["1"]
    assert not (manager.path.parent / "status.json").exists()


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
