"""The delay from a live frame's last byte to the last of its five CAN frames: beside C, with everything switched on, under load."""

import contextlib
import os
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator

from bench_programs import Measured, end, median, once, start
from live_cpu import CANOPEN, compare, keep, losses
from registry import Benchmark, Context, Figure, LeftOut

_PRIORITY = 60
RIGHT_LINE = "sudo prlimit --rtprio=99 --pid $$"


def delay(context: Context) -> list[Figure]:
    """One ESC, the three programs by turns."""
    found = compare(context, ("c", "ours", "obvious"), 1)
    keep(context, "1", found)
    figures = []
    for program, runs in found.items():
        p50, p99, longest = (median([run.delay[key] for run in runs]) for key in ("p50", "p99", "max"))
        figures.append(Figure(f"{program}, median", p50, "us", note=f"99 %: {p99:.0f}, longest {longest:.0f}"))
    value = median([a.delay["p50"] / b.delay["p50"] for a, b in zip(found["ours"], found["c"], strict=True)])
    slow = median([run.delay["p99"] for run in found["ours"]])
    figures.append(Figure("ours / c, median", value, "x", "<= 2", value <= 2))
    figures.append(Figure("ours, 99 %", slow, "us", "<= 2000", slow <= 2000))
    return figures


def everything(port: int) -> str:
    """Recorder, status file, Prometheus, nodes."""
    statistics = f'[statistics]\nfile = "status.json"\nprometheus = "127.0.0.1:{port}"\n'
    return f'{CANOPEN}[record]\ndirectory = "captures"\n{statistics}'


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port


@contextlib.contextmanager
def scraping(port: int) -> Iterator[list[int]]:
    """Be a Prometheus that asks each second, as from the moment when there is an answer. Gives the lengths of the answers."""
    sizes: list[int] = []
    over = threading.Event()

    def ask() -> None:
        while not over.wait(1):
            with (
                contextlib.suppress(OSError),
                urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=2) as answer,
            ):
                sizes.append(len(answer.read()))

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield sizes
    finally:
        over.set()
        thread.join()


def full(context: Context) -> list[Figure]:
    """8 ESCs with recorder, status file, a Prometheus that asks, CANopen nodes and a master that polls them."""
    runs = []
    for _ in range(context.rounds):
        port = _free_port()
        with scraping(port) as sizes:
            runs.append(once(context, "ours", 8, "--sdo", config=everything(port)))
        if not sizes:
            raise RuntimeError("Prometheus got no answer")
    context.data["runs"] = [run.result for run in runs]
    p50, p99, longest = (median([run.delay[key] for run in runs]) for key in ("p50", "p99", "max"))
    unanswered = sum(run.result["sdo_sent"] - run.result["sdo_answers"] for run in runs)
    asked = sum(run.result["sdo_sent"] for run in runs)
    answer = median([run.result["sdo_us"]["p99"] for run in runs])
    if not asked or unanswered == asked:
        raise RuntimeError("the nodes answered no SDO request")
    return [
        Figure("8 ESCs and all, median", p50, "us"),
        Figure("8 ESCs and all, 99 %", p99, "us", "<= 2000", p99 <= 2000, note=f"longest {longest:.0f}"),
        Figure("SDO answers, 99 %", answer, "us", note=f"{asked} requests, {unanswered} without an answer in 50 ms"),
        Figure("CPU, all of it", median([run.cpu_us for run in runs]), "us/frame", note=losses(runs)),
    ]


@contextlib.contextmanager
def burners() -> Iterator[None]:
    """Two programs a core that do nothing but work."""
    children: list[subprocess.Popen[str]] = []
    try:
        for _ in range(2 * len(os.sched_getaffinity(0))):
            children.append(start([sys.executable, "-c", "while True: pass"]))
        yield
    finally:
        for child in children:
            child.kill()
            end(child)


def may_have_priority(priority: int) -> bool:
    """Whether a child of ours may have it."""
    attempt = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({priority}))"
    return subprocess.run([sys.executable, "-c", attempt], stderr=subprocess.DEVNULL).returncode == 0


def realtime(context: Context) -> list[Figure]:
    """With and without real-time priority while other programs load all cores."""
    priority = context.realtime or _PRIORITY
    if not may_have_priority(priority):
        raise LeftOut(f"no right to real-time priority; for this shell:  {RIGHT_LINE}")
    config = f"[run]\nrealtime_priority = {priority}\n"
    runs: dict[str, list[Measured]] = {"normal": [], "real-time": []}
    with burners():
        for _ in range(context.rounds):
            runs["normal"].append(once(context, "ours", 8))
            runs["real-time"].append(once(context, "ours", 8, config=config))
    context.data["runs"] = {name: [run.result for run in several] for name, several in runs.items()}
    normal = median([run.delay["p99"] for run in runs["normal"]])
    value = median([run.delay["p99"] for run in runs["real-time"]])
    longest = median([run.delay["max"] for run in runs["real-time"]])
    note = f"longest {longest:.0f}"
    return [
        Figure("loaded, normal priority, 99 %", normal, "us"),
        Figure(f"loaded, real-time priority {priority}, 99 %", value, "us", "<= 500", value <= 500, note=note),
    ]


BENCHMARKS = [
    Benchmark("delay", "from the last byte to the fifth CAN frame: C, ours, the obvious program", delay),
    Benchmark("delay-full", "the same with 8 ESCs, recorder, statistics, CANopen and a polling master", full),
    Benchmark("delay-realtime", "the same with real-time priority while other programs load all cores", realtime),
]
