"""What `doctor` says of the machine, the service, and the folders."""

import grp
import os
import subprocess
from pathlib import Path

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.desk.doctor.findings import Finding, Findings, Severity
from kontronik_can_gw.desk.doctor.folders import check_folder, check_readable
from kontronik_can_gw.desk.doctor.machine import check_machine
from kontronik_can_gw.desk.doctor.service import unit_of
from kontronik_can_gw.desk.doctor.system import FileSystem, System

CONFIG = "/etc/kontronik-can-gw/gateway.toml"
STORE = "/var/lib/kontronik-can-gw"
OK, NOTE, WARNING, ERROR = Severity.OK, Severity.NOTE, Severity.WARNING, Severity.ERROR
CPU = "/sys/devices/system/cpu/cpu0/cpufreq"
HWMON = "/sys/class/hwmon"


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    made = Tree(tmp_path)
    made.file("/proc/meminfo", "MemTotal: 900000 kB\nMemAvailable: 500000 kB\n")
    made.file("/proc/loadavg", "0.10 0.20 0.30 1/100 999\n")
    return made


def machine(tree: Tree, year: int = 2026) -> list[Finding]:
    return check_machine(tree, unit_of(tree, CONFIG), year)


def folder(tree: Tree, name: str = STORE, config: str = CONFIG) -> Finding:
    findings = Findings("Configuration")
    check_folder(tree, findings, "config.store", "stored parameters", name, unit_of(tree, config))
    return findings.found[-1]


def readable(tree: Tree, file: str = CONFIG) -> list[Finding]:
    findings = Findings("Configuration")
    check_readable(tree, findings, file, unit_of(tree, file))
    return findings.found


# --- the machine


def test_a_good_machine_has_nothing_but_ok(tree: Tree) -> None:
    tree.systemd()
    tree.folder("/var/log/journal")
    findings = machine(tree)
    assert grave(findings) == {}
    assert "python-can" in only(findings, "machine.versions").text


@pytest.mark.parametrize(
    ("files", "check", "severity"),
    [
        ({"/proc/loadavg": "4000.0 0.20 0.30 1/100 999"}, "machine.load", WARNING),
        ({"/proc/meminfo": "MemTotal: 900000 kB\nMemAvailable: 20000 kB"}, "machine.memory", WARNING),
        ({f"{CPU}/scaling_governor": "powersave", f"{CPU}/scaling_driver": "cpufreq-dt"}, "machine.governor", NOTE),
        # there it is the one that adapts
        ({f"{CPU}/scaling_governor": "powersave", f"{CPU}/scaling_driver": "intel_pstate"}, "machine.governor", OK),
        ({f"{HWMON}/hwmon1/name": "rpi_volt", f"{HWMON}/hwmon1/in0_lcrit_alarm": "1"}, "machine.power", NOTE),
        ({f"{HWMON}/hwmon1/name": "rpi_volt"}, "machine.power", OK),
    ],
)  # fmt: skip
def test_what_is_not_as_it_should_be_is_reported(
    tree: Tree, files: dict[str, str], check: str, severity: Severity
) -> None:
    for name, text in files.items():
        tree.file(name, f"{text}\n")
    assert only(machine(tree), check).severity is severity


def test_a_clock_that_was_never_set_is_noted(tree: Tree) -> None:
    assert only(machine(tree, 1970), "machine.clock").severity is NOTE


# --- the service


@pytest.mark.parametrize(
    ("shown", "severity", "word"),
    [
        ({"LoadState": "not-found"}, NOTE, "service install"),
        ({"ActiveState": "failed"}, ERROR, "journalctl -u kontronik-can-gw.service"),
        ({"ActiveState": "inactive", "SubState": "dead"}, NOTE, "systemctl start"),
        ({"NRestarts": "7"}, WARNING, "journalctl"),
        ({}, OK, ""),
    ],
)
def test_how_the_service_fares_is_reported(
    tree: Tree, shown: dict[str, str], severity: Severity, word: str
) -> None:
    assert "systemd does not run" in only(machine(tree), "machine.service").text
    tree.systemd(**shown)
    found = only(machine(tree), "machine.service")
    assert found.severity is severity
    assert word in found.command
    assert "machine.service_enabled" not in grave(machine(tree))


def test_a_service_that_does_not_start_with_the_machine_is_noted(tree: Tree) -> None:
    tree.systemd(UnitFileState="disabled")
    found = only(machine(tree), "machine.service_enabled")
    command = "sudo systemctl enable kontronik-can-gw.service"
    assert (found.severity, found.command) == (NOTE, command)


