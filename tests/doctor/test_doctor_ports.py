"""What `doctor` says of a serial port, good and bad. A port that is in use, or must not be touched, is never opened."""

import errno
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.desk.doctor.findings import Finding, Severity
from kontronik_can_gw.desk.doctor.ports import check_port
from kontronik_can_gw.desk.doctor.service import unit_of

OK, NOTE, WARNING, ERROR = Severity.OK, Severity.NOTE, Severity.WARNING, Severity.ERROR
BY_ID = "/dev/serial/by-id/usb-FTDI_A1234-port0"
GOOD = ("ok", {"framing": 0})
Line = tuple[str, dict[str, int]]
CONFIG = "/etc/kontronik-can-gw/gateway.toml"
RUN = ("python3", "-m", "kontronik_can_gw", "run")
USB0, AMA0, S0 = "/dev/ttyUSB0", "/dev/ttyAMA0", "/dev/ttyS0"


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


class Looked:
    """Stands for the port itself, and notes that it was opened."""

    def __init__(self, line: Line = GOOD) -> None:
        self.line = line
        self.calls: list[tuple[str, bool]] = []

    def __call__(self, path: str, alone: bool) -> Line:
        self.calls.append((path, alone))
        return self.line


def check(tree: Tree, port: str = BY_ID, look: Looked | None = None) -> list[Finding]:
    return check_port(tree, "esc1", port, unit_of(tree, CONFIG), look or Looked())


Set = Callable[[Tree], object]


def process(*words: str, opens: Sequence[str] = ()) -> Set:
    return lambda tree: tree.process(78, *words, opens=opens)


def file(name: str, text: str) -> Set:
    return lambda tree: tree.file(name, text)


def ftdi(**how: Any) -> Set:
    return lambda tree: tree.ftdi(**how)


def uart(tty: str, driver: str = "uart-pl011", compatible: str = "") -> Set:
    return lambda tree: tree.uart(tty, driver, compatible)


def systemd(**shown: str) -> Set:
    return lambda tree: tree.systemd(**shown)


def allows(*kinds: str) -> Set:
    return systemd(
        DevicePolicy="closed", DeviceAllow="\nDeviceAllow=".join(f"{kind} rw" for kind in kinds)
    )


def closed(tree: Tree) -> None:
    tree.closed.add(BY_ID)


def of_root(tree: Tree) -> None:
    tree.device(USB0, (188, 0), 0o600, 0)


def pty(tree: Tree) -> None:
    tree.device("/dev/pts/3", (136, 3), 0o620, 5)


def no_udev(tree: Tree) -> None:
    shutil.rmtree(tree.path("/dev/serial"))


def mm_ignored(tree: Tree) -> None:
    tree.programs["udevadm", "info"] = "ID_BUS=usb\nID_MM_DEVICE_IGNORE=1\n"


DEVICES = file(
    "/proc/devices", "Character devices:\n  4 ttyS\n188 ttyUSB\n\nBlock devices:\n188 other\n"
)
MODEM_MANAGER = process("/usr/sbin/ModemManager")
GETTY = process("/sbin/agetty", "115200", "ttyAMA0", "vt220", opens=[AMA0])
CONSOLE = file("/proc/cmdline", "console=tty1 console=ttyAMA0,115200 root=/dev/sda\n")
GATEWAY = process(*RUN, opens=[USB0])
INSTALLED = process("/usr/bin/python3", "/opt/bin/kontronik-can-gw", "run", "--wait", opens=[USB0])
MINI_UART = uart("ttyS0", "serial8250", "brcm,bcm2835-aux-uart")


