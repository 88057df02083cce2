"""Times on a real vcan: answers to SDO requests and PDOs amid full telemetry, what foreign traffic costs.

All times are the kernel's time stamps of the frames in a candump log, so what this process and the masters lose does not count. A VM as a
whole may stand still while its host does something else; a metronome, a process that does nothing but wake up, notes when.
"""

import itertools
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median, quantiles
from typing import NamedTuple

from sdo_poller import FRAME, Sdo
from vcan_tools import (
    EDS,
    LIVELY,
    GatewayProcess,
    Recorded,
    bench,
    canopen_configuration,
    gateway_process,
    wait_for,
)

from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.simulator import EscOptions

Start = Callable[..., GatewayProcess]

POLLER = Path(__file__).with_name("sdo_poller.py")
LIMIT_S = 0.04
NODES = (1, 2, 3, 4)
ROUNDS = 3
"""The machine is not ours alone: of so many rounds one has to be without an answer that was late."""
LIVE_OBJECTS = "2000:1,2000:2,2000:4,2020:1,2001:3"
OTHER_OBJECTS = "1000,1001,1018:4,2000:3,2011:1,2021:1,1A00:1"
METRONOME = """
import time
last = time.time()
while True:
    time.sleep(0.002)
    now = time.time()
    if now - last > 0.005:
        print(last + 0.002, now, flush=True)
    last = now
"""


@contextmanager
def log_of(interface: str, file: Path) -> Iterator[None]:
    """``candump`` writes every frame of an interface into a file; nothing of this process takes part."""
    with file.open("wb") as out:
        process = subprocess.Popen(["candump", "-D", "-L", "-r", "4194304", f"{interface},0:0,#FFFFFFFF"], stdout=out)
        try:
            time.sleep(0.2)
            yield
            time.sleep(0.2)
        finally:
            process.terminate()
            process.wait()


@contextmanager
def metronome(file: Path) -> Iterator[None]:
    """Notes the times in which nothing at all could run."""
    with file.open("wb") as out:
        process = subprocess.Popen([sys.executable, "-S", "-E", "-c", METRONOME], stdout=out)
        try:
            yield
        finally:
            process.terminate()
            process.wait()


def recorded(file: Path) -> list[Recorded]:
    pattern = re.compile(r"\((\d+\.\d+)\) \S+ ([0-9A-F]+)#([0-9A-F]*)")
    found = (pattern.match(line) for line in file.read_text().splitlines())
    return [Recorded(float(m[1]), int(m[2], 16), bytes.fromhex(m[3])) for m in found if m]


def stalls(file: Path) -> list[tuple[float, float]]:
    """Begin and end of each time in which nothing ran."""
    pairs = (line.split() for line in file.read_text().splitlines())
    return [(float(pair[0]), float(pair[1])) for pair in pairs if len(pair) == 2]


def without_stalls(begin: float, end: float, standstill: Sequence[tuple[float, float]]) -> float:
    """Seconds from begin to end in which something could run."""
    return end - begin - sum(max(0.0, min(end, b) - max(begin, a)) for a, b in standstill)


def answers(frames: Sequence[Recorded], node: int) -> list[tuple[float, float]]:
    """(time of the request, time of the first frame of its answer) of one node; what is not answered is left out.

    Requests are told apart by their object; those of a block transfer have none, and the next frame is the answer.
    """
    open_requests: dict[bytes, float] = {}
    found = []
    for frame in frames:
        if frame.can_id == 0x600 + node:
            command = frame.data[0]
            if command != 0xA1:  # the end of a block upload has no answer
                open_requests[b"" if command in (0xA2, 0xA3) else frame.data[1:4]] = frame.time
        elif frame.can_id == 0x580 + node:
            for name in (frame.data[1:4], b""):
                if name in open_requests:
                    found.append((open_requests.pop(name), frame.time))
                    break
    return found


def figures(seconds: Sequence[float]) -> str:
    """Median, 99th percentile and maximum in words."""
    p99 = quantiles(seconds, n=100)[98]
    return (
        f"{len(seconds)} answers, median {median(seconds) * 1000:.2f} ms, "
        f"99 % within {p99 * 1000:.2f} ms, longest {max(seconds) * 1000:.2f} ms"
    )


