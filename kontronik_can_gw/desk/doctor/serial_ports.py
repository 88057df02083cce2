"""Checks the serial port of one ESC: existence, permission, other programs that use it or write to it, even parity."""

import os
import stat
from collections.abc import Callable

from kontronik_can_gw.desk.doctor.devices import Adapter, adapter_of, ports_there, stable_names
from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.line import Line
from kontronik_can_gw.desk.doctor.service import Unit
from kontronik_can_gw.desk.doctor.system import Process, System, User

Look = Callable[[str, bool], Line]
SERVICE_INSTALL = "sudo kontronik-can-gw service install"
_GRABBED_BY_BRLTTY = ("1a86", "10c4", "0403")
_UNSTABLE = ("ttyUSB", "ttyACM")


def check_port(system: System, esc: str, port: str, unit: Unit | None, look: Look) -> list[Finding]:
    """All findings about the port of one ESC. ``unit``: the service that uses it, or None."""
    service = unit.user if unit is not None else None
    findings = Findings(f"Serial port of {esc}")
    status = system.status(port)
    if status is None:
        _missing(system, findings, port)
        return findings.found
    if not stat.S_ISCHR(status.st_mode):
        findings.error("port.exists", f"{port} is not a serial port", _choose(system))
        return findings.found
    real = system.real(port)
    if real.startswith("/dev/pts/"):
        findings.ok("port.exists", f"{port} is a pseudo terminal: a simulated ESC")
        # the simulator has it open too
        holders = [process for process in system.openers(status)[0] if process.is_gateway]
        if not holders and not system.may_open(port):
            findings.error(
                "port.permission",
                f"{system.user.name} may not open it: permission denied",
                "Run simulator and gateway as the same user",
            )
        _users(findings, holders, True)
        return findings.found
    tty = real.rpartition("/")[2]
    if not system.exists(f"/sys/class/tty/{tty}"):
        findings.error("port.exists", f"{port} is not a serial port", _choose(system))
        return findings.found
    adapter = adapter_of(system, tty)
    what = str(adapter)
    findings.ok(
        "port.exists",
        f"{port}{f' is {tty}' if tty not in port else ''}{f': {what}' if what else ''}",
    )
    _name(system, findings, port, tty)
    holders, complete = system.openers(status)
    gateway = any(process.is_gateway for process in holders)
    _permission(system, findings, port, status, service, gateway)
    _device_kind(system, findings, status, unit)
    console = _console(system, findings, tty)
    prompt, getty = _getty(system, findings, tty)
    _meddlers(system, findings, tty, adapter)
    _users(findings, [process for process in holders if process not in getty], complete)
    _power_and_latency(system, findings, tty, adapter, gateway)
    if adapter.mini_uart:
        findings.error(
            "port.parity",
            f"{tty} is the Raspberry Pi's mini-UART, which cannot do even parity",
            'Put dtoverlay=disable-bt into /boot/firmware/config.txt, restart, and use port = "/dev/ttyAMA0"',
            "echo dtoverlay=disable-bt | sudo tee -a /boot/firmware/config.txt",
        )
    elif holders or console or prompt:
        findings.note(
            "port.parity", "even parity was not tried: the port is in use", *_ask_gateway(gateway)
        )
    elif not system.may_open(port):
        findings.note(
            "port.parity",
            f"even parity was not tried: {system.user.name} may not open the port",
            "Run doctor with sudo",
        )
    else:
        _line(findings, look(str(system.path(port)), complete), tty)
    return findings.found


def _missing(system: System, findings: Findings, port: str) -> None:
    there = ports_there(system)
    text = f"{port}: no such port" + (f"; there are {', '.join(there)}" if there else "")
    if port.startswith("/dev/ttyAMA"):
        findings.error(
            "port.exists",
            text,
            "On a Raspberry Pi: enable_uart=1 and dtoverlay=disable-bt in config.txt",
        )
        return
    remedy = (
        "Plug in the adapter, or name another port"
        if not there
        else "Plug in the adapter, or name one of these"
    )
    findings.error("port.exists", text, remedy, "ls -l /dev/serial/by-id")


def _choose(system: System) -> str:
    there = ports_there(system)
    return (
        f"Name one of these as esc.port: {', '.join(there)}"
        if there
        else "Name the adapter's port as esc.port"
    )


