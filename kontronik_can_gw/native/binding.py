"""The shared object of the core in C by ctypes: no Python headers, no callbacks."""

import ctypes as c
import struct
from pathlib import Path
from typing import Any

from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.native.header import functions, structure
from kontronik_can_gw.native.objects import source_number

Frame = structure("kcg_frame")
_FRAME_SIZE = c.sizeof(Frame)
_SIZED = (
    *("signal", "message", "settings", "plan", "esc", "frame"),
    *("offline", "column", "cell", "turns"),
)
"""In the order of kcg_sizes, kcg_offline_sizes and kcg_turns_size."""
_head = struct.Struct("=IBBB").unpack_from
_new = tuple.__new__


class WrongObject(RuntimeError):
    """A shared object that is not of this version, or not for this machine: the message says which."""


def load(path: Path) -> Any:
    """The shared object with its functions declared. WrongObject where it cannot be used."""
    try:
        library: Any = c.PyDLL(str(path))  # other threads of Python run only while a turn waits
        library.kcg_turn = c.CDLL(str(path)).kcg_turn
        for name, (result, *arguments) in functions():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise WrongObject(f"{path.name}: {error}") from None
    its = [library.kcg_sizes(number) for number in range(7)]
    its += [*map(library.kcg_offline_sizes, range(3)), library.kcg_turns_size()]
    if its != [source_number(), *(c.sizeof(structure(f"kcg_{name}")) for name in _SIZED)]:
        raise WrongObject(f"{path.name}: made of other sources than these")
    return library


def frames_in(raw: memoryview, begin: int, count: int) -> list[CanFrame]:
    """As CanFrames: ``count`` of kcg_frame in memory from ``begin`` on."""
    frames = []
    for at in range(begin, begin + count * _FRAME_SIZE, _FRAME_SIZE):
        number, length, flags, page = _head(raw, at)
        data = bytes(raw[at + 8 : at + 8 + length])
        of = (number & ~EXTENDED, data, number >= EXTENDED, flags != 0, page, False, False)
        frames.append(_new(CanFrame, of))
    return frames
