"""Which core runs: the one in C where its shared object is there and can express the layout, else the one in Python."""

import os
from collections.abc import Sequence
from functools import cache
from typing import Any

from kontronik_can_gw.core import Core, OnEvent, PythonCore
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.native.binding import WrongObject, load
from kontronik_can_gw.native.compile import shared_object
from kontronik_can_gw.native.core import NativeCore
from kontronik_can_gw.native.tables import NotInCore
from kontronik_can_gw.signals.plan import Layout

PURE = "KONTRONIK_PURE"
"""Environment variable: 1 for the core in Python in any case."""


@cache
def library() -> tuple[Any, str]:
    """The shared object, None where it is not to be used, and why."""
    if os.environ.get(PURE, "0") not in ("", "0"):
        return None, f"{PURE} is set"
    path = shared_object()
    if not path.exists():
        return None, "there was no C compiler at the installation"
    try:
        return load(path), ""
    except WrongObject as error:
        return None, str(error)


def make_core(
    escs: Sequence[EscSettings],
    layout: Layout,
    now: int,
    silent: bool,
    on_event: OnEvent,
) -> tuple[Core, str]:
    """The core for a layout; and why it is the one in Python, empty where it is not."""
    found, why = library()
    if found is not None:
        try:
            return NativeCore(found, escs, layout, now, silent, on_event), ""
        except NotInCore as error:
            why = str(error)
    return PythonCore(escs, layout, now, silent, on_event), why
