"""Latency of the page of `web` in a real browser, its first paint, and its cost."""

import random
import re
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Self

from live import SHIPPED, cpu_of, delay_of
from programs import (
    ENVIRONMENT,
    HERE,
    Context,
    Figure,
    LeftOut,
    cpu_ns,
    median,
    new_bus,
    once,
    rss_mb,
    standin,
    started,
    write_config,
)

sys.path[:0] = [str(HERE.parent / "cli"), str(HERE.parent / "report")]
from report_browser import MISSING, PROGRAM, Browser  # noqa: E402
from simulated_bus import flight, layout_of  # noqa: E402

_ESCS = 8
_CLIENTS = 5
_FLIGHT_S = 20
_FRAME = struct.Struct("<IB3x8s")
"""The kernel's struct can_frame."""
_STATUS = 0x680
"""Id of the first ESC's status, which contains the temperature of its power stage."""
_TEMPERATURE = 5
"""The byte of the temperature in degrees."""
_READY = "!!(globalThis.live && live.updates > 2)"
# Notes when a figure has changed and the next picture is drawn, which shows it.
_WATCH = """(() => {
  globalThis.noted = [];
  const figure = document.querySelector('.figure[data-source=power_stage_temperature]');
  const node = figure.querySelector('.value span');
  const note = () => noted.push([Date.now(), Number(node.textContent)]);
  new MutationObserver(() => requestAnimationFrame(note)).observe(node, { childList: true });
})()"""
_PAINT = "performance.getEntriesByName('first-contentful-paint')[0].startTime"


class Feeder:
    """Sends the frames of a gateway with 8 ESCs in real time.

    The temperature of the first ESC changes in steps at random times, which are sent at once.
    """

    def __init__(self, bus: str) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind("\0" + bus)
        self._listener.listen(1)
        self._listener.settimeout(20)
        self._is_stopped = threading.Event()
        self._frames = flight(layout_of([f"e{n}" for n in range(1, _ESCS + 1)]), _FLIGHT_S)
        self.steps: list[tuple[float, int]] = []
        """Unix time and value of each step."""
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_stopped.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        bus, _ = self._listener.accept()
        rng = random.Random(1)
        values = iter(count())
        temperature = 20
        status = bytes(8)
        begin = time.monotonic()
        next_step = begin + 2
        with bus, suppress(OSError):
            for round_number in count():
                for now_ns, frame in self._frames:
                    due = begin + round_number * _FLIGHT_S + now_ns / 1e9
                    while (left := due - time.monotonic()) > 0:
                        time.sleep(min(left, 0.005))
                        if time.monotonic() >= next_step:
                            temperature = 20 + next(values) % 50
                            self.steps.append((time.time(), temperature))
                            bus.send(_FRAME.pack(_STATUS, 8, _with(status, temperature)))
                            next_step = time.monotonic() + 0.4 + rng.random() * 0.3
                        if self._is_stopped.is_set():
                            return
                    data = frame.data
                    if frame.can_id == _STATUS:
                        status = data
                        data = _with(data, temperature)
                    bus.send(_FRAME.pack(frame.can_id, len(data), data.ljust(8, b"\0")))


def _with(status: bytes, temperature: int) -> bytes:
    changed = bytearray(status)
    changed[_TEMPERATURE] = temperature
    return bytes(changed)


@contextmanager
def _served(folder: Path, log: Path) -> Iterator[tuple["subprocess.Popen[str]", str, Feeder]]:
    """Serve the page of 8 ESCs. Yields its process, its address and the feeder."""
    bus = new_bus()
    config = write_config(folder, [f"/dev/tty{n}" for n in range(_ESCS)], SHIPPED)
    words = ("web", "-c", config, "--listen", "127.0.0.1:0", "--cache", folder / "cache")
    with ExitStack() as stack:
        feeder = stack.enter_context(Feeder(bus))
        stream = stack.enter_context(log.open("w"))
        streams = {"stdin": subprocess.DEVNULL, "stderr": stream, "env": ENVIRONMENT}
        command = standin(bus, "ours", *words)
        process = stack.enter_context(started(command, **streams))
        end = time.monotonic() + 20
        while not (found := re.search(r"http://127.0.0.1:\d+/", log.read_text())):
            if process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"web ended: {log.read_text()[-2000:]}")
            time.sleep(0.02)
        yield process, found[0], feeder


