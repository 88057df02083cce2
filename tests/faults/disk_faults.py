"""Faults of the disk that the nodes' parameters are kept on. Telemetry must not notice any of them."""

import contextlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from beds import bench_of, fault, run
from harness import Bench, Injection
from process_faults import RESTART_LIMIT_S, TIMEOUT_OBJECT, start_and_wait
from raw_bus import RawBus

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


@contextlib.contextmanager
def disk(_: Path) -> Iterator[Bench]:
    """Two ESCs; the parameters on a small file system of their own; a slow one at will."""
    folder = Path(tempfile.mkdtemp(prefix="disk."))
    store, site = folder / "store", folder / "site"
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
    """Written to until nothing more fits."""
    filler = folder / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    yield
    filler.unlink()


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """On top of the one that the gateway has its lock open on, which would be busy."""
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
    """A master's "save" is refused, and is possible again when the disk is good; telemetry goes on."""
    with RawBus(bench.watched) as master, bad(bench.store):
        master.write(1, *TIMEOUT_OBJECT, 251, 2)
        code = master.store(1)
        bench.expect(code not in (0, None), f"saving was answered with {code}")
    stores_again(bench)


on_disk("full", None, escs=[])(partial(refused, bad=full))
on_disk("read-only", None, escs=[])(partial(refused, bad=read_only))


@on_disk("a write that takes 5 s", None, escs=[], rounds=[0])
def slow(bench: Bench, injection: Injection, _n: int) -> None:
    """No frame is delayed by it; the "save" is confirmed when it is on the disk."""
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
    """It starts with its defaults, says so by a line and EMCY 6300h, and stores again."""
    stores_again(bench)
    bench.stop()
    (file,) = bench.store.glob("esc1*.params")
    content = file.read_bytes()
    file.write_bytes((b"", content[: len(content) // 2], bytes(x ^ 0x20 for x in content))[n])
    start_and_wait(injection)
    bench.wait_log("Running on defaults")
    injection.wait_emergency(1, 0x6300)
    stores_again(bench)
