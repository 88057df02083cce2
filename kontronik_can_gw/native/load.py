"""Which core runs: the one in Python, unless the one in C is asked for, its shared object is there, and it can express the layout."""

import os
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

from kontronik_can_gw.core import Core, PythonCore
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.signals.plan import Layout

CORE = "KONTRONIK_CORE"
"""Environment variable: C asks for the core in C. (It saves little before it turns the loop too.)"""


class Made(NamedTuple):
    """A core, and in words why it is not the one in C although that was asked for; empty else."""

    core: Core
    why: str


@cache
def library() -> tuple[Any, str]:
    """The shared object where it is asked for; None where it is not or cannot be used, and why."""
    if os.environ.get(CORE, "") != "C":
        return None, ""
    from kontronik_can_gw.native.compile import (
        shared_object,  # a compiler's driver: not at each start
    )

    path = shared_object()
    if not path.exists():
        return None, f"no {path.name} in this installation"
    try:
        # where memory must not be executed, ctypes itself may not load
        from kontronik_can_gw.native.binding import WrongObject, load
    except (ImportError, MemoryError, OSError) as error:
        return None, f"ctypes cannot be used here: {error}"
    try:
        return load(path), ""
    except (WrongObject, OSError) as error:
        return None, str(error)


def make_core(
    escs: Sequence[EscSettings],
    layout: Layout,
    now: int,
    silent: bool,
    slots: int = 0,
) -> Made:
    """The core for these ESCs and this layout. ``slots`` of each ESC have room in C."""
    found, why = library()
    if found is not None:
        from kontronik_can_gw.native.core import NativeCore
        from kontronik_can_gw.native.rows import NotInCore

        try:
            return Made(NativeCore(found, escs, layout, now, silent, slots), "")
        except NotInCore as error:
            why = str(error)
    return Made(PythonCore(escs, layout, now, silent), why)
