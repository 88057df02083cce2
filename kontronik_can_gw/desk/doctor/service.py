"""Checks the installed systemd service: the unit that runs a configuration and its state; and folders that are written."""

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
_UNIT_FOLDERS = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")


class Unit(NamedTuple):
    """A systemd unit, and its properties as `systemctl show` has them."""

    name: str
    shown: dict[str, str]

    @property
    def state_folder(self) -> str:
        """Default folder of its stored parameters."""
        return f"/var/lib/{self.name.removesuffix('.service').replace('@', '-')}"


def unit_of(machine: Machine, config: str) -> Unit | None:
    """The unit for a configuration file, by its absolute path; None where systemd has none."""
    name = _unit_name(config)
    lines = machine.run("systemctl", "show", name, f"--property={_SHOWN}").splitlines()
    shown = dict(line.partition("=")[::2] for line in lines)
    return Unit(name, shown) if shown.get("LoadState") == "loaded" else None


def _unit_name(config: str) -> str:
    path = PurePath(config)
    is_instance = str(path.parent) == f"/etc/{NAME}" and path.stem != "gateway"
    return f"{NAME}@{path.stem}.service" if is_instance else f"{NAME}.service"


def check_service(machine: Machine, findings: Findings, unit: Unit | None, config: str) -> None:
    """Check whether it is installed, enabled and running, and how often it was restarted."""
    if unit is None:
        name = _unit_name(config)
        if not machine.exists(_BOOTED):
            is_packaged = any(
                machine.exists(f"{folder}/{NAME}.service") for folder in _UNIT_FOLDERS
            )
            findings.say(
                "machine.service",
                "not_booted" if is_packaged else "no_systemd",
                unit=name,
                file=config,
            )
        else:
            findings.say("machine.service", "none")
        return
    state = unit.shown.get("ActiveState", "")
    restarts, result = unit.shown.get("NRestarts", "0"), unit.shown.get("Result", "")
    case = "ok" if restarts == "0" else "restarted"
    if state not in ("active", "reloading"):
        case = "failed" if state == "failed" else "stopped"
    findings.values["unit"] = unit.name
    findings.say("machine.service", case, result=result, state=state, restarts=restarts)
    if not unit.shown.get("UnitFileState", "").startswith("enabled"):
        findings.say("machine.service_enabled", "no")
    user = unit.shown.get("User") or "root"
    if user != machine.user:
        findings.say("machine.user", "other", user=user, me=machine.user, file=config)


def check_folder(
    machine: Machine, findings: Findings, what: str, folder: str, own: bool, reserve: int
) -> None:
    """Check that a folder exists or can be created, is writable and has free space.

    ``what``: its use, as "stored parameters". ``own``: systemd makes it for the service. ``reserve``: with fewer bytes free nothing is
    written there.
    """
    there = PurePath(folder)
    while (status := machine.status(str(there))) is None:
        there = there.parent
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
        case = "gateway" if machine.runs_gateway else "closed"
    made = "" if str(there) == folder else ", will be made"
    space = {"free": free // 1_000_000, "needed": needed // 1_000_000}
    names = {"what": what, "folder": folder, "there": there, "user": machine.user}
    findings.say("config.folder", case, made=made, **names, **space)
