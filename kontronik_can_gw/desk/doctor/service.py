"""Checks the systemd service that runs a configuration, and the folders to which it writes."""

import os
from pathlib import PurePath
from stat import S_ISDIR
from typing import NamedTuple

from kontronik_can_gw.desk.doctor import Findings
from kontronik_can_gw.desk.doctor.machine import Machine

NAME = "kontronik-can-gw"
_SHOWN = "LoadState,ActiveState,SubState,UnitFileState,NRestarts,Result,User"
_MIN_BYTES = 1_000_000
_BOOTED = "/run/systemd/system"
"""Exists if systemd runs (sd_booted)."""
_WITHOUT_JOURNAL = ("vfat", "msdos", "exfat")
"""File systems in which a power loss while a file is replaced may destroy it."""
_UNIT_FOLDERS = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")


class ServiceUnit(NamedTuple):
    """A systemd unit with its properties from `systemctl show`."""

    name: str
    shown: dict[str, str]

    @property
    def state_folder(self) -> str:
        """Default folder of the stored parameters."""
        name = self.name.removesuffix(".service").replace("@", "-")
        return f"/var/lib/{name}"


def unit_of(machine: Machine, config: str) -> ServiceUnit | None:
    """Return the unit of a configuration file with this absolute path. None if there is none."""
    name = _unit_name(config)
    shown = {}
    for line in machine.run("systemctl", "show", name, f"--property={_SHOWN}").splitlines():
        key, _, value = line.partition("=")
        shown[key] = value
    if shown.get("LoadState") != "loaded":
        return None
    return ServiceUnit(name, shown)


def _unit_name(config: str) -> str:
    path = PurePath(config)
    is_instance = str(path.parent) == f"/etc/{NAME}" and path.stem != "gateway"
    return f"{NAME}@{path.stem}.service" if is_instance else f"{NAME}.service"


def check_service(
    machine: Machine, findings: Findings, unit: ServiceUnit | None, config: str
) -> None:
    """Check if the service is installed, enabled and running, and how often it was restarted."""
    if unit is None:
        units = [f"{folder}/{NAME}.service" for folder in _UNIT_FOLDERS]
        case = "none"
        if not machine.exists(_BOOTED):
            case = "not_booted" if any(map(machine.exists, units)) else "no_systemd"
        findings.add(
            "machine.service",
            case,
            unit=_unit_name(config),
            file=config,
        )
        return
    state = unit.shown.get("ActiveState", "")
    restarts = unit.shown.get("NRestarts", "0")
    result = unit.shown.get("Result", "")
    case = "ok" if restarts == "0" else "restarted"
    if state not in ("active", "reloading"):
        case = "failed" if state == "failed" else "stopped"
    findings.values["unit"] = unit.name
    findings.add(
        "machine.service",
        case,
        result=result,
        state=state,
        restarts=restarts,
    )
    if not unit.shown.get("UnitFileState", "").startswith("enabled"):
        findings.add("machine.service_enabled", "no")
    user = unit.shown.get("User") or "root"
    if user != machine.user:
        findings.add(
            "machine.user",
            "other",
            user=user,
            me=machine.user,
            file=config,
        )


def check_folder(
    machine: Machine,
    findings: Findings,
    what: str,
    folder: str,
    own: bool,
    reserve: int,
) -> None:
    """Check that a folder exists or can be created, is writable and has free space.

    ``what``: the use of the folder, for example "stored parameters". ``own``: systemd creates it
    for the service. ``reserve``: number of free bytes below which nothing is written to it.
    """
    there = _existing(machine, folder)
    status = machine.status(str(there))
    assert status is not None
    read_only, free = machine.space(str(there))
    needed = max(_MIN_BYTES, reserve)
    case = "ok"
    if not S_ISDIR(status.st_mode):
        case = "file"
    elif read_only:
        case = "read_only"
    elif free < needed:
        case = "full"
    elif own:
        case = "by_systemd"
    elif not machine.may(str(there), os.W_OK | os.X_OK):
        case = "gateway" if machine.has_gateway else "closed"
    made = "" if str(there) == folder else ", will be created"
    space = {"free": free // 1_000_000, "needed": needed // 1_000_000}
    names = {"what": what, "folder": folder, "there": there, "user": machine.user}
    findings.add(
        "config.folder",
        case,
        made=made,
        **names,
        **space,
    )


def check_file_system(machine: Machine, findings: Findings, what: str, folder: str) -> None:
    """Check that files of a folder can be replaced safely, so that a power loss is harmless."""
    kind = machine.file_system(str(_existing(machine, folder)))
    if kind in _WITHOUT_JOURNAL:
        findings.add(
            "config.file_system",
            "unsafe",
            what=what,
            folder=folder,
            kind=kind,
        )


def _existing(machine: Machine, folder: str) -> PurePath:
    """Return the folder, or the nearest folder above it that exists."""
    there = PurePath(folder)
    while not machine.exists(str(there)):
        there = there.parent
    return there
