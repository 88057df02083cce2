"""Faults of the process, of its clock, and of the disk that has the nodes' parameters.

The process is killed, ended, started twice, frozen or suspended.
"""

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from beds import bench_of, fault, run
from bus_watch import SECOND
from harness import Bench, Injection, PtyPort
from raw_bus import RawBus

RESTART_LIMIT_S = 3.0
"""Longest recovery in s, including the start of Python."""
STOPPING = 2
TIMEOUT_OBJECT = 0x2100, 4
"""Index and subindex of the telemetry timeout in ms, which a master may set and store."""
process = partial(fault, "Process", limit_s=RESTART_LIMIT_S)


def start_and_wait(injection: Injection) -> None:
    """Start the gateway."""
    injection.cleared()
    injection.bench.start(wait=False)
    injection.wait_recovery()


@process("kill -9 at any instant, and restart", rounds=range(3))
def killed(bench: Bench, injection: Injection, n: int) -> None:
    """Kill the gateway, also while it stores parameters.

    After that the stored parameters are the old or the new ones, never anything else.
    """
    generator = random.Random(6 + n)
    with RawBus(bench.watched) as master:
        value = 200 + generator.randrange(90)
        known = {250, value}
        set_to = master.write(1, *TIMEOUT_OBJECT, value, 2)
        bench.expect(set_to == 0, "the master cannot set the timeout")
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
        bench.expect(found in known, f"the stored timeout is {found}, not one of {known}")
        master.write(1, *TIMEOUT_OBJECT, 250, 2)
        master.store(1)


@process("SIGTERM, and restart")
def ended(bench: Bench, injection: Injection, _n: int) -> None:
    """Check that it ends within 0.5 s, and that its last status reports it."""
    begin = time.monotonic_ns()
    code = bench.stop()
    took = (time.monotonic_ns() - begin) / SECOND
    bench.watch.catch_up()
    bench.expect(code == 0, f"it ended with {code}")
    state = bench.watch.value("GatewayStatus", "gateway_state")
    bench.expect(state == STOPPING, f"its last state is {state}, not Stopping")
    bench.expect(took < 0.5, f"it took {took:.2f} s to end")
    start_and_wait(injection)


SAME_PORT = "is in use by another program"
SAME_NODES = "another gateway on this machine"


@fault("Process", "a second instance", None, escs=[], rounds=(SAME_PORT, SAME_NODES))
def second(bench: Bench, injection: Injection, reason: str) -> None:
    """Start a second gateway on the same port, or with the same nodes on the same interface.

    It is refused with one line, and the first gateway is not disturbed.
    """
    other = bench.folder / "second.toml"
    extra = bench.folder / "second"
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
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
    finally:
        port.close()
    errors = done.stderr.strip()
    is_one_line = len(errors.splitlines()) == 1
    bench.expect(
        done.returncode == 1 and is_one_line and reason in errors,
        f"it ended with {done.returncode}, not by {reason!r} in one line: {errors}",
    )


class Supervisor:
    """Replacement for systemd that receives notifications and records when it was fed."""

    def __init__(self, path: str, watchdog_s: float) -> None:
        self.watchdog_s = watchdog_s
        self.environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": str(int(watchdog_s * 1e6))}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(path)
        self._socket.settimeout(0.02)
        self.fed_at = time.monotonic()
        self.ready = False

    def is_hungry_within(self, seconds: float) -> bool:
        """Return whether the watchdog's time ends within this number of seconds."""
        end = time.monotonic() + seconds
        while True:
            now = time.monotonic()
            if now >= end:
                return False
            try:
                message = self._socket.recv(4096)
            except TimeoutError:
                if now - self.fed_at > self.watchdog_s:
                    return True
                continue
            self.ready = self.ready or b"READY=1" in message
            if b"WATCHDOG=1" in message:
                self.fed_at = time.monotonic()


@process("a frozen loop, restarted by the watchdog", rounds=[0])
def frozen(bench: Bench, injection: Injection, n: int) -> None:
    """Follow systemd's rule: SIGABRT and a new start after the time without WATCHDOG=1.

    The recovery is measured from the new start.
    """
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


def clock_set(
    bench: Bench,
    _injection: Injection,
    _n: int,
    to: Callable[[], float],
) -> None:
    right = time.time() - time.monotonic()
    time.clock_settime(time.CLOCK_REALTIME, to())
    try:
        time.sleep(1.2)
    finally:
        time.clock_settime(time.CLOCK_REALTIME, right + time.monotonic())


for name, to in (
    ("wall clock set 1 h forward, and back", lambda: time.time() + 3600),
    ("wall clock set 1 h back, and forward", lambda: time.time() - 3600),
    # A kernel accepts no earlier time, because it would have been started before 1970.
    ("wall clock set to 1970, and right again", lambda: time.monotonic() + 5),
):
    fault("Time", name, None, escs=[])(partial(clock_set, to=to))


