"""Which core runs: the one in C where its shared object is there and can express the layout; else the one in Python, and why."""

import os
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

from kontronik_can_gw.core.interface import Core
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.objects import fault, shared_object
from kontronik_can_gw.signals.plan import Layout

PURE = "KONTRONIK_PURE"
"""Environment variable: 1 asks for the core in Python."""


class Made(NamedTuple):
    """A core, and in words why it is the one in Python; empty with the one in C."""

    core: Core
    why: str


@cache
def library() -> tuple[Any, str]:
    """The shared object; None where it cannot or is not to be used, and why."""
    if os.environ.get(PURE, "0") not in ("", "0"):
        return None, f"{PURE} is set"
    path = shared_object()
    if why := fault(path):
        return None, why
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


def give_back() -> None:
    """Give the system the memory that the C library holds free. Nothing without the core in C, or where the library cannot (musl)."""
    if library()[0] is None:
        return
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def in_words(language: str, why: str | None) -> str:
    """One line for people, as ``core: Python (KONTRONIK_PURE is set)``."""
    return f"core: {language} ({why})" if why else f"core: {language}"
