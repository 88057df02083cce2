"""Checks the installed systemd service: the unit that runs a configuration, its user and its state."""

from dataclasses import dataclass
from pathlib import PurePath

from kontronik_can_gw.desk.doctor.findings import Findings
from kontronik_can_gw.desk.doctor.system import System, User
from kontronik_can_gw.runtime.locks import SYSTEM_FOLDER

NAME = "kontronik-can-gw"
_FOLDER = f"/etc/{NAME}"
_SHOWN = (
    "LoadState,ActiveState,SubState,UnitFileState,NRestarts,Result,User,DynamicUser,SupplementaryGroups,"
    "ProtectSystem,ProtectHome,ReadWritePaths,DevicePolicy,DeviceAllow"
)


@dataclass(frozen=True)
class Unit:
    """A systemd unit."""

    name: str
    user: User | None
    """None: unknown."""
    state: str
    """active, failed, inactive ..."""
    detail: str
    enabled: bool
    restarts: int
    strict: bool = False
    """True if all folders but its own and ``writable`` are read-only for it."""
    writable: tuple[str, ...] = ()
    hides_homes: bool = False
    devices: tuple[str, ...] | None = None
    """Kinds of devices that it may use, as char-ttyUSB; None: all kinds."""

    @property
    def state_folder(self) -> str:
        """Default folder of its stored parameters."""
        return f"/var/lib/{self.name.removesuffix('.service').replace('@', '-')}"


def unit_of(system: System, config: str) -> Unit | None:
    """The unit for a configuration file; None where systemd has none."""
    path = PurePath(config)
    instance = path.stem if str(path.parent) == _FOLDER and path.stem != "gateway" else ""
    name = f"{NAME}@{instance}.service" if instance else f"{NAME}.service"
    if not system.has_systemd:
        return None
    lines = (system.run("systemctl", "show", name, f"--property={_SHOWN}") or "").splitlines()
    shown: dict[str, str] = {}
    for key, _, value in (line.partition("=") for line in lines):
        # DeviceAllow has one line for each kind
        shown[key] = f"{shown[key]} {value}" if key in shown else value
    if shown.get("LoadState") != "loaded":
        return None
    groups, user = tuple(shown.get("SupplementaryGroups", "").split()), shown.get("User", "")
    who = system.user_named(user or "root", groups)
    if who is None and shown.get("DynamicUser") == "yes":
        who = system.dynamic_user(user or NAME, groups)
    restarts = shown.get("NRestarts", "0")
    return Unit(
        name,
        who,
        shown.get("ActiveState", ""),
        f"{shown.get('SubState', '')}, result {shown.get('Result', '')}",
        shown.get("UnitFileState", "").startswith("enabled"),
        int(restarts) if restarts.isdigit() else 0,
        shown.get("ProtectSystem") == "strict",
        tuple(path.lstrip("-+") for path in shown.get("ReadWritePaths", "").split()),
        shown.get("ProtectHome") in ("yes", "tmpfs"),
        tuple(shown.get("DeviceAllow", "").split()[::2])
        if shown.get("DevicePolicy") in ("closed", "strict")
        else None,
    )


def check_service(system: System, findings: Findings, unit: Unit | None) -> None:
    """Check whether it is installed, enabled and running, and how often it was restarted."""
    if unit is None:
        findings.say("machine.service", "none" if system.has_systemd else "no_systemd")
        return
    case = "ok"
    if unit.state == "failed":
        case = "failed"
    elif unit.state not in ("active", "reloading"):
        case = "stopped"
    elif unit.restarts:
        case = "restarted"
    findings.say(
        "machine.service",
        case,
        unit=unit.name,
        detail=unit.detail,
        state=unit.state,
        restarts=unit.restarts,
    )
    folder = system.status(str(SYSTEM_FOLDER))
    if folder is None or (unit.user is not None and not unit.user.may(folder, 7)):
        findings.say("machine.locks", "none", folder=SYSTEM_FOLDER)
    if not unit.enabled:
        findings.say("machine.service_enabled", "no", unit=unit.name)
