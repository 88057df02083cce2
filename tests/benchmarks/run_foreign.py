"""What foreign traffic costs the gateway: the kernel's filters are to keep it out. On real vcan interfaces, here or in a VM that has them.

The same sender sends 4000 frames a second by turns on the gateway's bus and on another one: the machine is loaded alike, only the bus
differs. CPU time and wake-ups of the gateway's process are compared, and as a check of the measure itself frames that it does listen to.
"""

import argparse
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parent)]

from bench_programs import config_text, cpu_ns, end, median, start
from registry import ROOT, Benchmark, Context, Figure, LeftOut, NotEqual

VM_RUN = ROOT / "tests" / "vm" / "vm_run.py"
ENABLE = "sudo apt-get install user-mode-linux can-utils iproute2 busybox-static"
RATE = 4000
_BURST_S = 0.005
_EXTENDED = 0x80000000
FOREIGN = (
    *range(0x020, 0x040),
    *range(0x1A0, 0x1C0),  # PDOs, SDOs and heartbeats of other nodes
    *range(0x5A0, 0x5B0),
    *range(0x620, 0x630),
    *range(0x720, 0x740),
    *(_EXTENDED | 0x18FE0000 + n for n in range(32)),
)
"""Ids that are none of ours."""
CONFIGURATIONS = {
    "DBC": "",
    "DBC, CANopen": '[canopen]\nenabled = true\nnode_id = 1\nself_start = true\nstore = "{folder}/store"\n',
}


# --- where there is vcan


def wakeups(pid: int) -> int:
    """How often the threads of a process went to sleep of their own accord."""
    total = 0
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            for line in (thread / "status").read_text().splitlines():
                if line.startswith("voluntary_ctxt_switches:"):
                    total += int(line.split()[1])
    return total


class Sender(threading.Thread):
    """Sends ``RATE`` frames a second to one of some interfaces, with one of some sets of ids."""

    def __init__(self, interfaces: Sequence[str]) -> None:
        super().__init__(daemon=True)
        self._sockets = {}
        for name in interfaces:
            made = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            made.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # it hears nothing
            made.bind((name,))
            self._sockets[name] = made
        self.to = interfaces[0]
        self.ids: Sequence[int] = FOREIGN
        self.sent = 0
        self._ending = threading.Event()

    def run(self) -> None:
        due, number = time.monotonic(), 0
        while not self._ending.is_set():
            bus, ids = self._sockets[self.to], self.ids
            for _ in range(int(RATE * _BURST_S)):
                number += 1
                can_id = ids[number % len(ids)]
                with contextlib.suppress(OSError):  # no room for a moment
                    bus.send(can_id.to_bytes(4, sys.byteorder) + b"\x08\0\0\0" + number.to_bytes(8, "little"))
                    self.sent += 1
            due += _BURST_S
            time.sleep(max(0.0, due - time.monotonic()))

    def close(self) -> None:
        self._ending.set()
        self.join()
        for each in self._sockets.values():
            each.close()


@contextlib.contextmanager
def interfaces() -> Iterator[tuple[str, str]]:
    """Two fresh vcan interfaces that are up."""
    names = (f"kcgb{os.getpid() % 10000}a", f"kcgb{os.getpid() % 10000}b")
    made = []
    try:
        for name in names:
            subprocess.run(["ip", "link", "add", name, "type", "vcan"], check=True)
            made.append(name)
            subprocess.run(["ip", "link", "set", name, "up"], check=True)
        yield names
    finally:
        for name in made:
            subprocess.run(["ip", "link", "del", name], check=False)


def inside(seconds: float, rounds: int) -> dict[str, Any]:
    """The measurement, where there is vcan."""
    from run_start import sending

    found: dict[str, Any] = {}
    with interfaces() as (ours, other), tempfile.TemporaryDirectory() as made, sending(1) as ports:
        sender = Sender((other, ours))
        sender.start()
        for number, (name, config) in enumerate(CONFIGURATIONS.items()):
            folder = Path(made) / str(number)
            folder.mkdir()
            file = folder / "gateway.toml"
            text = config_text(ports, ours, ROOT / "dbc" / "kontronik_esc.dbc", folder, config.format(folder=folder))
            file.write_text(text)
            with (folder / "errors").open("w") as errors:
                process = start(
                    [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(file)], stderr=errors, cwd=ROOT
                )
            try:
                sender.to, sender.ids = other, FOREIGN
                status = folder / "status.json"
                _wait(lambda status=status: status.exists() and _counter(status, "sent_frames") > 100, process, folder)
                rows: dict[str, list[dict[str, float]]] = {"without": [], "foreign": [], "heard": []}
                received = _counter(status, "received_frames")
                for _ in range(rounds):
                    for case, bus in (("without", other), ("foreign", ours)):
                        sender.to = bus
                        rows[case].append(_measure(process.pid, sender, seconds))
                sender.to = other
                time.sleep(1.5)  # a document a second
                heard = _counter(status, "received_frames") - received
                sender.to, sender.ids = ours, (0x680,)  # of a message of ours: another sender of it is to be noticed
                rows["heard"].append(_measure(process.pid, sender, seconds))
                found[name] = {"rows": rows, "received": heard}
            finally:
                sender.to, sender.ids = other, FOREIGN
                end(process)
        sender.close()
    return found


