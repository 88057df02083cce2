"""Finds USB serial adapters by properties that stay the same when their device number changes."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from serial.tools.list_ports_linux import SysFS


class UsbIdentity(NamedTuple):
    """The properties that identify a USB adapter under any device number."""

    vendor: int
    product: int
    serial: str
    place: str
    """The interface of the adapter, or its whole USB location if it has no serial number."""


def identity_at(path: str) -> UsbIdentity | None:
    """Return the identity of the USB adapter to which a path leads now, or None."""
    real = os.path.realpath(path.partition("@")[0])
    for device, identity in adapters():
        if os.path.realpath(device) == real:
            return identity
    return None


def find_adapter(identity: UsbIdentity) -> str | None:
    """Return the present path of an adapter, for example /dev/ttyUSB1.

    None if it is not plugged in, or if two adapters have this identity.
    """
    found = [device for device, other in adapters() if other == identity]
    return found[0] if len(found) == 1 else None


def adapters() -> Iterator[tuple[str, UsbIdentity]]:
    """Yield path and identity of each USB serial adapter that is plugged in.

    The loop waits for this function, so other kinds of ports are not queried.
    """
    for kind in ("USB", "ACM"):
        for path in sorted(Path("/dev").glob(f"tty{kind}*")):
            with contextlib.suppress(OSError, ValueError, TypeError):  # it is being unplugged
                found = SysFS(str(path))
                if found.vid is None or found.pid is None:
                    continue
                serial_number = found.serial_number or ""
                place = found.location or ""
                if serial_number:
                    # An adapter with several ports has one serial number for all of them.
                    place = place.partition(":")[2]
                yield str(path), UsbIdentity(found.vid, found.pid, serial_number, place)
