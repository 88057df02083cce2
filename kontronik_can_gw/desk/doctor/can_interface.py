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
GOOD_QUEUE = 128
_FD_MTU = 72
_VIRTUAL = ("vcan", "vxcan")
_SAMPLE_POINTS = (0.75, 0.9)
_RESTART_MS = 100
_LONG_RESTART_MS = 1000


def check_can(system: System, can: CanConfig) -> list[Finding]:
    """All findings about the CAN interface."""
    findings = Findings(f"CAN {can.channel}")
    if can.interface != "socketcan":
        _driver(findings, can)
        return findings.found
    if not _kernel(system, findings):
        return findings.found
    link = link_of(system, can.channel)
    if link is None:
        _missing(system, findings, can)
    elif not link.is_can:
        there = ", ".join(can_interfaces(system)) or "none"
        findings.error(
            "can.exists",
            f"{can.channel} is no CAN interface",
            f"Set can.channel; CAN interfaces: {there}",
        )
    else:
        _link(findings, link, can)
    _other_gateways(system, findings, can.channel)
    return findings.found


def _driver(findings: Findings, can: CanConfig) -> None:
    """Check a python-can driver that bypasses the kernel: without opening it only its import can be tested."""
    from kontronik_can_gw.lean import without_asammdf

    with without_asammdf():
        from can.interfaces import BACKENDS
    module = BACKENDS.get(can.interface, ("", ""))[0]
    try:
        import_module(module)
    except Exception as error:  # without its vendor's library a driver fails in its own way
        findings.error(
            "can.driver",
            f"{can.interface}: its driver cannot be loaded: {error}",
            "Install what it names",
        )
        return
    findings.ok(
        "can.driver", f"python-can's driver {can.interface} can be loaded; it is not opened here"
    )


def _kernel(system: System, findings: Findings) -> bool:
    lines = (system.text("/proc/net/protocols") or "").splitlines()
    if any(line.split()[:1] == ["CAN_RAW"] for line in lines) or system.exists(
        "/sys/module/can_raw"
    ):
        findings.ok("can.kernel", "the kernel has SocketCAN")
        return True
    release = platform.release()
    for name in ("modules.dep", "modules.builtin"):
        if "/can-raw.ko" in (system.text(f"/lib/modules/{release}/{name}") or ""):
            findings.ok("can.kernel", "the kernel loads SocketCAN when it is first used")
            return True
    findings.error(
        "can.kernel",
        f"kernel {release} has no SocketCAN (module can_raw)",
        "Ubuntu has it in a package of its own; Debian's cloud kernels have none, linux-image-amd64 has:",
        f"sudo apt install linux-modules-extra-{release}",
    )
    return False


def _up_command(can: CanConfig) -> str:
    fd = f" dbitrate {can.data_bitrate} fd on" if can.fd else ""
    return f"sudo ip link set {can.channel} up type can bitrate {can.bitrate}{fd} restart-ms {_RESTART_MS}"


def _again_command(can: CanConfig, what: str) -> str:
    return f"sudo ip link set {can.channel} down; sudo ip link set {can.channel} up type can {what}"


def _missing(system: System, findings: Findings, can: CanConfig) -> None:
    there = can_interfaces(system)
    if there:
        findings.error(
            "can.exists",
            f"there is no interface {can.channel}",
            f"Set can.channel: {', '.join(there)}",
        )
        return
    remedy = "Plug in the adapter and load its driver; for a virtual one (tests only):"
    command = f"sudo ip link add {can.channel} type vcan && sudo ip link set {can.channel} up"
    findings.error(
        "can.exists",
        f"there is no interface {can.channel}, nor any other CAN interface",
        remedy,
        command,
    )


