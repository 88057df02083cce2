"""Starts feeder and gateways, and measures the CPU time of a gateway while telemetry flows.

with running(context, "c", 8) as (feeder, gateway):    # "c", "ours" or "obvious"
    measured = feeder.measure(gateway)
"""

import contextlib
import ctypes
import json
import os
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from registry import HERE, Context

FIVE = HERE / "five.dbc"
STANDIN = HERE / "standin.py"
PROGRAMS = ("c", "ours", "obvious")
CANOPEN = '[canopen]\nenabled = true\nself_start = true\nstore = "store"\n'
EVERYTHING = f'{CANOPEN}[record]\ndirectory = "captures"\n[statistics]\nfile = "status.json"\n'
"""Nodes, recorder, status file."""
_PRIORITY = 80
"""Of the feeder, where we may: what it measures is not to be its own delay."""


@dataclass
class Measured:
    """What one run gave. ``cpu_us``: of all threads of the gateway, for each live frame."""

    cpu_us: float
    cpu_share: float
    sent: int
    lost: int
    result: dict[str, Any]

    @property
    def delay(self) -> dict[str, float]:
        """count, p50, p90, p99, p999, max in microseconds."""
        return cast(dict[str, float], self.result["delay_us"])

    @property
    def lost_share(self) -> float:
        """Of the CAN frames."""
        return self.lost / (5 * self.sent) if self.sent else 0.0


def cpu_ns(pid: int) -> int:
    """CPU time of all threads of a process."""
    total = 0
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # it has just ended
            total += int((thread / "schedstat").read_text().split()[0])
    return total


def die_with_us() -> None:
    """In a child: end when the benchmark does, however it ends."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def start(command: Sequence[str], **further: Any) -> "subprocess.Popen[str]":
    """A child that ends with us."""
    return subprocess.Popen(command, text=True, preexec_fn=die_with_us, **further)


def end(process: "subprocess.Popen[str]", patience_s: float = 3.0) -> None:
    """End it, one way or the other."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(patience_s)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()


class Feeder:
    """The ESCs, and the other end of the bus."""

    def __init__(self, context: Context, escs: int, *options: str) -> None:
        self.bus = f"kontronik-{uuid.uuid4().hex[:12]}"
        program = context.compiled("feeder.c", "-pthread")
        warmup = 0.5 if context.quick else 2.0
        self._limit_s = context.seconds + warmup + 30
        words = f"--bus {self.bus} --escs {escs} --seconds {context.seconds} --warmup {warmup}"
        command = [str(program), *words.split(), "--priority", str(_PRIORITY), *options]
        self.process = start(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.ports: list[str] = self._line()["ports"]

    def _line(self, gateway: "Gateway | None" = None) -> dict[str, Any]:
        """What the feeder says next; its lines come apart, and its end wakes who waits for one that was read with another."""
        assert self.process.stdout is not None
        deadline = time.monotonic() + self._limit_s
        while not select.select([self.process.stdout], [], [], 0.2)[0]:
            if gateway is not None:
                gateway.check()
            if time.monotonic() > deadline:
                raise RuntimeError("the feeder says nothing more")
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the feeder ended: exit code {self.process.wait()}")
        return cast(dict[str, Any], json.loads(line))

    def measure(self, gateway: "Gateway") -> Measured:
        """Wait for the run to be over. RuntimeError if the gateway ended meanwhile."""
        begun = self._line(gateway)["begin"]
        before, started = cpu_ns(gateway.pid), time.monotonic_ns()
        ended = self._line(gateway)["end"]
        gateway.check()
        used, took = cpu_ns(gateway.pid) - before, time.monotonic_ns() - started
        result = self._line()
        frames = max(1, ended - begun)
        return Measured(used / 1000 / frames, used / took, result["sent"], result["lost"], result)

    def close(self) -> None:
        end(self.process, 0.5)


class Gateway:
    """One of the three programs at work."""

    def __init__(
        self,
        context: Context,
        program: str,
        feeder: Feeder,
        config: str = "",
        dbc: Path = FIVE,
        wrap: Callable[[list[str]], list[str]] = list,
    ) -> None:
        """``config``: further lines of our configuration, tables at their end. ``wrap`` makes another command of the command."""
        self._folder = tempfile.TemporaryDirectory(prefix="kontronik-bench-")
        self.folder = folder = Path(self._folder.name)
        if program == "c":
            command = [str(context.compiled("gateway.c")), feeder.bus, *feeder.ports]
        else:
            command = [sys.executable, str(STANDIN), feeder.bus, program]
            if program == "obvious":
                command += [str(FIVE), "lo", *feeder.ports]
            else:
                text = config_text(feeder.ports, dbc, folder, config)
                (folder / "gateway.toml").write_text(text)
                command += ["run", "-c", str(folder / "gateway.toml")]
        self._errors = (folder / "errors").open("w+")
        # what is compiled at the first run is there from then on
        same = os.environ | {"PYTHONHASHSEED": "0", "PYTHONDONTWRITEBYTECODE": ""}
        nothing = subprocess.DEVNULL
        self.process = start(
            wrap(command), stdin=nothing, stdout=nothing, stderr=self._errors, env=same
        )
        self.program = program
        self.pid = self.process.pid

    def check(self) -> None:
        """RuntimeError if it has ended."""
        if self.process.poll() is not None:
            raise RuntimeError(f"{self.program} ended by itself: {self.said()}")

    def said(self) -> str:
        """What it wrote to standard error."""
        self._errors.flush()
        return (self.folder / "errors").read_text().strip()[-2000:]

    def close(self) -> None:
        end(self.process)
        self._errors.close()
        self._folder.cleanup()


def config_text(ports: Sequence[str], dbc: Path, folder: Path, further: str = "") -> str:
    """Our configuration; the 1 Mbit/s are what its bus load is compared with."""
    lines = ["[can]", 'interface = "socketcan"', 'channel = "lo"', "bitrate = 1000000"]
    lines += ["[dbc]", f'file = "{dbc}"', further]
    if "[statistics]" not in further:
        lines += ["[statistics]", f'file = "{folder / "status.json"}"']
    for index, port in enumerate(ports):
        lines += ["[[esc]]", f'port = "{port}"', f'name = "e{index + 1}"', "pole_pairs = 7"]
    return "\n".join(lines) + "\n"


@contextlib.contextmanager
def running(
    context: Context, program: str, escs: int, *options: str, **further: Any
) -> Iterator[tuple[Feeder, Gateway]]:
    """A feeder and a gateway, both ended at the end."""
    feeder = Feeder(context, escs, *options)
    try:
        gateway = Gateway(context, program, feeder, **further)
        try:
            yield feeder, gateway
        except RuntimeError as error:
            raise RuntimeError(f"{program}: {error}; it said: {gateway.said()}") from None
        finally:
            gateway.close()
    finally:
        feeder.close()


def once(context: Context, program: str, escs: int, *options: str, **further: Any) -> Measured:
    """One measurement."""
    with running(context, program, escs, *options, **further) as (feeder, gateway):
        measured = feeder.measure(gateway)
    delay = measured.delay
    context.say(
        f"{program} {escs:3} ESC: {measured.cpu_us:7.1f} us/frame, {measured.cpu_share:5.1%} of a core, lost {measured.lost} of "
        f"{5 * measured.sent}, delay {delay['p50']} / {delay['p99']} / {delay['max']:.0f} us"
    )
    return measured


def median(values: Sequence[float]) -> float:
    """Of a few rounds."""
    return float(statistics.median(values))
