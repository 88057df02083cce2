"""Checks the CAN interface: existence, state, bit rate, recovery from bus-off, and health of the bus."""

import json
import platform
from collections.abc import Mapping
from typing import Any

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.machine import Machine

MIN_QUEUE = 8
"""Frames: more than the few that the gateway keeps in the queue itself."""
_CAN_TYPE = "280"
"""ARPHRD_CAN"""
_FD_MTU = 72
_STATES = {"ERROR-ACTIVE": "active", "ERROR-WARNING": "warning", "ERROR-PASSIVE": "warning"}
_MODES = {"LISTEN-ONLY": "listen_only", "LOOPBACK": "loopback"}


def check_can(machine: Machine, can: CanConfig) -> list[Finding]:
    """All findings about the CAN interface."""
    fd = f" dbitrate {can.data_bitrate} fd on" if can.fd else ""
    findings = Findings(
        f"CAN {can.channel}",
        channel=can.channel,
        bitrate=can.bitrate,
        data_bitrate=can.data_bitrate,
        again=f"sudo ip link set {can.channel} down; sudo ip link set {can.channel} up",
        set=f"type can bitrate {can.bitrate}{fd}",
    )
    if can.interface != "socketcan":
        findings.say("can.driver", "unseen", interface=can.interface)
    elif _kernel(machine, findings) and _exists(machine, findings, can.channel):
        _interface(machine, findings, can)
    return findings.found


def _kernel(machine: Machine, findings: Findings) -> bool:
    release = platform.release()
    loaded = machine.exists("/sys/module/can_raw") or "\nCAN_RAW " in machine.text(
        "/proc/net/protocols"
    )
    lists = [f"/lib/modules/{release}/{name}" for name in ("modules.dep", "modules.builtin")]
    found = loaded or any("/can-raw.ko" in machine.text(name) for name in lists)
    findings.say("can.kernel", "ok" if found else "none", release=release)
    return found


def _exists(machine: Machine, findings: Findings, channel: str) -> bool:
    net = "/sys/class/net"
    kinds = {name: machine.text(f"{net}/{name}/type") for name in machine.names(net)}
    there = [name for name, kind in kinds.items() if kind == _CAN_TYPE]
    if channel in there:
        return True
    case = "no_can" if channel in kinds else "others" if there else "none"
    findings.say("can.exists", case, there=", ".join(there) or "none")
    return False


def _interface(machine: Machine, findings: Findings, can: CanConfig) -> None:
    """The kernel's own facts, and where `ip` is there those of the controller."""
    folder = f"/sys/class/net/{can.channel}"
    link = _link(machine, can.channel)
    kind = link.get("info_kind")
    virtual = kind in ("vcan", "vxcan")
    findings.say("can.exists", "virtual" if virtual else "ok", kind=kind)
    is_up = bool(int(machine.text(f"{folder}/flags") or "0", 0) & 1)
    findings.say("can.up", "ok" if is_up else "down_virtual" if virtual else "down")
    if can.fd and int(machine.text(f"{folder}/mtu") or "0") < _FD_MTU:
        findings.say("can.fd", "off_virtual" if virtual else "off")
    if not link:
        findings.say("can.details", "no_ip")
    elif not virtual:
        # slcan, which cannot leave bus-off by itself, has no device
        has_restart = kind != "can" or machine.exists(f"{folder}/device")
        _controller(findings, can, link.get("info_data", {}), is_up, has_restart)
    length = machine.text(f"{folder}/tx_queue_len")
    if length.isdigit() and not virtual and int(length) < MIN_QUEUE:  # other programs share it
        findings.say("can.queue", "short", length=length)
    if times := link.get("info_xstats", {}).get("bus_off"):
        findings.say("can.bus_off", "some", times=times)


def _link(machine: Machine, name: str) -> Mapping[str, Any]:
    """Kind, bit timing and state of an interface; empty without an `ip` that shows them."""
    shown = machine.run("ip", "-json", "-details", "-statistics", "link", "show", "dev", name)
    try:
        found: Mapping[str, Any] = json.loads(shown)[0].get("linkinfo", {})
    except (ValueError, LookupError):
        return {}
    return found


def _controller(
    findings: Findings, can: CanConfig, data: Mapping[str, Any], is_up: bool, has_restart: bool
) -> None:
    """What the driver says."""
    # a driver with fixed rates only, as slcan, has no further timing
    bitrate = data.get("bittiming", {}).get("bitrate", data.get("bittiming_bitrate", 0))
    fast = data.get("data_bittiming", {}).get("bitrate", can.data_bitrate)
    if is_up or bitrate:  # otherwise the command that starts it sets all of it
        case = "ok" if bitrate == can.bitrate else "other" if bitrate else "none"
        findings.say("can.bitrate", case, real=bitrate)
        if can.fd and fast != can.data_bitrate:
            findings.say("can.data_bitrate", "other", real=fast)
        ms = data.get("restart_ms", 0)
        findings.say("can.restart", ("ok" if ms else "never") if has_restart else "slcan", ms=ms)
    state, counters = data.get("state", "STOPPED"), data.get("berr_counter", {})
    counts = f", error counters {counters['tx']} and {counters['rx']}" if counters else ""
    case = _STATES.get(state, "other")
    if state == "BUS-OFF":
        case = "off" if has_restart else "off_slcan"
    if state != "STOPPED":  # it is down, as reported above
        findings.say("can.state", case, counts=counts, state=state.lower())
    for mode in set(_MODES) & set(data.get("ctrlmode", ())):
        findings.say("can.mode", _MODES[mode])
