"""A gateway with a simulated ESC on a virtual CAN bus, for tests of what receives its frames."""

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from display import Display

CHANNEL = os.environ.get("CAN_CHANNEL", "vcan0")
DBC = Path(__file__).parents[1] / "one-esc/bus.dbc"


class Bench:
    """``run`` and ``simulate`` of kontronik-can-gw, each a process of its own. Nothing is faked between them and the bus."""

    def __init__(self, folder: Path) -> None:
        self._port = folder / "esc1"
        self._processes: list[subprocess.Popen[bytes]] = []
        config = folder / "gateway.toml"
        config.write_text(
            f'[can]\nchannel = "{CHANNEL}"\n[run]\nwait_for_devices = true\n[[esc]]\nport = "{self._port}"\npole_pairs = 7\n'
        )
        self.gateway = self._start("run", "-c", config)

    def plug_in(self, *options: str) -> None:
        """The ESC appears and sends. ``options``: of kontronik-can-gw simulate."""
        self.esc = self._start("simulate", "--link", self._port, *options)

    def unplug(self) -> None:
        """The ESC, and its port with it, is gone."""
        self.esc.terminate()
        self.esc.wait()

    def bus(self, state: str) -> None:
        """Take the bus "down", as a cable or a bus-off would, or "up" again."""
        subprocess.run(["ip", "link", "set", CHANNEL, state], check=True)

    def end(self) -> None:
        for process in self._processes:
            process.terminate()
            process.wait()

    def _start(self, *words: object) -> subprocess.Popen[bytes]:
        command = ["kontronik-can-gw", *map(str, words)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        self._processes.append(process)
        return process


def until(condition: Callable[[], object], limit_s: float = 30) -> None:
    """Wait for an event; the limit is one that no working machine reaches."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.01)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.end()


@pytest.fixture
def display() -> Iterator[Display]:
    """The receiver under test. Put yours in its place."""
    display = Display(CHANNEL, str(DBC))
    yield display
    display.close()