def _drain(address: str, is_stopped: threading.Event) -> None:
    """Receive the page's events as a further client."""
    host, _, port = address.removeprefix("http://").rstrip("/").partition(":")
    with socket.create_connection((host, int(port))) as sock:
        sock.sendall(f"GET /events HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        sock.settimeout(0.2)
        while not is_stopped.is_set():
            with suppress(TimeoutError):
                sock.recv(1 << 16)


def _latencies(steps: list[tuple[float, int]], noted: list[list[float]]) -> list[float]:
    """Return the time in ms from each step until its figure or a later one was shown."""
    found = []
    for index, (sent, value) in enumerate(steps):
        values = {later for _, later in steps[index : index + 10]}
        seen = [at for at, shown in noted if shown in values and at / 1000 >= sent - 0.01]
        if not seen:
            raise RuntimeError(f"the step to {value} was not shown")
        found.append(seen[0] - sent * 1000)
    return sorted(found)


def web(context: Context) -> list[Figure]:
    """Page of `web`: latency in a browser, first paint, CPU and memory with 5 clients."""
    if PROGRAM is None:
        raise LeftOut(MISSING)
    is_stopped = threading.Event()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kontronik-bench-")))
        process, address, feeder = stack.enter_context(_served(folder, folder / "log"))
        browser = stack.enter_context(Browser(folder / "profile"))
        browser.open(address, 360, 780, phone=True, ready=_READY)
        paints = []
        for _ in range(context.rounds):
            browser.open(address, 360, 780, phone=True, ready=_READY)
            paints.append(browser.run(_PAINT))
        browser.run("document.querySelector('.esc button').click()")
        clients = [
            threading.Thread(target=_drain, args=(address, is_stopped)) for _ in range(_CLIENTS - 1)
        ]
        stack.callback(is_stopped.set)
        for client in clients:
            client.start()
        browser.run(_WATCH)
        time.sleep(1)
        feeder.steps.clear()
        used = cpu_ns(process.pid)
        since = time.monotonic_ns()
        time.sleep(max(4 * context.seconds, 2))
        used = cpu_ns(process.pid) - used
        share = used / (time.monotonic_ns() - since)
        steps = list(feeder.steps)
        time.sleep(1)
        latencies = _latencies(steps, browser.run("noted"))
        memory = rss_mb(process.pid)
    return [
        Figure("frame to figure, median", median(latencies), "ms", "<= 250"),
        Figure("frame to figure, p99", _share(latencies, 0.99), "ms", "<= 600"),
        Figure("frame to figure, maximum", latencies[-1], "ms", note=f"{len(latencies)} steps"),
        Figure("first paint", median(paints), "ms", "<= 1000"),
        Figure("8 ESCs, 5 clients: share of a core", share * 100, "%", "<= 10"),
        Figure("8 ESCs, 5 clients: RSS", memory, "MB", "<= 60"),
        *_beside(context),
    ]


def _share(values: list[float], share: float) -> float:
    """Return the value that this share of the sorted values does not exceed."""
    return values[min(len(values) - 1, int(share * len(values)))]


def _beside(context: Context) -> list[Figure]:
    """Return the gateway's figures beside the page, compared with those without it, by turns.

    Both have separate buses, so this is the effect of the page's process on the machine.
    """
    alone = []
    beside = []
    for _ in range(context.rounds):
        alone.append(once(context, "ours", _ESCS))
        with tempfile.TemporaryDirectory(prefix="kontronik-bench-") as scratch:
            folder = Path(scratch)
            with _served(folder, folder / "log"):
                beside.append(once(context, "ours", _ESCS))
    cpu = [after.cpu_us / before.cpu_us for after, before in zip(beside, alone, strict=True)]
    rss = [after.rss_mb / before.rss_mb for after, before in zip(beside, alone, strict=True)]
    spread = max(run.cpu_us for run in alone) / min(run.cpu_us for run in alone)
    note = f"runs without the page differ by {spread - 1:.0%}"
    delays = f"median delay {delay_of(beside, 'p50'):.0f} us, alone {delay_of(alone, 'p50'):.0f} us"
    return [
        Figure("gateway beside the page / alone, CPU", median(cpu), "x", "<= 1.01", note),
        Figure("gateway beside the page / alone, RSS", median(rss), "x", "<= 1.01"),
        Figure("gateway beside the page, CPU", cpu_of(beside), "us/frame", note=delays),
    ]
