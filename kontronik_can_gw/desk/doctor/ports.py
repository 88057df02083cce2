"""Checks the serial port of one ESC: existence, permission, other programs that use it or write to it.

No port is opened: whether it takes the ESC's line settings is known once the gateway runs.
"""

import os
import stat
from collections.abc import Mapping
from typing import Any

from kontronik_can_gw.desk.doctor import Finding, Findings
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.printable import printable
from kontronik_can_gw.runtime.ports.serial_port import is_mini_uart

_RULES = "udev/rules.d/70-kontronik-can-gw.rules"
"""Keeps ModemManager away."""


def diagnoses(document: Mapping[str, Any] | None) -> dict[str, str]:
    """Why the ESCs of a running gateway are not heard, by name, from its status document."""
    escs = [] if document is None else document["escs"]
    return {esc["name"]: printable(str(esc["diagnosis"])) for esc in escs if esc["diagnosis"]}


def check_port(
    machine: Machine, esc: str, port: str, even_parity: bool, diagnosis: str = ""
) -> list[Finding]:
    """Returns all findings about the port of one ESC.

    ``even_parity``: its line needs that. ``diagnosis``: why the gateway that runs does not hear it.
    """
    real, status = machine.real(port), machine.status(port)
    tty = real.rpartition("/")[2]
    findings = Findings(f"Serial port of {esc}", port=port, tty=tty, user=machine.user)
    hardware, is_pty = f"/sys/class/tty/{tty}", real.startswith("/dev/pts/")
    is_tty = status is not None and stat.S_ISCHR(status.st_mode)
    if status is None or not is_tty or not (is_pty or machine.exists(hardware)):
        named = ", ".join(machine.names("/dev/serial/by-id"))
        there = f"; in /dev/serial/by-id there are {named}" if named else ""
        findings.say("port.exists", "no_port" if status else "none", there=there)
        return findings.found
    usb = _adapter(machine, machine.real(f"{hardware}/device"))
    product = machine.text(f"{usb}/product") if usb else ""
    what = ", ".join(filter(None, [tty, product]))
    findings.say("port.exists", "pty" if is_pty else "ok", what=what)
    if diagnosis:
        findings.say("port.telemetry", "none", diagnosis=diagnosis)
    case = "ok"
    if not machine.may(port, os.R_OK | os.W_OK):
        is_shared = status.st_mode & 0o060 == 0o060 and status.st_gid != 0
        case = "gateway" if machine.runs_gateway else "join" if is_shared else "open"
    findings.say("port.permission", case, group=machine.group_name(status.st_gid))
    _users(machine, findings, status, is_pty)
    if is_pty:
        return findings.found
    if usb and port.startswith("/dev/tty"):
        better = _stable_name(machine, real, usb)
        findings.say("port.name", "unstable" if better else "no_udev", better=better)
    _writers(machine, findings, tty, usb)
    if even_parity and is_mini_uart(f"/dev/{tty}", machine.root):
        findings.say("port.parity", "mini_uart")
    return findings.found


def _adapter(machine: Machine, folder: str) -> str:
    """The folder of the USB adapter that a tty belongs to; empty for others."""
    while folder.count("/") > 2 and not machine.exists(f"{folder}/idVendor"):
        folder = folder.rpartition("/")[0]
    return folder if folder.count("/") > 2 else ""


def _stable_name(machine: Machine, real: str, usb: str) -> str:
    """A name by the adapter's serial number if it has one, else by the USB socket."""
    kinds = ("by-id", "by-path") if machine.text(f"{usb}/serial") else ("by-path", "by-id")
    folders = [f"/dev/serial/{kind}" for kind in kinds]
    names = [f"{folder}/{name}" for folder in folders for name in machine.names(folder)]
    return next((name for name in names if machine.real(name) == real), "")


def _users(machine: Machine, findings: Findings, status: os.stat_result, is_pty: bool) -> None:
    """Report who has the port open; of a pseudo terminal the simulator has it, too. A getty is reported below."""
    holders = [each for each in machine.openers(status) if "getty" not in each.name]
    own = [each for each in holders if each.is_gateway]
    others = [] if is_pty else [each for each in holders if not each.is_gateway]
    for process in own:
        findings.say("port.users", "gateway", who=process)
    if others:
        pids = " ".join(str(process.pid) for process in others)
        findings.say("port.users", "others", who=", ".join(map(str, others)), pids=pids)
    if not own and not others:
        findings.say("port.users", "ok" if is_pty or machine.user == "root" else "unseen")


def _writers(machine: Machine, findings: Findings, tty: str, usb: str) -> None:
    """Check that no console of the kernel, no login prompt and no service writes to the ESC."""
    is_console = tty in machine.text("/sys/class/tty/console/active").split()
    findings.say("port.console", "console" if is_console else "ok")
    prompts = [
        str(process)
        for process in machine.processes
        if "getty" in process.name and tty in [w.rpartition("/")[2] for w in process.words[1:]]
    ]
    findings.say("port.getty", "getty" if prompts else "ok", who=", ".join(prompts))
    names = {process.name for process in machine.processes} if usb else set()
    if "ModemManager" in names and not any(
        machine.exists(f"{top}/{_RULES}") for top in ("/etc", "/usr/lib", "/lib")
    ):
        findings.say("port.modem_manager", "runs")
    if "brltty" in names:
        findings.say("port.brltty", "runs")
