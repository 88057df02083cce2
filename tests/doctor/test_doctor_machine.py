"""What `doctor` says of the machine, the service, and the folders."""

import grp
import os
import subprocess
from pathlib import Path

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.desk.doctor.findings import Finding, Findings, Severity
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.desk.doctor.service import (
    check_folder,
    check_readable,
    check_service,
    unit_of,
)

CONFIG = "/etc/kontronik-can-gw/gateway.toml"
STORE = "/var/lib/kontronik-can-gw"
OK, NOTE, WARNING, ERROR = Severity.OK, Severity.NOTE, Severity.WARNING, Severity.ERROR


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


def service(tree: Tree) -> list[Finding]:
    findings = Findings("Machine")
    check_service(tree, findings, unit_of(tree, CONFIG))
    return findings.found


def folder(tree: Tree, name: str = STORE, config: str = CONFIG) -> Finding:
    findings = Findings("Configuration")
    check_folder(tree, findings, "stored parameters", name, unit_of(tree, config))
    return findings.found[-1]


def readable(tree: Tree, file: str = CONFIG) -> list[Finding]:
    findings = Findings("Configuration")
    check_readable(tree, findings, file, unit_of(tree, file))
    return findings.found


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
    assert "systemd does not run" in only(service(tree), "machine.service").text
    tree.systemd(**shown)
    found = only(service(tree), "machine.service")
    assert found.severity is severity
    assert word in found.command
    assert "machine.service_enabled" not in grave(service(tree))


@pytest.mark.parametrize("mode", [None, 0o755])
def test_a_service_that_cannot_lock_node_ids_is_warned_of(tree: Tree, mode: int | None) -> None:
    tree.systemd()
    tree.path("/run/kontronik-can-gw/lock").rmdir()
    if mode is not None:
        tree.folder("/run/kontronik-can-gw/lock", mode)
    found = only(service(tree), "machine.locks")
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
        ((True, 1 << 30), ERROR, "read-only"),
        ((False, 1000), ERROR, "full"),
        ((False, 1 << 21), OK, ""),
    ],
)
def test_a_full_or_read_only_file_system_is_reported(
    tree: Tree, left: tuple[bool, int], severity: Severity, word: str
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
    tree.systemd()
    assert only(readable(tree), "config.readable").command == f"sudo chmod o+r {CONFIG}"
    tree.path(CONFIG).chmod(0o644)
    assert readable(tree) == []
    tree.file("/srv/anna/gateway.toml", "")
    tree.path("/srv/anna").chmod(0o700)
    (found,) = readable(tree, "/srv/anna/gateway.toml")
    assert found.command == "sudo chmod o+x /srv/anna"


# --- the real thing


def test_who_has_a_terminal_open_or_locked_is_seen() -> None:
    master, slave = os.openpty()
    status = Machine().status(os.ttyname(slave))
    assert status is not None
    with subprocess.Popen(["sleep", "600"], stdin=slave) as child:
        try:
            assert child.pid in [process.pid for process in Machine().openers(status)[0]]
        finally:
            child.kill()
    assert child.pid not in [process.pid for process in Machine().openers(status)[0]]
    os.close(master)
    os.close(slave)


def test_the_real_machine_is_looked_at_without_an_exception() -> None:
    machine = Machine()
    assert machine.processes
    assert machine.space("/proc")
    assert machine.real("/proc/self/..") == "/proc"
    assert machine.text("/proc/none") == "" and machine.names("/proc/none") == []
    root = machine.user_named("root", "tty none")
    assert root is not None and root.uid == 0
    assert root.groups >= {0, grp.getgrnam("tty").gr_gid}
    assert machine.user_named("no such user") is None


def test_the_services_own_folder_is_made_by_systemd(tree: Tree) -> None:
    tree.systemd()
    tree.folder("/var/lib")
    tree.closed.add("/var/lib")
    assert "systemd" in folder(tree).text
    assert folder(tree, f"{STORE}-left", "/etc/kontronik-can-gw/left.toml").severity is OK


def test_a_service_that_does_not_start_with_the_machine_is_noted(tree: Tree) -> None:
    tree.systemd(UnitFileState="disabled")
    found = only(service(tree), "machine.service_enabled")
    command = "sudo systemctl enable kontronik-can-gw.service"
    assert (found.severity, found.command) == (NOTE, command)
