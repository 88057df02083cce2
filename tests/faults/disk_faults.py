"""Faults of the disk that the nodes' parameters are kept on. Telemetry must not notice any of them."""

import contextlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import benches
from bus_watch import SECOND
from fault_report import Fault, Report, fault
from harness import Bench, PtyPort
from process_faults import RESTART_LIMIT_S, start_and_wait
from raw_bus import RawBus

TIMEOUT_OBJECT = 0x2100, 4
SLOW_S = 5
SLOW_DISK = f"""
import os, time
for name in ("write", "fsync", "replace", "rename"):
    def slow(*args, _real=getattr(os, name), **options):
        import threading
        if threading.current_thread() is not threading.main_thread() and os.path.exists(os.environ["KCG_SLOW"]):
            time.sleep({SLOW_S} if _real.__name__ == "fsync" else 0.3)
        return _real(*args, **options)
    setattr(os, name, slow)
"""
"""The disk of a store's thread takes seconds for everything while a file is there. (In the loop's own thread nothing is slow: it must not
write to the disk at all, which the watch on its system calls would show as silence.)"""


def mount_small(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    benches.run("mount", "-t", "tmpfs", "-o", "size=64k,mode=0700", "tmpfs", str(folder))


def fill(folder: Path) -> Path:
    """Write until the disk is full."""
    filler = folder / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return filler


@contextlib.contextmanager
def disk_bench(report: Report) -> Iterator[Bench]:
    """Two ESCs; the parameters on a small file system of their own; a slow one at will."""
    folder = Path(tempfile.mkdtemp(prefix="disk."))
    store = folder / "store"
    mount_small(store)
    site = folder / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(SLOW_DISK)
    path = os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH"))))
    with benches.pair() as (near, far):
        ports = [
            PtyPort(folder / f"esc{i + 1}", identity)
            for i, identity in enumerate(benches.IDENTITIES)
        ]
        environment = {"PYTHONPATH": path, "KCG_SLOW": str(folder / "slow")}
        known = benches.table(len(ports), True)
        with Bench(
            near, far, ports, report, table=known, store=store, environment=environment
        ) as bench:
            bench.start()
            yield bench


def stores_again(bench: Bench, master: RawBus) -> None:
    assert master.write(1, *TIMEOUT_OBJECT, 250, 2) == 0
    code = master.store(1)
    if code != 0:
        raise AssertionError(f"parameters cannot be stored though the disk is good again: {code}")


@contextlib.contextmanager
def full(folder: Path) -> Iterator[None]:
    filler = fill(folder)
    yield
    filler.unlink()


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """On top of the one that the gateway has its lock open on, which would be busy."""
    benches.run("mount", "--bind", str(folder), str(folder))
    benches.run("mount", "-o", "remount,bind,ro", str(folder))
    yield
    benches.run("umount", str(folder))


def refused(
    bench: Bench, fault: Fault, times: int, bad: Callable[[Path], AbstractContextManager[None]]
) -> None:
    """A master's "save" is refused, and is possible again when the disk is good; telemetry goes on."""
    with RawBus(bench.watched) as master:
        for _ in range(times):
            with bench.injection(fault, []) as injection:
                with bad(bench.store):
                    master.write(1, *TIMEOUT_OBJECT, 251, 2)
                    code = master.store(1)
                    injection.expect(code not in (0, None), f"saving was answered with {code}")
                injection.cleared()
                stores_again(bench, master)


fault("Disk", "full", None, bench="disk")(partial(refused, bad=full))
fault("Disk", "read-only", None, bench="disk")(partial(refused, bad=read_only))


@fault("Disk", "a write that takes 5 s", None, bench="disk")
def slow(bench: Bench, fault: Fault, times: int) -> None:
    """No frame is delayed by it; the "save" is confirmed when it is on the disk."""
    switch = Path(bench.environment["KCG_SLOW"])
    with RawBus(bench.watched) as master:
        for _ in range(max(1, times // 3)):
            with bench.injection(fault, []) as injection:
                assert bench.gateway is not None
                said = len(bench.gateway.lines)
                bench.watch.reset_silence()
                switch.touch()
                master.write(1, *TIMEOUT_OBJECT, 253, 2)
                begin = time.monotonic()
                master.store(1, 1)
                bench.wait_log("parameters stored", said, 40)
                took = time.monotonic() - begin
                silence = max(map(bench.watch.silence_ns, range(len(bench.fed)))) / SECOND
                bench.report.row(fault).peak("s to save", round(took, 1))
                bench.report.row(fault).peak("longest silence in s", round(silence, 3))
                switch.unlink()
                injection.expect(took > SLOW_S, f"the disk was not slow: {took:.1f} s")
                injection.cleared()
                stores_again(bench, master)


@fault("Disk", "parameter file damaged or empty", RESTART_LIMIT_S, bench="disk")
def damaged(bench: Bench, fault: Fault, times: int) -> None:
    """It starts with its defaults, says so by a line and EMCY 6300h, and stores again."""
    with RawBus(bench.watched) as master:
        stores_again(bench, master)
        for i in range(max(3, times // 2)):
            with bench.injection(fault, settle_s=1) as injection:
                bench.stop()
                (file,) = bench.store.glob("esc1*.params")
                content = file.read_bytes()
                file.write_bytes(
                    (b"", content[: len(content) // 2], bytes(x ^ 0x20 for x in content))[i % 3]
                )
                start_and_wait(injection)
                assert bench.gateway is not None
                bench.wait_log("Running on defaults")
                injection.wait_emergency(1, 0x6300)
                stores_again(bench, master)


benches.BENCHES["disk"] = disk_bench
