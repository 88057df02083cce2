"""What `doctor` says of a serial port, good and bad."""

import errno
import os
from pathlib import Path

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.runtime.doctor.findings import Finding, Severity
from kontronik_can_gw.runtime.doctor.line import Line
from kontronik_can_gw.runtime.doctor.serial_ports import check_port
from kontronik_can_gw.runtime.doctor.service import unit_of

BY_ID = "/dev/serial/by-id/usb-FTDI_A1234-port0"
GOOD = Line(touched=True, even_parity=True, counts=True)
CONFIG = "/etc/kontronik-can-gw/gateway.toml"


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


def test_a_good_port_has_nothing_but_ok(tree: Tree) -> None:
    tree.ftdi()
    look = Looked()
    findings = check(tree, look=look)
    assert grave(findings) == {}
    assert {finding.group for finding in findings} == {"Serial port of esc1"}
    said = only(findings, "port.exists").text
    assert "ttyUSB0" in said and "FT232R USB UART, driver ftdi_sio, serial number A1234" in said
    assert look.calls == [(str(tree.path(BY_ID)), True)]


def test_a_missing_port_is_told_with_those_there_are(tree: Tree) -> None:
    tree.ftdi()
    look = Looked()
    found = only(check(tree, "/dev/ttyUSB7", look), "port.exists")
    assert found.severity is Severity.ERROR
    assert BY_ID in found.text
    assert look.calls == []


def test_without_any_port_the_remedy_is_to_plug_in_one(tree: Tree) -> None:
    found = only(check(tree, "/dev/ttyUSB0"), "port.exists")
    assert found.severity is Severity.ERROR
    assert found.remedy.startswith("Plug in the adapter")
    assert found.command


def test_a_standard_port_without_hardware_is_not_offered(tree: Tree) -> None:
    tree.uart("ttyS3", "serial8250")
    tree.file("/sys/class/tty/ttyS3/type", "0\n")
    assert "ttyS3" not in only(check(tree, "/dev/ttyUSB0"), "port.exists").text


def test_what_is_no_serial_port_is_an_error(tree: Tree) -> None:
    tree.file("/dev/notes", "x")
    tree.device("/dev/null", (1, 3), 0o666)
    for port in ("/dev/notes", "/dev/null"):
        look = Looked()
        assert grave(check(tree, port, look)) == {"port.exists": Severity.ERROR}
        assert look.calls == []


def test_a_number_as_name_is_warned_of_with_the_name_by_serial_number(tree: Tree) -> None:
    tree.ftdi()
    found = only(check(tree, "/dev/ttyUSB0"), "port.name")
    assert found.severity is Severity.WARNING
    assert f'port = "{BY_ID}"' in found.remedy


def test_an_adapter_without_serial_number_is_named_by_its_socket(tree: Tree) -> None:
    tree.ftdi(serial="")
    findings = check(tree, "/dev/ttyUSB0")
    assert 'port = "/dev/serial/by-path/pci-usb-0:1"' in only(findings, "port.name").remedy
    assert "without a serial number" in only(findings, "port.exists").text


def test_a_uart_of_the_board_needs_no_other_name(tree: Tree) -> None:
    tree.uart("ttyAMA0", "uart-pl011")
    findings = check(tree, "/dev/ttyAMA0")
    assert grave(findings) == {}
    assert "driver uart-pl011" in only(findings, "port.exists").text


def test_a_port_that_we_may_not_open_is_an_error_where_there_is_no_service(tree: Tree) -> None:
    tree.ftdi()
    tree.closed.add(BY_ID)
    look = Looked()
    findings = check(tree, look=look)
    found = only(findings, "port.permission")
    assert found.severity is Severity.ERROR
    assert found.command == "sudo usermod -aG dialout anna"
    assert look.calls == []
    assert only(findings, "port.parity").severity is Severity.NOTE


