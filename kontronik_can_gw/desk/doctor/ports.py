"""Checks the serial port of one ESC: existence, permission, other programs that use it or write to it, even parity.

A free port is opened for a moment. Nothing is written, and the settings of a port that another program may use are not changed. The
settings used, 115200 baud with even parity and without echo, are those of the gateway and are kept: an echo would be sent to the ESC.
"""

import contextlib
import errno
import os
import stat
import termios
from collections.abc import Callable, Mapping

from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.machine import Machine, Process
from kontronik_can_gw.desk.doctor.service import Unit
from kontronik_can_gw.runtime.serial_port import is_mini_uart, line_errors

Look = Callable[[str, bool], tuple[str, Mapping[str, int]]]
_OPENERS = {"ModemManager": "port.modem_manager", "brltty": "port.brltty"}
"""Services that open serial adapters by themselves, and their checks."""
_STICKY_PARITY = 0o10000000000


def check_port(
    machine: Machine, esc: str, port: str, unit: Unit | None, look: Look | None
) -> list[Finding]:
    """All findings about the port of one ESC. ``unit``: the service that uses it, or None. ``look`` None: no parity is needed."""
    real, status = machine.real(port), machine.status(port)
    tty = real.rpartition("/")[2]
    findings = Findings(f"Serial port of {esc}", port=port, tty=tty, user=machine.user.name)
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
    _permission(machine, findings, status, unit, holders)
    in_use = _users(findings, holders, complete or is_pty)
    if is_pty:
        return findings.found
    _name(machine, findings, port, usb)
    in_use |= _writers(machine, findings, tty)
    _openers(machine, findings, tty, usb)
    if look is not None:
        if is_mini_uart(f"/dev/{tty}", machine.root):
            findings.say("port.parity", "mini_uart")
        elif in_use:
            findings.say("port.parity", "in_use")
        elif not machine.may(port, os.R_OK | os.W_OK):
            findings.say("port.parity", "closed")
        else:
            _line(findings, *look(str(machine.path(port)), complete))
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
    machine: Machine,
    findings: Findings,
    status: os.stat_result,
    unit: Unit | None,
    holders: list[Process],
) -> None:
    """Check that the gateway may open the port: the service's user, a gateway that runs, else this user."""
    who = machine.user if unit is None or unit.user is None else unit.user
    may = machine.may(str(findings.values["port"]), os.R_OK | os.W_OK)
    if who is not machine.user:
        may = who.may(status, 6)
    is_shared = status.st_mode & 0o060 == 0o060 and status.st_gid != 0
    group = machine.group_name(status.st_gid)
    case = "ok" if may else "join" if is_shared else "open"
    if not may and who is machine.user and any(process.is_gateway for process in holders):
        case = "gateway"
    findings.say("port.permission", case, user=who.name, group=group)
    # the names in /proc/devices are those of DeviceAllow
    characters = machine.text("/proc/devices").partition("Block")[0].splitlines()
    kinds = {
        words[0]: f"char-{words[1]}" for words in map(str.split, characters) if len(words) == 2
    }
    kind = kinds.get(str(os.major(status.st_rdev)))
    if unit and unit.devices is not None and kind and kind not in unit.devices:
        findings.say("port.device_kind", "closed", unit=unit.name, kind=kind)


def _users(findings: Findings, holders: list[Process], complete: bool) -> bool:
    """Report who has the port open; True if somebody has."""
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
    return bool(holders)


def _writers(machine: Machine, findings: Findings, tty: str) -> bool:
    """Check that neither a kernel console nor a login prompt writes to the ESC; True if one does."""
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
    return is_console or bool(prompts)


def _openers(machine: Machine, findings: Findings, tty: str, usb: str) -> None:
    """Check for services that open serial adapters by themselves."""
    names = {process.name for process in machine.processes.values()} if usb else set()
    for name in sorted(names & set(_OPENERS)):
        asked = ("udevadm", "info", "--query=property", f"--name=/dev/{tty}")
        is_left = name == "ModemManager" and "ID_MM_DEVICE_IGNORE=1" in machine.run(*asked).split()
        findings.say(_OPENERS[name], "ok" if is_left else "runs")


def _line(findings: Findings, result: str, errors: Mapping[str, int]) -> None:
    known = result in ("ok", "none", "exclusive", "set_up")
    findings.say("port.parity", result if known else "trouble", trouble=result)
    seen = [f"{n} {kind.replace('_', ' ')}" for kind, n in errors.items() if n]
    if errors:
        findings.say("port.line_errors", "some" if seen else "ok", counts=", ".join(seen))


def look(path: str, alone: bool) -> tuple[str, Mapping[str, int]]:
    """Open a port for a moment and try even parity; the case of port.parity, or what went wrong, and line errors counted so far.

    ``alone``: no other program has it open; otherwise parity is tried only on an unconfigured port.
    """
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        return "exclusive" if error.errno == errno.EBUSY else error.strerror or str(error), {}
    try:
        return _try_even_parity(fd, alone), line_errors(fd)
    except termios.error as error:
        return f"is not a working serial port ({error.args[-1]})", {}
    finally:
        os.close(fd)


def _try_even_parity(fd: int, alone: bool) -> str:
    """Set 115200 baud, 8E1, raw, and read it back."""
    mode = termios.tcgetattr(fd)
    if not alone and not mode[3] & termios.ICANON and not _is_ours(mode):
        return "set_up"  # another program has configured it
    mode[0] = mode[3] = 0
    mode[1] &= ~termios.OPOST
    mode[2] &= ~(termios.CSIZE | termios.CSTOPB | termios.PARODD | termios.CRTSCTS | _STICKY_PARITY)
    mode[2] |= termios.CS8 | termios.PARENB | termios.CREAD | termios.CLOCAL
    mode[4] = mode[5] = termios.B115200
    with contextlib.suppress(termios.error):  # the result is read back
        termios.tcsetattr(fd, termios.TCSANOW, mode)
    return "ok" if _is_ours(termios.tcgetattr(fd)) else "none"


def _is_ours(mode: list[int]) -> bool:
    seen = mode[2] & (termios.CSIZE | termios.PARENB | termios.PARODD | termios.CSTOPB)
    return seen == termios.CS8 | termios.PARENB and mode[4] == termios.B115200
