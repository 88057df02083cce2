"""Checks the installed systemd service: the unit that runs a configuration and its state; and folders that are written."""

import os
from pathlib import PurePath
from stat import S_ISDIR
from typing import NamedTuple

from kontronik_can_gw.desk.doctor.findings import Findings
from kontronik_can_gw.desk.doctor.machine import Machine

NAME = "kontronik-can-gw"
_SHOWN = "LoadState,ActiveState,SubState,UnitFileState,NRestarts,Result,User"
_MIN_BYTES = 1_000_000


class Unit(NamedTuple):
    """A systemd unit, the configuration that it runs, and its properties as `systemctl show` has them."""

    name: str
    config: str
    shown: dict[str, str]

    @property
    def state_folder(self) -> str:
        """Default folder of its stored parameters."""
        return f"/var/lib/{self.name.removesuffix('.service').replace('@', '-')}"


def unit_of(machine: Machine, config: str) -> Unit | None:
    """The unit for a configuration file, by its absolute path; None where systemd has none."""
    path = PurePath(config)
    is_instance = str(path.parent) == f"/etc/{NAME}" and path.stem != "gateway"
    name = f"{NAME}@{path.stem}.service" if is_instance else f"{NAME}.service"
    if not machine.has_systemd:
        return None
    lines = machine.run("systemctl", "show", name, f"--property={_SHOWN}").splitlines()
    shown = dict(line.partition("=")[::2] for line in lines)
    if shown.get("LoadState") != "loaded":
        return None
    return Unit(name, config, shown)


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
    if not unit.shown.get("UnitFileState", "").startswith("enabled"):
        findings.say("machine.service_enabled", "no", unit=unit.name)
    user = unit.shown.get("User") or "root"
    if user != machine.user:
        names = {"unit": unit.name, "user": user, "me": machine.user, "file": unit.config}
        findings.say("machine.user", "other", **names)


def check_folder(
    machine: Machine, findings: Findings, what: str, folder: str, own: bool, reserve: int
) -> None:
    """Check that a folder exists or can be created, is writable and has free space.

    ``what``: its use, as "stored parameters". ``own``: systemd makes it for the service. ``reserve``: with fewer bytes free nothing is
    written there.
    """
    there = PurePath(folder)
    while not machine.exists(str(there)):
        there = there.parent
    status, (read_only, free) = machine.status(str(there)), machine.space(str(there))
    assert status is not None
    case = "ok"
    if not S_ISDIR(status.st_mode):
        case = "file"
    elif read_only:
        case = "read_only"
    elif free < max(_MIN_BYTES, reserve):
        case = "full"
    elif own:
        case = "by_systemd"
    elif not machine.may(str(there), os.W_OK | os.X_OK):
        running = any(each.is_gateway for each in machine.processes.values())
        case = "gateway" if running else "closed"
    findings.say(
        "config.folder",
        case,
        what=what,
        folder=folder,
        there=there,
        made="" if str(there) == folder else ", will be made",
        user=machine.user,
        free=free // 1_000_000,
        needed=max(1, reserve // 1_000_000),
    )
