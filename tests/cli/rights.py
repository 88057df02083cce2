"""Takes away the rights that root has beyond its own files."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PROJECT = Path(__file__).resolve().parents[2]
_VERSION_3 = 0x20080522
_BEYOND_MODES = (1, 2)
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH: use files in spite of their modes."""


@contextmanager
def modes_apply(folder: Path) -> Iterator[None]:
    """Let the modes of files apply to this thread, even if it is root's, during the block.

    It acts as the owner of the project, so that it can read the project below a folder that only
    its owner can enter. ``folder`` and all in it get the same owner.
    """
    if os.geteuid() != 0:
        yield
        return
    owner = _PROJECT.stat().st_uid
    for path in (folder, *folder.rglob("*")):
        os.chown(path, owner, -1, follow_symlinks=False)
    before = _effective()
    _set_effective([before[0] & ~sum(1 << bit for bit in _BEYOND_MODES), before[1]])
    os.seteuid(owner)
    try:
        yield
    finally:
        os.seteuid(0)
        _set_effective(before)


def _effective() -> list[int]:
    return [words[0] for words in _read()]


def _set_effective(effective: list[int]) -> None:
    words = [[new, *old[1:]] for new, old in zip(effective, _read(), strict=True)]
    _call("capset", [number for each in words for number in each])


def _read() -> list[list[int]]:
    """Return effective, permitted and inheritable capabilities 0 to 31, and those from 32 on."""
    found = _call("capget", [0] * 6)
    return [found[:3], found[3:]]


def _call(name: str, numbers: list[int]) -> list[int]:
    head = (ctypes.c_uint32 * 2)(_VERSION_3, 0)
    data = (ctypes.c_uint32 * 6)(*numbers)
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, name)(head, data) != 0:
        raise OSError(ctypes.get_errno(), name)
    return list(data)
