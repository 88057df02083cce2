"""Checks the CAN interface: existence, state, bit rate, recovery from bus-off, and health of the bus."""

import json
import platform
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.system import System
from kontronik_can_gw.runtime.locks import SYSTEM_FOLDER, is_held, lock_folder, lock_name

SHORTEST_QUEUE = 8
"""Frames: more than the few that the gateway keeps in the queue itself."""
_CAN_TYPE = 280
"""ARPHRD_CAN"""
_UP = 1
_FD_MTU = 72
_VIRTUAL = ("vcan", "vxcan")
_SAMPLE_POINTS = (0.75, 0.9)
_LONG_RESTART_MS = 1000
_STATES = {"ERROR-ACTIVE": "active", "ERROR-WARNING": "warning", "ERROR-PASSIVE": "passive"}
_MODES = {"LISTEN-ONLY": "listen_only", "LOOPBACK": "loopback", "ONE-SHOT": "one_shot"}
_COUNTED = {"error_passive": "error passive", "bus_error": "bus errors", "restarts": "restarts"}
_LOSSES = ("rx_dropped", "rx_errors", "rx_over_errors", "tx_dropped", "tx_errors")
_CHECK_BUS = "Check the wires, both 120 ohm terminators, the bit rate, and that another node is on and acknowledges"


def check_can(system: System, can: CanConfig) -> list[Finding]:
    """All findings about the CAN interface."""
    fd = f" dbitrate {can.data_bitrate} fd on" if can.fd else ""
    findings = Findings(
        f"CAN {can.channel}",
        channel=can.channel,
        bitrate=can.bitrate,
        data_bitrate=can.data_bitrate,
        again=f"sudo ip link set {can.channel} down; sudo ip link set {can.channel} up",
        up=f"sudo ip link set {can.channel} up type can bitrate {can.bitrate}{fd} restart-ms 100",
        check_bus=_CHECK_BUS,
    )
    if can.interface != "socketcan":
        _driver(findings, can.interface)
    elif _kernel(system, findings):
        _interface(system, findings, can)
        _other_gateways(system, findings, can.channel)
    return findings.found


def _driver(findings: Findings, interface: str) -> None:
    """Check a python-can driver that bypasses the kernel: without opening it only its import can be tested."""
    from kontronik_can_gw.lean import without_asammdf

    with without_asammdf():
        from can.interfaces import BACKENDS
    try:
        import_module(BACKENDS.get(interface, ("", ""))[0])
    except Exception as error:  # without its vendor's library a driver fails in its own way
        findings.say("can.driver", "broken", interface=interface, error=error)
    else:
        findings.say("can.driver", "ok", interface=interface)


def _kernel(system: System, findings: Findings) -> bool:
    lines = (system.text("/proc/net/protocols") or "").splitlines()
    if any(line.split()[:1] == ["CAN_RAW"] for line in lines) or system.exists(
        "/sys/module/can_raw"
    ):
        findings.say("can.kernel", "ok")
        return True
    release = platform.release()
    lists = [f"/lib/modules/{release}/{name}" for name in ("modules.dep", "modules.builtin")]
    is_module = any("/can-raw.ko" in (system.text(name) or "") for name in lists)
    findings.say("can.kernel", "module" if is_module else "none", release=release)
    return is_module


def _interface(system: System, findings: Findings, can: CanConfig) -> None:
    """The kernel's own facts, and where `ip` is there those of the controller."""
    net = "/sys/class/net"
    folder = f"{net}/{can.channel}"
    interfaces = [each for each in system.names(net) if _is_can(system, f"{net}/{each}")]
    there = ", ".join(interfaces)
    if not can.channel or "/" in can.channel or not system.exists(folder):
        findings.say("can.exists", "others" if there else "none", there=there)
        return
    if not _is_can(system, folder):
        findings.say("can.exists", "no_can", there=there or "none")
        return
    details = _details(system, can.channel)
    kind = None if details is None else details.get("info_kind")
    virtual = kind in _VIRTUAL
    kind = {None: "CAN", "can": "CAN controller"}.get(kind, kind)
    findings.say("can.exists", "virtual" if virtual else "ok", kind=kind)
    is_up = bool((system.number(f"{folder}/flags") or 0) & _UP)
    findings.say("can.up", "ok" if is_up else "down_virtual" if virtual else "down")
    if can.fd:
        off = "off_virtual" if virtual else "off"
        findings.say("can.fd", off if (system.number(f"{folder}/mtu") or 0) < _FD_MTU else "ok")
    if details is None:
        findings.say("can.details", "no_ip")
    elif not virtual:
        has_restart = kind != "CAN controller" or system.exists(f"{folder}/device")
        _controller(findings, can, details.get("info_data", {}), is_up, has_restart)
    length = system.number(f"{folder}/tx_queue_len")
    if length is not None and not virtual:  # other programs share it
        findings.say("can.queue", "short" if length < SHORTEST_QUEUE else "ok", length=length)
    losses = {name: system.number(f"{folder}/statistics/{name}") for name in _LOSSES}
    _statistics(findings, (details or {}).get("info_xstats", {}), losses)