def _counter(status: Path, name: str) -> int:
    return int(json.loads(status.read_text())["can"]["counters"][name])


def _wait(condition: Any, process: "subprocess.Popen[str]", folder: Path) -> None:
    until = time.monotonic() + 30
    while not condition():
        if process.poll() is not None or time.monotonic() > until:
            raise RuntimeError(f"the gateway does not send: {(folder / 'errors').read_text()[-2000:]}")
        time.sleep(0.1)


def _measure(pid: int, sender: Sender, seconds: float) -> dict[str, float]:
    time.sleep(0.3)
    before, woken, sent, begun = cpu_ns(pid), wakeups(pid), sender.sent, time.monotonic()
    time.sleep(seconds)
    took = time.monotonic() - begun
    return {
        "cpu_percent": (cpu_ns(pid) - before) / took / 1e7,
        "wakeups_per_s": (wakeups(pid) - woken) / took,
        "frames_per_s": (sender.sent - sent) / took,
    }


# --- here


def foreign(context: Context) -> list[Figure]:
    """Runs the measurement where there is vcan, and judges."""
    which = subprocess.run([sys.executable, str(VM_RUN), "--which"], capture_output=True, text=True).stdout.strip()
    if which in ("", "none", "qemu"):
        raise LeftOut(f"this kernel has no vcan for us, and there is no User Mode Linux:  {ENABLE}")
    seconds, rounds = (1.0, 2) if context.quick else (min(4.0, context.seconds), context.rounds + 2)
    with tempfile.TemporaryDirectory(prefix="kontronik-bench-", dir="/var/tmp") as made:
        report = Path(made) / "report.json"
        limit = 120 + len(CONFIGURATIONS) * (2 * rounds + 1) * (seconds + 1)
        command = [sys.executable, str(VM_RUN), f"--timeout={limit:.0f}", f"--rw={made}", "--"]
        command += [sys.executable, "-B", __file__, "--inside", str(seconds), str(rounds), str(report)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode or not report.exists():
            raise RuntimeError(f"{which}: exit code {done.returncode}: {(done.stdout + done.stderr)[-2000:]}")
        found = json.loads(report.read_text())
    context.data.update(found)
    figures = []
    for name, result in found.items():
        rows = result["rows"]
        if result["received"]:
            raise NotEqual(
                f"foreign: the gateway ({name}) was given {result['received']} frames that are none of its own"
            )
        cpu, woken, rate = (
            {case: median([each[key] for each in rows[case]]) for case in rows}
            for key in ("cpu_percent", "wakeups_per_s", "frames_per_s")
        )
        spread, spread_woken = (
            max(each[key] for each in rows["without"]) - min(each[key] for each in rows["without"])
            for key in ("cpu_percent", "wakeups_per_s")
        )
        extra, extra_woken = cpu["foreign"] - cpu["without"], woken["foreign"] - woken["without"]
        noise = max(spread, 0.05 * cpu["without"], 1 / seconds)  # some kernels count CPU time in steps of 10 ms
        told = f"{cpu['without']:.2f} % without, {cpu['foreign']:.2f} % with {rate['foreign']:.0f} foreign frames/s, {which}"
        heard = f"{woken['without']:.0f} without; {woken['heard']:.0f} where it listens, {cpu['heard']:.1f} % of a core then"
        figures.append(
            Figure(f"{name}: further CPU", extra, "% of a core", f"<= {noise:.2g} (noise)", extra <= noise, told)
        )
        limit_woken = max(2.0, 0.05 * woken["without"], spread_woken)
        figures.append(
            Figure(
                f"{name}: further wake-ups",
                extra_woken,
                "/s",
                f"<= {limit_woken:.2g} (noise)",
                extra_woken <= limit_woken,
                heard,
            )
        )
        if woken["heard"] < woken["without"] + 50 and cpu["heard"] < cpu["without"] + 2 * noise:
            raise NotEqual(f"foreign: the measure does not see frames that the gateway does listen to ({heard})")
    return figures


BENCHMARKS = [
    Benchmark("foreign", "CPU and wake-ups on a bus with 4000 foreign frames a second, on real vcan", foreign)
]

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--inside", nargs=3, required=True, metavar=("SECONDS", "ROUNDS", "REPORT"))
    length, turns, file = parser.parse_args().inside
    Path(file).write_text(json.dumps(inside(float(length), int(turns))))
