"""Checks the serial port of one ESC: existence, permission, other programs that use it or write to it.

No port is opened: whether it takes the ESC's line settings is known once the gateway runs.
"""

import os
import stat

from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.machine import Machine, Process
from kontronik_can_gw.runtime.serial_port import is_mini_uart

_OPENERS = {"ModemManager": "port.modem_manager", "brltty": "port.brltty"}
"""Services that open serial adapters by themselves, and their checks."""


def check_port(machine: Machine, esc: str, port: str, even_parity: bool) -> list[Finding]:
    """All findings about the port of one ESC. ``even_parity``: its line needs that."""
    real, status = machine.real(port), machine.status(port)
    tty = real.rpartition("/")[2]
    findings = Findings(f"Serial port of {esc}", port=port, tty=tty, user=machine.user)
    hardware = f"/sys/class/tty/{tty}"
    is_pty = real.startswith("/dev/pts/")
    if (
        status is None
        or not stat.S_ISCHR(status.st_mode)
        or not (is_pty or machine.exists(hardware))
    ):
        there = ", ".join(_ports(machine))
        case = "no_port" if status else "pi" if tty.startswith("ttyAMA") else "none"
        findings.say("port.exists", case, there=f"; there are {there}" if there else "")
        return findings.found
    holders, complete = machine.openers(status)
    if is_pty:  # the simulator has it open too
        holders = [process for process in holders if process.is_gateway]
    usb = _adapter(machine, machine.real(f"{hardware}/device"))
    product = machine.text(f"{usb}/product") if usb else ""
    case = "pty" if is_pty else "ok"
    findings.say("port.exists", case, what=", ".join(filter(None, [tty, product])))
    _permission(machine, findings, status, holders)
    _users(findings, holders, complete or is_pty)
    if is_pty:
        return findings.found
    _name(machine, findings, port, usb)
    _writers(machine, findings, tty)
    _openers(machine, findings, tty, usb)
    if even_parity and is_mini_uart(f"/dev/{tty}", machine.root):
        findings.say("port.parity", "mini_uart")
    return findings.found


def _ports(machine: Machine) -> list[str]:
    """Serial ports usable for an ESC, by their most stable names."""
    found = []
    for tty in machine.names("/sys/class/tty"):
        folder = f"/sys/class/tty/{tty}"
        # Linux creates ttyS0..3 even without hardware; then the type is 0
        if machine.exists(f"{folder}/device") and machine.text(f"{folder}/type") != "0":
            usb = _adapter(machine, machine.real(f"{folder}/device"))
            found.append(_stable_name(machine, f"/dev/{tty}", usb) or f"/dev/{tty}")
    return found


def _adapter(machine: Machine, folder: str) -> str:
    """The folder of the USB adapter that a tty belongs to; empty for others."""
    while folder.count("/") > 2 and not machine.exists(f"{folder}/idVendor"):
        folder = folder.rpartition("/")[0]
    return folder if folder.count("/") > 2 else ""


def _stable_name(machine: Machine, port: str, usb: str) -> str:
    """A name by the adapter's serial number if it has one, else by the USB socket."""
    kinds = ("by-id", "by-path") if machine.text(f"{usb}/serial") else ("by-path", "by-id")
    names = [f"/dev/serial/{kind}" for kind in kinds]
    all_names = [f"{folder}/{name}" for folder in names for name in machine.names(folder)]
    real = machine.real(port)
    return next((name for name in all_names if machine.real(name) == real), "")


def _name(machine: Machine, findings: Findings, port: str, usb: str) -> None:
    if usb and port.startswith("/dev/tty"):
        better = _stable_name(machine, port, usb)
        findings.say("port.name", "unstable" if better else "no_udev", better=better)


def _permission(
    machine: Machine, findings: Findings, status: os.stat_result, holders: list[Process]
) -> None:
    """Check that this user may open the port."""
    may = machine.may(str(findings.values["port"]), os.R_OK | os.W_OK)
    is_shared = status.st_mode & 0o060 == 0o060 and status.st_gid != 0
    case = "ok" if may else "join" if is_shared else "open"
    if not may and any(process.is_gateway for process in holders):
        case = "gateway"
    findings.say("port.permission", case, group=machine.group_name(status.st_gid))


def _users(findings: Findings, holders: list[Process], complete: bool) -> None:
    """Report who has the port open."""
    others = [
        process for process in holders if not process.is_gateway and "getty" not in process.name
    ]
    for process in (process for process in holders if process.is_gateway):
        findings.say("port.users", "gateway", who=process)
    if others:
        pids = " ".join(str(process.pid) for process in others)
        findings.say("port.users", "others", who=", ".join(map(str, others)), pids=pids)
    if not holders:
        findings.say("port.users", "ok" if complete else "unseen")


def _writers(machine: Machine, findings: Findings, tty: str) -> None:
    """Check that neither a kernel console nor a login prompt writes to the ESC."""
    words = [word.partition(",")[0] for word in machine.text("/proc/cmdline").split()]
    active = machine.text("/sys/class/tty/console/active").split()
    is_console = f"console={tty}" in words or tty in active
    findings.say("port.console", "console" if is_console else "ok")
    unit = f"serial-getty@{tty}"
    prompts = [
        str(process)
        for process in machine.processes.values()
        if "getty" in process.name and tty in [w.rpartition("/")[2] for w in process.words[1:]]
    ]
    if machine.has_systemd and machine.run("systemctl", "is-active", unit).strip() == "active":
        prompts = prompts or [unit]
    findings.say("port.getty", "getty" if prompts else "ok", who=", ".join(prompts), unit=unit)


def _openers(machine: Machine, findings: Findings, tty: str, usb: str) -> None:
    """Check for services that open serial adapters by themselves."""
    names = {process.name for process in machine.processes.values()} if usb else set()
    for name in sorted(names & set(_OPENERS)):
        asked = ("udevadm", "info", "--query=property", f"--name=/dev/{tty}")
        is_left = name == "ModemManager" and "ID_MM_DEVICE_IGNORE=1" in machine.run(*asked).split()
        findings.say(_OPENERS[name], "ok" if is_left else "runs")