@fault("Time", "process suspended (SIGSTOP, SIGCONT)", 1.0, rounds=(10, 0.4))
def suspended(bench: Bench, injection: Injection, seconds: float) -> None:
    """Suspend the process. After that it must not send an old value as a new one."""
    bench.gateway.process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    injection.cleared()
    bench.gateway.process.send_signal(signal.SIGCONT)


# --- the disk, which must not affect telemetry

SLOW_S = 5
SLOW_DISK = f"""
import os, time
for name in ("write", "fsync", "replace", "rename"):
    def slow(*args, _real=getattr(os, name), **options):
        import threading
        is_main = threading.current_thread() is threading.main_thread()
        if not is_main and os.path.exists(os.environ["KCG_SLOW"]):
            time.sleep({SLOW_S} if _real.__name__ == "fsync" else 0.3)
        return _real(*args, **options)
    setattr(os, name, slow)
"""
"""Code that makes the disk of a store's thread slow while a file exists.

The loop's own thread is not slowed down, because it must not write to the disk at all.
"""


@contextlib.contextmanager
def disk(_: Path) -> Iterator[Bench]:
    """Yield a bench with two ESCs, and a small separate file system for the parameters.

    It can be made slow.
    """
    folder = Path(tempfile.mkdtemp(prefix="disk."))
    store = folder / "store"
    site = folder / "site"
    store.mkdir()
    run(f"mount -t tmpfs -o size=64k,mode=0700 tmpfs {store}")
    site.mkdir()
    (site / "sitecustomize.py").write_text(SLOW_DISK)
    path = os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH"))))
    environment = {"PYTHONPATH": path, "KCG_SLOW": str(folder / "slow")}
    with bench_of(store=store, environment=environment) as bench:
        yield bench


on_disk = partial(fault, "Disk", bed=disk)


def stores_again(bench: Bench) -> None:
    with RawBus(bench.watched) as master:
        bench.expect(master.write(1, *TIMEOUT_OBJECT, 250, 2) == 0, "a write is refused")
        code = master.store(1)
        bench.expect(code == 0, f"the disk is good again, but storing is answered with {code}")


@contextlib.contextmanager
def full(folder: Path) -> Iterator[None]:
    """Fill the file system within the block."""
    filler = folder / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    yield
    filler.unlink()


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Mount the folder read-only within the block.

    It is mounted on top, because the gateway has a lock open on the file system below.
    """
    run(f"mount --bind {folder} {folder}")
    run(f"mount -o remount,bind,ro {folder}")
    yield
    run(f"umount {folder}")


def refused(
    bench: Bench,
    injection: Injection,
    _n: int,
    bad: Callable[[Path], AbstractContextManager[None]],
) -> None:
    """Check that "save" is refused until the disk is good again, while telemetry continues."""
    with RawBus(bench.watched) as master, bad(bench.store):
        master.write(1, *TIMEOUT_OBJECT, 251, 2)
        code = master.store(1)
        bench.expect(code not in (0, None), f"saving was answered with {code}")
    stores_again(bench)


on_disk("full", None, escs=[])(partial(refused, bad=full))
on_disk("read-only", None, escs=[])(partial(refused, bad=read_only))


@on_disk("a write that takes 5 s", None, escs=[], rounds=[0])
def slow(bench: Bench, injection: Injection, _n: int) -> None:
    """Check that no frame is delayed, and that "save" is confirmed when it is on the disk."""
    switch = Path(bench.environment["KCG_SLOW"])
    said = len(bench.gateway.lines)
    switch.touch()
    with RawBus(bench.watched) as master:
        master.write(1, *TIMEOUT_OBJECT, 253, 2)
        begin = time.monotonic()
        master.store(1, 1)
    bench.wait_log("parameters stored", said, 40)
    took = time.monotonic() - begin
    switch.unlink()
    bench.expect(took > SLOW_S, f"the disk was not slow: {took:.1f} s")
    stores_again(bench)


@on_disk("parameter file damaged or empty", RESTART_LIMIT_S, settle_s=1, rounds=range(3))
def damaged(bench: Bench, injection: Injection, n: int) -> None:
    """Check that it starts with defaults, reports it by a line and EMCY 6300h, and stores again."""
    stores_again(bench)
    bench.stop()
    (file,) = bench.store.glob("esc1*.params")
    content = file.read_bytes()
    contents = (b"", content[: len(content) // 2], bytes(x ^ 0x20 for x in content))
    file.write_bytes(contents[n])
    start_and_wait(injection)
    bench.wait_log("Using defaults")
    injection.wait_emergency(1, 0x6300)
    stores_again(bench)
