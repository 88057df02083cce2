"""``run --record`` as its own process: captures to the end."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

from kontronik_can_gw.desk import pty
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.esc.kontronik.simulator import EscOptions, Faults, SimulatedEsc

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
ENOUGH = 36_000
"""Bytes of a capture with some seconds of telemetry."""


@contextmanager
def telemetry(*options: EscOptions) -> Iterator[list[str]]:
    """ESCs on pseudo terminals; their paths."""
    terminals = [pty.PtyEsc() for _ in options]
    stopped = threading.Event()
    simulated = [SimulatedEsc(one, seed=number) for number, one in enumerate(options)]
    escs = list(zip(simulated, terminals, strict=True))
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
        command = [*PROGRAM, "run", "-c", str(config), *map(str, words)]
        with self._log.open("w") as file:
            self.process = subprocess.Popen(command, stderr=file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def log(self) -> str:
        return self._log.read_text()

    def wait_for(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + 120
        while not condition():
            assert self.process.poll() is None, self.log
            assert time.monotonic() < end, self.log
            time.sleep(0.01)

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(120)


def configuration(path: Path, ports: list[str], more: str = "") -> Path:
    text = f'[can]\ninterface = "virtual"\nchannel = "r{os.getpid()}"\n{more}\n'
    path.write_text(text + "".join(f'[[esc]]\nport = "{one}"\npole_pairs = 7\n' for one in ports))
    return path


def test_a_run_is_recorded_whole_and_can_be_converted(
    tmp_path: Path,
) -> None:
    """By a configuration of 0.5.0, which asks for a CAN log beside the capture: that is not written any more."""
    noisy = EscOptions(faults=Faults(noise=0.5, lost_bytes=0.002))
    more = f'[canopen]\nenabled = true\nself_start = true\nstore = "{tmp_path}/store"\n'
    more += '[record]\ncan_log = "blf"\n'
    folder = tmp_path / "captures"
    with telemetry(noisy, EscOptions()) as ports:
        config = configuration(tmp_path / "gw.toml", ports, more)
        with Run(config, "--record", folder) as run:
            run.wait_for(lambda: "esc2: telemetry ok" in run.log)
            run.wait_for(lambda: sum(p.stat().st_size for p in folder.iterdir()) > ENOUGH)
            assert run.end() == 0
    removed = (
        f"warning: {config}: record.can_log: was removed and is ignored. `kontronik-can-gw convert"
    )
    assert removed in run.log
    assert {path.suffix for path in folder.iterdir()} == {".kcap"}
    converted = tmp_path / "converted.log"
    words = [*PROGRAM, "convert", "-q", "captures", str(converted)]
    subprocess.run(words, check=True, cwd=tmp_path)
    assert len(converted.read_text().splitlines()) > 300
    with open_input(folder) as found:
        list(found.frames())
        assert found.damage == []
        assert "KOSMIK 120, firmware 4.17, V4 layout" in found.provenance["esc1"]
        assert re.fullmatch(r".*\.dbc, layout [0-9A-F]{8}", found.provenance["DBC"])
