"""Selects the core: in C if its shared object fits and can express the layout, else in Python."""

import os
from functools import cache
from typing import Any

from kontronik_can_gw.core.interface import Core
from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.native.objects import fault, shared_object

PURE = "KONTRONIK_PURE"
"""Environment variable: 1 asks for the core in Python."""


@cache
def library() -> tuple[Any, str]:
    """Return the shared object and "". If it is not used, return None and the reason."""
    if os.environ.get(PURE, "0") not in ("", "0"):
        return None, f"{PURE} is set"
    path = shared_object()
    if why := fault(path):
        return None, why
    try:
        # ctypes cannot be imported if the system forbids memory to be executed
        from kontronik_can_gw.native.binding import WrongObject, load
    except (ImportError, MemoryError, OSError) as error:
        return None, f"ctypes cannot be used here: {error}"
    try:
        return load(path), ""
    except (WrongObject, OSError) as error:
        return None, str(error)


def make_core(settings: CoreSettings, now: int) -> Core:
    """Return the core in C if it can run with these settings, else the core in Python."""
    found, why = library()
    if found is not None:
        from kontronik_can_gw.native.core import NativeCore
        from kontronik_can_gw.native.rows import NotInCore

        try:
            return NativeCore(found, settings, now)
        except NotInCore as error:
            why = str(error)
    return PythonCore(settings, now, why)


def give_back() -> None:
    """Return free memory of the C library to the system.

    Does nothing without the core in C, or if the C library has no such function (musl).
    """
    if library()[0] is None:
        return
    import ctypes

    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def in_words(language: str, why: str | None) -> str:
    """Return a line for people, for example ``core: Python (KONTRONIK_PURE is set)``."""
    return f"core: {language} ({why})" if why else f"core: {language}"
