"""Checks the wall clock: is it synchronised, and is there a hardware clock."""

from kontronik_can_gw.desk.doctor import Findings
from kontronik_can_gw.desk.doctor.machine import Machine

_SERVICES = {
    "systemd-timesyncd": "timedatectl timesync-status",
    "chronyd": "chronyc tracking",
    "ntpd": "ntpq -p",
    "ntpd-rs": "ntp-ctl status",
}
"""Time services by the names of their processes, each with the command that shows its state."""
_COMM_LENGTH = 15
"""Longest name of a process, as the kernel stores it."""


def check_clock(machine: Machine, findings: Findings) -> None:
    """Report the state of the clock. Times in logs, tables and captures depend on it."""
    clock = machine.clock()
    if clock.synchronized is None:
        findings.add("machine.clock", "unknown")
    elif clock.synchronized:
        findings.add("machine.clock", "ok")
    else:
        running = {process.name for process in machine.processes}
        for name, command in _SERVICES.items():
            if name[:_COMM_LENGTH] in running:
                findings.add(
                    "machine.clock",
                    "waits",
                    service=name,
                    show=command,
                )
                break
        else:
            findings.add("machine.clock", "no_service")
    if clock.hardware:
        findings.add("machine.hardware_clock", "ok", name=clock.hardware)
    elif clock.hardware == "":
        findings.add("machine.hardware_clock", "none")