def test_a_port_that_its_group_may_not_use_is_told_so(tree: Tree) -> None:
    tree.ftdi()
    tree.device("/dev/ttyUSB0", (188, 0), 0o600, 0)
    tree.closed.add(BY_ID)
    assert "chmod g+rw" in only(check(tree), "port.permission").command


def test_with_a_service_it_is_its_user_who_must_be_allowed(tree: Tree) -> None:
    tree.ftdi()
    tree.systemd()
    tree.closed.add(BY_ID)
    found = [f for f in check(tree) if f.check == "port.permission"]
    assert [f.severity for f in found] == [Severity.OK, Severity.NOTE]
    assert "kontronik-can-gw may open it (group dialout)" in found[0].text


def test_a_service_outside_the_group_may_not_open_it(tree: Tree) -> None:
    tree.ftdi()
    tree.systemd(SupplementaryGroups="")
    found = only(check(tree), "port.permission")
    assert found.severity is Severity.ERROR
    assert found.command == "sudo usermod -aG dialout kontronik-can-gw"


def test_a_dynamic_user_gets_his_groups_from_the_unit(tree: Tree) -> None:
    tree.ftdi()
    tree.systemd(User="made-up", DynamicUser="yes")
    assert "made-up may open it" in only(check(tree), "port.permission").text


def test_a_port_that_only_the_running_gateway_may_open_is_no_error(tree: Tree) -> None:
    tree.ftdi()
    tree.device("/dev/pts/3", (136, 3), 0o620, 5)
    tree.closed |= {BY_ID, "/dev/pts/3"}
    assert grave(check(tree, "/dev/pts/3")) == {"port.permission": Severity.ERROR}
    tree = Tree(tree.root)
    tree.device("/dev/pts/3", (136, 3), 0o620, 5)
    tree.device("/dev/ttyUSB0", (188, 0))
    tree.closed |= {BY_ID, "/dev/pts/3"}
    tree.process(78, "python3", "-m", "kontronik_can_gw", "run", opens=["/dev/ttyUSB0", "/dev/pts/3"])
    assert Severity.ERROR not in grave(check(tree)).values()
    assert grave(check(tree, "/dev/pts/3")) == {"port.users": Severity.NOTE}


def test_a_kind_of_device_that_the_unit_does_not_allow_is_an_error(tree: Tree) -> None:
    tree.ftdi()
    tree.file("/proc/devices", "Character devices:\n  4 ttyS\n188 ttyUSB\n\nBlock devices:\n188 other\n")
    tree.systemd(DevicePolicy="closed", DeviceAllow="char-ttyUSB rw\nDeviceAllow=char-ttyS rw")
    assert grave(check(tree)) == {}
    tree.systemd(DevicePolicy="closed", DeviceAllow="char-ttyS rw\nDeviceAllow=char-ttyACM rw")
    found = only(check(tree), "port.device_kind")
    assert found.severity is Severity.ERROR
    assert "DeviceAllow=char-ttyUSB rw" in found.remedy


def test_a_login_prompt_is_an_error_and_the_port_is_left_alone(tree: Tree) -> None:
    tree.uart("ttyAMA0", "uart-pl011")
    tree.process(412, "/sbin/agetty", "-o", "-p -- \\u", "115200", "ttyAMA0", "vt220", opens=["/dev/ttyAMA0"])
    look = Looked()
    findings = check(tree, "/dev/ttyAMA0", look)
    found = only(findings, "port.getty")
    assert found.severity is Severity.ERROR
    assert "agetty (pid 412)" in found.text
    assert "systemctl disable --now serial-getty@ttyAMA0" in found.command
    assert look.calls == []
    assert grave(findings)["port.parity"] is Severity.NOTE


def test_a_login_prompt_on_another_port_does_not_matter(tree: Tree) -> None:
    tree.ftdi()
    tree.process(412, "/sbin/agetty", "115200", "ttyUSB01", "vt220")
    assert grave(check(tree)) == {}


