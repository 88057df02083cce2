"""Checks files and folders: access of the service to its configuration and folders, and free space."""

from pathlib import Path, PurePath
from stat import S_ISDIR

from kontronik_can_gw.desk.doctor.findings import Findings
from kontronik_can_gw.desk.doctor.service import Unit
from kontronik_can_gw.desk.doctor.system import FileSystem, System

_MIN_BYTES = 64 * 1024
_LOW_BYTES = 16 * 1024 * 1024
_HOMES = ("/home", "~root", "/run/user")
_READ, _WRITE_AND_ENTER, _ENTER = 4, 3, 1


def check_readable(system: System, findings: Findings, file: str, unit: Unit | None) -> None:
    """Check that the service can read a file. No finding without a service."""
    if unit is None or unit.user is None:
        return
    path, user = PurePath(file), unit.user.name
    if unit.hides_homes and any(path.is_relative_to(Path(home).expanduser()) for home in _HOMES):
        findings.say("config.readable", "home", file=file, unit=unit.name)
        return
    for folder in path.parents:
        at = system.status(str(folder))
        if at is not None and not unit.user.may(at, _ENTER):
            findings.say("config.readable", "enter", file=file, user=user, folder=folder)
            return
    status = system.status(file)
    if status is not None and not unit.user.may(status, _READ):
        findings.say("config.readable", "read", file=file, user=user)


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
    left = system.file_system(there)

    def say(case: str, **values: object) -> None:
        findings.say_as(check, "config.folder", case, **values, **where)

    where: dict[str, object] = {"what": what, "folder": folder, "there": there}
    where["made"] = "" if there == folder else ", will be made"
    where["user"] = system.user.name
    if unit is not None:
        where |= {"unit": unit.name, "state": unit.state_folder}
        if unit.user is not None:
            where["user"] = unit.user.name
    case = _unusable(system, there, left) or _access(system, folder, there, unit)
    say(case)
    if case not in ("ok", "by_systemd", "gateway") or left is None:
        return
    if left.free_bytes < reserve:
        say("reserve", free=left.free_bytes // 1_000_000, reserve=reserve // 1_000_000)
    elif left.free_bytes < _LOW_BYTES:
        say("low", free=left.free_bytes // 1024)


def _unusable(system: System, there: str, left: FileSystem | None) -> str | None:
    """Why nobody can write in a folder that is there; None where somebody can."""
    status = system.status(there)
    if status is not None and not S_ISDIR(status.st_mode):
        return "file"
    if left is not None and left.read_only:
        return "read_only"
    if left is not None and (left.free_bytes < _MIN_BYTES or left.free_files == 0):
        return "full"
    return None


def _access(system: System, folder: str, there: str, unit: Unit | None) -> str:
    """Whether the gateway may write in a folder, of which ``there`` exists."""
    status = system.status(there)
    if unit is not None and PurePath(folder).is_relative_to(unit.state_folder):
        return "by_systemd"
    if unit is not None and unit.user is not None:
        if status is None or not unit.user.may(status, _WRITE_AND_ENTER):
            return "service"
        allowed = any(PurePath(folder).is_relative_to(path) for path in unit.writable)
        return "ok" if allowed or not unit.strict else "strict"
    if system.may_fill(there):
        return "ok"
    return "gateway" if any(process.is_gateway for process in system.processes) else "closed"
