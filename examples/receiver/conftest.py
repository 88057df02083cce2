"""A gateway with a simulated ESC on a virtual CAN bus, for tests of a receiver."""

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
    """The commands ``run`` and ``simulate`` of kontronik-can-gw, each in its own process.

    Gateway and bus are real. Only the ESC is simulated.
    """

    def __init__(self, folder: Path) -> None:
        self._port = folder / "esc1"
        self._processes: list[subprocess.Popen[bytes]] = []
        config = folder / "gateway.toml"
        config.write_text(
            f'[can]\nchannel = "{CHANNEL}"\n'
            "[run]\nwait_for_devices = true\n"
            f'[[esc]]\nport = "{self._port}"\npole_pairs = 7\n'
        )
        self.gateway = self._start("run", "-c", config)

    def plug_in(self, *options: str) -> None:
        """Connect the ESC, which then sends. ``options`` are those of kontronik-can-gw simulate."""
        self.esc = self._start("simulate", "--link", self._port, *options)

    def unplug(self) -> None:
        """Remove the ESC and its port."""
        self.esc.terminate()
        self.esc.wait()

    def bus(self, state: str) -> None:
        """Set the bus "down", like a broken cable or a bus-off does, or "up" again."""
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
    """Wait for a condition. No working machine reaches the limit."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, "the condition did not become true"
        time.sleep(0.01)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.end()


@pytest.fixture
def display() -> Iterator[Display]:
    """Return the receiver under test. Replace it by your own."""
    display = Display(CHANNEL, str(DBC))
    yield display
    display.close()