def test_a_login_prompt_that_only_systemd_knows_of_is_found(tree: Tree) -> None:
    tree.ftdi()
    tree.folder("/run/systemd/system")
    tree.programs["systemctl", "is-active", "serial-getty@ttyUSB0"] = "active\n"
    look = Looked()
    assert only(check(tree, look=look), "port.getty").severity is Severity.ERROR
    assert look.calls == []


@pytest.mark.parametrize("how", ["command line", "active"])
def test_a_console_of_the_kernel_is_an_error_and_the_port_is_left_alone(tree: Tree, how: str) -> None:
    tree.uart("ttyAMA0", "uart-pl011")
    if how == "active":
        tree.file("/sys/class/tty/console/active", "tty0 ttyAMA0\n")
    else:
        tree.file("/proc/cmdline", "console=tty1 console=ttyAMA0,115200 root=/dev/sda\n")
    look = Looked()
    found = only(check(tree, "/dev/ttyAMA0", look), "port.console")
    assert found.severity is Severity.ERROR
    assert "Remove console=ttyAMA0" in found.remedy
    assert look.calls == []


def test_a_console_elsewhere_does_not_matter(tree: Tree) -> None:
    tree.ftdi()
    tree.file("/proc/cmdline", "console=ttyUSB01 console=tty1 quiet\n")
    assert grave(check(tree)) == {}


def test_modem_manager_is_warned_of_unless_udev_keeps_it_away(tree: Tree) -> None:
    tree.ftdi()
    tree.process(300, "/usr/sbin/ModemManager")
    found = only(check(tree), "port.modem_manager")
    assert found.severity is Severity.WARNING
    assert "service install" in found.command
    tree = Tree(tree.root)
    tree.device("/dev/ttyUSB0", (188, 0))
    tree.programs["udevadm", "info"] = "ID_BUS=usb\nID_MM_DEVICE_IGNORE=1\n"
    assert only(check(tree), "port.modem_manager").severity is Severity.OK


def test_brltty_is_warned_of_where_it_takes_such_adapters(tree: Tree) -> None:
    tree.ftdi()
    tree.uart("ttyAMA0", "uart-pl011")
    tree.process(300, "brltty")
    assert only(check(tree), "port.brltty").severity is Severity.WARNING
    assert grave(check(tree, "/dev/ttyAMA0")) == {}


@pytest.mark.parametrize(
    ("driver", "compatible"),
    [("serial8250", "brcm,bcm2835-aux-uart"), ("bcm2835-aux-uart", "")],
    ids=["tree", "driver"],
)
def test_the_mini_uart_is_an_error_with_its_remedy_and_is_not_tried(tree: Tree, driver: str, compatible: str) -> None:
    tree.uart("ttyS0", driver, compatible)
    look = Looked()
    found = only(check(tree, "/dev/ttyS0", look), "port.parity")
    assert found.severity is Severity.ERROR
    assert "dtoverlay=disable-bt" in found.remedy and "ttyAMA0" in found.remedy
    assert look.calls == []


@pytest.mark.parametrize(
    ("line", "severity", "word"),
    [
        (Line(even_parity=False), Severity.ERROR, "does not take"),
        (Line(even_parity=None), Severity.NOTE, "not tried"),
        (Line("Device or resource busy", busy=True), Severity.NOTE, "for himself"),
        (Line(os.strerror(errno.EIO)), Severity.ERROR, "Input/output error"),
    ],
)
def test_what_the_port_itself_answers_is_told(tree: Tree, line: Line, severity: Severity, word: str) -> None:
    tree.ftdi()
    found = only(check(tree, look=Looked(line)), "port.parity")
    assert found.severity is severity
    assert word in found.text


def test_line_errors_are_noted(tree: Tree) -> None:
    tree.ftdi()
    line = Line(even_parity=True, errors={"framing": 3, "parity": 12}, counts=True)
    found = only(check(tree, look=Looked(line)), "port.line_errors")
    assert found.severity is Severity.NOTE
    assert "3 framing, 12 parity" in found.text