def _link(findings: Findings, link: Link, can: CanConfig) -> None:
    kind = {None: "CAN", "can": "CAN controller"}.get(link.kind, str(link.kind))
    virtual = link.kind in _VIRTUAL
    if virtual:
        findings.note(
            "can.exists",
            f"{kind}: a virtual interface without a controller; frames stay on this machine",
        )
    else:
        findings.ok("can.exists", kind)
    if not link.up:
        command = f"sudo ip link set {can.channel} up" if virtual else _up_command(can)
        findings.error("can.up", "the interface is down", "", command)
    else:
        findings.ok("can.up", "the interface is up")
    if can.fd and link.mtu < _FD_MTU:
        command = _again_command(can, f"bitrate {can.bitrate} dbitrate {can.data_bitrate} fd on")
        if virtual:
            command = f"sudo ip link set {can.channel} down; sudo ip link set {can.channel} mtu {_FD_MTU} up"
        findings.error("can.fd", "can.fd = true, but CAN FD is not switched on", "", command)
    elif can.fd:
        findings.ok("can.fd", "CAN FD is on")
    if not link.complete:
        findings.note(
            "can.details",
            "without `ip` bit rate and controller cannot be looked at",
            "",
            "sudo apt install iproute2",
        )
    elif not virtual:
        if link.up or link.bitrate:  # otherwise the command that starts it sets both
            _bit_timing(findings, link, can)
            _restart(findings, link, can)
        _controller(findings, link, can)
    _queue(findings, link, can, virtual)
    _statistics(findings, link)


def _bit_timing(findings: Findings, link: Link, can: CanConfig) -> None:
    command = _again_command(can, f"bitrate {can.bitrate}")
    if not link.bitrate:
        findings.error("can.bitrate", "no bit rate is set", "", command)
        return
    if link.bitrate != can.bitrate:
        findings.error(
            "can.bitrate",
            f"the interface runs at {link.bitrate} bit/s, can.bitrate is {can.bitrate}",
            f"Set can.bitrate = {link.bitrate} if the bus has that rate, else:",
            command,
        )
    else:
        findings.ok("can.bitrate", f"{link.bitrate} bit/s, as can.bitrate says")
    if can.fd and link.data_bitrate and link.data_bitrate != can.data_bitrate:
        findings.error(
            "can.data_bitrate",
            f"the data phase runs at {link.data_bitrate} bit/s, can.data_bitrate is {can.data_bitrate}",
            f"Set can.data_bitrate = {link.data_bitrate} if the bus has that rate, else:",
            _again_command(can, f"bitrate {can.bitrate} dbitrate {can.data_bitrate} fd on"),
        )
    if link.sample_point is not None:
        if _SAMPLE_POINTS[0] <= link.sample_point <= _SAMPLE_POINTS[1]:
            findings.ok("can.sample_point", f"sample point {link.sample_point:.1%}")
        else:
            findings.note(
                "can.sample_point",
                f"sample point {link.sample_point:.1%}; usual is 75 % to 90 %, CiA recommends 87.5 %",
                "All nodes of the bus should have much the same:",
                _again_command(can, f"bitrate {can.bitrate} sample-point 0.875"),
            )


def _restart(findings: Findings, link: Link, can: CanConfig) -> None:
    if not link.can_restart:
        findings.note(
            "can.restart",
            "this driver (slcan) cannot leave bus-off by itself",
            "After a bus-off:",
            f"sudo ip link set {can.channel} down; sudo ip link set {can.channel} up",
        )
        return
    remedy = (
        f"Once by hand, and for good by RestartSec={_RESTART_MS}ms in [CAN] of systemd-networkd:"
    )
    command = _again_command(can, f"restart-ms {_RESTART_MS}")
    if not link.restart_ms:
        findings.error(
            "can.restart",
            "restart-ms 0: after a bus-off the controller stays off for ever",
            remedy,
            command,
        )
    elif link.restart_ms > _LONG_RESTART_MS:
        findings.warning(
            "can.restart", f"restart-ms {link.restart_ms}: bus-off lasts that long", remedy, command
        )
    else:
        findings.ok("can.restart", f"leaves bus-off after {link.restart_ms} ms")


