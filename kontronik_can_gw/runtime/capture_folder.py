"""The folder of captures: which files are captures, the oldest are removed."""

import contextlib
import os
import re
from pathlib import Path

from kontronik_can_gw.capture.format import SUFFIX
from kontronik_can_gw.runtime.disk import is_locked

_OURS = re.compile(rf"[0-9]{{8}}T[0-9]{{6}}Z-[0-9a-f]{{6}}-[0-9]+{SUFFIX}")


def remove_oldest(folder: Path, keep_bytes: int) -> None:
    """Keep the folder below a size, 0: any; what is being written, by any process, stays."""
    if not keep_bytes:
        return
    found: list[tuple[int, str, int, Path]] = []
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another gateway has removed it
            if _OURS.fullmatch(path.name) and not path.is_symlink() and path.is_file():
                status = path.stat()
                found.append((status.st_mtime_ns, path.name, status.st_size, path))
    total = sum(size for _, _, size, _ in found)
    for _, _, size, path in sorted(found):
        if total <= keep_bytes:
            return
        if not is_locked(path):  # it is being written
            with contextlib.suppress(OSError):
                path.unlink()
                total -= size


def make_folder(folder: Path) -> None:
    folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(1, "may not be written to")
