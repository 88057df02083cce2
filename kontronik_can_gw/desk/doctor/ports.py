"""Checks the serial port of one ESC: existence, permission, and other programs that use it.

No port is opened. So only a running gateway shows if the port accepts the ESC's line settings.
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
"""These rules prevent ModemManager from using the ports."""


def diagnoses(document: Mapping[str, Any] | None) -> dict[str, str]:
    """Return the reasons for missing telemetry, by ESC, from a gateway's status document."""
    return {
        esc["name"]: printable(str(esc["diagnosis"]))
        for esc in (document or {"escs": ()})["escs"]
        if esc["diagnosis"]
    }


def check_port(
    machine: Machine,
    esc: str,
    port: str,
    even_parity: bool,
    diagnosis: str = "",
) -> list[Finding]:
    """Return all findings about the port of one ESC.

    ``even_parity`` is True if the ESC needs even parity. ``diagnosis`` is the reason why a running
    gateway receives no telemetry from it.
    """
    real = machine.real(port)
    status = machine.status(port)
    tty = real.rpartition("/")[2]
    findings = Findings(
        f"Serial port of {esc}",
        port=port,
        tty=tty,
        user=machine.user,
    )
    hardware = f"/sys/class/tty/{tty}"
    is_pty = real.startswith("/dev/pts/")
    if status is None or not _is_port(machine, status, hardware, is_pty):
        names = ", ".join(machine.names("/dev/serial/by-id"))
        there = f". Available in /dev/serial/by-id: {names}" if names else ""
        findings.add("port.exists", "no_port" if status else "none", there=there)
        return findings.found
    usb = _adapter(machine, machine.real(f"{hardware}/device"))
    product = machine.text(f"{usb}/product") if usb else ""
    what = ", ".join(filter(None, [tty, product]))
    findings.add("port.exists", "pty" if is_pty else "ok", what=what)
    if diagnosis:
        findings.add("port.telemetry", "none", diagnosis=diagnosis)
    group = machine.group_name(status.st_gid)
    findings.add("port.permission", _permission(machine, port, status), group=group)
    _check_users(
        machine,
        findings,
        status,
        is_pty,
    )
    if is_pty:
        return findings.found
    if usb:
        if port.startswith("/dev/tty"):
            better = _stable_name(machine, real, usb)
            findings.add("port.name", "unstable" if better else "no_udev", better=better)
        _check_probing_services(machine, findings)
    _check_consoles(machine, findings, tty)
    if even_parity and is_mini_uart(f"/dev/{tty}", machine.root):
        findings.add("port.parity", "mini_uart")
    return findings.found


def _is_port(machine: Machine, status: os.stat_result, hardware: str, is_pty: bool) -> bool:
    """Return True for a pseudo terminal, and for a terminal with hardware."""
    if not stat.S_ISCHR(status.st_mode):
        return False
    return is_pty or machine.exists(hardware)


def _permission(machine: Machine, port: str, status: os.stat_result) -> str:
    """Return the case of the check ``port.permission``."""
    if machine.may(port, os.R_OK | os.W_OK):
        return "ok"
    if machine.has_gateway:
        return "gateway"
    has_group_access = status.st_mode & 0o060 == 0o060
    if has_group_access and status.st_gid != 0:
        return "join"
    return "open"


def _adapter(machine: Machine, folder: str) -> str:
    """Return the folder of a tty's USB adapter. Empty if the tty is not a USB adapter."""
    while folder.count("/") > 2 and not machine.exists(f"{folder}/idVendor"):
        folder = folder.rpartition("/")[0]
    if folder.count("/") <= 2:
        return ""
    return folder


def _stable_name(machine: Machine, real: str, usb: str) -> str:
    """Return a stable name of a port. Empty if there is none.

    It contains the adapter's serial number if it has one, and otherwise the USB socket.
    """
    kinds = ["by-id", "by-path"]
    if not machine.text(f"{usb}/serial"):
        kinds.reverse()
    for kind in kinds:
        folder = f"/dev/serial/{kind}"
        for name in machine.names(folder):
            if machine.real(f"{folder}/{name}") == real:
                return f"{folder}/{name}"
    return ""


def _check_users(
    machine: Machine,
    findings: Findings,
    status: os.stat_result,
    is_pty: bool,
) -> None:
    """Report the programs that have the port open.

    The simulator has a pseudo terminal open, too. A getty is reported by another check.
    """
    users = [process for process in machine.openers(status) if "getty" not in process.name]
    own = [process for process in users if process.is_gateway]
    others = [process for process in users if not process.is_gateway and not is_pty]
    for process in own:
        findings.add("port.users", "gateway", who=process)
    if others:
        who = ", ".join(map(str, others))
        pids = " ".join(str(process.pid) for process in others)
        findings.add(
            "port.users",
            "others",
            who=who,
            pids=pids,
        )
    if not own and not others:
        sees_all = is_pty or machine.user == "root"
        findings.add("port.users", "ok" if sees_all else "unseen")


def _check_consoles(machine: Machine, findings: Findings, tty: str) -> None:
    """Check that no console of the kernel and no login prompt writes to the ESC."""
    consoles = machine.text("/sys/class/tty/console/active").split()
    findings.add("port.console", "console" if tty in consoles else "ok")
    prompts = []
    for process in machine.processes:
        arguments = [word.rpartition("/")[2] for word in process.words[1:]]
        if "getty" in process.name and tty in arguments:
            prompts.append(str(process))
    findings.add("port.getty", "getty" if prompts else "ok", who=", ".join(prompts))


def _check_probing_services(machine: Machine, findings: Findings) -> None:
    """Check that no service sends bytes to USB adapters to find out what they are."""
    names = {process.name for process in machine.processes}
    places = [f"{top}/{_RULES}" for top in ("/etc", "/usr/lib", "/lib")]
    has_rules = any(map(machine.exists, places))
    if "ModemManager" in names and not has_rules:
        findings.add("port.modem_manager", "runs")
    if "brltty" in names:
        findings.add("port.brltty", "runs")