def _is_can(system: System, folder: str) -> bool:
    return system.number(f"{folder}/type") == _CAN_TYPE


def _details(system: System, name: str) -> Mapping[str, Any] | None:
    """Kind, bit timing and state of an interface; None without an `ip` that shows them."""
    shown = system.run("ip", "-json", "-details", "-statistics", "link", "show", "dev", name)
    try:
        found: Mapping[str, Any] = json.loads(shown or "")[0].get("linkinfo", {})
    except (ValueError, LookupError):
        return None
    return found


def _controller(
    findings: Findings, can: CanConfig, data: Mapping[str, Any], is_up: bool, has_restart: bool
) -> None:
    """What the driver says. ``has_restart`` False for slcan, which cannot leave bus-off by itself."""
    # a driver with fixed rates only, as slcan, has no further timing
    bitrate = data.get("bittiming", {}).get("bitrate", data.get("bittiming_bitrate", 0))
    if is_up or bitrate:  # otherwise the command that starts it sets both
        _bit_timing(findings, can, data, bitrate)
        ms = data.get("restart_ms", 0)
        case = "never" if not ms else "long" if ms > _LONG_RESTART_MS else "ok"
        findings.say("can.restart", case if has_restart else "slcan", ms=ms)
    counts, state = "", data.get("state")
    if (counters := data.get("berr_counter")) is not None:
        counts = f", error counters: transmit {counters['tx']}, receive {counters['rx']}"
    if state == "BUS-OFF":
        findings.say("can.state", "off" if has_restart else "off_slcan", counts=counts)
    elif state not in (None, "STOPPED"):  # it is down, as reported above
        findings.say("can.state", _STATES.get(state, "other"), counts=counts, state=state.lower())
    for mode, case in _MODES.items():
        if mode in data.get("ctrlmode", ()):
            findings.say("can.mode", case)
    if (ohm := data.get("termination")) is not None:
        findings.say("can.termination", "any", ohm=f"{ohm} ohm" if ohm else "off")


def _bit_timing(findings: Findings, can: CanConfig, data: Mapping[str, Any], bitrate: int) -> None:
    if not bitrate:
        findings.say("can.bitrate", "none")
        return
    findings.say("can.bitrate", "ok" if bitrate == can.bitrate else "other", real=bitrate)
    fast = data.get("data_bittiming", {}).get("bitrate", data.get("data_bittiming_bitrate"))
    if can.fd and fast and fast != can.data_bitrate:
        findings.say("can.data_bitrate", "other", real=fast)
    if point := float(data.get("bittiming", {}).get("sample_point", 0)):
        usual = _SAMPLE_POINTS[0] <= point <= _SAMPLE_POINTS[1]
        findings.say("can.sample_point", "ok" if usual else "unusual", point=point)


def _statistics(
    findings: Findings, events: Mapping[str, int], losses: Mapping[str, int | None]
) -> None:
    """Events since the interface was made, and frames lost."""
    if times := events.get("bus_off"):
        findings.say("can.bus_off", "some", times=times)
    seen = [f"{events[key]} {name}" for key, name in _COUNTED.items() if events.get(key)]
    seen += [f"{number} {name.replace('_', ' ')}" for name, number in losses.items() if number]
    findings.say("can.statistics", "some" if seen else "ok", counts=", ".join(seen))


def _other_gateways(system: System, findings: Findings, channel: str) -> None:
    """Find other gateways by held locks; a lock file alone may be left by a killed gateway."""
    namespace = system.status("/proc/self/ns/net")
    held = system.text("/proc/locks") or ""
    found: dict[str, set[str]] = {"node": set(), "messages": set()}
    any_lock = False
    for path in {SYSTEM_FOLDER, lock_folder()}:
        for file in system.names(str(path)):
            status = system.status(str(path / file))
            name = lock_name(file, 0 if namespace is None else namespace.st_ino) or ""
            if status is None or not name.startswith(f"{channel}/") or not is_held(status, held):
                continue
            any_lock = True
            kind, _, number = name.removeprefix(f"{channel}/").partition("/")
            found.setdefault(kind, set()).add(number)
    if not any_lock:
        return
    what = []
    if found["node"] and all(node.isdigit() for node in found["node"]):
        what.append(f"CANopen node {', '.join(sorted(found['node'], key=int))}")
    if found["messages"]:
        what.append(f"the messages from {', '.join(sorted(found['messages']))}h on")
    running = ", ".join(str(process) for process in system.processes if process.is_gateway)
    who, sent = running or "a gateway", " and ".join(what) or "here"
    findings.say("can.gateway", "runs", who=who, what=sent)
