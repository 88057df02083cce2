"""Checks the serial port of one ESC: existence, permission, other programs that use it or write to it, even parity."""

import os
import stat
from collections.abc import Callable

from kontronik_can_gw.desk.doctor.devices import Adapter, adapter_of, ports_there, stable_names
from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.line import Line
from kontronik_can_gw.desk.doctor.service import Unit
from kontronik_can_gw.desk.doctor.system import Process, System, User
from kontronik_can_gw.runtime.serial_port import is_mini_uart

Look = Callable[[str, bool], Line]
_GRABBED_BY_BRLTTY = ("1a86", "10c4", "0403")
_UNSTABLE = ("ttyUSB", "ttyACM")
_READ_AND_WRITE = 6


def check_port(
    system: System, esc: str, port: str, unit: Unit | None, look: Look | None
) -> list[Finding]:
    """All findings about the port of one ESC. ``unit``: the service that uses it, or None. ``look`` None: no parity is needed."""
    status, real = system.status(port), system.real(port)
    tty = real.rpartition("/")[2]
    findings = Findings(f"Serial port of {esc}", port=port, tty=tty, user=system.user.name)
    if status is None:
        _missing(system, findings, port)
    elif real.startswith("/dev/pts/") and stat.S_ISCHR(status.st_mode):
        _pseudo_terminal(system, findings, port, status)
    elif stat.S_ISCHR(status.st_mode) and system.exists(f"/sys/class/tty/{tty}"):
        _Port(system, findings, port, tty, status).check(unit, look)
    else:
        there = ", ".join(ports_there(system))
        choose = f"Name one of these as esc.port: {there}"
        if not there:
            choose = "Name the adapter's port as esc.port"
        findings.say("port.exists", "no_port", choose=choose)
    return findings.found


def _missing(system: System, findings: Findings, port: str) -> None:
    names = ports_there(system)
    there = f"; there are {', '.join(names)}" if names else ""
    case = "others" if names else "none"
    if port.startswith("/dev/ttyAMA"):
        case = "pi"
    findings.say("port.exists", case, there=there)


def _pseudo_terminal(system: System, findings: Findings, port: str, status: os.stat_result) -> None:
    findings.say("port.exists", "pty")
    # the simulator has it open too
    holders = [process for process in system.openers(status)[0] if process.is_gateway]
    if not holders and not system.may_open(port):
        findings.say("port.permission", "pty")
    _users(findings, holders, True)


