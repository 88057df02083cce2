"""Writes the bundle as a zip file. If the disk is full, the largest parts are left out."""

import errno
import os
import stat
import time
import zipfile
from collections import Counter
from collections.abc import Sequence
from typing import IO

from kontronik_can_gw import __version__
from kontronik_can_gw.desk.bundle.parts import BundlePart, Contents
from kontronik_can_gw.runtime.files.disk import write_all
from kontronik_can_gw.runtime.status.facts import utc
from kontronik_can_gw.times import SECOND

README = "README.txt"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_ABOUT = (
    ("doctor.txt", "faults of machine, ports, CAN interface and configuration, with remedies"),
    ("check.txt", "what the configuration sends"),
    ("status.txt, status.json", "the state of the running gateways"),
    ("configuration/, dbc/, eds/", "the files in use"),
    ("journal.txt", "the log of the services in the last day"),
    ("captures/", "the two newest captures, which replay like the originals"),
    ("versions.json", "versions, and SHA-256 digests of files"),
)
_STILL_INSIDE = """\
Names of ESCs, ports, messages, signals and of this machine; the broker's host; paths of files;
names of options and attributes, without their values. A capture reveals the use of the vehicle: it
has all telemetry and all CAN frames that the gateway received. Leave captures out with
--without-captures, and the DBC with --without-dbc. Warnings may name messages and signals of the
DBC nevertheless.
Rules recognise secrets by their names, forms and values. Look through the files before you send
them.
"""


class _File:
    """An unbuffered file for zipfile, so that nothing is left to write after a full disk."""

    def __init__(self, file: IO[bytes]) -> None:
        self._fd = file.fileno()

    def write(self, data: bytes) -> int:
        write_all(self._fd, data)
        return len(data)

    def tell(self) -> int:
        return os.lseek(self._fd, 0, os.SEEK_CUR)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return os.lseek(self._fd, offset, whence)

    def flush(self) -> None:
        """Do nothing, because nothing is buffered."""

    def restart(self) -> None:
        """Remove everything that was written."""
        self.seek(0)
        os.ftruncate(self._fd, 0)


def write_archive(file: IO[bytes], contents: Contents, made_ns: int) -> None:
    """Write the bundle. OSError if the disk has no room even for the smallest part.

    Only its owner may read the file. ``made_ns`` is the Unix time of all files in it.
    """
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        os.fchmod(file.fileno(), 0o600)
    raw = _File(file)
    parts = list(contents.parts)
    while True:
        try:
            _write(
                raw,
                parts,
                contents,
                made_ns,
            )
            return
        except OSError as error:
            if error.errno not in _FULL or not parts:
                raise
            largest = max(parts, key=lambda part: part.size)
            parts.remove(largest)
            room = f"{largest.size / 1e6:.1f} MB do not fit on the disk: {os.strerror(error.errno)}"
            contents.missing.append(f"{largest.name}: {room}")
            raw.restart()


def _write(raw: _File, parts: Sequence[BundlePart], contents: Contents, made_ns: int) -> None:
    date = time.gmtime(made_ns // SECOND)[:6]
    with zipfile.ZipFile(raw, "w") as archive:  # type: ignore[call-overload]
        for part in parts:
            is_packed = part.name.startswith("captures/")
            info = _info(part.name, date, zipfile.ZIP_STORED if is_packed else zipfile.ZIP_DEFLATED)
            with archive.open(info, "w", force_zip64=True) as entry:
                for data in part.chunks():
                    entry.write(data)
        text = readme(contents, [part.name for part in parts], made_ns)
        info = _info(README, date, zipfile.ZIP_DEFLATED)
        archive.writestr(info, text.encode("utf-8", "replace"))


def _info(name: str, date: tuple[int, ...], kind: int) -> zipfile.ZipInfo:
    year, *rest = date
    info = zipfile.ZipInfo(name, (min(max(year, 1980), 2107), *rest))  # type: ignore[arg-type]
    info.compress_type = kind
    info.external_attr = 0o600 << 16
    return info


def readme(contents: Contents, names: Sequence[str], made_ns: int) -> str:
    """Return the text of README.txt: the parts, missing parts, and removed secrets."""
    made = utc(made_ns / SECOND)
    lines = [f"Support bundle of kontronik-can-gw {__version__}, made {made}", "", "Files:"]
    lines += [f"  {name}" for name in names]
    lines += ["", "Meaning:"]
    lines += [f"  {name:<28}{about}" for name, about in _ABOUT]
    lines += ["", "Missing:"]
    lines += [f"  {line}" for line in contents.missing] or ["  nothing"]
    lines += ["", "Removed:"]
    removed = []
    for name in sorted(names):
        counts = sorted(contents.cleaner.removed.get(name, Counter[str]()).items())
        removed += [f"  {name}: {number} x {kind}" for kind, number in counts]
    lines += removed or ["  nothing"]
    lines += ["", "Still inside:", _STILL_INSIDE]
    return contents.cleaner.text("\n".join(lines), README)
