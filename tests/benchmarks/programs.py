"""What all benchmarks share: figures with their targets, and one measurement of a program while a feeder plays the ESCs."""

import ctypes
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
FIVE = HERE / "five.dbc"
PROGRAMS = ("c", "ours", "obvious")
CANOPEN = '[canopen]\nenabled = true\nself_start = true\nstore = "store"\n'
EVERYTHING = f'{CANOPEN}[record]\ndirectory = "captures"\n'
"""Nodes and recorder, beside the status file that every run has."""
STATUS_FOLDER = Path("/dev/shm")
"""In memory, as a service's /run is: another file system may begin to write out what replaces a file."""
_PRIORITY = 80
"""Of the feeder, where we may: what it measures is not to be its own delay."""
# what is compiled at the first run is there from then on
ENVIRONMENT = os.environ | {"PYTHONHASHSEED": "0", "PYTHONDONTWRITEBYTECODE": ""}


class LeftOut(Exception):
    """This benchmark cannot be run here. The text says what is missing and how to get it, in one line."""


class Figure(NamedTuple):
    """A line of the table. ``target``: "<= 2.2" or ">= 4"; a missed one is no error."""

    name: str
    value: float
    unit: str
    target: str = ""
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """None where there is no target."""
        if not self.target:
            return None
        sign, limit = self.target.split()
        return self.value <= float(limit) if sign == "<=" else self.value >= float(limit)


@dataclass
class Context:
    """How long a benchmark may measure, and where it may write. ``rounds``: of measurements that are compared, by turns."""

    folder: Path
    seconds: float = 5.0
    rounds: int = 3
    quick: bool = False
    """As short as it can be: for trying the benchmarks themselves. Figures mean little."""

    def compiled(self, name: str, *options: str) -> Path:
        """The program made of a C file in peers/ by gcc -O2; made anew only where the file has changed."""
        source, gcc = HERE / "peers" / name, shutil.which("gcc")
        if gcc is None:
            raise LeftOut(f"no gcc to compile {name} with:  sudo apt-get install gcc libc6-dev")
        program = self.folder / source.stem
        if not program.exists() or program.stat().st_mtime < source.stat().st_mtime:
            command = [gcc, "-O2", "-Wall", "-Wextra", "-o", str(program), str(source), *options]
            subprocess.run(command, check=True)
        return program


def say(text: str) -> None:
    """A line of progress, to standard error."""
    print(f"  {text}", file=sys.stderr, flush=True)


def median(values: Sequence[float]) -> float:
    return float(statistics.median(values))


# --- processes


@contextmanager
def started(command: Sequence[object], **further: Any) -> Iterator["subprocess.Popen[str]"]:
    """A child that ends with the block, and with us however we end."""

    def die_with_us() -> None:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)

    words = list(map(str, command))
    with subprocess.Popen(words, text=True, preexec_fn=die_with_us, **further) as process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(3)
            except subprocess.TimeoutExpired:
                process.kill()


def standin(bus: str, *words: object) -> list[object]:
    """The command of a Python program on a bus that is no CAN interface."""
    return [sys.executable, HERE / "standin.py", bus, *words]


def new_bus() -> str:
    return f"kontronik-{uuid.uuid4().hex[:12]}"


def write_config(folder: Path, ports: Sequence[str], dbc: Path, further: str = "") -> Path:
    """Our configuration; the 1 Mbit/s are what its bus load is compared with. ``further``: lines, tables at their end."""
    lines = ['[can]\ninterface = "socketcan"\nchannel = "lo"\nbitrate = 1000000']
    status = (STATUS_FOLDER if STATUS_FOLDER.is_dir() else folder) / f"{folder.name}.json"
    lines += [f'[dbc]\nfile = "{dbc}"', further, f'[statistics]\nfile = "{status}"']
    for index, port in enumerate(ports, 1):
        lines.append(f'[[esc]]\nport = "{port}"\nname = "e{index}"\npole_pairs = 7')
    file = folder / "gateway.toml"
    file.write_text("\n".join(lines) + "\n")
    return file


