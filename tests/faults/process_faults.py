"""Faults of the process: killed, ended, started twice, hung, suspended; and a wall clock that is set."""

import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

from beds import fault
from harness import Bench, Injection, PtyPort
from raw_bus import RawBus

RESTART_LIMIT_S = 3.0
"""With the start of Python. That a gateway is back within a second is held by tests/runtime/test_life_of_the_process.py."""
STOPPING = 2
TIMEOUT_OBJECT = 0x2100, 4
"""Telemetry time-out in ms, which a master may set and store."""
process = partial(fault, "Process", limit_s=RESTART_LIMIT_S)


def start_and_wait(injection: Injection) -> None:
    """Start the gateway."""
    injection.cleared()
    injection.bench.start(wait=False)
    injection.wait_recovery()


@process("kill -9 at any instant, and restart", rounds=range(3))
def killed(bench: Bench, injection: Injection, n: int) -> None:
    """Also while it stores parameters: afterwards they are those before or those after, never anything else."""
    generator = random.Random(6 + n)
    with RawBus(bench.watched) as master:
        value = 200 + generator.randrange(90)
        known = {250, value}
        set_to = master.write(1, *TIMEOUT_OBJECT, value, 2)
        bench.expect(set_to == 0, "the master cannot set the time-out")
        if n % 2:
            bench.expect(master.store(1) == 0, "the master cannot store")
            known = {value}
        else:
            master.send(0x601, bytes([0x23, 0x10, 0x10, 1]) + b"save")
            time.sleep(generator.random() * 0.02)
        bench.kill()
        time.sleep(generator.random() * 0.3)
        start_and_wait(injection)
        found = master.read(1, *TIMEOUT_OBJECT)
        bench.expect(found in known, f"the stored time-out is {found}, not one of {known}")
        master.write(1, *TIMEOUT_OBJECT, 250, 2)
        master.store(1)


@process("SIGTERM, and restart")
def ended(bench: Bench, injection: Injection, _n: int) -> None:
    """Ends within 0.5 s, and its last status says so."""
    begin = time.monotonic_ns()
    code = bench.stop()
    took = bench.running_s(begin, time.monotonic_ns())
    bench.watch.catch_up()
    bench.expect(code == 0, f"it ended with {code}")
    state = bench.watch.value("GatewayStatus", "gateway_state")
    bench.expect(state == STOPPING, f"its last state is {state}, not Stopping")
    bench.expect(took < 0.5, f"it took {took:.2f} s to end")
    start_and_wait(injection)


SAME_PORT, SAME_NODES = "is in use by another program", "another gateway on this machine"


@fault("Process", "a second instance", None, escs=[], rounds=(SAME_PORT, SAME_NODES))
def second(bench: Bench, injection: Injection, reason: str) -> None:
    """On the same port, and with the same nodes on the same interface: refused with one line, the first goes on undisturbed."""
    other, extra = bench.folder / "second.toml", bench.folder / "second"
    text = bench.config.read_text()
    if reason == SAME_PORT:
        text = text.replace("enabled = true", "enabled = false")
    else:
        common, first, *_ = text.replace('/store"', '/store2"').split("[[esc]]")
        text = f"{common}[[esc]]{first.replace(bench.escs[0].path, str(extra))}"
    other.write_text(text)
    port = PtyPort(extra, bench.escs[0].identity)
    try:
        command = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(other)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    finally:
        port.close()
    said = done.stderr.strip()
    bench.expect(
        done.returncode == 1 and len(said.splitlines()) == 1 and reason in said,
        f"it ended with {done.returncode}, not by {reason!r} in one line: {said}",
    )


class Supervisor:
    """A stand-in for systemd: takes the notifications, and knows when the watchdog was fed last."""

    def __init__(self, path: str, watchdog_s: float) -> None:
        self.watchdog_s = watchdog_s
        self.environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": str(int(watchdog_s * 1e6))}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(path)
        self._socket.settimeout(0.02)
        self.fed_at = time.monotonic()
        self.ready = False

    def is_hungry_within(self, seconds: float) -> bool:
        """Whether the watchdog's time is over before so many seconds are."""
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end:
            try:
                message = self._socket.recv(4096)
            except TimeoutError:
                if now - self.fed_at > self.watchdog_s:
                    return True
                continue
            self.ready = self.ready or b"READY=1" in message
            if b"WATCHDOG=1" in message:
                self.fed_at = time.monotonic()
        return False


@process("a frozen loop, restarted by the watchdog", rounds=[0])
def frozen(bench: Bench, injection: Injection, n: int) -> None:
    """By systemd's rule: no WATCHDOG=1 for its time, then SIGABRT and a new start. Recovery counts from there."""
    supervisor = Supervisor(f"{bench.folder}/notify{time.monotonic_ns()}", 2)
    before = bench.environment
    bench.environment = before | supervisor.environment
    try:
        bench.stop()
        bench.start(wait=False)
        bench.wait_fresh(injection.escs, bench.gateway.started_ns, 20)
        fed = not supervisor.is_hungry_within(3)
        bench.expect(fed, "the watchdog of a healthy gateway was not fed")
        bench.expect(supervisor.ready, "it never said READY=1")
        bench.gateway.process.send_signal(signal.SIGSTOP)
        hungry = supervisor.is_hungry_within(4)
        bench.expect(hungry, "the watchdog of a frozen gateway was fed on")
        bench.gateway.process.send_signal(signal.SIGABRT)
        bench.gateway.process.send_signal(signal.SIGCONT)
        bench.kill()
        start_and_wait(injection)
    finally:
        bench.environment = before


def clock_set(bench: Bench, _injection: Injection, _n: int, to: Callable[[], float]) -> None:
    right = time.time() - time.monotonic()
    bench.watch.note_clocks()
    time.clock_settime(time.CLOCK_REALTIME, to())
    bench.watch.note_clocks()
    try:
        time.sleep(1.2)
    finally:
        time.clock_settime(time.CLOCK_REALTIME, right + time.monotonic())
        bench.watch.note_clocks()


for name, to in (
    ("wall clock set 1 h forward, and back", lambda: time.time() + 3600),
    ("wall clock set 1 h back, and forward", lambda: time.time() - 3600),
    # no kernel takes less: it would have been started before 1970
    ("wall clock set to 1970, and right again", lambda: time.monotonic() + 5),
):
    fault("Time", name, None, escs=[])(partial(clock_set, to=to))


@fault("Time", "process suspended (SIGSTOP, SIGCONT)", 1.0, rounds=(10, 0.4))
def suspended(bench: Bench, injection: Injection, seconds: float) -> None:
    """Nothing old is sent as new."""
    bench.gateway.process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    injection.cleared()
    bench.gateway.process.send_signal(signal.SIGCONT)