@pytest.mark.parametrize("mode", [None, 0o755])
def test_a_service_that_cannot_lock_node_ids_is_warned_of(tree: Tree, mode: int | None) -> None:
    tree.systemd()
    tree.path("/run/kontronik-can-gw/lock").rmdir()
    if mode is not None:
        tree.folder("/run/kontronik-can-gw/lock", mode)
    found = only(machine(tree), "machine.locks")
    assert found.severity is Severity.WARNING
    assert "systemd-tmpfiles --create" in found.command


# --- files and folders


def test_without_a_service_we_must_be_able_to_write_where_parameters_go(tree: Tree) -> None:
    tree.folder("/var/lib")
    assert folder(tree).text.endswith(f"{STORE}, will be made")
    tree.closed.add("/var/lib")
    found = folder(tree)
    assert found.severity is ERROR
    assert f"chown anna {STORE}" in found.command
    tree = Tree(tree.root)
    tree.closed.add("/var/lib")
    tree.process(78, "python3", "-m", "kontronik_can_gw", "run")  # of another user
    assert folder(tree).severity is NOTE


def test_the_services_own_folder_is_made_by_systemd(tree: Tree) -> None:
    tree.systemd()
    tree.folder("/var/lib")
    tree.closed.add("/var/lib")
    assert "systemd" in folder(tree).text
    assert folder(tree, f"{STORE}-left", "/etc/kontronik-can-gw/left.toml").severity is OK


def test_a_folder_of_ones_own_must_be_the_services_and_the_unit_must_let_it_write(
    tree: Tree,
) -> None:
    tree.systemd()
    tree.folder("/data", 0o755)
    assert folder(tree, "/data").severity is ERROR
    assert "chown kontronik-can-gw /data" in folder(tree, "/data").command
    tree.path("/data").chmod(0o777)
    assert folder(tree, "/data").severity is OK
    tree.systemd(ProtectSystem="strict")
    assert folder(tree, "/data").severity is ERROR
    assert "ReadWritePaths=/data" in folder(tree, "/data").remedy
    tree.systemd(ProtectSystem="strict", ReadWritePaths="/var/tmp -/data")
    assert folder(tree, "/data").severity is OK


@pytest.mark.parametrize(
    ("left", "severity", "word"),
    [
        (FileSystem(True, 1 << 30, 1000), ERROR, "read-only"),
        (FileSystem(False, 1000, 1000), ERROR, "full"),
        (FileSystem(False, 1 << 30, 0), ERROR, "full"),
        (FileSystem(False, 1 << 20, 1000), WARNING, "1024 kB"),
    ],
)
def test_a_full_or_read_only_file_system_is_reported(
    tree: Tree, left: FileSystem, severity: Severity, word: str
) -> None:
    tree.folder(STORE)
    tree.full[STORE] = left
    found = folder(tree)
    assert found.severity is severity
    assert word in found.text


def test_a_configuration_that_the_service_cannot_read_is_an_error(tree: Tree) -> None:
    tree.file(CONFIG, "")
    tree.path(CONFIG).chmod(0o640)
    assert readable(tree) == []
    tree.systemd(ProtectHome="yes")
    assert only(readable(tree), "config.readable").command == f"sudo chmod o+r {CONFIG}"
    tree.path(CONFIG).chmod(0o644)
    assert readable(tree) == []
    tree.file("/srv/anna/gateway.toml", "")
    tree.path("/srv/anna").chmod(0o700)
    (found,) = readable(tree, "/srv/anna/gateway.toml")
    assert "may not enter /srv/anna" in found.text
    tree.file("/home/anna/gateway.toml", "")
    assert "ProtectHome" in only(readable(tree, "/home/anna/gateway.toml"), "config.readable").text
    tree.systemd(ProtectHome="read-only")
    assert readable(tree, "/home/anna/gateway.toml") == []


# --- the real thing


def test_who_has_a_terminal_open_or_locked_is_seen() -> None:
    master, slave = os.openpty()
    status = System().status(os.ttyname(slave))
    assert status is not None
    with subprocess.Popen(["sleep", "600"], stdin=slave) as child:
        try:
            assert child.pid in [process.pid for process in System().openers(status)[0]]
        finally:
            child.kill()
    assert child.pid not in [process.pid for process in System().openers(status)[0]]
    os.close(master)
    os.close(slave)


def test_the_real_machine_is_looked_at_without_an_exception() -> None:
    system = System()
    assert system.processes
    assert system.file_system("/proc") is not None
    assert system.real("/proc/self/..") == "/proc"
    assert system.text("/proc/none") is None
    assert system.names("/proc/none") == []
    root = system.user_named("root", ["tty", "no such group"])
    assert root is not None and (root.uid, root.groups >= {0, grp.getgrnam("tty").gr_gid}) == (
        0,
        True,
    )
    assert system.user_named("no such user") is None
    assert check_machine(system, None)
