"""``run --record`` as its own process: captures to the end, and a log beside them that a replay repeats to the byte."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from kontronik_can_gw.offline import pty
from kontronik_can_gw.offline.inputs import open_input
from kontronik_can_gw.simulator import EscOptions, Faults, SimulatedEsc

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]


def until(condition: Callable[[], bool], what: str, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.01)


ENOUGH = 12_000
"""Bytes of a capture with its header, which stands there twice, and some data."""


def size_of(folder: Path, pattern: str = "*") -> int:
    """What has been written so far; 0 where there is no folder yet."""
    return sum(path.stat().st_size for path in folder.glob(pattern))


@contextmanager
def telemetry(*options: EscOptions) -> Iterator[list[str]]:
    """ESCs on pseudo terminals; their paths."""
    terminals = [pty.PtyEsc() for _ in options]
    stopped = threading.Event()
    escs = [(SimulatedEsc(o, seed=n), t) for n, (o, t) in enumerate(zip(options, terminals, strict=True))]
    thread = threading.Thread(target=lambda: pty.run(escs, stop=stopped.is_set), daemon=True)
    thread.start()
    try:
        yield [terminal.path for terminal in terminals]
    finally:
        stopped.set()
        thread.join(5)
        received = [terminal.received for terminal in terminals]
        for terminal in terminals:
            terminal.close()
    assert received == [0] * len(options), "something was transmitted to an ESC"


class Run:
    """The gateway's process; ``log`` is what it said so far."""

    def __init__(self, config: Path, *words: object) -> None:
        self._log = config.with_suffix(".err")
        with self._log.open("w") as file:
            self.process = subprocess.Popen([*PROGRAM, "run", "-c", str(config), *map(str, words)], stderr=file)

    @property
    def log(self) -> str:
        return self._log.read_text()

    def wait_for(self, text: str) -> None:
        until(lambda: text in self.log or self.process.poll() is not None, f"{text!r} in:\n{self.log}")
        assert text in self.log

    def end(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(120)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Run]]:
    runs: list[Run] = []

    def begin(config: Path, *words: object) -> Run:
        runs.append(Run(config, *words))
        return runs[-1]

    yield begin
    for run in runs:
        if run.process.poll() is None:
            run.process.kill()
            run.process.wait()


def configuration(ports: list[str], record: str = "", more: str = "") -> str:
    text = f'[can]\ninterface = "virtual"\nchannel = "r{os.getpid()}"\n[record]\n{record}\n{more}\n'
    return text + "".join(f'[[esc]]\nport = "{port}"\npole_pairs = 7\n' for port in ports)


def test_the_log_beside_a_capture_is_what_a_replay_gives(start: Callable[..., Run], tmp_path: Path) -> None:
    config = tmp_path / "gw.toml"
    noisy = EscOptions(faults=Faults(noise=0.5, lost_bytes=0.002))
    canopen = f'[canopen]\nenabled = true\nself_start = true\nstore = "{tmp_path}/store"\n'
    with telemetry(noisy, EscOptions()) as ports:
        config.write_text(configuration(ports, 'can_log = "candump"', canopen))
        run = start(config, "--record", tmp_path / "captures")
        run.wait_for("esc2: telemetry ok")
        until(lambda: size_of(tmp_path / "captures", "*.log") > 40_000, "a second's frames in the log")
        assert run.end() == 0
    [log] = (tmp_path / "captures").glob("*.log")
    again = tmp_path / "again.log"
    done = subprocess.run(
        [*PROGRAM, "replay", str(tmp_path / "captures"), "--to", "log", "-o", str(again)], check=False
    )
    assert done.returncode == 0
    assert again.read_bytes() == log.read_bytes()
    assert len(log.read_text().splitlines()) > 800
    with open_input(tmp_path / "captures") as found:
        list(found.frames())
        assert found.damage == []
        assert "KOSMIK 120, firmware 4.17, V4 layout" in found.provenance["esc1"]


@pytest.mark.parametrize("wait", [False, True])
def test_a_folder_that_cannot_be_made(wait: bool, start: Callable[..., Run], tmp_path: Path) -> None:
    """An error at once for a person, no obstacle for a service."""
    config = tmp_path / "gw.toml"
    (tmp_path / "file").write_text("")
    with telemetry(EscOptions()) as ports:
        config.write_text(configuration(ports))
        words = ["--wait"] if wait else []
        run = start(config, "--record", tmp_path / "file" / "captures", *words)
        if not wait:
            assert run.process.wait(120) == 1
            assert run.log.count("\n") == 1
            assert "Give another folder (record.directory, --record)" in run.log
            return
        run.wait_for("esc1: telemetry ok")
        run.wait_for("cannot be written: Not a directory. Trying again.")
        assert run.end() == 0


def test_the_logs_of_several_parts_are_what_a_replay_of_all_gives(start: Callable[..., Run], tmp_path: Path) -> None:
    config = tmp_path / "gw.toml"
    with telemetry(EscOptions(period_ns=500_000, faults=Faults(noise=80))) as ports:
        config.write_text(configuration(ports, 'can_log = "candump"\npart_mb = 1'))
        run = start(config, "--record", tmp_path / "captures")
        run.wait_for("esc1: telemetry ok")
        run.wait_for(f"recording to {tmp_path}/captures, parts of 1 MB")
        folder = tmp_path / "captures"
        until(lambda: len(list(folder.glob("*.kcap"))) > 1, "parts", 600)
        assert run.end() == 0
    logs = b"".join(log.read_bytes() for log in sorted(folder.glob("*.log")))
    again = tmp_path / "again.log"
    done = subprocess.run([*PROGRAM, "replay", str(folder), "--to", "log", "-o", str(again)], check=False)
    assert done.returncode == 0

    def lines(text: bytes) -> list[tuple[int, bytes]]:
        found = [line.split(b" ", 1) for line in text.splitlines()]
        return [(round(float(when.strip(b"()")) * 1e6), rest) for when, rest in found]

    live, replayed = lines(logs), lines(again.read_bytes())
    assert [rest for _, rest in live] == [rest for _, rest in replayed]
    # the clock is read anew for each part, and may have been adjusted by some microseconds since
    assert max(abs(a - b) for (a, _), (b, _) in zip(live, replayed, strict=True)) <= 5
