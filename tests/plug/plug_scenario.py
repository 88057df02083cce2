"""Lets a gateway record and store parameters on a logged device, in a virtual machine."""

import contextlib
import random
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from beds import bench_of, make_pair
from block_log import SECTOR, Log
from devices import LoggedDevice, LoopDevice, mount, unmount
from feeder import Identity
from harness import Bench, LoggedProcess
from plug_judge import LOWEST, Capture, capture_of, read_blocks
from raw_bus import RawBus

from kontronik_can_gw.capture.format import SUFFIX

ROOT = Path("/run/plug")
"""Folder at which the device is mounted."""
MEMORY = Path("/run/images")
INTERFACE = "plug0"
RUNS = 2
STORES = 7
"""Number of sets that each run stores."""
LEAST_BLOCKS = 5
"""Smallest number of blocks of a run's capture."""
_MARK_S = 0.05
_LOG_BYTES = 400 << 20
_START_S = 30


class FileSystem(NamedTuple):
    """A file system, and the files that the gateway has on it."""

    kind: str
    size: int
    make: tuple[str, ...]
    repair: tuple[str, ...] = ()
    """Command that a system runs before it mounts the file system. Exit code 1: repaired."""
    rescue: tuple[str, ...] = ()
    """The same, if the kernel refuses to mount it after a torn write or a second power loss."""
    unit: int = SECTOR
    """A write reaches the device in units of this number of bytes."""
    is_recovery_safe: bool = True
    """False if a power loss while it is mounted again may undo flushed writes.

    f2fs in Linux 6.1 overwrites the nodes that fsync has written before it has a new checkpoint.
    """
    has_folder: bool = False
    """The folder of the captures exists before. vfat may damage a new folder beyond repair."""
    has_store: bool = True
    """It also has the stored parameters and the statistics."""


_NOT_LATER = "lazy_itable_init=0,lazy_journal_init=0"
_CHECK_EXT4 = """
e2fsck -y "$0"
code=$?
[ $code -le 3 ] && exit $code
exec e2fsck -y -b 4096 -B 4096 "$0"
"""
"""By itself e2fsck finds the copy of a torn superblock only on a disk above 128 MB."""
FILE_SYSTEMS = {
    system.kind: system
    for system in (
        FileSystem(
            kind="ext4",
            size=32 << 20,
            make=("mkfs.ext4", "-q", "-F", "-b", "4096", "-g", "4096", "-E", _NOT_LATER),
            rescue=("sh", "-c", _CHECK_EXT4),
        ),
        FileSystem(
            kind="f2fs",
            size=64 << 20,
            make=("mkfs.f2fs", "-q", "-f"),
            unit=4096,
            is_recovery_safe=False,
        ),
        FileSystem(
            kind="vfat",
            size=32 << 20,
            make=("mkfs.vfat",),
            repair=("fsck.vfat", "-a"),
            has_folder=True,
            has_store=False,
        ),
    )
}


@dataclass
class Recorded:
    """The log of a gateway's writes, and its captures as it wrote them."""

    log: Log
    captures: dict[str, Capture] = field(default_factory=dict)


def make_file_system(system: FileSystem, disk: LoopDevice) -> None:
    """Make the file system on the disk, as it is before the gateway runs for the first time."""
    subprocess.run([*system.make, MEMORY / "disk"], check=True, stdout=subprocess.DEVNULL)
    if system.has_folder:
        mount(disk.path, ROOT, system.kind)
        (ROOT / "captures").mkdir()
        unmount(ROOT)


def configuration(system: FileSystem) -> tuple[Path, str]:
    """Return the folder of the stored parameters, and tables for the gateway's configuration."""
    text = f'[record]\ndirectory = "{ROOT}/captures"\nmin_free_mb = 1\n'
    if not system.has_store:
        return MEMORY / "store", text
    return ROOT / "store", text + f'[statistics]\nfile = "{ROOT}/status.json"\n'


