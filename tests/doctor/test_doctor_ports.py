"""What `doctor` says of a serial port, good and bad. A port that is in use, or must not be touched, is never opened."""

import errno
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.desk.doctor.findings import Finding, Severity
from kontronik_can_gw.desk.doctor.line import Line
from kontronik_can_gw.desk.doctor.serial_ports import check_port
from kontronik_can_gw.desk.doctor.service import unit_of

OK, NOTE, WARNING, ERROR = Severity.OK, Severity.NOTE, Severity.WARNING, Severity.ERROR
BY_ID = "/dev/serial/by-id/usb-FTDI_A1234-port0"
GOOD = Line(even_parity=True, counts=True)
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


def all_of(*steps: Set) -> Set:
    def do(tree: Tree) -> None:
        for step in steps:
            step(tree)

    return do


def ftdi(tree: Tree) -> None:
    tree.ftdi()


def process(*words: str, opens: Sequence[str] = ()) -> Set:
    return lambda tree: tree.process(78, *words, opens=opens)


def closed(name: str) -> Set:
    return lambda tree: tree.closed.add(name)


def device(name: str, number: tuple[int, int], mode: int, group: int) -> Set:
    return lambda tree: tree.device(name, number, mode, group)


def file(name: str, text: str) -> Set:
    return lambda tree: tree.file(name, text)


def prints(text: str, *command: str) -> Set:
    return lambda tree: tree.programs.update({command: text})


def systemd(**shown: str) -> Set:
    return lambda tree: tree.systemd(**shown)


def uart(tty: str, driver: str = "uart-pl011", compatible: str = "") -> Set:
    return lambda tree: tree.uart(tty, driver, compatible)


DEVICES = file(
    "/proc/devices", "Character devices:\n  4 ttyS\n188 ttyUSB\n\nBlock devices:\n188 other\n"
)


@pytest.mark.parametrize(
    ("given", "port", "opened", "name", "severity", "said"),
    [
        (
            ftdi,
            BY_ID,
            True,
            "port.exists",
            OK,
            "FT232R USB UART, driver ftdi_sio, serial number A1234",
        ),
        (ftdi, "/dev/ttyUSB7", False, "port.exists", ERROR, BY_ID),
        (all_of(), USB0, False, "port.exists", ERROR, "Plug in the adapter"),
        (all_of(), AMA0, False, "port.exists", ERROR, "enable_uart=1"),
        (
            all_of(ftdi, lambda t: shutil.rmtree(t.path("/dev/serial"))),
            *(USB0, True, "port.name", WARNING, "systemctl status systemd-udevd"),
        ),
        (file("/dev/notes", "x"), "/dev/notes", False, "port.exists", ERROR, ""),
        (
            device("/dev/pts/3", (136, 3), 0o620, 5),
            "/dev/pts/3",
            False,
            "port.exists",
            OK,
            "pseudo terminal",
        ),
        (uart("ttyAMA0"), AMA0, True, "port.exists", OK, "driver uart-pl011"),
        (ftdi, USB0, True, "port.name", WARNING, f'port = "{BY_ID}"'),
        (
            lambda t: t.ftdi(serial=""),
            USB0,
            True,
            "port.name",
            WARNING,
            "/dev/serial/by-path/pci-usb-0:1",
        ),
        # who may open it
        (
            all_of(ftdi, closed(BY_ID)),
            BY_ID,
            False,
            "port.permission",
            ERROR,
            "sudo usermod -aG dialout anna",
        ),
        (
            all_of(ftdi, device(USB0, (188, 0), 0o600, 0), closed(BY_ID)),
            *(BY_ID, False, "port.permission", ERROR, "chmod g+rw"),
        ),
        (
            all_of(ftdi, systemd(User="made-up", DynamicUser="yes")),
            *(BY_ID, True, "port.permission", OK, "made-up may open it"),
        ),
        (
            all_of(
                ftdi,
                DEVICES,
                systemd(
                    DevicePolicy="closed", DeviceAllow="char-ttyS rw\nDeviceAllow=char-ttyACM rw"
                ),
            ),
            *(BY_ID, True, "port.device_kind", ERROR, "DeviceAllow=char-ttyUSB rw"),
        ),
        (
            all_of(ftdi, systemd(SupplementaryGroups="")),
            *(BY_ID, True, "port.permission", ERROR, "usermod -aG dialout kontronik-can-gw"),
        ),
        (
            all_of(ftdi, device(USB0, (188, 0), 0o600, 0), systemd()),
            *(BY_ID, True, "port.permission", ERROR, "chmod g+rw"),
        ),
        (
            all_of(
                ftdi, device(USB0, (188, 0), 0o600, 0), closed(BY_ID), process(*RUN, opens=[USB0])
            ),
            *(BY_ID, False, "port.permission", NOTE, "chmod g+rw"),
        ),
        # what else is on it
        (
            all_of(ftdi, process("/usr/bin/brltty")),
            *(BY_ID, True, "port.brltty", WARNING, "apt remove brltty"),
        ),
        (
            all_of(
                uart("ttyAMA0"), process("/sbin/agetty", "115200", "ttyAMA0", "vt220", opens=[AMA0])
            ),
            *(AMA0, False, "port.getty", ERROR, "systemctl disable --now serial-getty@ttyAMA0"),
        ),
        (
            all_of(
                uart("ttyAMA0"),
                file("/proc/cmdline", "console=tty1 console=ttyAMA0,115200 root=/dev/sda\n"),
            ),
            *(AMA0, False, "port.console", ERROR, "Remove console=ttyAMA0"),
        ),
        (
            all_of(ftdi, process("/usr/sbin/ModemManager")),
            BY_ID,
            True,
            "port.modem_manager",
            WARNING,
            "service install",
        ),
        (
            all_of(
                ftdi,
                process("/usr/sbin/ModemManager"),
                prints("ID_BUS=usb\nID_MM_DEVICE_IGNORE=1\n", "udevadm", "info"),
            ),
            *(BY_ID, True, "port.modem_manager", OK, ""),
        ),
        (
            all_of(ftdi, process("minicom", opens=[USB0])),
            BY_ID,
            False,
            "port.users",
            ERROR,
            "kill 78",
        ),
        (
            all_of(ftdi, process(*RUN, opens=[USB0])),
            BY_ID,
            False,
            "port.users",
            NOTE,
            "kontronik-can-gw (pid 78)",
        ),
        (
            all_of(
                ftdi,
                process(
                    "/usr/bin/python3", "/opt/bin/kontronik-can-gw", "run", "--wait", opens=[USB0]
                ),
            ),
            *(BY_ID, False, "port.users", NOTE, "kontronik-can-gw (pid 78)"),
        ),
        # the line itself
        (
            uart("ttyS0", "serial8250", "brcm,bcm2835-aux-uart"),
            S0,
            False,
            "port.parity",
            ERROR,
            "dtoverlay=disable-bt",
        ),
        (
            lambda t: t.ftdi(latency=16),
            BY_ID,
            True,
            "port.latency",
            OK,
            "16 ms; the gateway asks for 1 ms",
        ),
        (
            all_of(lambda t: t.ftdi(latency=16), process(*RUN, opens=[USB0])),
            *(BY_ID, False, "port.latency", WARNING, "latency_timer"),
        ),
        (
            all_of(ftdi, file("/sys/devices/pci0/usb1/1-1/power/control", "auto\n")),
            *(
                BY_ID,
                True,
                "port.autosuspend",
                NOTE,
                "echo on | sudo tee /sys/devices/pci0/usb1/1-1/power/control",
            ),
        ),
    ],
)
def test_what_is_found_is_reported_and_the_port_is_opened_only_where_nobody_else_needs_it(
    tree: Tree, given: Set, port: str, opened: bool, name: str, severity: Severity, said: str
) -> None:
    given(tree)
    look = Looked()
    found = only(check(tree, port, look), name)
    assert found.severity is severity
    assert said in f"{found.text} {found.remedy} {found.command}"
    assert look.calls == ([(str(tree.path(port)), True)] if opened else [])


