"""Findings of `doctor` at serial ports, good and bad."""

import shutil
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.desk.doctor.ports import check_port

pytestmark = pytest.mark.promise("doctor")

OK = "ok"
NOTE = "note"
WARNING = "warning"
ERROR = "error"
BY_ID = "/dev/serial/by-id/usb-FTDI_A1234-port0"


RUN = ("python3", "-m", "kontronik_can_gw", "run")
USB0 = "/dev/ttyUSB0"
AMA0 = "/dev/ttyAMA0"
S0 = "/dev/ttyS0"


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


Set = Callable[[Tree], object]


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


FTDI = methodcaller("ftdi")
UART = methodcaller("uart", "ttyAMA0")
MINI_UART = methodcaller("uart", "ttyS0", "brcm,bcm2835-aux-uart")
MODEM_MANAGER = methodcaller("process", 78, "/usr/sbin/ModemManager")
GETTY = methodcaller("process", 78, "/sbin/agetty", "115200", "ttyAMA0", "vt220", opens=[AMA0])
CONSOLE = methodcaller("file", "/sys/class/tty/console/active", "tty0 ttyAMA0\n")
RULES = methodcaller("file", "/usr/lib/udev/rules.d/70-kontronik-can-gw.rules", "")
BRLTTY = methodcaller("process", 78, "/usr/bin/brltty")
MINICOM = methodcaller("process", 78, "minicom", opens=[USB0])
GATEWAY = methodcaller("process", 78, *RUN, opens=[USB0])
INSTALLED = methodcaller(
    "process",
    78,
    "/usr/bin/python3",
    "/opt/bin/kontronik-can-gw",
    "run",
    "--wait",
    opens=[USB0],
)


@pytest.mark.parametrize(
    ("given", "port", "name", "severity", "said"),
    [
        ([FTDI], BY_ID, "port.exists", OK, "ttyUSB0, FT232R USB UART"),
        ([FTDI], "/dev/ttyUSB7", "port.exists", ERROR, "usb-FTDI_A1234-port0"),
        ([], USB0, "port.exists", ERROR, "Plug in the adapter"),
        ([], AMA0, "port.exists", ERROR, "enable_uart=1"),
        ([FTDI, no_udev], USB0, "port.name", WARNING, "systemctl status systemd-udevd"),
        ([methodcaller("file", "/dev/notes", "x")], "/dev/notes", "port.exists", ERROR, ""),
        ([pty], "/dev/pts/3", "port.exists", OK, "pseudo terminal"),
        ([UART], AMA0, "port.exists", OK, "ttyAMA0"),
        ([FTDI], USB0, "port.name", WARNING, f'port = "{BY_ID}"'),
        ([methodcaller("ftdi", "")], USB0, "port.name", WARNING, "/dev/serial/by-path/pci-usb-0:1"),
        # permissions
        ([FTDI, closed], BY_ID, "port.permission", ERROR, "sudo usermod -aG dialout anna"),
        ([FTDI, of_root, closed], BY_ID, "port.permission", ERROR, "chmod g+rw"),
        ([FTDI, of_root, closed, GATEWAY], BY_ID, "port.permission", NOTE,
         "perhaps the running gateway may"),
        # other programs that use the port
        ([FTDI, BRLTTY], BY_ID, "port.brltty", WARNING, "apt remove brltty"),
        ([UART, GETTY], AMA0, "port.getty", ERROR, "systemctl disable --now serial-getty@ttyAMA0"),
        ([UART, CONSOLE], AMA0, "port.console", ERROR, "Remove console=ttyAMA0"),
        ([FTDI, MODEM_MANAGER], BY_ID, "port.modem_manager", WARNING, "service install"),
        ([FTDI, MINICOM], BY_ID, "port.users", ERROR, "kill 78"),
        ([FTDI, GATEWAY], BY_ID, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        ([FTDI, INSTALLED], BY_ID, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        ([FTDI], BY_ID, "port.users", NOTE, "only root can see all"),
        # settings of the line
        ([MINI_UART], S0, "port.parity", ERROR, "dtoverlay=disable-bt"),
    ],
)  # fmt: skip
def test_findings_at_a_port_are_reported(
    tree: Tree,
    given: list[Set],
    port: str,
    name: str,
    severity: str,
    said: str,
) -> None:
    for each in given:
        each(tree)
    found = only(check_port(tree, "esc1", port, even_parity=True), name)
    assert found.severity == severity
    assert said in f"{found.text} {found.remedy} {found.command}"


@pytest.mark.parametrize(
    ("given", "port"),
    [
        ([FTDI, MODEM_MANAGER, RULES], BY_ID),
        ([UART], AMA0),
        ([FTDI, methodcaller("process", 78, "/sbin/agetty", "115200", "ttyUSB01", "vt220")], BY_ID),
        ([FTDI, methodcaller("file", "/sys/class/tty/console/active", "ttyUSB01 tty0\n")], BY_ID),
    ],
)
def test_good_port_has_only_results_that_are_ok(tree: Tree, given: list[Set], port: str) -> None:
    for each in (*given, root):
        each(tree)
    findings = check_port(tree, "esc1", port, even_parity=True)
    assert grave(findings) == {}
    assert {finding.group for finding in findings} == {"Serial port of esc1"}
