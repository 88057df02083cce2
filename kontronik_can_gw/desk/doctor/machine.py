"""Checks the machine: clock, load, memory, power, log, versions."""

import os
import platform
import re
import time
from importlib.metadata import PackageNotFoundError, version

from kontronik_can_gw import __version__
from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.service import Unit, check_service
from kontronik_can_gw.desk.doctor.system import System

_PACKAGES = ("python-can", "pyserial", "cantools", "rich")
_FIRST_YEAR = 2024
_MIN_MEMORY_KB = 64 * 1024
_FREQUENCY = "/sys/devices/system/cpu/cpu0/cpufreq"


def check_machine(system: System, unit: Unit | None, year: int | None = None) -> list[Finding]:
    """All findings about the machine. ``year``: replaces that of the wall clock in tests."""
    findings = Findings("Machine")
    check_service(system, findings, unit)
    year = time.gmtime().tm_year if year is None else year
    findings.say("machine.clock", "wrong" if year < _FIRST_YEAR else "ok", year=year)
    _processor(system, findings)
    _memory(system, findings)
    _power(system, findings)
    if system.has_systemd:
        is_kept = system.exists("/var/log/journal")
        findings.say("machine.log", "ok" if is_kept else "lost")
    _versions(findings)
    return findings.found


def _processor(system: System, findings: Findings) -> None:
    number = os.cpu_count() or 1
    load = (system.text("/proc/loadavg") or "").split()
    if load:
        processors = f"{number} processor{'s' * (number > 1)}"
        case = "high" if float(load[0]) > 2 * number else "ok"
        findings.say("machine.load", case, load=load[0], processors=processors)
    governor = system.text(f"{_FREQUENCY}/scaling_governor")
    if governor:
        adapts = system.text(f"{_FREQUENCY}/scaling_driver") == "intel_pstate"
        case = "powersave" if governor == "powersave" and not adapts else "ok"
        findings.say("machine.governor", case, governor=governor)


def _memory(system: System, findings: Findings) -> None:
    found = re.search(r"^MemAvailable: *(\d+)", system.text("/proc/meminfo") or "", re.MULTILINE)
    if found is not None:
        free = int(found[1])
        case = "low" if free < _MIN_MEMORY_KB else "ok"
        findings.say("machine.memory", case, megabytes=free // 1024)


def _power(system: System, findings: Findings) -> None:
    """Check for undervoltage, which a Raspberry Pi detects and which affects USB adapters first."""
    for name in system.names("/sys/class/hwmon"):
        folder = f"/sys/class/hwmon/{name}"
        if system.text(f"{folder}/name") == "rpi_volt":
            is_low = system.number(f"{folder}/in0_lcrit_alarm")
            findings.say("machine.power", "low" if is_low else "ok")


def _versions(findings: Findings) -> None:
    findings.say(
        "machine.versions",
        "ok",
        version=__version__,
        python=platform.python_version(),
        kernel=platform.release(),
        packages=", ".join(filter(None, map(_package, _PACKAGES))),
    )


def _package(name: str) -> str:
    """Its name and version; empty where it is not known."""
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return ""
