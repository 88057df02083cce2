"""USB serial adapters that are plugged in, identified by what stays the same when their number changes."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple


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


def adapters(root: Path = Path("/")) -> Iterator[tuple[str, Identity]]:
    """USB adapters that are plugged in: path and identity. The loop waits for this, so it reads no more than is needed."""
    names = []
    with contextlib.suppress(OSError):
        listed = os.listdir(root / "sys/class/tty")  # noqa: PTH208
        names = [name for name in listed if name.startswith(("ttyUSB", "ttyACM"))]
    for name in names:
        with contextlib.suppress(OSError, ValueError):  # one is being unplugged
            folder = Path(os.path.realpath(root / "sys/class/tty" / name / "device"))
            interface = ""
            while not (folder / "idVendor").exists() and folder.name:
                interface = folder.name if ":" in folder.name else interface  # as 1-1.2:1.0
                folder = folder.parent
            if not folder.name:
                continue
            vendor, product = (
                int((folder / file).read_text(), 16) for file in ("idVendor", "idProduct")
            )
            file = folder / "serial"
            serial_number = file.read_text().strip() if file.exists() else ""
            # an adapter with several ports has one serial number for all
            place = interface.partition(":")[2] if serial_number else interface
            yield f"/dev/{name}", Identity(vendor, product, serial_number, place)
