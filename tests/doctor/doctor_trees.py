"""A machine made of files in a folder, for the checks of `doctor`.

It has /sys, /proc, /dev and the output of programs.
"""

import os
import stat
from collections.abc import Sequence
from pathlib import Path

from kontronik_can_gw.desk.doctor import Finding
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.runtime.system.clock import ClockFacts

DIALOUT = 20
ROOM = (False, 1 << 30)


class Tree(Machine):
    """A machine below a folder. It contains only the things that a test adds."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.user = "anna"
        self.programs: dict[tuple[str, ...], str] = {}
        self.devices: dict[str, os.stat_result] = {}
        self.full: dict[str, tuple[bool, int]] = {}
        self.wall_clock = ClockFacts(synchronized=True, hardware="rtc-ds3231")
        self.closed: set[str] = set()
        """Files and folders that this user may not open or write to."""
        root.chmod(0o755)  # only the owner may enter the folder that pytest creates
        self.folder("/dev")

    # --- building the tree

    def folder(self, name: str, mode: int = 0o755) -> None:
        """Create a folder with this mode, for any umask.

        Missing folders above it are created too, and every user may enter them.
        """
        path = self.path(name)
        if not path.parent.exists():
            self.folder(os.path.dirname(name))
        path.mkdir(exist_ok=True)
        path.chmod(mode)

    def file(self, name: str, text: str) -> None:
        if not self.path(name).parent.exists():
            self.folder(os.path.dirname(name))
        self.path(name).write_text(text)
        self.path(name).chmod(0o644)

    def link(self, name: str, target: str) -> None:
        """Create a symbolic link to an absolute name of this machine."""
        if not self.path(name).parent.exists():
            self.folder(os.path.dirname(name))
        self.path(name).symlink_to(self.path(target))

    def device(
        self,
        name: str,
        number: tuple[int, int],
        mode: int = 0o660,
        group: int = DIALOUT,
    ) -> None:
        """Create a character device whose owner is root."""
        self.file(name, "")
        values = (stat.S_IFCHR | mode, 0, 0, 1, 0, group, 0, 0, 0, 0)
        self.devices[name] = os.stat_result(values, {"st_rdev": os.makedev(*number)})

    def process(
        self,
        pid: int,
        *words: str,
        opens: Sequence[str] = (),
    ) -> None:
        _, _, program = words[0].rpartition("/")
        self.file(f"/proc/{pid}/comm", program[:15] + "\n")
        self.file(f"/proc/{pid}/cmdline", "\0".join(words) + "\0")
        self.folder(f"/proc/{pid}/fd")
        for number, name in enumerate(opens, 3):
            self.link(f"/proc/{pid}/fd/{number}", name)

    def ftdi(self, serial: str = "A1234") -> None:
        """Add an FTDI adapter with its device node and the names made by udev."""
        usb = "/sys/devices/pci0/usb1/1-1"
        port = f"{usb}/1-1:1.0/ttyUSB0"
        self.file(f"{usb}/idVendor", "0403\n")
        self.file(f"{usb}/product", "FT232R USB UART\n")
        if serial:
            self.file(f"{usb}/serial", f"{serial}\n")
        self.folder(f"{port}/tty/ttyUSB0")
        self.link("/sys/class/tty/ttyUSB0", f"{port}/tty/ttyUSB0")
        self.link(f"{port}/tty/ttyUSB0/device", port)
        self.device("/dev/ttyUSB0", (188, 0))
        self.link(f"/dev/serial/by-id/usb-FTDI_{serial or 'none'}-port0", "/dev/ttyUSB0")
        self.link("/dev/serial/by-path/pci-usb-0:1", "/dev/ttyUSB0")

    def uart(self, tty: str, compatible: str = "") -> None:
        """Add a UART of the board as shown by kernels since 6.6.

        Two devices of the serial core are between the UART and the tty.
        """
        board = f"/sys/devices/platform/soc/{tty}.serial"
        core = f"{board}/{tty}:0/{tty}:0.0"
        self.folder(f"{core}/tty/{tty}")
        if compatible:
            self.file(f"{board}/of_node/compatible", compatible + "\0")
        self.link(f"/sys/class/tty/{tty}", f"{core}/tty/{tty}")
        self.link(f"{core}/tty/{tty}/device", core)
        self.device(f"/dev/{tty}", (4, 64))

    def systemd(self, **shown: str) -> None:
        """Add systemd with our unit, which shows these properties in addition to the usual ones."""
        usual = {
            "LoadState": "loaded",
            "ActiveState": "active",
            "SubState": "running",
            "UnitFileState": "enabled",
            "NRestarts": "0",
            "Result": "success",
            "User": "anna",
        }
        properties = {**usual, **shown}
        text = "".join(f"{name}={value}\n" for name, value in properties.items())
        self.programs["systemctl", "show"] = text
        self.folder("/run/systemd/system")

    # --- the interface that the checks use

    def group_name(self, gid: int) -> str:
        return {0: "root", DIALOUT: "dialout"}.get(gid, str(gid))

    def status(self, name: str) -> os.stat_result | None:
        return self.devices.get(self.real(name)) or super().status(name)

    def clock(self) -> ClockFacts:
        return self.wall_clock

    def run(self, *command: str) -> str:
        """Return the output stored for the longest beginning of this command, or ""."""
        for length in range(len(command), 0, -1):
            beginning = command[:length]
            if beginning in self.programs:
                return self.programs[beginning]
        return ""

    def space(self, folder: str) -> tuple[bool, int]:
        return self.full.get(folder, ROOM)

    def may(self, name: str, mode: int) -> bool:
        return name not in self.closed


def only(findings: Sequence[Finding], check: str) -> Finding:
    """Return the single finding of a check."""
    found = [finding for finding in findings if finding.check == check]
    assert len(found) == 1, f"{check}: {found}"
    return found[0]


def grave(findings: Sequence[Finding]) -> dict[str, str]:
    """Return the severities of all findings that are not ok, by check."""
    found = [finding for finding in findings if finding.severity != "ok"]
    return {finding.check: finding.severity for finding in found}
