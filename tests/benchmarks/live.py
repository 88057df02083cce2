"""CPU time and delay of the gateway and of the two other programs, its start and its memory."""

import os
import re
import socket
import subprocess
import tempfile
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from programs import (
    CANOPEN,
    ENVIRONMENT,
    EVERYTHING,
    HERE,
    PROGRAMS,
    Context,
    Figure,
    Measured,
    cpu_ns,
    median,
    new_bus,
    once,
    standin,
    started,
    write_config,
)

from kontronik_can_gw.desk.pty import PtyEsc

SHIPPED = HERE.parents[1] / "dbc" / "kontronik_esc.dbc"
_PATIENCE_S = 20.0
_EXTENDED = 0x80000000


def compare(context: Context, escs: int) -> dict[str, list[Measured]]:
    """Run the three programs by turns, so that other work of the machine disturbs all of them."""
    found: dict[str, list[Measured]] = {program: [] for program in PROGRAMS}
    for _ in range(context.rounds):
        for program, runs in found.items():
            runs.append(once(context, program, escs))
    return found


def cpu_of(runs: list[Measured]) -> float:
    return median([run.cpu_us for run in runs])


def delay_of(runs: list[Measured], key: str) -> float:
    return median([run.delay[key] for run in runs])


def losses(runs: list[Measured]) -> str:
    """Return a note on lost frames, or "" if less than 0.1 % are lost."""
    share = median([run.lost_share for run in runs])
    return f"{share:.1%} of its CAN frames lost" if share >= 0.001 else ""


def ratio(above: list[Measured], below: list[Measured]) -> float:
    """Return the median of the ratios of CPU times in all rounds."""
    rounds = zip(above, below, strict=True)
    return median([one.cpu_us / other.cpu_us for one, other in rounds])


def cpu(context: Context) -> list[Figure]:
    """CPU time for a live frame at 1, 8 and 64 ESCs: C, ours, the baseline program.

    Frames that are lost need no CPU time, so the losses are noted.
    """
    figures = []
    targets = {
        1: ("<= 1.35", ">= 6"),
        8: ("<= 1.25", ">= 6"),
        64: ("<= 1.2", ""),
    }
    if context.quick:
        targets = {1: targets[1]}
    for escs, (most, least) in targets.items():
        found = compare(context, escs)
        for program, runs in found.items():
            name = f"{program}, {escs} ESC"
            figures.append(Figure(name, cpu_of(runs), "us/frame", note=losses(runs)))
        ours = found["ours"]
        note = losses(ours)
        to_c = ratio(ours, found["c"])
        to_obvious = ratio(found["obvious"], ours)
        figures.append(Figure(f"ours / c, {escs} ESC", to_c, "x", most, note))
        figures.append(Figure(f"obvious / ours, {escs} ESC", to_obvious, "x", least, note))
    return figures


def canopen(context: Context) -> list[Figure]:
    """CPU time at 8 ESCs with CANopen nodes and default PDOs, and without them, by turns."""
    plain = []
    both = []
    for _ in range(context.rounds):
        plain.append(once(context, "ours", 8))
        both.append(once(context, "ours", 8, config=CANOPEN))
    frames = median([run.result["others"] / run.result["sent"] for run in both])
    if not frames:
        raise RuntimeError("the CANopen nodes sent nothing")
    note = f"{frames:.1f} CANopen frames each"
    return [
        Figure("ours, 8 ESC, CANopen too", cpu_of(both), "us/frame", note=note),
        Figure("with / without CANopen", ratio(both, plain), "x", "<= 1.25"),
    ]


def many(context: Context) -> list[Figure]:
    """No frame is lost with 128 ESCs, nor with 30 ESCs on one core.

    30 ESCs send 15 000 CAN frames a second, as many as two buses can carry. A frame also counts as
    lost if it was replaced by the next one because the process had to wait.
    """
    figures = []
    last_core = max(os.sched_getaffinity(0))
    pinned = ("taskset", "-c", str(last_core))
    cases: list[tuple[int, tuple[str, ...]]] = [
        (128, ()),
        (30, pinned),
    ]
    if context.quick:
        cases = [(4, ()), (2, pinned)]
    for escs, prefix in cases:
        run = once(context, "ours", escs, prefix=prefix)
        what = f"{escs} ESCs" + (" on one core" if prefix else "")
        note = f"latency, p99: {run.delay['p99']} us, maximum {run.delay['max']:.0f}"
        lost = run.result["lost"]
        figures.append(Figure(f"{what}: CAN frames lost", lost, f"of {run.frames}", "<= 0", note))
        figures.append(Figure(f"{what}: share of a core", run.cpu_share * 100, "%"))
    return figures


