"""Checks the CAN interface: existence, state, bit rate, recovery from bus-off, and health of the bus."""

import platform
from importlib import import_module

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.doctor.can_link import Link, can_interfaces, link_of
from kontronik_can_gw.desk.doctor.findings import Finding, Findings
from kontronik_can_gw.desk.doctor.system import System
from kontronik_can_gw.runtime.locks import SYSTEM_FOLDER, is_held, lock_folder, lock_name

SHORTEST_QUEUE = 8
"""Frames: more than the few that the gateway keeps in the queue itself."""
_FD_MTU = 72
_VIRTUAL = ("vcan", "vxcan")
_SAMPLE_POINTS = (0.75, 0.9)
_LONG_RESTART_MS = 1000
_STATES = {"ERROR-ACTIVE": "active", "ERROR-WARNING": "warning", "ERROR-PASSIVE": "passive"}
_MODES = {"LISTEN-ONLY": "listen_only", "LOOPBACK": "loopback", "ONE-SHOT": "one_shot"}
_COUNTED = {"error_passive": "error passive", "bus_error": "bus errors", "restarts": "restarts"}
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
    link = link_of(system, can.channel)
    there = ", ".join(can_interfaces(system))
    if link is None:
        findings.say("can.exists", "others" if there else "none", there=there)
        return
    if not link.is_can:
        findings.say("can.exists", "no_can", there=there or "none")
        return
    virtual = link.kind in _VIRTUAL
    kind = {None: "CAN", "can": "CAN controller"}.get(link.kind, link.kind)
    findings.say("can.exists", "virtual" if virtual else "ok", kind=kind)
    down = "down_virtual" if virtual else "down"
    findings.say("can.up", "ok" if link.up else down)
    if can.fd:
        off = "off_virtual" if virtual else "off"
        findings.say("can.fd", off if link.mtu < _FD_MTU else "ok")
    if not link.complete:
        findings.say("can.details", "no_ip")
    elif not virtual:
        if link.up or link.bitrate:  # otherwise the command that starts it sets both
            _bit_timing(findings, link, can)
            _restart(findings, link)
        _controller(findings, link)
    if link.queue_length is not None and not virtual:  # other programs share it
        short = link.queue_length < SHORTEST_QUEUE
        findings.say("can.queue", "short" if short else "ok", length=link.queue_length)
    _statistics(findings, link)


def _bit_timing(findings: Findings, link: Link, can: CanConfig) -> None:
    if not link.bitrate:
        findings.say("can.bitrate", "none")
        return
    is_right = link.bitrate == can.bitrate
    findings.say("can.bitrate", "ok" if is_right else "other", real=link.bitrate)
    if can.fd and link.data_bitrate and link.data_bitrate != can.data_bitrate:
        findings.say("can.data_bitrate", "other", real=link.data_bitrate)
    if link.sample_point is not None:
        usual = _SAMPLE_POINTS[0] <= link.sample_point <= _SAMPLE_POINTS[1]
        findings.say("can.sample_point", "ok" if usual else "unusual", point=link.sample_point)


def _restart(findings: Findings, link: Link) -> None:
    ms = link.restart_ms
    if not link.can_restart:
        findings.say("can.restart", "slcan")
    elif not ms:
        findings.say("can.restart", "never")
    else:
        findings.say("can.restart", "long" if ms > _LONG_RESTART_MS else "ok", ms=ms)


def _controller(findings: Findings, link: Link) -> None:
    counts = ""
    if link.error_counters is not None:
        transmit, receive = link.error_counters
        counts = f", error counters: transmit {transmit}, receive {receive}"
    if link.state == "BUS-OFF":
        findings.say("can.state", "off" if link.can_restart else "off_slcan", counts=counts)
    elif link.state not in (None, "STOPPED"):  # it is down, as reported above
        case = _STATES.get(link.state, "other")
        findings.say("can.state", case, counts=counts, state=link.state.lower())
    for mode, case in _MODES.items():
        if mode in link.modes:
            findings.say("can.mode", case)
    if link.termination is not None:
        ohm = f"{link.termination} ohm" if link.termination else "off"
        findings.say("can.termination", "any", ohm=ohm)


def _statistics(findings: Findings, link: Link) -> None:
    if times := link.events.get("bus_off"):
        findings.say("can.bus_off", "some", times=times)
    seen = [f"{link.events[key]} {name}" for key, name in _COUNTED.items() if link.events.get(key)]
    for name, number in sorted(link.statistics.items()):
        if number:
            seen.append(f"{number} {name.replace('_', ' ')}")
    if seen or link.statistics:
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
