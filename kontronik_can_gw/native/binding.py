"""Loads the shared object of the core in C through ctypes, without Python headers or callbacks."""

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
    "kcg_signal",
    "kcg_message",
    "kcg_e2e",
    "kcg_settings",
    "kcg_plan",
    "kcg_esc",
    "kcg_frame",
    "kcg_offline",
    "kcg_column",
    "kcg_cell",
    "kcg_turns",
)
"""Structures in the order of kcg_sizes, kcg_offline_sizes and kcg_turns_size."""
_IN_CORE = 7
_IN_OFFLINE = 3
"""Numbers of structures whose sizes kcg_sizes and kcg_offline_sizes return."""
_head = struct.Struct("=IBBB").unpack_from


class WrongObject(RuntimeError):
    """The shared object is from another version or for another machine. The message tells which."""


def load(path: Path) -> Any:
    """Return the shared object with its functions declared. Raises WrongObject if it is wrong."""
    try:
        # A function of PyDLL keeps the GIL. kcg_turn is a function of CDLL, which releases the GIL
        # for the whole call, because the call waits. Other threads run meanwhile. They must neither
        # call the core nor read or write its memory and that of its Turns: NativeCore, its ``escs``
        # and its ``status``. They are given copies (``frozen``) between two calls.
        library: Any = c.PyDLL(str(path))
        released: Any = c.CDLL(str(path))
        library.kcg_turn = released.kcg_turn
        for name, (result, *arguments) in functions():
            function = getattr(library, name)
            function.restype = result
            function.argtypes = arguments
    except (OSError, AttributeError) as error:
        raise WrongObject(f"{path.name}: {error}") from None
    sizes = [library.kcg_sizes(1 + number) for number in range(_IN_CORE)]
    sizes += [library.kcg_offline_sizes(number) for number in range(_IN_OFFLINE)]
    sizes.append(library.kcg_turns_size())
    expected = [c.sizeof(structure(name)) for name in _SIZED]
    if library.kcg_sizes(0) != source_number() or sizes != expected:
        raise WrongObject(f"{path.name}: built from other sources than this version")
    return library


def frames_in(raw: memoryview, begin: int, count: int) -> list[CanFrame]:
    """Return ``count`` frames (kcg_frame) in memory, from offset ``begin``, as CanFrames."""
    frames = []
    for at in range(begin, begin + count * _FRAME_SIZE, _FRAME_SIZE):
        number, length, flags, page = _head(raw, at)
        data = bytes(raw[at + 8 : at + 8 + length])
        can_id = number & ~EXTENDED
        frames.append(CanFrame(can_id, data, number >= EXTENDED, flags != 0, page))
    return frames