def _name(system: System, findings: Findings, port: str, tty: str) -> None:
    if not tty.startswith(_UNSTABLE) or not port.startswith(f"/dev/{tty}"):
        findings.ok("port.name", "the name stays the same when adapters are replugged")
        return
    better = stable_names(system, port)
    text = f"{tty} may be another adapter after replugging or a restart"
    if better:
        findings.warning("port.name", text, f'Write port = "{better[0]}"')
    else:
        findings.warning(
            "port.name",
            text,
            "udev makes names that stay, in /dev/serial; here it made none:",
            "systemctl status systemd-udevd",
        )


def _permission(
    system: System,
    findings: Findings,
    port: str,
    status: os.stat_result,
    service: User | None,
    gateway: bool,
) -> None:
    """Check that the gateway's user may open the port: the service's user, that of a running gateway, else the current one."""
    group, me = system.group_name(status.st_gid), system.user.name
    shared = status.st_mode & 0o060 == 0o060 and status.st_gid != 0
    open_to_group = f"sudo chgrp dialout {port} && sudo chmod g+rw {port}"
    if service is not None and service.may(status, 6):
        findings.ok(
            "port.permission", f"the service's user {service.name} may open it (group {group})"
        )
    elif service is not None:
        command = (
            f"sudo usermod -aG {group} {service.name}"
            if shared and service.uid > 0
            else open_to_group
        )
        findings.error(
            "port.permission", f"the service's user {service.name} may not open it", "", command
        )
    if system.may_open(port):
        if service is None:
            findings.ok("port.permission", f"{me} may open it (group {group})")
        return
    remedy, command = "Let its group use it; a udev rule makes that last:", open_to_group
    if shared:
        remedy, command = "Join its group, then log in again:", f"sudo usermod -aG {group} {me}"
    if service is None and not gateway:
        findings.error(
            "port.permission", f"{me} may not open it: permission denied", remedy, command
        )
    else:
        findings.note(
            "port.permission", f"{me} may not open it, only the gateway can", remedy, command
        )


def _device_kind(
    system: System, findings: Findings, status: os.stat_result, unit: Unit | None
) -> None:
    """Check that the unit's DeviceAllow covers the port, by the names in /proc/devices."""
    if unit is None or unit.devices is None:
        return
    lines = (
        line.split()
        for line in (system.text("/proc/devices") or "").partition("Block")[0].splitlines()
    )
    kinds = [
        f"char-{words[1]}"
        for words in lines
        if len(words) == 2 and words[0] == str(os.major(status.st_rdev))
    ]
    if kinds and not set(kinds) & set(unit.devices):
        text = f"{unit.name} may not use this kind of device ({kinds[0]})"
        findings.error(
            "port.device_kind",
            text,
            f"Add DeviceAllow={kinds[0]} rw:",
            f"sudo systemctl edit {unit.name}",
        )


def _console(system: System, findings: Findings, tty: str) -> bool:
    """Check that the port is no kernel console, whose messages would reach the ESC."""
    words = (system.text("/proc/cmdline") or "").split()
    named = [
        word for word in words if word.startswith("console=") and word[8:].partition(",")[0] == tty
    ]
    active = tty in (system.text("/sys/class/tty/console/active") or "").split()
    if named or active:
        word = named[0] if named else f"console={tty}"
        findings.error(
            "port.console",
            f"{tty} is a console of the kernel ({word}): its messages are sent to the ESC",
            f"Remove {word} from the kernel's command line (cmdline.txt, or GRUB_CMDLINE_LINUX) and restart; on a Raspberry Pi:",
            "sudo raspi-config nonint do_serial_cons 1",
        )
        return True
    findings.ok("port.console", "no console of the kernel")
    return False


def _getty(system: System, findings: Findings, tty: str) -> tuple[bool, list[Process]]:
    """Check for a login prompt on the port; return whether there is one, and its programs."""
    found = [
        p
        for p in system.processes
        if "getty" in p.name and any(w.rpartition("/")[2] == tty for w in p.words[1:])
    ]
    unit = f"serial-getty@{tty}"
    active = bool(
        system.has_systemd
        and (system.run("systemctl", "is-active", unit) or "").strip() == "active"
    )
    if found or active:
        who = ", ".join(map(str, found)) or unit
        findings.error(
            "port.getty",
            f"a login prompt is on this port ({who}): it writes to the ESC",
            "",
            f"sudo systemctl disable --now {unit}; sudo systemctl mask {unit}",
        )
    else:
        findings.ok("port.getty", "no login prompt (getty)")
    return bool(found or active), found


