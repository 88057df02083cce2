"""Loop devices, logged block devices and mounts, by system calls. Needs root and a Linux kernel.

A process for each mount would take most of the time of a state.
"""

import ctypes
import fcntl
import mmap
import os
import struct
import subprocess
import time
from pathlib import Path

from block_log import SECTOR, Entry, Write, entries_before

_libc = ctypes.CDLL(None, use_errno=True)
_LOOP_SET_FD = 0x4C00
_LOOP_CLR_FD = 0x4C01
_DM = struct.Struct("=3I2IIiIIIQ128s129s7x")
_DM_TARGET = struct.Struct("=QQiI16s")
_DM_CREATE = 3
_DM_REMOVE = 4
_DM_SUSPEND = 6
_DM_LOAD = 9
_DM_MESSAGE = 14
_DM_VERSION = (4, 0, 0)
_DM_UNUSED = (0, 0, 0, 0, 0)
"""Number of users, flags, event, padding and device, which the kernel returns."""
_DM_CONTROL = Path("/dev/mapper/control")
_MODULES = ("loop", "dm-mod", "dm-log-writes", "crc32_generic", "f2fs", "fat", "vfat")
_CHARACTER_SETS = ("nls_cp437", "nls_ascii", "nls_iso8859-1", "nls_utf8")
_DELAY_S = 0.001


def load_modules() -> None:
    """Load the modules of User Mode Linux, which loads nothing by itself."""
    folder = Path(Path("/run/job/modules").read_text().strip(), os.uname().release)
    for name in _MODULES + _CHARACTER_SETS:
        for file in folder.glob(f"kernel/**/{name}.ko"):
            subprocess.run(["busybox", "insmod", file], check=True)


def mount(device: str, folder: Path, kind: str) -> None:
    """Mount a device as a usual system does. OSError if the kernel refuses."""
    words = [device.encode(), os.fsencode(folder), kind.encode()]
    if _libc.mount(*words, 0, b""):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def unmount(folder: Path) -> None:
    if _libc.umount2(os.fsencode(folder), 0):
        raise OSError(ctypes.get_errno(), f"{folder}: {os.strerror(ctypes.get_errno())}")


class LoopDevice:
    """A block device whose content is a file in memory."""

    def __init__(self, number: int, file: Path, size: int) -> None:
        self.path = f"/dev/loop{number}"
        self.size = size
        with file.open("ab") as made:
            made.truncate(size)
        self.fd = os.open(file, os.O_RDWR | os.O_CLOEXEC)
        device = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        fcntl.ioctl(device, _LOOP_SET_FD, self.fd)
        os.close(device)

    def clear(self) -> None:
        """Let the content be zeros."""
        os.ftruncate(self.fd, 0)
        os.ftruncate(self.fd, self.size)

    def close(self) -> None:
        device = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        fcntl.ioctl(device, _LOOP_CLR_FD)
        os.close(device)
        os.close(self.fd)


class LoggedDevice:
    """A device mapper device that logs all writes and flushes to its disk, until ``close``."""

    def __init__(self, name: str, disk: LoopDevice, log: LoopDevice) -> None:
        self._name = name.encode()
        self._log = log
        self._control = os.open(_DM_CONTROL, os.O_RDWR | os.O_CLOEXEC)
        self._at = SECTOR
        self._marks = 0
        log.clear()
        self._map = mmap.mmap(log.fd, log.size)
        answer = self._call(_DM_CREATE)
        number = _DM.unpack_from(answer)[10]
        minor = (number & 0xFF) | (number >> 12 & ~0xFF)
        self.path = f"/dev/dm-{minor}"
        words = f"{disk.path} {log.path}\0".encode()
        words += bytes(-len(words) % 8)
        target = _DM_TARGET.pack(0, disk.size // SECTOR, 0, 0, b"log-writes")
        self._call(_DM_LOAD, target + words, targets=1)
        self._call(_DM_SUSPEND)  # without the flag for it, this resumes

    def _call(self, number: int, data: bytes = b"", targets: int = 0) -> bytes:
        size = max(_DM.size + len(data), 1024)
        counts = (size, _DM.size, targets)
        head = _DM.pack(*_DM_VERSION, *counts, *_DM_UNUSED, self._name, b"")
        argument = bytearray(head + data).ljust(size, b"\0")
        fcntl.ioctl(self._control, 0xC000FD00 | _DM.size << 16 | number, argument)
        return bytes(argument)

    def mark(self, text: str) -> None:
        """Write a mark, which is one word, to the log."""
        self._call(_DM_MESSAGE, struct.pack("=Q", 0) + f"mark {text}\0".encode())

    def entries(self) -> list[Entry]:
        """Return the entries since the last call. The device must not be mounted."""
        device = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        os.fsync(device)
        os.close(device)
        self._marks += 1
        last = Entry(data=f"end={self._marks}".encode(), is_mark=True)
        self.mark(last.data.decode())
        while True:
            with memoryview(self._map) as view:
                found = entries_before(view, self._at, last)
            if found is not None:
                break
            time.sleep(_DELAY_S)
        entries, self._at = found
        return entries

    @property
    def is_nearly_full(self) -> bool:
        return self._at > self._log.size // 2

    def close(self) -> None:
        self._call(_DM_REMOVE)
        self._map.close()
        os.close(self._control)


class Image:
    """The content of a device, built up from an empty file system and the writes of a log."""

    def __init__(self, disk: LoopDevice) -> None:
        self._disk = disk
        self._content = mmap.mmap(-1, disk.size)
        self._content[:] = os.pread(disk.fd, disk.size, 0)
        self._changed: list[tuple[int, int]] = []
        """Offset and length of the parts of the disk that differ from the content."""

    def advance(self, writes: list[Write]) -> None:
        """Add writes to the content."""
        for sector, data in writes:
            self._content[sector * SECTOR : sector * SECTOR + len(data)] = data
            self.note_changed(sector, len(data))

    def note_changed(self, sector: int, length: int) -> None:
        self._changed.append((sector * SECTOR, length))

    def put(self, writes: tuple[Write, ...]) -> None:
        """Let the disk have the content and then these writes."""
        for offset, length in self._changed:
            os.pwrite(self._disk.fd, self._content[offset : offset + length], offset)
        self._changed.clear()
        for sector, data in writes:
            os.pwrite(self._disk.fd, data, sector * SECTOR)
            self.note_changed(sector, len(data))
