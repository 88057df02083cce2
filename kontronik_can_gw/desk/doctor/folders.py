"""Checks files and folders: access of the service to its configuration and folders, and free space."""

from pathlib import Path, PurePath
from stat import S_ISDIR

from kontronik_can_gw.desk.doctor.findings import Findings
from kontronik_can_gw.desk.doctor.service import Unit
from kontronik_can_gw.desk.doctor.system import System

_MIN_BYTES = 64 * 1024
_LOW_BYTES = 16 * 1024 * 1024


_HOMES = ("/home", "~root", "/run/user")


def check_readable(
    system: System, findings: Findings, check: str, file: str, unit: Unit | None
) -> None:
    """Check that the service can read a file. No finding without a service."""
    if unit is None or unit.user is None:
        return
    who = unit.user
    if unit.hides_homes and any(
        PurePath(file).is_relative_to(Path(home).expanduser()) for home in _HOMES
    ):
        text = f"{file}: {unit.name} sees no home folders (ProtectHome)"
        findings.error(check, text, "Move it:", f"sudo mv {file} /etc/kontronik-can-gw/")
        return
    status = system.status(file)
    for folder in PurePath(file).parents:
        at = system.status(str(folder))
        if at is not None and not who.may(at, 1):
            text = f"{file}: the service's user {who.name} may not enter {folder}"
            findings.error(
                check,
                text,
                "Keep the configuration in /etc/kontronik-can-gw, or:",
                f"sudo chmod o+x {folder}",
            )
            return
    if status is not None and not who.may(status, 4):
        findings.error(
            check,
            f"{file}: the service's user {who.name} may not read it",
            "",
            f"sudo chmod o+r {file}",
        )


def check_folder(
    system: System,
    findings: Findings,
    check: str,
    what: str,
    folder: str,
    unit: Unit | None,
    reserve: int = 0,
) -> None:
    """Check that a folder exists or can be created, is writable and has free space.

    ``what``: its use, as "stored parameters". ``reserve``: with fewer bytes free nothing is written there.
    """
    there = folder
    while there != "/" and not system.exists(there):
        there = str(PurePath(there).parent)
    made = "" if there == folder else ", will be made"
    status = system.status(there)
    if status is not None and not S_ISDIR(status.st_mode):
        findings.error(
            check,
            f"{what}: {folder}: {there} is a file, not a folder",
            "Choose another folder:",
            f"ls -l {there}",
        )
        return
    left = system.file_system(there)
    if left is not None and left.read_only:
        text = f"{what}: {folder}: the file system is read-only"
        findings.error(
            check, text, "Make it writable, or choose another folder:", f"findmnt --target {there}"
        )
        return
    if left is not None and (left.free_bytes < _MIN_BYTES or left.free_files == 0):
        text = f"{what}: {folder}: the file system is full"
        findings.error(check, text, "Make room:", f"df -h {there}; df -i {there}")
        return
    kept_by_systemd = unit is not None and PurePath(folder).is_relative_to(unit.state_folder)
    owner = unit.user if unit is not None else None
    if kept_by_systemd or (system.exists(folder) and status is None):
        findings.ok(check, f"{what}: {folder}, made by systemd for the service")
    elif unit is not None and owner is not None:
        allowed = not unit.strict or any(
            PurePath(folder).is_relative_to(path) for path in unit.writable
        )
        if status is None or not owner.may(status, 3):
            findings.error(
                check,
                f"{what}: {folder}: the service's user {owner.name} may not write there",
                f"Leave it out of the configuration ({unit.state_folder} is taken then), or:",
                f"sudo mkdir -p {folder} && sudo chown {owner.name} {folder}",
            )
            return
        if not allowed:
            findings.error(
                check,
                f"{what}: {folder}: is read-only for {unit.name} (ProtectSystem=strict)",
                f"Leave it out of the configuration ({unit.state_folder} is taken then), or add ReadWritePaths={folder}:",
                f"sudo systemctl edit {unit.name}",
            )
            return
        findings.ok(check, f"{what}: {folder}{made}")
    elif not system.may_fill(there) and any(process.is_gateway for process in system.processes):
        findings.note(
            check,
            f"{what}: {folder}: {system.user.name} may not write there; perhaps the gateway that runs may",
        )
    elif not system.may_fill(there):
        findings.error(
            check,
            f"{what}: {folder}: {system.user.name} may not write in {there}",
            "Run doctor as the user that runs the gateway, or:",
            f"sudo mkdir -p {folder} && sudo chown {system.user.name} {folder}",
        )
        return
    else:
        findings.ok(check, f"{what}: {folder}{made}")
    if left is not None and left.free_bytes < reserve:
        text = f"{what}: {left.free_bytes // 1_000_000} MB are free in {there}: nothing is written with less than {reserve // 1_000_000} MB"
        findings.error(check, text, "Make room:", f"df -h {there}")
    elif left is not None and left.free_bytes < _LOW_BYTES:
        text = f"{what}: only {left.free_bytes // 1024} kB are free in {there}"
        findings.warning(check, text, "Make room:", f"df -h {there}")