def _meddlers(system: System, findings: Findings, tty: str, adapter: Adapter) -> None:
    """Check for services that open serial adapters by themselves."""
    if not adapter.usb:
        return
    names = {process.name for process in system.processes}
    if "ModemManager" in names:
        facts = system.run("udevadm", "info", "--query=property", f"--name=/dev/{tty}") or ""
        if "ID_MM_DEVICE_IGNORE=1" in facts.split() or "ID_MM_PORT_IGNORE=1" in facts.split():
            findings.ok("port.modem_manager", "ModemManager leaves this adapter alone")
        else:
            findings.warning(
                "port.modem_manager",
                "ModemManager runs, and may send modem commands to new adapters",
                "Its udev rule keeps ModemManager away:",
                SERVICE_INSTALL,
            )
    if "brltty" in names and adapter.vendor_id in _GRABBED_BY_BRLTTY:
        findings.warning(
            "port.brltty",
            "brltty runs, and takes such adapters for Braille displays",
            "",
            "sudo apt remove brltty",
        )


def _users(findings: Findings, holders: list[Process], complete: bool) -> None:
    others = [process for process in holders if not process.is_gateway]
    if others:
        who = ", ".join(map(str, others))
        command = f"kill {' '.join(str(process.pid) for process in others)}"
        findings.error(
            "port.users", f"in use by {who}", "End it, and what starts it again:", command
        )
    for process in holders:
        if process.is_gateway:
            findings.note("port.users", f"in use by {process}")
    if not holders:
        if complete:
            findings.ok("port.users", "nobody else has it open")
        else:
            findings.note(
                "port.users",
                "nobody seems to have it open; only root can see all",
                "Run doctor with sudo",
            )


def _ask_gateway(gateway: bool) -> tuple[str, str]:
    return (
        ("The gateway has set it, or has said why it cannot:", "kontronik-can-gw status")
        if gateway
        else ("", "")
    )


def _power_and_latency(
    system: System, findings: Findings, tty: str, adapter: Adapter, gateway: bool
) -> None:
    latency = system.number(f"/sys/class/tty/{tty}/device/latency_timer")
    if latency is not None and latency > 1 and gateway:  # which asked for less
        text = f"latency timer {latency} ms: the adapter holds bytes back that long"
        findings.warning(
            "port.latency", text, "", f"echo 1 | sudo tee /sys/class/tty/{tty}/device/latency_timer"
        )
    elif latency is not None:
        asks = "; the gateway asks for 1 ms when it opens the port" if latency > 1 else ""
        findings.ok("port.latency", f"latency timer {latency} ms{asks}")
    control = f"{adapter.usb}/power/control"
    if adapter.usb and system.text(control) == "auto":
        findings.note(
            "port.autosuspend",
            "the USB adapter may be suspended to save power",
            "",
            f"echo on | sudo tee {control}",
        )


def _line(findings: Findings, line: Line, tty: str) -> None:
    if line.busy:
        findings.note(
            "port.parity",
            "even parity was not tried: somebody has the port for himself",
            "Run doctor with sudo",
        )
        return
    if line.trouble is not None:
        findings.error("port.parity", f"{tty} cannot be opened: {line.trouble}")
        return
    if line.even_parity is None:
        findings.note(
            "port.parity",
            "even parity was not tried: somebody has set the port up and may use it",
            "Run doctor with sudo",
        )
    elif line.even_parity:
        findings.ok("port.parity", "takes 115200 baud, 8 data bits, even parity, 1 stop bit")
    else:
        findings.error(
            "port.parity",
            f"{tty} does not take 115200 baud with even parity",
            "Use another port or a USB adapter (FTDI)",
        )
    if line.errors:
        counts = ", ".join(f"{number} {name}" for name, number in line.errors.items())
        findings.note(
            "port.line_errors",
            f"line errors counted so far: {counts}",
            "Normal if the port had other settings before. If they grow while the gateway runs: check ground, cable, baud rate",
        )
    elif line.counts:
        findings.ok("port.line_errors", "no line errors counted")
