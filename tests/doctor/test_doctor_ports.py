"""What `doctor` says of a serial port, good and bad."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.desk.doctor.findings import Severity
from kontronik_can_gw.desk.doctor.ports import check_port

OK, NOTE, WARNING, ERROR = Severity.OK, Severity.NOTE, Severity.WARNING, Severity.ERROR
BY_ID = "/dev/serial/by-id/usb-FTDI_A1234-port0"


RUN = ("python3", "-m", "kontronik_can_gw", "run")
USB0, AMA0, S0 = "/dev/ttyUSB0", "/dev/ttyAMA0", "/dev/ttyS0"


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


Set = Callable[[Tree], object]


def process(*words: str, opens: Sequence[str] = ()) -> Set:
    return lambda tree: tree.process(78, *words, opens=opens)


def file(name: str, text: str) -> Set:
    return lambda tree: tree.file(name, text)


def ftdi(**how: Any) -> Set:
    return lambda tree: tree.ftdi(**how)


def uart(tty: str, compatible: str = "") -> Set:
    return lambda tree: tree.uart(tty, compatible)


def closed(tree: Tree) -> None:
    tree.closed.add(BY_ID)


def of_root(tree: Tree) -> None:
    tree.device(USB0, (188, 0), 0o600, 0)


def pty(tree: Tree) -> None:
    tree.device("/dev/pts/3", (136, 3), 0o620, 5)


def hidden(tree: Tree) -> None:
    """As with hidepid."""
    tree.path("/proc/1/comm").unlink()


def no_udev(tree: Tree) -> None:
    shutil.rmtree(tree.path("/dev/serial"))


def mm_ignored(tree: Tree) -> None:
    tree.programs["udevadm", "info"] = "ID_BUS=usb\nID_MM_DEVICE_IGNORE=1\n"


MODEM_MANAGER = process("/usr/sbin/ModemManager")
GETTY = process("/sbin/agetty", "115200", "ttyAMA0", "vt220", opens=[AMA0])
CONSOLE = file("/proc/cmdline", "console=tty1 console=ttyAMA0,115200 root=/dev/sda\n")
GATEWAY = process(*RUN, opens=[USB0])
INSTALLED = process("/usr/bin/python3", "/opt/bin/kontronik-can-gw", "run", "--wait", opens=[USB0])
LOCK = file(
    "/proc/locks",
    "1: FLOCK  ADVISORY  WRITE 78 00:06:100 0 EOF\n2: POSIX ADVISORY READ 1 00:06:5 0 EOF\n",
)
MINI_UART = uart("ttyS0", "brcm,bcm2835-aux-uart")


@pytest.mark.parametrize(
    ("given", "port", "name", "severity", "said"),
    [
        ([ftdi()], BY_ID, "port.exists", OK, "ttyUSB0, FT232R USB UART"),
        ([ftdi()], "/dev/ttyUSB7", "port.exists", ERROR, BY_ID),
        ([], USB0, "port.exists", ERROR, "Plug in the adapter"),
        ([], AMA0, "port.exists", ERROR, "enable_uart=1"),
        ([ftdi(), no_udev], USB0, "port.name", WARNING, "systemctl status systemd-udevd"),
        ([file("/dev/notes", "x")], "/dev/notes", "port.exists", ERROR, ""),
        ([pty], "/dev/pts/3", "port.exists", OK, "pseudo terminal"),
        ([uart("ttyAMA0")], AMA0, "port.exists", OK, "ttyAMA0"),
        ([ftdi()], USB0, "port.name", WARNING, f'port = "{BY_ID}"'),
        ([ftdi(serial="")], USB0, "port.name", WARNING, "/dev/serial/by-path/pci-usb-0:1"),
        # who may open it
        ([ftdi(), closed], BY_ID, "port.permission", ERROR, "sudo usermod -aG dialout anna"),
        ([ftdi(), of_root, closed], BY_ID, "port.permission", ERROR, "chmod g+rw"),
        ([ftdi(), of_root, closed, GATEWAY], BY_ID, "port.permission", NOTE, "the gateway that runs"),
        # what else is on it
        ([ftdi(), process("/usr/bin/brltty")], BY_ID, "port.brltty", WARNING, "apt remove brltty"),
        ([uart("ttyAMA0"), GETTY], AMA0, "port.getty", ERROR, "systemctl disable --now serial-getty@ttyAMA0"),
        ([uart("ttyAMA0"), CONSOLE], AMA0, "port.console", ERROR, "Remove console=ttyAMA0"),
        ([ftdi(), MODEM_MANAGER], BY_ID, "port.modem_manager", WARNING, "service install"),
        ([ftdi(), MODEM_MANAGER, mm_ignored], BY_ID, "port.modem_manager", OK, ""),
        ([ftdi(), process("minicom", opens=[USB0])], BY_ID, "port.users", ERROR, "kill 78"),
        ([ftdi(), GATEWAY], BY_ID, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        ([ftdi(), INSTALLED], BY_ID, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        # a lock, which all may see, where nothing else may be seen
        ([ftdi(), process(*RUN), LOCK], BY_ID, "port.users", NOTE, "in use by kontronik-can-gw (pid 78)"),
        ([ftdi(), hidden], BY_ID, "port.users", NOTE, "only root can see all"),
        # the line itself
        ([MINI_UART], S0, "port.parity", ERROR, "dtoverlay=disable-bt"),
    ],
)  # fmt: skip
def test_what_is_found_is_reported(
    tree: Tree, given: list[Set], port: str, name: str, severity: Severity, said: str
) -> None:
    for each in given:
        each(tree)
    found = only(check_port(tree, "esc1", port, even_parity=True), name)
    assert found.severity is severity
    assert said in f"{found.text} {found.remedy} {found.command}"


@pytest.mark.parametrize(
    ("given", "port"),
    [
        ([ftdi()], BY_ID),
        ([uart("ttyAMA0")], AMA0),
        ([ftdi(), process("/sbin/agetty", "115200", "ttyUSB01", "vt220")], BY_ID),
        ([ftdi(), file("/proc/cmdline", "console=ttyUSB01 console=tty1 quiet\n")], BY_ID),
    ],
)
def test_a_good_port_has_nothing_but_ok(tree: Tree, given: list[Set], port: str) -> None:
    for each in given:
        each(tree)
    findings = check_port(tree, "esc1", port, even_parity=True)
    assert grave(findings) == {}
    assert {finding.group for finding in findings} == {"Serial port of esc1"}