def _controller(findings: Findings, link: Link, can: CanConfig) -> None:
    counters = link.error_counters
    counts = (
        ""
        if counters is None
        else f", error counters: transmit {counters[0]}, receive {counters[1]}"
    )
    bus = "Check the wires, both 120 ohm terminators, the bit rate, and that another node is on and acknowledges"
    match link.state:
        case "ERROR-ACTIVE":
            findings.ok("can.state", f"controller error active{counts}")
        case "ERROR-WARNING":
            findings.warning("can.state", f"controller at its warning limit{counts}", bus)
        case "ERROR-PASSIVE":
            findings.warning("can.state", f"controller error passive{counts}", bus)
        case "BUS-OFF":
            command = f"sudo ip link set {can.channel} type can restart"
            if not link.can_restart:
                command = f"sudo ip link set {can.channel} down; sudo ip link set {can.channel} up"
            findings.error("can.state", f"controller bus-off{counts}", f"{bus}; then:", command)
        case None | "STOPPED":
            pass  # it is down, as reported above
        case other:
            findings.warning(
                "can.state", f"controller {other.lower()}{counts}", "", _up_command(can)
            )
    off = {"LISTEN-ONLY": "listen-only", "LOOPBACK": "loopback"}
    for mode, option in off.items():
        if mode in link.modes:
            what = (
                "nothing can be sent" if mode == "LISTEN-ONLY" else "frames may not reach the bus"
            )
            command = _again_command(can, f"{option} off")
            findings.error("can.mode", f"the controller is in {option} mode: {what}", "", command)
    if "ONE-SHOT" in link.modes:
        command = _again_command(can, "one-shot off")
        findings.warning(
            "can.mode", "one-shot mode: a frame that loses arbitration is lost", "", command
        )
    if link.termination is not None:
        findings.note(
            "can.termination",
            f"built-in termination: {link.termination or 'off'}{' ohm' * bool(link.termination)}",
        )


def _queue(findings: Findings, link: Link, can: CanConfig, virtual: bool) -> None:
    """Check the transmit queue. The gateway keeps at most about six frames in it, but other programs share it."""
    length = link.queue_length
    if length is None or virtual:
        return
    if length < SHORTEST_QUEUE:
        findings.warning(
            "can.queue",
            f"transmit queue of {length} frames: too short to keep the bus busy",
            f"For good by TransmitQueueLength={GOOD_QUEUE} in a systemd .link file:",
            f"sudo ip link set {can.channel} txqueuelen {GOOD_QUEUE}",
        )
    else:
        findings.ok("can.queue", f"transmit queue of {length} frames")


def _statistics(findings: Findings, link: Link) -> None:
    if times := link.events.get("bus_off"):
        remedy = "A short, a wrong bit rate or a bad cable: check the bus"
        findings.warning(
            "can.bus_off", f"bus-off {times} times since the interface was made", remedy
        )
    names = {"error_passive": "error passive", "bus_error": "bus errors", "restarts": "restarts"}
    seen = [f"{link.events[key]} {name}" for key, name in names.items() if link.events.get(key)]
    seen += [
        f"{number} {name.replace('_', ' ')}"
        for name, number in sorted(link.statistics.items())
        if number
    ]
    if seen:
        findings.note(
            "can.statistics", f"counted so far: {', '.join(seen)}", "If they grow, check the bus"
        )
    elif link.statistics:
        findings.ok("can.statistics", "no errors and no lost frames counted")


def _other_gateways(system: System, findings: Findings, channel: str) -> None:
    """Find other gateways by held locks; a lock file alone may be left by a killed gateway."""
    namespace = system.status("/proc/self/ns/net")
    held = system.text("/proc/locks") or ""
    found = []
    for path in {SYSTEM_FOLDER, lock_folder()}:
        for file in system.names(str(path)):
            status = system.status(str(path / file))
            name = lock_name(file, 0 if namespace is None else namespace.st_ino)
            if (
                name is not None
                and name.startswith(f"{channel}/")
                and status is not None
                and is_held(status, held)
            ):
                found.append(name.removeprefix(f"{channel}/"))
    if not found:
        return
    nodes = sorted(
        {number for what, _, number in (name.partition("/") for name in found) if what == "node"}
    )
    messages = sorted(
        {
            number
            for what, _, number in (name.partition("/") for name in found)
            if what == "messages"
        }
    )
    what = (
        [f"CANopen node {', '.join(sorted(nodes, key=int))}"]
        if nodes and all(n.isdigit() for n in nodes)
        else []
    )
    what += [f"the messages from {', '.join(messages)}h on"] if messages else []
    running = ", ".join(str(process) for process in system.processes if process.is_gateway)
    findings.note(
        "can.gateway", f"{running or 'a gateway'} already sends {' and '.join(what) or 'here'}"
    )
