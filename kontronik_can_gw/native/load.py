"""Which core runs: the one in C where its shared object is there and can express the layout, else the one in Python."""

import os
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

from kontronik_can_gw.core import Core, PythonCore
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.compile import shared_object as shared_object
from kontronik_can_gw.signals.plan import Layout

PURE = "KONTRONIK_PURE"
"""Environment variable: 1 for the core in Python in any case."""


class Made(NamedTuple):
    """A core, and in words why it is not the one in C; empty where it is."""

    core: Core
    why: str


@cache
def library() -> tuple[Any, str]:
    """The shared object, None where it is not to be used, and why."""
    if os.environ.get(PURE, "0") not in ("", "0"):
        return None, f"{PURE} is set"
    path = shared_object()
    if not path.exists():
        return None, f"no {path.name}: there was no C compiler at the installation"
    try:
        # where memory must not be executed, ctypes itself may not load
        from kontronik_can_gw.native.binding import WrongObject, load
    except (ImportError, MemoryError, OSError) as error:
        return None, f"ctypes cannot be used here: {error}"
    try:
        return load(path), ""
    except WrongObject as error:
        return None, str(error)


def make_core(
    escs: Sequence[EscSettings],
    layout: Layout,
    now: int,
    silent: bool,
) -> Made:
    """The core for these ESCs and this layout."""
    found, why = library()
    if found is not None:
        from kontronik_can_gw.native.core import NativeCore
        from kontronik_can_gw.native.tables import NotInCore

        try:
            return Made(NativeCore(found, escs, layout, now, silent), "")
        except NotInCore as error:
            why = str(error)
    return Made(PythonCore(escs, layout, now, silent), why)
