"""CPU time and delay of the gateway and of the two other programs, its start and its memory."""

import os
import re
import socket
import subprocess
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from programs import (
    CANOPEN,
    ENVIRONMENT,
    EVERYTHING,
    HERE,
    PROGRAMS,
    Context,
    Figure,
    Measured,
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
    """CPU time for a live frame at 1, 8 and 64 ESCs: C, ours, the obvious program.

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
        note = f"delay, 99 %: {run.delay['p99']} us, longest {run.delay['max']:.0f}"
        lost = run.result["lost"]
        figures.append(Figure(f"{what}: CAN frames lost", lost, f"of {run.frames}", "<= 0", note))
        figures.append(Figure(f"{what}: share of a core", run.cpu_share * 100, "%"))
    return figures


def delay(context: Context) -> list[Figure]:
    """Delay from the last byte to the fifth CAN frame, one ESC: C, ours, the obvious program."""
    found = compare(context, 1)
    figures = []
    for program, runs in found.items():
        note = f"99 %: {delay_of(runs, 'p99'):.0f}, longest {delay_of(runs, 'max'):.0f}"
        figures.append(Figure(f"{program}, median", delay_of(runs, "p50"), "us", note=note))
    pairs = zip(found["ours"], found["c"], strict=True)
    value = median([ours.delay["p50"] / c.delay["p50"] for ours, c in pairs])
    figures.append(Figure("ours / c, median", value, "x", "<= 1.1"))
    figures.append(Figure("ours, 99 %", delay_of(found["ours"], "p99"), "us", "<= 2000"))
    return figures


def delay_full(context: Context) -> list[Figure]:
    """The same delay with 8 ESCs, recorder, status file, CANopen nodes and a busy master.

    The master asks 200 times a second for one of 20 objects.
    """
    runs = [once(context, "ours", 8, "--sdo", config=EVERYTHING) for _ in range(context.rounds)]
    asked = sum(run.result["sdo_sent"] for run in runs)
    answered = sum(run.result["sdo_answers"] for run in runs)
    if not answered:
        raise RuntimeError("the nodes answered no SDO request")
    lost = max(0, asked - answered - len(runs))  # the end of a run may cut off its last answer
    answer = median([run.result["sdo_us"]["p99"] for run in runs])
    longest = f"longest {delay_of(runs, 'max'):.0f}"
    return [
        Figure("8 ESCs and all, median", delay_of(runs, "p50"), "us"),
        Figure("8 ESCs and all, 99 %", delay_of(runs, "p99"), "us", "<= 1000", longest),
        Figure("SDO answers, 99 %", answer, "us"),
        Figure("SDO requests not answered", lost, f"of {asked}", "<= 0"),
        Figure("CPU, all of it", cpu_of(runs), "us/frame", note=losses(runs)),
    ]


# --- start and memory


def first_frame_ms(escs: int, config: str) -> float:
    """Start the gateway on a new bus, wait for its first frame, and end it. Returns ms."""
    bus = new_bus()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kontronik-bench-")))
        ports = [stack.enter_context(PtyEsc()).path for _ in range(escs)]
        family = socket.AF_UNIX, socket.SOCK_SEQPACKET
        listener = stack.enter_context(socket.socket(*family))
        listener.bind("\0" + bus)
        listener.listen(1)
        listener.settimeout(_PATIENCE_S)
        file = write_config(folder, ports, SHIPPED, config)
        command = standin(bus, "ours", "run", "-c", file)
        log = stack.enter_context((folder / "errors").open("w"))
        begun = time.perf_counter()
        stack.enter_context(started(command, stdin=subprocess.DEVNULL, stderr=log, env=ENVIRONMENT))
        try:
            frames = stack.enter_context(listener.accept()[0])
            frames.settimeout(_PATIENCE_S)
            frames.recv(128)
        except TimeoutError:
            raise RuntimeError(f"no frame came: {(folder / 'errors').read_text()}") from None
        return (time.perf_counter() - begun) * 1e3


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
