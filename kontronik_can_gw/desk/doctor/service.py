"""Checks the installed systemd service: the unit that runs a configuration, its user and its state, and what it may use."""

import os
from pathlib import PurePath
from stat import S_ISDIR
from typing import NamedTuple

from kontronik_can_gw.desk.doctor.findings import Findings
from kontronik_can_gw.desk.doctor.machine import Machine, User
from kontronik_can_gw.runtime.locks import SYSTEM_FOLDER

NAME = "kontronik-can-gw"
_SHOWN = (
    "LoadState,ActiveState,SubState,UnitFileState,NRestarts,Result,User,SupplementaryGroups,"
    "ProtectSystem,ReadWritePaths,DevicePolicy,DeviceAllow"
)
_MIN_BYTES = 1_000_000


class Unit(NamedTuple):
    """A systemd unit: its properties as `systemctl show` has them, its user, None where that is unknown."""

    name: str
    shown: dict[str, str]
    user: User | None

    @property
    def state_folder(self) -> str:
        """Default folder of its stored parameters."""
        return f"/var/lib/{self.name.removesuffix('.service').replace('@', '-')}"

    @property
    def devices(self) -> list[str] | None:
        """Kinds of devices that it may use, as char-ttyUSB; None: all kinds."""
        is_limited = self.shown.get("DevicePolicy") in ("closed", "strict")
        return self.shown.get("DeviceAllow", "").split()[::2] if is_limited else None

    def may_write(self, folder: str, status: os.stat_result) -> bool:
        """True if its user may, or may not be known, and the unit does not make the folder read-only."""
        writable = [path.lstrip("-+") for path in self.shown.get("ReadWritePaths", "").split()]
        inside = any(PurePath(folder).is_relative_to(path) for path in writable)
        allowed = self.user is None or self.user.may(status, 3)
        return allowed and (inside or self.shown.get("ProtectSystem") != "strict")


def unit_of(machine: Machine, config: str) -> Unit | None:
    """The unit for a configuration file; None where systemd has none."""
    path = PurePath(config)
    is_instance = str(path.parent) == f"/etc/{NAME}" and path.stem != "gateway"
    name = f"{NAME}@{path.stem}.service" if is_instance else f"{NAME}.service"
    if not machine.has_systemd:
        return None
    shown: dict[str, str] = {}
    for line in machine.run("systemctl", "show", name, f"--property={_SHOWN}").splitlines():
        key, _, value = line.partition("=")
        # DeviceAllow has one line for each kind
        shown[key] = f"{shown[key]} {value}" if key in shown else value
    if shown.get("LoadState") != "loaded":
        return None
    groups = shown.get("SupplementaryGroups", "")
    return Unit(name, shown, machine.user_named(shown.get("User") or "root", groups))


def check_service(machine: Machine, findings: Findings, unit: Unit | None) -> None:
    """Check whether it is installed, enabled and running, and how often it was restarted."""
    if unit is None:
        findings.say("machine.service", "none" if machine.has_systemd else "no_systemd")
        return
    state, restarts = unit.shown.get("ActiveState", ""), unit.shown.get("NRestarts", "0")
    case = "ok" if restarts == "0" else "restarted"
    if state not in ("active", "reloading"):
        case = "failed" if state == "failed" else "stopped"
    detail = f"{unit.shown.get('SubState', '')}, result {unit.shown.get('Result', '')}"
    findings.say(
        "machine.service", case, unit=unit.name, detail=detail, state=state, restarts=restarts
    )
    folder = machine.status(str(SYSTEM_FOLDER))
    if folder is None or (unit.user is not None and not unit.user.may(folder, 7)):
        findings.say("machine.locks", "none", folder=SYSTEM_FOLDER)
    if not unit.shown.get("UnitFileState", "").startswith("enabled"):
        findings.say("machine.service_enabled", "no", unit=unit.name)


def check_readable(machine: Machine, findings: Findings, file: str, unit: Unit | None) -> None:
    """Check that the service can read a file. No finding without a service."""
    if unit is None or unit.user is None:
        return
    for path, bits in [
        *((str(folder), 1) for folder in reversed(PurePath(file).parents)),
        (file, 4),
    ]:
        status = machine.status(path)
        if status is not None and not unit.user.may(status, bits):
            mode = "o+r" if bits == 4 else "o+x"
            values = {"file": file, "user": unit.user.name, "closed": path, "mode": mode}
            findings.say("config.readable", "no", **values)
            return


def check_folder(
    machine: Machine,
    findings: Findings,
    what: str,
    folder: str,
    unit: Unit | None,
    reserve: int = 0,
) -> None:
    """Check that a folder exists or can be created, is writable and has free space.

    ``what``: its use, as "stored parameters". ``reserve``: with fewer bytes free nothing is written there.
    """
    there = PurePath(folder)
    while not machine.exists(str(there)):
        there = there.parent
    status, (read_only, free) = machine.status(str(there)), machine.space(str(there))
    assert status is not None
    who = machine.user if unit is None or unit.user is None else unit.user
    is_own = unit is not None and PurePath(folder).is_relative_to(unit.state_folder)
    if not S_ISDIR(status.st_mode):
        case = "file"
    elif read_only:
        case = "read_only"
    elif free < max(_MIN_BYTES, reserve):
        case = "full"
    elif is_own:
        case = "by_systemd"
    elif unit is not None:
        case = "ok" if unit.may_write(folder, status) else "service"
    else:
        case = "ok" if machine.may(str(there), os.W_OK | os.X_OK) else "closed"
        if case == "closed" and any(each.is_gateway for each in machine.processes.values()):
            case = "gateway"
    findings.say(
        "config.folder",
        case,
        what=what,
        folder=folder,
        there=there,
        made="" if str(there) == folder else ", will be made",
        user=who.name,
        unit=unit.name if unit else "",
        free=free // 1_000_000,
        needed=max(1, reserve // 1_000_000),
    )
