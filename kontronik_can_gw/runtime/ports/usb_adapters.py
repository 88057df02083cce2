"""USB serial adapters that are plugged in, identified by what stays the same when their number changes."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from serial.tools.list_ports_linux import SysFS


class Identity(NamedTuple):
    """What identifies a USB adapter, whatever its number is: vendor, product, serial number, or place where it has none."""

    vendor: int
    product: int
    serial: str
    place: str


def identity_at(path: str) -> Identity | None:
    """Of the USB adapter that a path leads to now."""
    real = os.path.realpath(path.partition("@")[0])
    return next((found for device, found in adapters() if os.path.realpath(device) == real), None)


def find_adapter(identity: Identity) -> str | None:
    """The path of the adapter now, as /dev/ttyUSB1; None while it is not plugged in, or if two are alike."""
    found = [device for device, other in adapters() if other == identity]
    return found[0] if len(found) == 1 else None


def adapters() -> Iterator[tuple[str, Identity]]:
    """USB adapters that are plugged in: path and identity. The loop waits for this, so ports of other kinds are not asked."""
    for kind in ("USB", "ACM"):
        for path in sorted(Path("/dev").glob(f"tty{kind}*")):
            with contextlib.suppress(OSError, ValueError, TypeError):  # one is being unplugged
                found = SysFS(str(path))
                if found.vid is not None and found.pid is not None:
                    serial_number, place = found.serial_number or "", found.location or ""
                    # an adapter with several ports has one serial number for all
                    place = place.partition(":")[2] if serial_number else place
                    yield str(path), Identity(found.vid, found.pid, serial_number, place)
