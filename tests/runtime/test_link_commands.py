"""Advised `ip link` commands fit the kind of the interface.

A vcan refuses the options of a controller.
"""

import errno
from pathlib import Path

import pytest

import kontronik_can_gw
from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.runtime.can import link_commands
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.can.socketcan_port import socketcan_error

pytestmark = pytest.mark.promise("doctor")

ADD = "sudo ip link add vcan0 type vcan && sudo ip link set vcan0 up"
UP = "sudo ip link set can0 up type can bitrate 500000 restart-ms 100"


class Kernel:
    """Replacement for the kernel that reports one interface."""

    def __init__(self, facts: LinkFacts) -> None:
        self.facts = facts

    def ask(self) -> None: ...

    def take(self) -> list[LinkFacts]:
        return [self.facts]

    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("name", "kind", "number", "said"),
    [
        ("can0", "can", errno.ENETDOWN, f"is down. Start it: {UP}."),
        ("vcan0", "vcan", errno.ENETDOWN, "is down. Start it: sudo ip link set vcan0 up."),
        ("bus", "vcan", errno.ENETDOWN, "is down. Start it: sudo ip link set bus up."),
        ("far0", "vxcan", errno.ENETDOWN, "is down. Start it: sudo ip link set far0 up."),
        ("vcan0", "", errno.ENODEV, f"does not exist. Create it: {ADD}."),
        ("can0", "", errno.ENODEV, f"If its adapter is plugged in: {UP}."),
    ],
)
def test_advice_of_run_and_monitor_fits_the_kind(
    name: str,
    kind: str,
    number: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    facts = LinkFacts(exists=bool(kind), kind=kind)
    monkeypatch.setattr(link_commands, "link_monitor", lambda _name: Kernel(facts))
    assert said in str(socketcan_error(CanConfig(channel=name), number))


def test_without_rtnetlink_the_name_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_commands, "link_monitor", lambda _name: None)
    assert link_commands.kind_of("vcan7") == "vcan"
    assert link_commands.kind_of("can0") == ""


def test_can_fd_is_switched_on_by_the_mtu_of_a_virtual_interface() -> None:
    virtual = CanConfig(channel="vcan0", fd=True)
    adapter = CanConfig(fd=True)
    command = "sudo ip link set vcan0 down; sudo ip link set vcan0 mtu 72 up"
    assert link_commands.enable_fd(virtual, "vcan") == command
    assert link_commands.add_virtual(virtual).endswith("&& sudo ip link set vcan0 mtu 72 up")
    command = link_commands.enable_fd(adapter, "can")
    assert command.endswith("can0 up type can bitrate 500000 dbitrate 2000000 fd on")


def test_no_other_module_contains_such_a_command() -> None:
    package = Path(kontronik_can_gw.__file__).parent
    found = set()
    for path in package.rglob("*"):
        if path.suffix in (".py", ".toml") and "ip link set" in path.read_text("utf-8"):
            found.add(path.relative_to(package).as_posix())
    assert found == {"runtime/can/link_commands.py", "desk/mqtt/client.py"}, "MQTT's is about lo"
