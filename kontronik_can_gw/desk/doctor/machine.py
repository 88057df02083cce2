"""Checks the machine: clock, load, memory, power, log, versions."""

import os
import platform
import time
from importlib.metadata import PackageNotFoundError, version

from kontronik_can_gw import __version__
from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.service import Unit, check_service
from kontronik_can_gw.desk.doctor.system import System

_PACKAGES = ("python-can", "canopen", "pyserial", "cantools", "rich")
_FIRST_YEAR = 2024
_MIN_MEMORY_KB = 64 * 1024
_SLOW_CLOCKS = ("acpi_pm", "hpet", "jiffies", "pit")


def check_machine(system: System, unit: Unit | None, year: int | None = None) -> list[Finding]:
    """All findings about the machine. ``year``: replaces that of the wall clock in tests."""
    findings = Findings("Machine")
    check_service(system, findings, unit)
    _clock(system, findings, time.gmtime().tm_year if year is None else year)
    _processor(system, findings)
    _memory(system, findings)
    _power(system, findings)
    _log(system, findings)
    _versions(findings)
    return findings.found


def _clock(system: System, findings: Findings, year: int) -> None:
    if year < _FIRST_YEAR:
        text = f"the clock says {year}; the gateway does not mind, but log lines have wrong times"
        findings.note("machine.clock", text, "", "sudo timedatectl set-ntp true")
    else:
        findings.ok("machine.clock", f"the clock says {year}")
    source = system.text("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    if source in _SLOW_CLOCKS:
        findings.note(
            "machine.clock_source",
            f"clock source {source}: reading the time is slow on this machine",
        )
    elif source:
        findings.ok("machine.clock_source", f"clock source {source}")


def _processor(system: System, findings: Findings) -> None:
    processors = os.cpu_count() or 1
    load = (system.text("/proc/loadavg") or "").split()
    if load:
        text = f"load {load[0]} with {processors} processor{'s' * (processors > 1)}"
        if float(load[0]) > 2 * processors:
            findings.warning(
                "machine.load", f"{text}: values may be late", "See what else runs:", "top"
            )
        else:
            findings.ok("machine.load", text)
    governor = system.text("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if (
        governor == "powersave"
        and system.text("/sys/devices/system/cpu/cpu0/cpufreq/scaling_driver") != "intel_pstate"
    ):
        command = "echo schedutil | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
        findings.note(
            "machine.governor", "the processor is kept at its lowest speed (powersave)", "", command
        )
    elif governor:
        findings.ok("machine.governor", f"processor governor {governor}")


def _memory(system: System, findings: Findings) -> None:
    lines = [line.split() for line in (system.text("/proc/meminfo") or "").splitlines()]
    kilobytes = {
        words[0]: int(words[1]) for words in lines if len(words) > 1 and words[1].isdigit()
    }
    free = kilobytes.get("MemAvailable:")
    if free is None:
        return
    if free < _MIN_MEMORY_KB:
        findings.warning(
            "machine.memory",
            f"{free // 1024} MB of memory are free; a gateway needs about 40",
            "",
            "free -h",
        )
    else:
        findings.ok("machine.memory", f"{free // 1024} MB of memory are free")


def _power(system: System, findings: Findings) -> None:
    """Check for undervoltage, which a Raspberry Pi detects and which affects USB adapters first."""
    for name in system.names("/sys/class/hwmon"):
        folder = f"/sys/class/hwmon/{name}"
        if system.text(f"{folder}/name") != "rpi_volt":
            continue
        if system.number(f"{folder}/in0_lcrit_alarm"):
            findings.note(
                "machine.power",
                "undervoltage since the start: USB adapters may drop out",
                "Use a stronger supply",
            )
        else:
            findings.ok("machine.power", "no undervoltage since the start")


def _log(system: System, findings: Findings) -> None:
    if not system.has_systemd:
        return
    if system.exists("/var/log/journal"):
        findings.ok("machine.log", "the log is kept over restarts")
    else:
        remedy = "To keep it (it wears memory cards a little):"
        command = "sudo mkdir -p /var/log/journal && sudo systemctl restart systemd-journald"
        findings.note("machine.log", "the log is lost when the machine restarts", remedy, command)


def _versions(findings: Findings) -> None:
    found = []
    for name in _PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    text = f"kontronik-can-gw {__version__}, Python {platform.python_version()}, kernel {platform.release()}, {', '.join(found)}"
    findings.ok("machine.versions", text)
