"""``run --record`` as its own process: captures to the end."""

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

from kontronik_can_gw.desk import pty
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Faults, SimulatedEsc

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
    escs = [
        (SimulatedEsc(o, seed=n), t)
        for n, (o, t) in enumerate(zip(options, terminals, strict=True))
    ]
    thread = threading.Thread(target=lambda: pty.run(escs, stop=stopped.is_set), daemon=True)
    thread.start()
    try:
        yield [terminal.path for terminal in terminals]
    finally:
        stopped.set()
        thread.join(120)
        received = [terminal.received for terminal in terminals]
        for terminal in terminals:
            terminal.close()
    assert received == [0] * len(options), "something was transmitted to an ESC"


class Run:
    """The gateway's process; ``log`` is what it said so far."""

    def __init__(self, config: Path, *words: object) -> None:
        self._log = config.with_suffix(".err")
        with self._log.open("w") as file:
            self.process = subprocess.Popen(
                [*PROGRAM, "run", "-c", str(config), *map(str, words)], stderr=file
            )

    @property
    def log(self) -> str:
        return self._log.read_text()

    def wait_for(self, text: str) -> None:
        until(
            lambda: text in self.log or self.process.poll() is not None, f"{text!r} in:\n{self.log}"
        )
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


def test_a_run_is_recorded_whole_and_converts_to_the_log_that_a_replay_gives(
    start: Callable[..., Run], tmp_path: Path
) -> None:
    config = tmp_path / "gw.toml"
    noisy = EscOptions(faults=Faults(noise=0.5, lost_bytes=0.002))
    canopen = f'[canopen]\nenabled = true\nself_start = true\nstore = "{tmp_path}/store"\n'
    with telemetry(noisy, EscOptions()) as ports:
        config.write_text(configuration(ports, "", canopen))
        run = start(config, "--record", tmp_path / "captures")
        run.wait_for("esc2: telemetry ok")
        until(lambda: size_of(tmp_path / "captures") > 3 * ENOUGH, "some seconds of telemetry")
        assert run.end() == 0
    again, converted = tmp_path / "again.log", tmp_path / "converted.log"
    for words in (
        ["replay", "captures", "--to", "log", "-o", again],
        ["convert", "-q", "captures", converted],
    ):
        subprocess.run([*PROGRAM, *map(str, words)], check=True, cwd=tmp_path)
    assert again.read_bytes() == converted.read_bytes()
    assert len(again.read_text().splitlines()) > 300
    with open_input(tmp_path / "captures") as found:
        list(found.frames())
        assert found.damage == []
        assert "KOSMIK 120, firmware 4.17, V4 layout" in found.provenance["esc1"]


def test_a_can_log_is_not_written_any_more_and_the_gateway_runs(
    start: Callable[..., Run], tmp_path: Path
) -> None:
    """By a configuration of 0.5.0."""
    config = tmp_path / "gw.toml"
    with telemetry(EscOptions()) as ports:
        config.write_text(configuration(ports, 'directory = "captures"\ncan_log = "blf"'))
        run = start(config)
        run.wait_for("esc1: telemetry ok")
        assert run.end() == 0
    assert (
        f"warning: {config}: record.can_log: was removed and is ignored. `kontronik-can-gw convert"
        in run.log
    )
    assert [path.suffix for path in (tmp_path / "captures").iterdir()] == [".kcap"]


@pytest.mark.parametrize("wait", [False, True])
def test_a_folder_that_cannot_be_made(
    wait: bool, start: Callable[..., Run], tmp_path: Path
) -> None:
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