def delay(context: Context) -> list[Figure]:
    """Latency from the last byte to the fifth CAN frame, one ESC: C, ours, the baseline program."""
    found = compare(context, 1)
    figures = []
    for program, runs in found.items():
        note = f"p99: {delay_of(runs, 'p99'):.0f}, maximum {delay_of(runs, 'max'):.0f}"
        figures.append(Figure(f"{program}, median", delay_of(runs, "p50"), "us", note=note))
    pairs = zip(found["ours"], found["c"], strict=True)
    value = median([ours.delay["p50"] / c.delay["p50"] for ours, c in pairs])
    figures.append(Figure("ours / c, median", value, "x", "<= 1.1"))
    figures.append(Figure("ours, p99", delay_of(found["ours"], "p99"), "us", "<= 2000"))
    return figures


def delay_full(context: Context) -> list[Figure]:
    """The same latency with 8 ESCs, recorder, status file, CANopen nodes and a busy master.

    The master asks 200 times a second for one of 20 objects.
    """
    runs = [once(context, "ours", 8, "--sdo", config=EVERYTHING) for _ in range(context.rounds)]
    asked = sum(run.result["sdo_sent"] for run in runs)
    answered = sum(run.result["sdo_answers"] for run in runs)
    if not answered:
        raise RuntimeError("the nodes answered no SDO request")
    lost = max(0, asked - answered - len(runs))  # the end of a run may cut off its last answer
    answer = median([run.result["sdo_us"]["p99"] for run in runs])
    longest = f"maximum {delay_of(runs, 'max'):.0f}"
    return [
        Figure("8 ESCs and all, median", delay_of(runs, "p50"), "us"),
        Figure("8 ESCs and all, p99", delay_of(runs, "p99"), "us", "<= 1000", longest),
        Figure("SDO responses, p99", answer, "us"),
        Figure("SDO requests not answered", lost, f"of {asked}", "<= 0"),
        Figure("CPU, all of it", cpu_of(runs), "us/frame", note=losses(runs)),
    ]


# --- start and memory


def first_frame_ms(escs: int, config: str) -> float:
    """Start the gateway on a new bus, wait for its first frame, and end it. Returns ms."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kontronik-bench-")))
        gateway = silent_gateway(stack, folder, escs, config)
        return gateway.first_frame_ms


class Silent(NamedTuple):
    """A gateway that has sent its first frame, and hears no ESC."""

    process: "subprocess.Popen[str]"
    frames: socket.socket
    """Returns the frames that the gateway sends."""
    first_frame_ms: float
    """Time from its start to the first frame."""


def silent_gateway(stack: ExitStack, folder: Path, escs: int, config: str, can: str = "") -> Silent:
    """Start a gateway on a new bus, and wait for its first frame. It ends with ``stack``."""
    bus = new_bus()
    ports = [stack.enter_context(PtyEsc()).path for _ in range(escs)]
    family = socket.AF_UNIX, socket.SOCK_SEQPACKET
    listener = stack.enter_context(socket.socket(*family))
    listener.bind("\0" + bus)
    listener.listen(1)
    listener.settimeout(_PATIENCE_S)
    file = write_config(folder, ports, SHIPPED, config, can)
    command = standin(bus, "ours", "run", "-c", file)
    log = stack.enter_context((folder / "errors").open("w"))
    begun = time.perf_counter()
    streams = {"stdin": subprocess.DEVNULL, "stderr": log, "env": ENVIRONMENT}
    process = stack.enter_context(started(command, **streams))
    try:
        frames = stack.enter_context(listener.accept()[0])
        frames.settimeout(_PATIENCE_S)
        frames.recv(128)
    except TimeoutError:
        raise RuntimeError(f"no frame came: {(folder / 'errors').read_text()}") from None
    return Silent(process, frames, (time.perf_counter() - begun) * 1e3)


_QUIET = "quiet_after_s = 1"
_SETTLED_S = 3.0
"""Pause after the first frame. Quiet mode begins within it."""


def silent_us(context: Context, escs: int, config: str, can: str) -> float:
    """Return the CPU time in a second of a gateway that hears no ESC, in us."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kontronik-bench-")))
        gateway = silent_gateway(stack, folder, escs, config, can)
        drain(gateway.frames, _SETTLED_S)
        before = cpu_ns(gateway.process.pid)
        since = time.monotonic_ns()
        count = drain(gateway.frames, context.seconds)
        used = cpu_ns(gateway.process.pid) - before
        took = time.monotonic_ns() - since
    if bool(count) == bool(can):
        raise RuntimeError(f"{count} frames were sent")
    return used * 1e6 / took