class _Port:
    """The checks of a port that is a tty of hardware."""

    def __init__(
        self, system: System, findings: Findings, port: str, tty: str, status: os.stat_result
    ) -> None:
        self._system = system
        self._say = findings.say
        self._findings = findings
        self._port, self._tty, self._status = port, tty, status
        self._adapter: Adapter = adapter_of(system, tty)
        self._holders, self._complete = system.openers(status)
        self._has_gateway = any(process.is_gateway for process in self._holders)

    def check(self, unit: Unit | None, look: Look | None) -> None:
        """All of them, in the order of the report."""
        what = str(self._adapter)
        real = f" is {self._tty}" if self._tty not in self._port else ""
        self._say("port.exists", "ok", real=real, adapter=f": {what}" if what else "")
        self._name()
        self._permission(unit.user if unit is not None else None)
        self._device_kind(unit)
        is_console = self._console()
        has_prompt, prompts = self._getty()
        self._meddlers()
        others = [process for process in self._holders if process not in prompts]
        _users(self._findings, others, self._complete)
        self._latency()
        self._power()
        if look is None:
            return
        if is_mini_uart(f"/dev/{self._tty}", self._system.root):
            self._say("port.parity", "mini_uart")
        elif self._holders or is_console or has_prompt:
            self._say("port.parity", "gateway" if self._has_gateway else "in_use")
        elif not self._system.may_open(self._port):
            self._say("port.parity", "closed")
        else:
            self._line(look(str(self._system.path(self._port)), self._complete))

    def _name(self) -> None:
        if not self._tty.startswith(_UNSTABLE) or not self._port.startswith(f"/dev/{self._tty}"):
            self._say("port.name", "ok")
        elif better := stable_names(self._system, self._port):
            self._say("port.name", "unstable", better=better[0])
        else:
            self._say("port.name", "no_udev")

    def _permission(self, service: User | None) -> None:
        """Check that the gateway's user may open the port: the service's user, that of a running gateway, else the current one."""
        status, group = self._status, self._system.group_name(self._status.st_gid)
        is_shared = status.st_mode & 0o060 == 0o060 and status.st_gid != 0
        command = f"sudo chgrp dialout {self._port} && sudo chmod g+rw {self._port}"
        values = {"group": group, "open": command}
        if service is not None:
            case = "service_join" if is_shared and service.uid > 0 else "service_open"
            if service.may(status, _READ_AND_WRITE):
                case = "service_ok"
            self._say("port.permission", case, **values, user=service.name)
        if self._system.may_open(self._port):
            if service is None:
                self._say("port.permission", "ok", **values)
        elif service is None and not self._has_gateway:
            self._say("port.permission", "join" if is_shared else "open", **values)
        else:
            case = "gateway_join" if is_shared else "gateway_open"
            self._say("port.permission", case, **values)

    def _device_kind(self, unit: Unit | None) -> None:
        """Check that the unit's DeviceAllow covers the port, by the names in /proc/devices."""
        if unit is None or unit.devices is None:
            return
        major = str(os.major(self._status.st_rdev))
        characters = (self._system.text("/proc/devices") or "").partition("Block")[0]
        lines = [line.split() for line in characters.splitlines()]
        kinds = [f"char-{words[1]}" for words in lines if len(words) == 2 and words[0] == major]
        if kinds and not set(kinds) & set(unit.devices):
            self._say("port.device_kind", "closed", unit=unit.name, kind=kinds[0])

    def _console(self) -> bool:
        """Check that the port is no kernel console, whose messages would reach the ESC."""
        words = (self._system.text("/proc/cmdline") or "").split()
        named = [word for word in words if word.partition(",")[0] == f"console={self._tty}"]
        active = (self._system.text("/sys/class/tty/console/active") or "").split()
        if not named and self._tty not in active:
            self._say("port.console", "ok")
            return False
        word = named[0] if named else f"console={self._tty}"
        self._say("port.console", "console", word=word)
        return True

    def _getty(self) -> tuple[bool, list[Process]]:
        """Check for a login prompt on the port; return whether there is one, and its programs."""
        found = []
        for process in self._system.processes:
            ports = [word.rpartition("/")[2] for word in process.words[1:]]
            if "getty" in process.name and self._tty in ports:
                found.append(process)
        unit = f"serial-getty@{self._tty}"
        state = self._system.run("systemctl", "is-active", unit) if self._system.has_systemd else ""
        if not found and (state or "").strip() != "active":
            self._say("port.getty", "ok")
            return False, found
        self._say("port.getty", "getty", who=", ".join(map(str, found)) or unit, unit=unit)
        return True, found

    def _meddlers(self) -> None:
        """Check for services that open serial adapters by themselves."""
        if not self._adapter.usb:
            return
        names = {process.name for process in self._system.processes}
        if "ModemManager" in names:
            asked = ("udevadm", "info", "--query=property", f"--name=/dev/{self._tty}")
            facts = (self._system.run(*asked) or "").split()
            is_left = "ID_MM_DEVICE_IGNORE=1" in facts or "ID_MM_PORT_IGNORE=1" in facts
            self._say("port.modem_manager", "ok" if is_left else "runs")
        if "brltty" in names and self._adapter.vendor_id in _GRABBED_BY_BRLTTY:
            self._say("port.brltty", "runs")

    def _latency(self) -> None:
        latency = self._system.number(f"/sys/class/tty/{self._tty}/device/latency_timer")
        if latency is None:
            return
        case = "ok"
        if latency > 1:  # a gateway that runs has asked for less
            case = "long" if self._has_gateway else "gateway"
        self._say("port.latency", case, ms=latency)

    def _power(self) -> None:
        control = f"{self._adapter.usb}/power/control"
        if self._adapter.usb and self._system.text(control) == "auto":
            self._say("port.autosuspend", "on", control=control)

    def _line(self, line: Line) -> None:
        if line.busy:
            self._say("port.parity", "exclusive")
            return
        if line.trouble is not None:
            self._say("port.parity", "trouble", trouble=line.trouble)
            return
        case = {None: "set_up", True: "ok", False: "none"}[line.even_parity]
        self._say("port.parity", case)
        seen = [f"{n} {kind.replace('_', ' ')}" for kind, n in line.errors.items() if n]
        if line.errors:
            self._say("port.line_errors", "some" if seen else "ok", counts=", ".join(seen))


def _users(findings: Findings, holders: list[Process], complete: bool) -> None:
    others = [process for process in holders if not process.is_gateway]
    if others:
        pids = " ".join(str(process.pid) for process in others)
        findings.say("port.users", "others", who=", ".join(map(str, others)), pids=pids)
    for process in holders:
        if process.is_gateway:
            findings.say("port.users", "gateway", who=process)
    if not holders:
        findings.say("port.users", "ok" if complete else "unseen")