def test_a_port_that_another_program_has_open_is_an_error_and_is_left_alone(tree: Tree) -> None:
    tree.ftdi()
    tree.process(77, "minicom", "-D", "/dev/ttyUSB0", opens=["/dev/ttyUSB0"])
    look = Looked()
    found = only(check(tree, look=look), "port.users")
    assert found.severity is Severity.ERROR
    assert "minicom (pid 77)" in found.text
    assert found.command == "kill 77"
    assert look.calls == []


@pytest.mark.parametrize(
    "words",
    [
        ("/usr/bin/python3", "/opt/venv/bin/kontronik-can-gw", "run", "--wait", "-c", "x.toml"),
        ("/usr/bin/python3", "-u", "-m", "kontronik_can_gw", "run", "-c", "x.toml"),
    ],
)
def test_a_port_that_our_gateway_has_open_is_a_note_and_is_left_alone(tree: Tree, words: tuple[str, ...]) -> None:
    tree.ftdi()
    tree.process(78, *words, opens=["/dev/ttyUSB0"])
    look = Looked()
    findings = check(tree, look=look)
    assert only(findings, "port.users").text == "in use by kontronik-can-gw (pid 78)"
    assert grave(findings) == {"port.users": Severity.NOTE, "port.parity": Severity.NOTE}
    assert only(findings, "port.parity").command == "kontronik-can-gw status"
    assert look.calls == []


def test_a_program_of_ours_that_is_no_gateway_is_another_program(tree: Tree) -> None:
    tree.ftdi()
    tree.process(79, "python3", "-m", "kontronik_can_gw", "simulate", opens=["/dev/ttyUSB0"])
    assert only(check(tree), "port.users").severity is Severity.ERROR


def test_a_lock_tells_who_has_the_port_where_nothing_else_may_be_seen(tree: Tree) -> None:
    tree.ftdi()
    tree.process(80, "python3", "-m", "kontronik_can_gw", "run")
    inode = tree.devices["/dev/ttyUSB0"].st_ino
    tree.file(
        "/proc/locks", f"1: FLOCK  ADVISORY  WRITE 80 00:06:{inode} 0 EOF\n2: POSIX ADVISORY READ 1 00:06:5 0 EOF\n"
    )
    look = Looked()
    assert only(check(tree, look=look), "port.users").text == "in use by kontronik-can-gw (pid 80)"
    assert look.calls == []


def test_where_not_all_programs_can_be_seen_it_is_said_and_the_port_is_not_thought_free(tree: Tree) -> None:
    tree.ftdi()
    tree.path("/proc/1/comm").unlink()  # as with hidepid
    look = Looked()
    findings = check(tree, look=look)
    assert only(findings, "port.users").severity is Severity.NOTE
    assert look.calls == [(str(tree.path(BY_ID)), False)]


def test_a_slow_latency_timer_is_warned_of_where_the_gateway_could_not_help_it(tree: Tree) -> None:
    tree.ftdi(latency=16)
    found = only(check(tree), "port.latency")
    assert found.severity is Severity.OK
    assert "16 ms; the gateway asks for 1 ms" in found.text
    tree.process(78, "python3", "-m", "kontronik_can_gw", "run", opens=["/dev/ttyUSB0"])
    fresh = Tree(tree.root)
    fresh.devices = tree.devices
    assert only(check(fresh), "port.latency").severity is Severity.WARNING


def test_an_adapter_that_may_be_suspended_is_noted(tree: Tree) -> None:
    tree.ftdi()
    tree.file("/sys/devices/pci0/usb1/1-1/power/control", "auto\n")
    found = only(check(tree), "port.autosuspend")
    assert found.severity is Severity.NOTE
    assert found.command == "echo on | sudo tee /sys/devices/pci0/usb1/1-1/power/control"


def test_a_pseudo_terminal_is_told_as_such_and_not_opened(tree: Tree) -> None:
    tree.device("/dev/pts/3", (136, 3), 0o620, 5)
    look = Looked()
    findings = check(tree, "/dev/pts/3", look)
    assert "pseudo terminal" in only(findings, "port.exists").text
    assert grave(findings) == {}
    assert look.calls == []