def drain(frames: socket.socket, seconds: float) -> int:
    """Read frames for this time. Returns their number."""
    count = 0
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        frames.settimeout(left)
        with suppress(TimeoutError):
            count += bool(frames.recv(128))
    return count


def quiet(context: Context) -> list[Figure]:
    """CPU time without telemetry, in quiet mode and without it, by turns."""
    figures = []
    cases = {"1 ESC": (1, ""), "8 ESCs, CANopen": (8, CANOPEN)}
    for name, (escs, config) in cases.items():
        found: dict[str, list[float]] = {"": [], _QUIET: []}
        for _ in range(context.rounds):
            for can, times in found.items():
                times.append(silent_us(context, escs, config, can))
        pairs = zip(found[_QUIET], found[""], strict=True)
        ratios = [one / other for one, other in pairs]
        figures.append(Figure(f"idle, {name}", median(found[""]), "us/s"))
        figures.append(Figure(f"quiet, {name}", median(found[_QUIET]), "us/s"))
        figures.append(Figure(f"quiet / idle, {name}", median(ratios), "x", "<= 0.5"))
    return figures


def start(context: Context) -> list[Figure]:
    """Time from exec to the first CAN frame: 1 and 8 ESCs, CANopen, by turns."""
    cases = {"1 ESC": (1, ""), "8 ESCs": (8, "")}
    cases |= {"1 ESC, CANopen": (1, CANOPEN), "8 ESCs, CANopen": (8, CANOPEN)}
    first_frame_ms(1, CANOPEN)  # the first run compiles modules
    found: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(2 * context.rounds - 1):
        for name, (escs, config) in cases.items():
            found[name].append(first_frame_ms(escs, config))
    aims = {"1 ESC": "<= 250"}
    return [
        Figure(f"first CAN frame, {name}", median(times), "ms", aims.get(name, ""))
        for name, times in found.items()
    ]


def many_escs_dbc(folder: Path) -> Path:
    """Write the shipped DBC with 29-bit ids, so that 64 ESCs have enough ids.

    Its messages are sent so seldom that a bus could carry them.
    """
    text = SHIPPED.read_text()
    found_ids = set(re.findall(r"^BO_ (\d+)", text, re.MULTILINE))
    ids = "|".join(sorted(found_ids))
    text = re.sub(rf"\b({ids})\b", lambda found: str(int(found[1]) | _EXTENDED), text)
    text = re.sub(r'(BA_ "GenMsgDelayTime" BO_ \d+) \d+', r"\1 500", text)
    text = re.sub(r'(BA_ "GenMsgCycleTime" BO_ \d+) [1-9]\d*', r"\1 1000", text)
    file = folder / "many_escs.dbc"
    file.write_text(text)
    return file


def memory(context: Context) -> list[Figure]:
    """RSS after some seconds of traffic with 1 to 64 ESCs, CANopen, recorder."""
    cases = {
        "1 ESC": (1, ""),
        "64 ESCs": (64, ""),
        "1 ESC, CANopen": (1, CANOPEN),
        "8 ESCs, CANopen": (8, CANOPEN),
        "1 ESC, CANopen, recorder": (1, EVERYTHING),
    }
    short = replace(context, seconds=min(context.seconds, 3.0))
    dbc = many_escs_dbc(context.folder)
    rss = {}
    for name, (escs, config) in cases.items():
        run = once(short, "ours", escs, dbc=dbc, config=config)
        rss[name] = run.rss_mb
    further = (rss["64 ESCs"] - rss["1 ESC"]) / 63
    nodes = (rss["8 ESCs, CANopen"] - rss["1 ESC, CANopen"]) / 7
    aims = {"1 ESC": "<= 24"}
    figures = []
    for name, mb in rss.items():
        figures.append(Figure(f"RSS, {name}", mb, "MB", aims.get(name, "")))
    figures.append(Figure("RSS, each further ESC", further, "MB", "<= 0.05"))
    figures.append(Figure("RSS, each further ESC, CANopen", nodes, "MB"))
    return figures