def record(system: FileSystem, disk: LoopDevice, seed: int) -> Recorded:
    """Run a gateway twice on the disk's file system. It is killed at the end of the second run."""
    loop = LoopDevice(1, MEMORY / "log", _LOG_BYTES)
    device = LoggedDevice("recording", disk, loop)
    mount(device.path, ROOT, system.kind)
    store, more = configuration(system)
    with marked_times(device), bench_of([Identity(1)], store=store, more=more) as bench:
        with RawBus(bench.watched) as master:
            for run in range(RUNS):
                if run:
                    bench.start()
                _store_often(bench, master, device, run * STORES, random.Random(seed + run))
                if run < RUNS - 1:
                    bench.stop()
        bench.kill()
        files = sorted((ROOT / "captures").glob(f"*{SUFFIX}"))
        captures = {each.name: capture_of(read_blocks(each)) for each in files}
    unmount(ROOT)
    log = Log(device.entries(), system.unit)
    device.close()
    loop.close()
    # without captures and stored parameters each state would be good
    assert len(captures) == RUNS, sorted(captures)
    assert all(len(each.blocks) >= LEAST_BLOCKS for each in captures.values())
    assert log.stored(len(log.entries)) == RUNS * STORES
    return Recorded(log, captures)


def _store_often(
    bench: Bench,
    master: RawBus,
    device: LoggedDevice,
    first: int,
    generator: random.Random,
) -> None:
    for number in range(first + 1, first + STORES + 1):
        value = LOWEST + number
        bench.expect(master.write(1, 0x2100, 4, value, 2) == 0, "the timeout cannot be set")
        bench.expect(master.write(1, 0x1017, 0, value, 2) == 0, "the heartbeat cannot be set")
        device.mark(f"storing={number}")
        bench.expect(master.store(1) == 0, "the master cannot store")
        device.mark(f"stored={number}")
        time.sleep(generator.uniform(0.2, 2.5))


@contextlib.contextmanager
def marked_times(device: LoggedDevice) -> Iterator[None]:
    """Mark the time in the log until the end of the block."""
    stop = threading.Event()

    def mark() -> None:
        while True:
            device.mark(f"now={time.monotonic_ns()}")
            if stop.wait(_MARK_S):
                return

    thread = threading.Thread(target=mark, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        device.mark(f"now={time.monotonic_ns()}")


class RealStart:
    """Starts `run` with the files of a state, without an ESC."""

    def __init__(self, system: FileSystem) -> None:
        make_pair(INTERFACE, f"{INTERFACE}far")
        subprocess.run(["ip", "link", "set", INTERFACE, "up"], check=True)
        store, more = configuration(system)
        self._config = MEMORY / "gateway.toml"
        self._config.write_text(
            f'[can]\ninterface = "socketcan"\nchannel = "{INTERFACE}"\nbitrate = 1000000\n'
            "[canopen]\nenabled = true\nself_start = true\nnode_id = 1\nserial = 1050112\n"
            f'store = "{store}"\n[[esc]]\nname = "esc1"\nport = "{MEMORY}/none"\n{more}'
        )

    def problem(self) -> str:
        """Return why the gateway does not start, record and end properly, or ""."""
        shutil.rmtree(MEMORY / "store", ignore_errors=True)
        program = [sys.executable, "-m", "kontronik_can_gw", "run", "-c", str(self._config)]
        process = LoggedProcess([*program, "--wait"])
        begin = time.monotonic()
        while "recording to" not in process.log and process.process.poll() is None:
            if time.monotonic() - begin > _START_S:
                break
            time.sleep(0.05)
        is_recording = "recording to" in process.log
        process.process.terminate()
        code = process.wait()
        is_bad = "Traceback" in process.log or "internal error" in process.log
        if code or is_bad or not is_recording or "damaged" in process.log:
            return f"run: exit code {code}, log: {process.log[-1500:]}"
        return ""
