"""Identifies the hardware of a serial port: driver, USB adapter, device tree, stable names. Reads only /sys and /dev/serial."""

from collections.abc import Iterator
from dataclasses import dataclass

from kontronik_can_gw.desk.doctor.system import System

_BUS_DRIVERS = ("port", "ctrl", "usb", "")
"""Drivers of the serial core, which newer kernels insert between tty and UART."""
_OF_USB = ("product", "serial")


@dataclass(frozen=True)
class Adapter:
    """The hardware of a tty. ``usb`` is the folder of the USB device in /sys, empty for others."""

    driver: str = ""
    usb: str = ""
    product: str = ""
    serial: str = ""
    vendor_id: str = ""

    def __str__(self) -> str:
        words = [self.product, f"driver {self.driver}" if self.driver else ""]
        if self.usb:
            words.append(
                f"serial number {self.serial}" if self.serial else "without a serial number"
            )
        return ", ".join(word for word in words if word)


def adapter_of(system: System, tty: str) -> Adapter:
    """The hardware of a tty given by name, as ttyUSB0."""
    driver = ""
    for folder in _ancestors(system, f"/sys/class/tty/{tty}/device"):
        if not driver and system.exists(f"{folder}/driver"):
            name = system.real(f"{folder}/driver").rpartition("/")[2]
            driver = "" if name in _BUS_DRIVERS else name
        if (vendor_id := system.text(f"{folder}/idVendor")) is not None:
            product, serial = (system.text(f"{folder}/{name}") or "" for name in _OF_USB)
            return Adapter(driver, folder, product, serial, vendor_id)
    return Adapter(driver)


def _ancestors(system: System, folder: str) -> Iterator[str]:
    """A device's folder in /sys and those of its parents."""
    if not system.exists(folder):
        return
    at = system.real(folder)
    while at.count("/") > 2:
        yield at
        at = at.rpartition("/")[0]


def stable_names(system: System, port: str) -> list[str]:
    """Stable names of a port: by the adapter's serial number if it has one, else by the USB socket."""
    real = system.real(port)
    tty = real.rpartition("/")[2]
    kinds = ("by-id", "by-path") if adapter_of(system, tty).serial else ("by-path", "by-id")
    found = []
    for kind in kinds:
        folder = f"/dev/serial/{kind}"
        found += [
            f"{folder}/{name}"
            for name in system.names(folder)
            if system.real(f"{folder}/{name}") == real
        ]
    return found


def ports_there(system: System) -> list[str]:
    """Serial ports usable for an ESC, by their most stable names."""
    found = []
    for tty in system.names("/sys/class/tty"):
        if system.exists(f"/sys/class/tty/{tty}/device") and system.exists(f"/dev/{tty}"):
            # Linux creates ttyS0..3 even without hardware; then the type is 0
            if system.text(f"/sys/class/tty/{tty}/type") == "0":
                continue
            found.append(next(iter(stable_names(system, f"/dev/{tty}")), f"/dev/{tty}"))
    return found
