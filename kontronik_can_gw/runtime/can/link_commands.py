"""Forms the `ip link` commands that messages advise.

They depend on the kind of the interface. A controller (can0) needs its bit rate. A virtual
interface (vcan, vxcan) has no bit rate, and refuses options of a controller.
"""

from contextlib import closing

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.runtime.can.link_monitor import link_monitor

VIRTUAL = ("vcan", "vxcan")
_FD_MTU = 72


def kind_of(name: str) -> str:
    """Return the kind of an interface as the kernel reports it, for example "can" or "vcan".

    An interface that does not exist is a "vcan" if it is called so. "" if unknown.
    """
    monitor = link_monitor(name)
    if monitor is not None:
        with closing(monitor):
            monitor.ask()
            for facts in reversed(monitor.take()):
                if facts.exists:
                    return facts.kind
    return kind_by_name(name)


def kind_by_name(name: str) -> str:
    """Return the kind that the name of an interface suggests: "vcan", or "" if unknown."""
    return "vcan" if name.startswith("vcan") else ""


def controller_settings(config: CanConfig) -> str:
    """Return the options of `ip link set` for a controller."""
    settings = f"type can bitrate {config.bitrate}"
    if config.fd:
        settings += f" dbitrate {config.data_bitrate} fd on"
    return settings


def set_up(config: CanConfig, kind: str) -> str:
    """Return the command that sets up an interface of this kind."""
    command = f"sudo ip link set {config.channel}"
    if kind not in VIRTUAL:
        return f"{command} up {controller_settings(config)} restart-ms 100"
    if config.fd:
        return f"{command} mtu {_FD_MTU} up"
    return f"{command} up"


def add_virtual(config: CanConfig) -> str:
    """Return the command that creates a virtual interface and sets it up."""
    return f"sudo ip link add {config.channel} type vcan && {set_up(config, 'vcan')}"


def restart(name: str, settings: str = "") -> str:
    """Return the command that sets an interface down and up again.

    The settings can be changed only while the interface is down.
    """
    return f"sudo ip link set {name} down; sudo ip link set {name} up {settings}".rstrip()


def leave_bus_off(name: str) -> str:
    """Return the command that restarts a controller in bus-off."""
    return f"sudo ip link set {name} type can restart"


def enable_fd(config: CanConfig, kind: str) -> str:
    """Return the command that switches CAN FD on."""
    if kind in VIRTUAL:
        return f"sudo ip link set {config.channel} down; {set_up(config, kind)}"
    return restart(config.channel, controller_settings(config))