# --- a measurement


class Measured(NamedTuple):
    """What one run gave. ``cpu_us``: of all threads of the gateway, for each live frame; ``result``: what the feeder says."""

    cpu_us: float
    cpu_share: float
    rss_mb: float
    result: dict[str, Any]

    @property
    def delay(self) -> dict[str, float]:
        """count, p50, p90, p99, p999, max in microseconds."""
        found: dict[str, float] = self.result["delay_us"]
        return found

    @property
    def frames(self) -> int:
        """CAN frames that there should have been."""
        return 5 * int(self.result["sent"])

    @property
    def lost_share(self) -> float:
        return self.result["lost"] / self.frames if self.frames else 0.0


def _cpu_ns(pid: int) -> int:
    """CPU time of all threads of a process."""
    total = 0
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):  # it has just ended
            total += int((thread / "schedstat").read_text().split()[0])
    return total


def _rss_mb(pid: int) -> float:
    found = re.search(r"^VmRSS:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert found
    return int(found[1]) / 1024


def once(
    context: Context,
    program: str,
    escs: int,
    *options: str,
    config: str = "",
    dbc: Path = FIVE,
    prefix: Sequence[str] = (),
) -> Measured:
    """One measurement. ``options``: of the feeder; ``config``: of ours; ``prefix``: in front of the gateway's command."""
    bus, warmup = new_bus(), 0.5 if context.quick else 2.0
    words = f"--bus {bus} --escs {escs} --seconds {context.seconds} --warmup {warmup} --priority {_PRIORITY}"
    limited = ["timeout", context.seconds + warmup + 30, context.compiled("feeder.c", "-pthread")]
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kontronik-bench-")))
        log = stack.enter_context((folder / "errors").open("w"))
        feeding = started([*limited, *words.split(), *options], stdin=pipe, stdout=pipe)
        feeder = stack.enter_context(feeding)
        assert feeder.stdout is not None
        ports = json.loads(feeder.stdout.readline())["ports"]
        if program == "c":
            command: list[object] = [context.compiled("gateway.c"), bus, *ports]
        elif program == "obvious":
            command = standin(bus, program, FIVE, "lo", *ports)
        else:
            command = standin(bus, program, "run", "-c", write_config(folder, ports, dbc, config))
        streams = {"stdin": nothing, "stdout": nothing, "stderr": log, "env": ENVIRONMENT}
        gateway = stack.enter_context(started([*prefix, *command], **streams))

        def heard(is_last: bool = False) -> dict[str, Any]:
            """The gateway may end with the bus, before the feeder has said all."""
            line = feeder.stdout.readline() if feeder.stdout else ""
            if not line or (gateway.poll() is not None and not is_last):
                said = (folder / "errors").read_text().strip()[-2000:]
                raise RuntimeError(f"{program} or the feeder ended: {said}")
            found: dict[str, Any] = json.loads(line)
            return found

        begun = heard()["begin"]
        before, since = _cpu_ns(gateway.pid), time.monotonic_ns()
        frames = max(1, heard()["end"] - begun)
        used, took = _cpu_ns(gateway.pid) - before, time.monotonic_ns() - since
        if not used:
            raise LeftOut("this kernel counts CPU time by ticks, too coarse to compare")
        rss = _rss_mb(gateway.pid)
        measured = Measured(used / 1000 / frames, used / took, rss, heard(True))
    delay = measured.delay
    say(
        f"{program} {escs:3} ESC: {measured.cpu_us:7.1f} us/frame, {measured.cpu_share:5.1%} of a core, RSS {rss:.1f} MB, "
        f"lost {measured.lost_share:.2%}, delay {delay['p50']} / {delay['p99']} / {delay['max']:.0f} us"
    )
    return measured
