"""Figures with their targets, and measurements of a program while a feeder simulates the ESCs."""

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
"""Nodes and recorder, in addition to the status file that every run has."""
STATUS_FOLDER = Path("/dev/shm")
"""A folder in memory, as /run of a service is. Other file systems may write to the disk at once."""
_PRIORITY = 80
"""Priority of the feeder if we may set it, so that its own delays are not measured."""
# the first run compiles modules, and the next ones use them
ENVIRONMENT = os.environ | {"PYTHONHASHSEED": "0", "PYTHONDONTWRITEBYTECODE": ""}


class LeftOut(Exception):
    """This benchmark cannot be run here.

    The text names the missing program and the command that installs it, in one line.
    """


class Figure(NamedTuple):
    """A line of the table. ``target`` is like "<= 2.2" or ">= 4", and may be missed."""

    name: str
    value: float
    unit: str
    target: str = ""
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """True if the value reaches the target. None without a target."""
        if not self.target:
            return None
        sign, limit = self.target.split()
        if sign == "<=":
            return self.value <= float(limit)
        return self.value >= float(limit)


@dataclass
class Context:
    """The duration of measurements, and the folder for their files."""

    folder: Path
    seconds: float = 5.0
    """Duration of one measurement."""
    long_seconds: float = 600.0
    """Duration of a measurement that looks for a rare delay."""
    rounds: int = 3
    """Number of measurements of each program, which are made by turns."""
    quick: bool = False
    """Makes all measurements as short as possible, to try the benchmarks. Figures mean little."""

    def compiled(self, name: str, *options: str) -> Path:
        """Return the program that gcc -O2 makes from a C file in peers/.

        It is compiled again only if the file has changed.
        """
        source = HERE / "peers" / name
        gcc = shutil.which("gcc")
        if gcc is None:
            raise LeftOut(f"no gcc to compile {name} with:  sudo apt-get install gcc libc6-dev")
        program = self.folder / source.stem
        if not program.exists() or program.stat().st_mtime < source.stat().st_mtime:
            flags = ["-O2", "-Wall", "-Wextra", *options]
            command = [gcc, *flags, "-o", str(program), str(source)]
            subprocess.run(command, check=True)
        return program


def say(text: str) -> None:
    """Print a line of progress to standard error."""
    print(f"  {text}", file=sys.stderr, flush=True)


def median(values: Sequence[float]) -> float:
    return float(statistics.median(values))


# --- processes


@contextmanager
def started(command: Sequence[object], **further: Any) -> Iterator["subprocess.Popen[str]"]:
    """Start a child process that ends with the block, or with this process in any case."""

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
    """Return the command of a Python program on a bus without a CAN interface."""
    return [sys.executable, HERE / "standin.py", bus, *words]


def new_bus() -> str:
    return f"kontronik-{uuid.uuid4().hex[:12]}"


def write_config(
    folder: Path,
    ports: Sequence[str],
    dbc: Path,
    further: str = "",
    can: str = "",
) -> Path:
    """Write the gateway's configuration.

    The bus load is compared with its 1 Mbit/s. ``further`` has more lines, with tables at the end.
    ``can`` has more lines of [can].
    """
    lines = [f'[can]\ninterface = "socketcan"\nchannel = "lo"\nbitrate = 1000000\n{can}']
    status_folder = STATUS_FOLDER if STATUS_FOLDER.is_dir() else folder
    status = status_folder / f"{folder.name}.json"
    lines += [f'[dbc]\nfile = "{dbc}"', further, f'[statistics]\nfile = "{status}"']
    for index, port in enumerate(ports, 1):
        lines.append(f'[[esc]]\nport = "{port}"\nname = "e{index}"\npole_pairs = 7')
    file = folder / "gateway.toml"
    file.write_text("\n".join(lines) + "\n")
    return file


# --- a measurement


class Measured(NamedTuple):
    """The results of one run."""

    cpu_us: float
    """CPU time of all threads of the gateway for each live frame."""
    cpu_share: float
    """Share of a core."""
    rss_mb: float
    result: dict[str, Any]
    """The results printed by the feeder."""

    @property
    def delay(self) -> dict[str, float]:
        """The delays count, p50, p90, p99, p999 and max, in microseconds."""
        found: dict[str, float] = self.result["delay_us"]
        return found

    @property
    def frames(self) -> int:
        """Number of CAN frames that should have been sent."""
        return 5 * int(self.result["sent"])

    @property
    def lost_share(self) -> float:
        return self.result["lost"] / self.frames if self.frames else 0.0


def cpu_ns(pid: int) -> int:
    """Return the CPU time of all threads of a process."""
    total = 0
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):  # the thread has just ended
            total += int((thread / "schedstat").read_text().split()[0])
    return total


def rss_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    found = re.search(r"^VmRSS:\s+(\d+) kB$", status, re.MULTILINE)
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
    """Measure a program once.

    ``options`` are words for the feeder, ``config`` is added to the gateway's configuration, and
    ``prefix`` is put before the gateway's command.
    """
    bus = new_bus()
    warmup = 0.5 if context.quick else 2.0
    words = f"--bus {bus} --escs {escs} --seconds {context.seconds}"
    words += f" --warmup {warmup} --priority {_PRIORITY}"
    limited = ["timeout", context.seconds + warmup + 30, context.compiled("feeder.c", "-pthread")]
    pipe = subprocess.PIPE
    nothing = subprocess.DEVNULL
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
            """Read a line of the feeder.

            The gateway ends with the bus, perhaps before the feeder has written its last line.
            """
            line = feeder.stdout.readline() if feeder.stdout else ""
            if not line or (gateway.poll() is not None and not is_last):
                said = (folder / "errors").read_text().strip()[-2000:]
                raise RuntimeError(f"{program} or the feeder ended: {said}")
            found: dict[str, Any] = json.loads(line)
            return found

        begun = heard()["begin"]
        before = cpu_ns(gateway.pid)
        since = time.monotonic_ns()
        frames = max(1, heard()["end"] - begun)
        used = cpu_ns(gateway.pid) - before
        took = time.monotonic_ns() - since
        if not used:
            raise LeftOut("this kernel counts CPU time by ticks, too coarse to compare")
        rss = rss_mb(gateway.pid)
        measured = Measured(used / 1000 / frames, used / took, rss, heard(True))
    delay = measured.delay
    say(
        f"{program} {escs:3} ESC: {measured.cpu_us:7.1f} us/frame, "
        f"{measured.cpu_share:5.1%} of a core, RSS {rss:.1f} MB, "
        f"lost {measured.lost_share:.2%}, "
        f"delay {delay['p50']} / {delay['p99']} / {delay['max']:.0f} us"
    )
    return measured