def poller(vcan: str, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-S", "-E", str(POLLER), vcan, *words], stdout=subprocess.PIPE, text=True)


def output(process: subprocess.Popen[str]) -> str:
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return text


@contextmanager
def four_nodes(vcan: str, folder: Path) -> Iterator[GatewayProcess]:
    """Four ESCs at 100 Hz, their nodes OPERATIONAL, PDOs and the DBC's messages on the bus."""
    with bench(*[EscOptions(profile=LIVELY)] * 4) as run:
        ports = [port.path for port in run.ports]
        toml = canopen_configuration(vcan, ports, folder / "store", canopen="self_start = true")
        with gateway_process(folder / "gateway.toml", toml) as gateway:
            run.start()
            wait_for(lambda: all(len(run.live(i)) > 100 for i in range(4)), 10, "telemetry")
            yield gateway


class Round(NamedTuple):
    """What one round of polling showed; times in seconds, ``running`` and ``gaps`` less the machine's standstill."""

    unanswered: int
    raw: list[float]
    running: list[float]
    gaps: dict[int, float]
    """Longest gap of TPDO 1 of each node during the block upload."""
    rates: dict[int, float]
    """TPDO 1 a second of each node during the block upload."""

    @property
    def good(self) -> bool:
        # inhibit time, frame period, and what an answer may take
        return not self.unanswered and max(self.running) < LIMIT_S and max(self.gaps.values()) < 0.02 + 0.01 + LIMIT_S


def poll_and_measure(vcan: str, folder: Path) -> Round:
    """Two masters poll four nodes, then three of them while the EDS is fetched from the fourth by a block upload."""
    log, beats = folder / "candump.log", folder / "metronome"
    with log_of(vcan, log), metronome(beats):
        all_nodes = ",".join(map(str, NODES))
        pair = [poller(vcan, "poll", "5", "5", all_nodes, objects) for objects in (LIVE_OBJECTS, OTHER_OBJECTS)]
        counts = [output(process).split() for process in pair]
        block_begin = time.time()
        pair = [poller(vcan, "poll", "4", "5", "1,2,3", objects) for objects in (LIVE_OBJECTS, OTHER_OBJECTS)]
        eds = bytes.fromhex(output(poller(vcan, "block", "4", "1021")))
        counts += [output(process).split() for process in pair]
    assert eds == EDS.read_bytes()
    frames, standstill = recorded(log), stalls(beats)
    pairs = [pair for node in NODES for pair in answers(frames, node)]
    assert len(pairs) >= sum(int(answered) for answered, _ in counts) > 500
    raw = [end - begin for begin, end in pairs]
    running = [without_stalls(begin, end, standstill) for begin, end in pairs]
    lost = sum(end - begin for begin, end in standstill) / (frames[-1].time - frames[0].time)
    print()
    print("SDO:", figures(raw))
    print("     less standstill of the machine:", figures(running))
    print(
        f"     standstill: {lost:.1%} of the time, longest {max((b - a for a, b in standstill), default=0) * 1000:.0f} ms"
    )

    block = [frame for frame in frames if frame.can_id in (0x584, 0x604) and frame.time > block_begin]
    first, last = block[0].time, block[-1].time
    print(f"block upload: {sum(f.can_id == 0x584 for f in block)} frames in {last - first:.2f} s, TPDO 1 meanwhile:")
    gaps, rates = {}, {}
    for node in NODES:
        times = [frame.time for frame in frames if frame.can_id == 0x180 + node and first < frame.time < last]
        gaps[node] = max(without_stalls(a, b, standstill) for a, b in itertools.pairwise([first, *times, last]))
        rates[node] = len(times) / (last - first)
        print(f"     node {node}: {rates[node]:.0f}/s, longest gap {gaps[node] * 1000:.1f} ms")
    return Round(sum(int(unanswered) for _, unanswered in counts), raw, running, gaps, rates)


def test_two_masters_get_every_answer_within_40_ms_and_pdos_go_on(vcan: str, tmp_path: Path) -> None:
    with four_nodes(vcan, tmp_path) as gateway:
        for _ in range(ROUNDS):
            found = poll_and_measure(vcan, tmp_path)
            if found.good:
                break
    assert not found.unanswered, gateway.log  # "suspended": the machine held it up, and it threw old requests away
    assert max(found.running) < LIMIT_S
    assert max(found.gaps.values()) < 0.02 + 0.01 + LIMIT_S
    assert min(found.rates.values()) > 0.7 * 50
    assert median(found.raw) < 0.005


def test_foreign_traffic_does_not_wake_the_nodes(vcan: str, start_gateway: Start, tmp_path: Path) -> None:
    with PtyEsc() as port:
        gateway = start_gateway(canopen_configuration(vcan, [port.path], tmp_path, dbc="[dbc]\nenabled = false"))
        gateway.wait_for_line("node 1 pre-operational")
        bus = Sdo(vcan)
        # neighbours of what the node listens to, the same numbers as 29-bit and as remote frames
        ids = [0x001, 0x07F, 0x082, 0x182, 0x582, 0x600, 0x602, 0x67F, 0x702, 0x703, 0x7E4, 0x7E6]
        ids += [flag | can_id for flag in (0x80000000, 0x40000000) for can_id in (0x000, 0x080, 0x601, 0x7E5)]
        frames = [FRAME.pack(can_id, 8, bytes(8)) for can_id in ids]

        def wakes(rate: int) -> int:
            """How often the process slept within 2 s at so many foreign frames a second."""
            before = switches(gateway.process.pid)
            begin = time.monotonic()
            sent = 0
            while (elapsed := time.monotonic() - begin) < 2:
                while sent < rate * elapsed:
                    bus.send_raw(frames[sent % len(frames)])
                    sent += 1
                time.sleep(0.01)
            assert sent >= 1.9 * rate
            return switches(gateway.process.pid) - before

        quiet, busy = wakes(0), wakes(4000)
        print(f"\nslept {quiet} times in 2 s of quiet, {busy} times beside 8000 foreign frames")
        assert busy <= quiet + 5
        bus.close()
        master = Sdo(vcan, 0x581)
        assert master.upload(1, 0x1000, 0) is not None
        master.close()


def switches(pid: int) -> int:
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("\nvoluntary_ctxt_switches:")[2].split()[0])
