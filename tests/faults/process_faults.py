"""Faults of the process: killed, ended, told to read its configuration again, started twice, hung."""

import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

from fault_report import WITH_PYTHON, Fault, fault
from harness import AHEAD, Bench, Injection, PtyPort, half, injected
from raw_bus import RawBus

RESTART_LIMIT_S = 3.0
"""A new process needs its layout compiled too, for which User Mode Linux, on one shared processor, takes some times as long as the machine
itself; that a gateway is back within a second there is held by tests/runtime/test_life_of_the_process.py."""
STOPPING = 2
TIMEOUT_OBJECT = 0x2100, 4
"""Telemetry time-out in ms, which a master may set and store."""
process = partial(injected, "Process")


def python_start_s(bench: Bench) -> float:
    """How long a Python with the libraries takes to start here and now: no part of the gateway's own time."""
    command = [*AHEAD, sys.executable, "-c", "import can, canopen, serial, cantools.database"]
    begin = time.monotonic_ns()
    subprocess.run(command, check=True)
    return bench.running_s(begin, time.monotonic_ns())


def start_and_wait(injection: Injection) -> None:
    """Start the gateway. Its recovery is the time until the first right values, less Python's own start."""
    bench = injection.bench
    python_s = python_start_s(bench)
    injection.cleared()
    assert injection.cleared_ns is not None
    bench.start(wait=False)
    injection.recovered_ns = bench.wait_fresh(injection.escs, injection.cleared_ns, 30)
    whole = bench.running_s(injection.cleared_ns, injection.recovered_ns)
    injection.recovery_s = max(0.0, whole - python_s)
    injection.row.peak(WITH_PYTHON, round(whole, 2))
    injection.row.peak("s of it for Python and its libraries", round(python_s, 2))


@fault("Process", "kill -9 at any instant, and restart", RESTART_LIMIT_S)
def killed(bench: Bench, fault: Fault, times: int) -> None:
    """Also while it stores parameters: afterwards they are those before or those after, never anything else."""
    generator = random.Random(6)
    known = {250}
    with RawBus(bench.watched) as master:
        for i in range(times + 1):
            with bench.injection(fault) as injection:
                value = 200 + generator.randrange(90)
                injection.expect(
                    master.write(1, *TIMEOUT_OBJECT, value, 2) == 0,
                    "the master cannot set the time-out",
                )
                known.add(value)
                if i % 2:
                    injection.expect(master.store(1) == 0, "the master cannot store")
                    known = {value}
                else:
                    master.send(0x601, bytes([0x23, 0x10, 0x10, 1]) + b"save")
                    time.sleep(generator.random() * 0.02)
                bench.kill()
                time.sleep(generator.random() * 0.3)
                start_and_wait(injection)
                found = master.read(1, *TIMEOUT_OBJECT)
                injection.expect(
                    found in known, f"the stored time-out is {found}, not one of {sorted(known)}"
                )
                assert found is not None
                known = {found}
        master.write(1, *TIMEOUT_OBJECT, 250, 2)
        master.store(1)


@process("SIGTERM, and restart", RESTART_LIMIT_S)
def ended(bench: Bench, injection: Injection, _n: int) -> None:
    """Ends within 0.5 s, and its last status says so."""
    begin = time.monotonic_ns()
    code = bench.stop()
    took = bench.running_s(begin, time.monotonic_ns())
    bench.watch.catch_up()
    injection.expect(code == 0, f"it ended with {code}")
    state = bench.watch.value("GatewayStatus", "gateway_state")
    injection.expect(state == STOPPING, f"its last state is {state}, not Stopping")
    injection.row.peak("s to its end", round(took, 2))
    injection.expect(
        took < 0.8, f"it took {took:.2f} s to end; 0.5 s, and 0.3 s for a Python's end here"
    )
    start_and_wait(injection)


SAME_PORT, SAME_NODES = "is in use by another program", "another gateway on this machine"


@process(
    "a second instance",
    None,
    escs=[],
    rounds=lambda times: [SAME_PORT, SAME_NODES] * max(1, times // 2),
)
def second(bench: Bench, injection: Injection, reason: str) -> None:
    """On the same port, and with the same nodes on the same interface: refused with one line, the first goes on undisturbed."""
    other, extra = bench.folder / "second.toml", bench.folder / "second"
    text = bench.configuration()
    if reason == SAME_PORT:
        text = text.replace("enabled = true", "enabled = false")
    else:
        common, first, *_ = text.replace('/store"', '/store2"').split("[[esc]]")
        text = f"{common}[[esc]]{first.replace(bench.ports[0].path, str(extra))}"
    other.write_text(text)
    port = PtyPort(extra, bench.fed[0].identity)
    try:
        command = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(other)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    finally:
        port.close()
    said = done.stderr.strip()
    injection.expect(
        done.returncode == 1, f"it ended with {done.returncode}, not by {reason!r}: {said}"
    )
    injection.expect(
        len(said.splitlines()) == 1 and reason in said, f"not {reason!r} was said: {said}"
    )


class Supervisor:
    """A stand-in for systemd: takes the notifications, and knows when the watchdog was fed last."""

    def __init__(self, watchdog_s: float) -> None:
        self.path = str(Path(tempfile.mkdtemp(prefix="notify.")) / "notify")
        self.watchdog_s = watchdog_s
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.path)
        self._socket.setblocking(False)
        self.fed_at = time.monotonic()
        self.ready = False

    def environment(self) -> dict[str, str]:
        return {"NOTIFY_SOCKET": self.path, "WATCHDOG_USEC": str(int(self.watchdog_s * 1e6))}

    def listen(self) -> None:
        while True:
            try:
                message = self._socket.recv(4096).decode()
            except BlockingIOError:
                return
            self.ready = self.ready or "READY=1" in message
            if "WATCHDOG=1" in message:
                self.fed_at = time.monotonic()

    def is_hungry_within(self, seconds: float) -> bool:
        """Whether the watchdog's time is over before so many seconds are."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.listen()
            if time.monotonic() - self.fed_at > self.watchdog_s:
                return True
            time.sleep(0.02)
        return False

    def close(self) -> None:
        self._socket.close()
        os.unlink(self.path)


@process("a frozen loop, restarted by the watchdog", RESTART_LIMIT_S, rounds=half)
def frozen(bench: Bench, injection: Injection, _n: int) -> None:
    """By systemd's rule: no WATCHDOG=1 for its time, then SIGABRT and a new start. Recovery counts from there."""
    supervisor = Supervisor(2)
    before = bench.environment
    bench.environment = before | supervisor.environment()
    try:
        bench.stop()
        gateway = bench.start(wait=False)
        bench.wait_fresh(injection.escs, gateway.started_ns, 20)
        injection.expect(
            not supervisor.is_hungry_within(3), "the watchdog of a healthy gateway was not fed"
        )
        injection.expect(supervisor.ready, "it never said READY=1")
        gateway.process.send_signal(signal.SIGSTOP)
        injection.expect(
            supervisor.is_hungry_within(4), "the watchdog of a frozen gateway was fed on"
        )
        gateway.process.send_signal(signal.SIGABRT)
        gateway.process.send_signal(signal.SIGCONT)
        bench.kill()
        start_and_wait(injection)
    finally:
        bench.environment = before
        supervisor.close()
