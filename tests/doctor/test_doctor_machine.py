"""Findings of `doctor` about the machine, the service and the folders."""

import os
import subprocess
from pathlib import Path

import pytest
from doctor_trees import ROOM, Tree, grave, only

from kontronik_can_gw.desk.doctor import Finding, Findings
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.desk.doctor.service import (
    check_file_system,
    check_folder,
    check_service,
    unit_of,
)

pytestmark = pytest.mark.promise("doctor")

CONFIG = "/etc/kontronik-can-gw/gateway.toml"
STORE = "/var/lib/kontronik-can-gw"
OK = "ok"
NOTE = "note"
WARNING = "warning"
ERROR = "error"


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


def service(tree: Tree) -> list[Finding]:
    findings = Findings("Machine")
    check_service(tree, findings, unit_of(tree, CONFIG), CONFIG)
    return findings.found


# --- the service


@pytest.mark.parametrize(
    ("shown", "check", "severity", "word"),
    [
        ({"LoadState": "not-found"}, "service", NOTE, "service install"),
        ({"ActiveState": "failed"}, "service", ERROR, "journalctl -u kontronik-can-gw.service"),
        ({"ActiveState": "inactive", "SubState": "dead"}, "service", NOTE, "systemctl start"),
        ({"NRestarts": "7"}, "service", WARNING, "journalctl"),
        ({}, "service", OK, ""),
        ({"UnitFileState": "disabled"}, "service_enabled", NOTE, "systemctl enable"),
        ({"User": "bob"}, "user", NOTE, f"sudo -u bob kontronik-can-gw doctor -c {CONFIG}"),
    ],
)
def test_state_of_the_service_is_reported(
    tree: Tree,
    shown: dict[str, str],
    check: str,
    severity: str,
    word: str,
) -> None:
    tree.systemd(**shown)
    findings = service(tree)
    found = only(findings, f"machine.{check}")
    assert found.severity == severity
    assert word in found.command
    assert set(grave(findings)) <= {found.check}


@pytest.mark.parametrize("folder", ["/usr/lib/systemd/system", "/etc/systemd/system"])
def test_without_systemd_an_installation_is_not_advised(tree: Tree, folder: str) -> None:
    found = only(service(tree), "machine.service")
    assert found.severity == NOTE
    assert found.command == f"kontronik-can-gw run --wait -c {CONFIG}"
    tree.file(f"{folder}/kontronik-can-gw.service", "")
    found = only(service(tree), "machine.service")
    assert "kontronik-can-gw.service is installed, but systemd does not run here" in found.text
    assert found.severity == NOTE
    assert found.command == "sudo systemctl enable --now kontronik-can-gw.service"


# --- files and folders


@pytest.mark.parametrize(
    ("there", "space", "who", "severity", "said"),
    [
        (STORE, (True, 1 << 30), "open", ERROR, "read-only"),
        (STORE, (False, 1000), "open", ERROR, "full"),
        (STORE, (False, 1 << 21), "open", OK, ""),
        ("/var/lib", ROOM, "open", OK, f"{STORE}, will be created"),
        ("/var/lib", ROOM, "closed", ERROR, f"chown anna {STORE}"),
        ("/var/lib", ROOM, "of systemd", OK, "made by systemd"),
        ("/var/lib", ROOM, "of a gateway", NOTE, "perhaps the running gateway may"),
    ],
)
def test_folder_must_be_writable_by_this_user_or_systemd(
    tree: Tree,
    there: str,
    space: tuple[bool, int],
    who: str,
    severity: str,
    said: str,
) -> None:
    tree.folder(there)
    tree.full[there] = space
    if who != "open":
        tree.closed.add(there)
    if who == "of a gateway":
        tree.process(78, "python3", "-m", "kontronik_can_gw", "run")
    findings = Findings("Configuration")
    check_folder(tree, findings, "stored parameters", STORE, who == "of systemd", 0)
    (found,) = findings.found
    assert found.severity == severity, found
    assert said in f"{found.text} {found.command}", found


MOUNTS = """\
22 1 179:2 / / rw,noatime shared:1 - ext4 /dev/root rw
30 22 179:1 / /boot rw - vfat /dev/mmcblk0p1 rw
31 22 8:1 / /media/my\\040stick rw - exfat /dev/sda1 rw
32 22 0:40 / /mnt rw - tmpfs tmpfs rw
33 22 0:41 / /mnt rw - vfat /dev/sdb1 rw
"""


@pytest.mark.parametrize(
    ("folder", "kind"),
    [
        ("/var/lib/kontronik-can-gw", "ext4"),
        ("/boot", "vfat"),
        ("/boot/store", "vfat"),
        ("/bootstrap", "ext4"),
        ("/media/my stick/store", "exfat"),
        ("/mnt/store", "vfat"),
    ],
)
def test_parameters_on_a_file_system_without_journal_get_a_warning(
    folder: str,
    kind: str,
    tree: Tree,
) -> None:
    tree.file("/proc/self/mountinfo", MOUNTS)
    for name in ("/boot", "/media/my stick", "/mnt"):
        tree.folder(name)
    assert tree.file_system(folder) == kind
    findings = Findings("Configuration")
    check_file_system(tree, findings, "stored parameters", folder)
    assert [found.severity for found in findings.found] == ["warning"] * (kind != "ext4")
    for found in findings.found:
        assert found.text == (
            f"stored parameters: {folder}: a power loss may destroy them, "
            f"because the file system is {kind}"
        )
        assert found.remedy == "Choose a folder on ext4 or f2fs as canopen.store:"


def test_machine_without_a_list_of_mounts_gets_no_warning(tree: Tree) -> None:
    findings = Findings("Configuration")
    check_file_system(tree, findings, "stored parameters", "/boot")
    assert findings.found == []


# --- the real machine


def test_program_that_has_the_terminal_open_is_found() -> None:
    master, slave = os.openpty()
    status = Machine().status(os.ttyname(slave))
    assert status is not None
    with subprocess.Popen(["sleep", "600"], stdin=slave) as child:
        try:
            assert child.pid in [process.pid for process in Machine().openers(status)]
        finally:
            child.kill()
    assert child.pid not in [process.pid for process in Machine().openers(status)]
    os.close(master)
    os.close(slave)


def test_real_machine_is_checked_without_an_exception() -> None:
    machine = Machine()
    assert machine.processes
    assert machine.space("/proc")
    assert machine.real("/proc/self/..") == "/proc"
    assert machine.text("/proc/none") == ""
    assert machine.names("/proc/none") == []
    assert machine.user
    assert machine.group_name(0) == "root"
