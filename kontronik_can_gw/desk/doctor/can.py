"""Checks the CAN interface: existence, state, bit rate, recovery from bus-off, and bus errors."""

import json
from collections.abc import Mapping
from typing import Any

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.doctor import Finding, Findings
from kontronik_can_gw.desk.doctor.machine import Machine
from kontronik_can_gw.runtime.can.interface_restart import RIGHTS
from kontronik_can_gw.runtime.can.link_commands import (
    VIRTUAL,
    add_virtual,
    controller_settings,
    enable_fd,
    kind_by_name,
    leave_bus_off,
    restart,
    set_up,
)

_NET = "/sys/class/net"
_CAN_TYPE = "280"
"""ARPHRD_CAN"""
_FD_MTU = 72
_CRASHING_DRIVER = "mcp251xfd"
"""Driver of the MCP2517FD and MCP2518FD. See raspberrypi/linux, issue 6916."""
_STATES = {"ERROR-ACTIVE": "active", "ERROR-WARNING": "warning", "ERROR-PASSIVE": "warning"}
_MODES = {"LISTEN-ONLY": "listen_only", "LOOPBACK": "loopback"}


def check_can(machine: Machine, can: CanConfig) -> list[Finding]:
    """Return all findings about the CAN interface.

    They are based on the kernel's data, and on the controller's if the program `ip` is installed.
    """
    findings = Findings(
        f"CAN {can.channel}",
        channel=can.channel,
        again=restart(can.channel),
        again_set=restart(can.channel, controller_settings(can)),
        add=add_virtual(can),
        leave_bus_off=leave_bus_off(can.channel),
    )
    if can.interface != "socketcan":
        findings.add("can.driver", "unseen", interface=can.interface)
        return findings.found
    folder = f"{_NET}/{can.channel}"
    if machine.text(f"{folder}/type") != _CAN_TYPE:
        _report_missing(findings, machine, can.channel)
        return findings.found
    link = _link(machine, can.channel)
    kind = link.get("info_kind") or kind_by_name(can.channel)
    is_virtual = kind in VIRTUAL
    findings.values["up"] = set_up(can, kind)
    findings.values["fd"] = enable_fd(can, kind)
    findings.add("can.exists", "virtual" if is_virtual else "ok", kind=kind)
    flags = int(machine.text(f"{folder}/flags") or "0", 0)
    is_up = bool(flags & 1)
    findings.add("can.up", "ok" if is_up else "down")
    if can.fd and int(machine.text(f"{folder}/mtu") or "0") < _FD_MTU:
        findings.add("can.fd", "off")
    if not link:
        findings.add("can.details", "no_ip")
    if is_virtual:
        return findings.found
    if link:
        # an slcan interface has no device, and cannot leave bus-off by itself
        has_restart = kind != "can" or machine.exists(f"{folder}/device")
        data = link.get("info_data", {})
        if is_up or _bitrate(data):  # otherwise the command that starts it sets all of it
            _check_timing(
                findings,
                can,
                data,
                has_restart,
            )
        _check_state(findings, data, has_restart)
        driver = machine.target_of(f"{folder}/device/driver").rpartition("/")[2]
        if driver == _CRASHING_DRIVER and data.get("restart_ms"):
            findings.add(
                "can.restart",
                "may_crash",
                driver=driver,
                ms=data["restart_ms"],
            )
    if can.restart_after_s:
        watched = f"multi-user.target.wants/kontronik-can-gw-restart@{can.channel}.path"
        is_enabled = machine.target_of(f"/etc/systemd/system/{watched}")
        findings.add("can.restart_unit", "ok" if is_enabled else "off", rights=RIGHTS)
    return findings.found


def _report_missing(findings: Findings, machine: Machine, channel: str) -> None:
    """Report that no CAN interface has this name, and list the others."""
    names = machine.names(_NET)
    others = [name for name in names if machine.text(f"{_NET}/{name}/type") == _CAN_TYPE]
    case = "others" if others else "none"
    if machine.exists(f"{_NET}/{channel}"):
        case = "no_can"
    elif kind_by_name(channel) in VIRTUAL:
        case = "no_virtual"
    findings.add("can.exists", case, there=", ".join(others) or "none")


def _link(machine: Machine, name: str) -> Mapping[str, Any]:
    """Return kind, bit timing and state of an interface. Empty if `ip` does not show them."""
    shown = machine.run(
        "ip",
        "-json",
        "-details",
        "link",
        "show",
        "dev",
        name,
    )
    try:
        found: Mapping[str, Any] = json.loads(shown)[0].get("linkinfo", {})
    except (ValueError, LookupError):
        return {}
    return found


def _bitrate(data: Mapping[str, Any]) -> int:
    """Return the bit rate that the driver shows. 0 if it shows none."""
    # a driver with fixed rates, for example slcan, shows the bit rate without further timing
    fixed_bitrate = data.get("bittiming_bitrate", 0)
    bitrate: int = data.get("bittiming", {}).get("bitrate", fixed_bitrate)
    return bitrate


def _check_timing(
    findings: Findings,
    can: CanConfig,
    data: Mapping[str, Any],
    has_restart: bool,
) -> None:
    """Report bit rates and recovery from bus-off as the driver shows them."""
    rates = {"bitrate": (can.bitrate, _bitrate(data))}
    data_bitrate = data.get("data_bittiming", {}).get("bitrate")
    if can.fd and data_bitrate:
        rates["data_bitrate"] = (can.data_bitrate, data_bitrate)
    for key, (wanted, real) in rates.items():
        case = "other" if real else "none"
        if real == wanted:
            case = "ok"
        findings.add(
            "can.bitrate",
            case,
            key=key,
            wanted=wanted,
            real=real,
        )
    ms = data.get("restart_ms", 0)
    case = "slcan"
    if has_restart:
        case = "ok" if ms else "never"
    findings.add("can.restart", case, ms=ms)


def _check_state(findings: Findings, data: Mapping[str, Any], has_restart: bool) -> None:
    """Report the controller's state, error counters and modes."""
    state = data.get("state", "STOPPED")
    counters = data.get("berr_counter", {})
    counts = ""
    if counters:
        counts = f", error counters {counters['tx']} and {counters['rx']}"
    case = _STATES.get(state, "other")
    if state == "BUS-OFF":
        case = "off" if has_restart else "off_slcan"
    if state != "STOPPED":  # a stopped interface is down, which was reported above
        findings.add(
            "can.state",
            case,
            counts=counts,
            state=state.lower(),
        )
    for mode in set(_MODES) & set(data.get("ctrlmode", ())):
        findings.add("can.mode", _MODES[mode])