@pytest.mark.parametrize(
    ("given", "port", "opened", "name", "severity", "said"),
    [
        ([ftdi()], BY_ID, True, "port.exists", OK, "ttyUSB0, FT232R USB UART"),
        ([ftdi()], "/dev/ttyUSB7", False, "port.exists", ERROR, BY_ID),
        ([], USB0, False, "port.exists", ERROR, "Plug in the adapter"),
        ([], AMA0, False, "port.exists", ERROR, "enable_uart=1"),
        ([ftdi(), no_udev], USB0, True, "port.name", WARNING, "systemctl status systemd-udevd"),
        ([file("/dev/notes", "x")], "/dev/notes", False, "port.exists", ERROR, ""),
        ([pty], "/dev/pts/3", False, "port.exists", OK, "pseudo terminal"),
        ([uart("ttyAMA0")], AMA0, True, "port.exists", OK, "ttyAMA0"),
        ([ftdi()], USB0, True, "port.name", WARNING, f'port = "{BY_ID}"'),
        ([ftdi(serial="")], USB0, True, "port.name", WARNING, "/dev/serial/by-path/pci-usb-0:1"),
        # who may open it
        ([ftdi(), closed], BY_ID, False, "port.permission", ERROR, "sudo usermod -aG dialout anna"),
        ([ftdi(), of_root, closed], BY_ID, False, "port.permission", ERROR, "chmod g+rw"),
        (
            [ftdi(), DEVICES, allows("char-ttyS", "char-ttyACM")],
            BY_ID, True, "port.device_kind", ERROR, "DeviceAllow=char-ttyUSB rw",
        ),
        (
            [ftdi(), systemd(SupplementaryGroups="")],
            BY_ID, True, "port.permission", ERROR, "usermod -aG dialout kontronik-can-gw",
        ),
        ([ftdi(), of_root, systemd()], BY_ID, True, "port.permission", ERROR, "chmod g+rw"),
        ([ftdi(), of_root, closed, GATEWAY], BY_ID, False, "port.permission", NOTE, "the gateway that runs"),
        # what else is on it
        ([ftdi(), process("/usr/bin/brltty")], BY_ID, True, "port.brltty", WARNING, "apt remove brltty"),
        ([uart("ttyAMA0"), GETTY], AMA0, False, "port.getty", ERROR, "systemctl disable --now serial-getty@ttyAMA0"),
        ([uart("ttyAMA0"), CONSOLE], AMA0, False, "port.console", ERROR, "Remove console=ttyAMA0"),
        ([ftdi(), MODEM_MANAGER], BY_ID, True, "port.modem_manager", WARNING, "service install"),
        ([ftdi(), MODEM_MANAGER, mm_ignored], BY_ID, True, "port.modem_manager", OK, ""),
        ([ftdi(), process("minicom", opens=[USB0])], BY_ID, False, "port.users", ERROR, "kill 78"),
        ([ftdi(), GATEWAY], BY_ID, False, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        ([ftdi(), INSTALLED], BY_ID, False, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        # the line itself
        ([MINI_UART], S0, False, "port.parity", ERROR, "dtoverlay=disable-bt"),
    ],
)  # fmt: skip
def test_what_is_found_is_reported_and_the_port_is_opened_only_where_nobody_else_needs_it(
    tree: Tree, given: list[Set], port: str, opened: bool, name: str, severity: Severity, said: str
) -> None:
    for each in given:
        each(tree)
    look = Looked()
    found = only(check(tree, port, look), name)
    assert found.severity is severity
    assert said in f"{found.text} {found.remedy} {found.command}"
    assert look.calls == ([(str(tree.path(port)), True)] if opened else [])


@pytest.mark.parametrize(
    ("given", "port"),
    [
        ([ftdi()], BY_ID),
        ([uart("ttyAMA0")], AMA0),
        ([ftdi(), process("/sbin/agetty", "115200", "ttyUSB01", "vt220")], BY_ID),
        ([ftdi(), file("/proc/cmdline", "console=ttyUSB01 console=tty1 quiet\n")], BY_ID),
        ([ftdi(), DEVICES, allows("char-ttyUSB", "char-ttyS")], BY_ID),
    ],
)
def test_a_good_port_has_nothing_but_ok(tree: Tree, given: list[Set], port: str) -> None:
    for each in given:
        each(tree)
    findings = check(tree, port)
    assert grave(findings) == {}
    assert {finding.group for finding in findings} == {"Serial port of esc1"}


def test_a_port_that_only_the_running_gateway_may_open_is_no_error(tree: Tree) -> None:
    tree.ftdi()
    pty(tree)
    tree.closed |= {BY_ID, "/dev/pts/3"}
    assert grave(check(tree, "/dev/pts/3")) == {"port.permission": ERROR}
    tree.process(78, *RUN, opens=[USB0, "/dev/pts/3"])
    fresh = Tree(tree.root)
    fresh.devices, fresh.closed = tree.devices, tree.closed
    assert ERROR not in grave(check(fresh)).values()
    assert grave(check(fresh, "/dev/pts/3")) == {"port.users": NOTE, "port.permission": NOTE}


@pytest.mark.parametrize(
    ("line", "name", "severity", "word"),
    [
        (("none", {}), "port.parity", ERROR, "does not take"),
        (("set_up", {}), "port.parity", NOTE, "not tried"),
        (("exclusive", {}), "port.parity", NOTE, "for himself"),
        ((os.strerror(errno.EIO), {}), "port.parity", ERROR, "Input/output error"),
        (
            ("ok", {"framing": 3, "parity": 12, "break": 0}),
            *("port.line_errors", NOTE, "3 framing, 12 parity"),
        ),
    ],
)
def test_what_the_port_itself_answers_is_reported(
    tree: Tree, line: Line, name: str, severity: Severity, word: str
) -> None:
    tree.ftdi()
    found = only(check(tree, look=Looked(line)), name)
    assert found.severity is severity
    assert word in found.text


def test_a_lock_shows_who_has_the_port_where_nothing_else_may_be_seen(tree: Tree) -> None:
    tree.ftdi()
    tree.process(80, *RUN)
    inode = tree.devices[USB0].st_ino
    locks = f"1: FLOCK  ADVISORY  WRITE 80 00:06:{inode} 0 EOF\n2: POSIX ADVISORY READ 1 00:06:5 0 EOF\n"
    tree.file("/proc/locks", locks)
    look = Looked()
    assert only(check(tree, look=look), "port.users").text == "in use by kontronik-can-gw (pid 80)"
    assert look.calls == []


def test_where_not_all_programs_can_be_seen_it_is_said_and_the_port_is_not_thought_free(
    tree: Tree,
) -> None:
    tree.ftdi()
    tree.path("/proc/1/comm").unlink()  # as with hidepid
    look = Looked()
    assert only(check(tree, look=look), "port.users").severity is NOTE
    assert look.calls == [(str(tree.path(BY_ID)), False)]
