"""Faults of the disk that the nodes' parameters are kept on. Telemetry must not notice any of them."""

import contextlib
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import benches
from harness import SECOND, Bench, Fault, Gateway, PtyPort, Report, fault
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
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k,mode=0700", "tmpfs", str(folder)], check=True)


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
        ports = [PtyPort(folder / f"esc{i + 1}", identity) for i, identity in enumerate(benches.IDENTITIES)]
        environment = {"PYTHONPATH": path, "KCG_SLOW": str(folder / "slow")}
        known = benches.table(len(ports), True)
        with Bench(near, far, ports, report, table=known, store=store, environment=environment) as bench:
            bench.start()
            yield bench


def stores_again(bench: Bench, master: RawBus) -> None:
    assert master.write(1, *TIMEOUT_OBJECT, 250, 2) == 0
    code = master.store(1)
    if code != 0:
        raise AssertionError(f"parameters cannot be stored though the disk is good again: {code}")


@fault("Disk", "full", None, bench="disk")
def full(bench: Bench, fault: Fault, times: int) -> None:
    """A master's "save" is refused, and is possible again when there is room; telemetry goes on."""
    with RawBus(bench.watched) as master:
        for _ in range(times):
            with bench.injection(fault, []) as injection:
                filler = fill(bench.store)
                master.write(1, *TIMEOUT_OBJECT, 251, 2)
                code = master.store(1)
                injection.expect(code not in (0, None), f"saving on a full disk was answered with {code}")
                filler.unlink()
                injection.cleared()
                stores_again(bench, master)


@fault("Disk", "read-only", None, bench="disk")
def read_only(bench: Bench, fault: Fault, times: int) -> None:
    with RawBus(bench.watched) as master:
        for _ in range(times):
            with bench.injection(fault, []) as injection:
                # on top of the one that the gateway has its lock open on, which would be busy
                subprocess.run(["mount", "--bind", str(bench.store), str(bench.store)], check=True)
                subprocess.run(["mount", "-o", "remount,bind,ro", str(bench.store)], check=True)
                master.write(1, *TIMEOUT_OBJECT, 252, 2)
                code = master.store(1)
                injection.expect(code not in (0, None), f"saving on a read-only disk was answered with {code}")
                subprocess.run(["umount", str(bench.store)], check=True)
                injection.cleared()
                stores_again(bench, master)


@fault("Disk", "a write that takes 5 s", None, bench="disk")
def slow(bench: Bench, fault: Fault, times: int) -> None:
    """No frame is delayed by it; the "save" is confirmed when it is on the disk."""
    switch = Path(bench.environment["KCG_SLOW"])
    with RawBus(bench.watched) as master:
        for _ in range(max(1, times // 3)):
            with bench.injection(fault, []) as injection:
                assert bench.gateway is not None
                gateway, saved = bench.gateway, bench.gateway.log.count("parameters stored")
                bench.watch.reset_silence()
                switch.touch()
                master.write(1, *TIMEOUT_OBJECT, 253, 2)
                begin = time.monotonic()
                master.store(1, 1)

                def stored(gateway: Gateway = gateway, saved: int = saved) -> bool:
                    return gateway.log.count("parameters stored") > saved

                bench.wait_until(stored, 40, "the saving's end")
                took = time.monotonic() - begin
                silence = max(bench.watch.longest_silence_ns) / SECOND
                bench.report.row(fault).figures |= {
                    "s to save": round(took, 1),
                    "longest silence in s": round(silence, 3),
                }
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
                file.write_bytes((b"", content[: len(content) // 2], bytes(x ^ 0x20 for x in content))[i % 3])
                start_and_wait(injection)
                assert bench.gateway is not None
                injection.expect(
                    "Running on defaults" in bench.gateway.log, "the log does not say that the file is bad"
                )
                injection.expect(0x6300 in injection.emergency_codes(1), "no EMCY 6300h")
                stores_again(bench, master)


benches.BENCHES["disk"] = disk_bench