@pytest.mark.parametrize(
    ("given", "port"),
    [
        (ftdi, BY_ID),
        (uart("ttyAMA0"), AMA0),
        (all_of(ftdi, process("/sbin/agetty", "115200", "ttyUSB01", "vt220")), BY_ID),
        (all_of(ftdi, file("/proc/cmdline", "console=ttyUSB01 console=tty1 quiet\n")), BY_ID),
        (
            all_of(
                ftdi,
                DEVICES,
                systemd(
                    DevicePolicy="closed", DeviceAllow="char-ttyUSB rw\nDeviceAllow=char-ttyS rw"
                ),
            ),
            BY_ID,
        ),
    ],
)
def test_a_good_port_has_nothing_but_ok(tree: Tree, given: Set, port: str) -> None:
    given(tree)
    findings = check(tree, port)
    assert grave(findings) == {}
    assert {finding.group for finding in findings} == {"Serial port of esc1"}


def test_a_port_that_only_the_running_gateway_may_open_is_no_error(tree: Tree) -> None:
    tree.ftdi()
    tree.device("/dev/pts/3", (136, 3), 0o620, 5)
    tree.closed |= {BY_ID, "/dev/pts/3"}
    assert grave(check(tree, "/dev/pts/3")) == {"port.permission": ERROR}
    tree.process(78, *RUN, opens=[USB0, "/dev/pts/3"])
    fresh = Tree(tree.root)
    fresh.devices, fresh.closed = tree.devices, tree.closed
    assert ERROR not in grave(check(fresh)).values()
    assert grave(check(fresh, "/dev/pts/3")) == {"port.users": NOTE}


@pytest.mark.parametrize(
    ("line", "name", "severity", "word"),
    [
        (Line(even_parity=False), "port.parity", ERROR, "does not take"),
        (Line(even_parity=None), "port.parity", NOTE, "not tried"),
        (Line("Device or resource busy", busy=True), "port.parity", NOTE, "for himself"),
        (Line(os.strerror(errno.EIO)), "port.parity", ERROR, "Input/output error"),
        (
            Line(even_parity=True, errors={"framing": 3, "parity": 12}, counts=True),
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
