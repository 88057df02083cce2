"""What `doctor` says of a serial port, good and bad."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.desk.doctor.ports import check_port

OK, NOTE, WARNING, ERROR = "ok", "note", "warning", "error"
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


def root(tree: Tree) -> None:
    tree.user = "root"


def no_udev(tree: Tree) -> None:
    shutil.rmtree(tree.path("/dev/serial"))


MODEM_MANAGER = process("/usr/sbin/ModemManager")
GETTY = process("/sbin/agetty", "115200", "ttyAMA0", "vt220", opens=[AMA0])
CONSOLE = file("/sys/class/tty/console/active", "tty0 ttyAMA0\n")
RULES = file("/usr/lib/udev/rules.d/70-kontronik-can-gw.rules", "")
GATEWAY = process(*RUN, opens=[USB0])
INSTALLED = process("/usr/bin/python3", "/opt/bin/kontronik-can-gw", "run", "--wait", opens=[USB0])
MINI_UART = uart("ttyS0", "brcm,bcm2835-aux-uart")


@pytest.mark.parametrize(
    ("given", "port", "name", "severity", "said"),
    [
        ([ftdi()], BY_ID, "port.exists", OK, "ttyUSB0, FT232R USB UART"),
        ([ftdi()], "/dev/ttyUSB7", "port.exists", ERROR, "usb-FTDI_A1234-port0"),
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
        ([ftdi(), of_root, closed, GATEWAY], BY_ID, "port.permission", NOTE, "perhaps the gateway that runs may"),
        # what else is on it
        ([ftdi(), process("/usr/bin/brltty")], BY_ID, "port.brltty", WARNING, "apt remove brltty"),
        ([uart("ttyAMA0"), GETTY], AMA0, "port.getty", ERROR, "systemctl disable --now serial-getty@ttyAMA0"),
        ([uart("ttyAMA0"), CONSOLE], AMA0, "port.console", ERROR, "Remove console=ttyAMA0"),
        ([ftdi(), MODEM_MANAGER], BY_ID, "port.modem_manager", WARNING, "service install"),
        ([ftdi(), process("minicom", opens=[USB0])], BY_ID, "port.users", ERROR, "kill 78"),
        ([ftdi(), GATEWAY], BY_ID, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        ([ftdi(), INSTALLED], BY_ID, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        ([ftdi()], BY_ID, "port.users", NOTE, "only root can see all"),
        # the line itself
        ([MINI_UART], S0, "port.parity", ERROR, "dtoverlay=disable-bt"),
    ],
)  # fmt: skip
def test_what_is_found_is_reported(
    tree: Tree, given: list[Set], port: str, name: str, severity: str, said: str
) -> None:
    for each in given:
        each(tree)
    found = only(check_port(tree, "esc1", port, even_parity=True), name)
    assert found.severity == severity
    assert said in f"{found.text} {found.remedy} {found.command}"


@pytest.mark.parametrize(
    ("given", "port"),
    [
        ([ftdi(), MODEM_MANAGER, RULES], BY_ID),
        ([uart("ttyAMA0")], AMA0),
        ([ftdi(), process("/sbin/agetty", "115200", "ttyUSB01", "vt220")], BY_ID),
        ([ftdi(), file("/sys/class/tty/console/active", "ttyUSB01 tty0\n")], BY_ID),
    ],
)
def test_a_good_port_has_nothing_but_ok(tree: Tree, given: list[Set], port: str) -> None:
    for each in (*given, root):
        each(tree)
    findings = check_port(tree, "esc1", port, even_parity=True)
    assert grave(findings) == {}
    assert {finding.group for finding in findings} == {"Serial port of esc1"}
