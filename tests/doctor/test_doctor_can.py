"""Findings of `doctor` at a CAN interface.

The documents are as printed by `ip -json -details -statistics link show`.
"""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.desk.doctor.can import check_can

pytestmark = pytest.mark.promise("doctor")

OK = "ok"
NOTE = "note"
WARNING = "warning"
ERROR = "error"
PLAIN = CanConfig()
FD = CanConfig(fd=True)
UP = "sudo ip link set can0 up type can bitrate 500000"


LINK = {
    "state": "ERROR-ACTIVE",
    "berr_counter": {"tx": 0, "rx": 0},
    "restart_ms": 100,
    "bittiming": {"bitrate": 500000, "sample_point": "0.875", "tq": 125},
    "clock": 8000000,
}


SYS = {"type": "280", "flags": "0x40041", "mtu": "16"}


def controller() -> dict[str, Any]:
    """Return an adapter with correct settings: ``linkinfo`` of `ip`, and files of /sys."""
    info = {"info_kind": "can", "info_data": LINK}
    return deepcopy({"linkinfo": info, **SYS})


def info(**data: object) -> dict[str, Any]:
    """Return a change below linkinfo/info_data."""
    return {"linkinfo": {"info_data": data}}


def merged(found: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Change a nested dictionary. ``None`` removes a key."""
    for key, value in change.items():
        if isinstance(value, dict) and isinstance(found.get(key), dict):
            merged(found[key], value)
        elif value is None:
            del found[key]
        else:
            found[key] = value
    return found


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


def interface(tree: Tree, change: dict[str, Any], hardware: bool = True) -> None:
    """Add can0, as `ip` and /sys show it."""
    found = merged(controller(), change)
    tree.programs["ip",] = json.dumps([{"linkinfo": found.pop("linkinfo")}])
    for name, text in found.items():
        tree.file(f"/sys/class/net/can0/{name}", f"{text}\n")
    if hardware:
        tree.folder("/sys/class/net/can0/device")


DOWN = {"flags": "0x40040"}


@pytest.mark.parametrize(
    ("change", "can", "check", "severity", "said"),
    [
        ({}, PLAIN, "can.bitrate", OK, "500000 bit/s"),
        (DOWN | info(state="STOPPED"), PLAIN, "can.up", ERROR, f"{UP} restart-ms 100"),
        (info(bittiming={"bitrate": 250000}), PLAIN, "can.bitrate", ERROR,
         "can0 up type can bitrate 500000"),
        (info(restart_ms=0), PLAIN, "can.restart", ERROR, "restart-ms 100"),
        (info(berr_counter={"tx": 128, "rx": 7}), PLAIN, "can.state", OK,
         "error counters 128 and 7"),
        (info(state="ERROR-PASSIVE"), PLAIN, "can.state", WARNING, ""),
        (info(state="ERROR-WARNING"), PLAIN, "can.state", WARNING, "error-warning"),
        (info(state="SLEEPING"), PLAIN, "can.state", WARNING, "type can bitrate 500000"),
        (info(state="BUS-OFF"), PLAIN, "can.state", ERROR, ""),
        (info(ctrlmode=["LISTEN-ONLY", "BERR-REPORTING"]), PLAIN, "can.mode", ERROR,
         "listen-only off"),
        (info(ctrlmode=["LOOPBACK"]), PLAIN, "can.mode", ERROR, "loopback off"),
        (info(bittiming={"bitrate": 0}), PLAIN, "can.bitrate", ERROR, "no bit rate is set"),
        ({}, FD, "can.fd", ERROR, "dbitrate 2000000 fd on"),
        (info(ctrlmode=["TRIPLE-SAMPLING"]), PLAIN, "can.state", OK, ""),
        ({"mtu": "72"} | info(data_bittiming={"bitrate": 2000000}), FD, "can.up", OK, ""),
        ({"mtu": "72"} | info(data_bittiming={"bitrate": 4000000}), FD, "can.bitrate", ERROR,
         "can.data_bitrate is 2000000"),
    ],
)  # fmt: skip
def test_wrong_setting_is_reported_with_the_command_that_corrects_it(
    tree: Tree,
    change: dict[str, Any],
    can: CanConfig,
    check: str,
    severity: str,
    said: str,
) -> None:
    interface(tree, change)
    findings = check_can(tree, can)
    (found,) = [each for each in findings if (each.check, each.severity) == (check, severity)]
    assert said in f"{found.text} {found.command}"
    assert severity in (OK, NOTE) or found.remedy or found.command
    expected = set() if severity == OK else {check}
    assert grave(findings).keys() == expected, "a cause is reported once"


def test_missing_interface_is_reported_with_the_existing_ones(tree: Tree) -> None:
    found = only(check_can(tree, PLAIN), "can.exists")
    assert found.severity == ERROR
    assert found.command == "sudo ip link add can0 type vcan && sudo ip link set can0 up"
    tree.file("/sys/class/net/can1/type", "280\n")
    tree.file("/sys/class/net/eth0/type", "1\n")
    assert only(check_can(tree, PLAIN), "can.exists").remedy == "Set can.channel: can1"


def test_virtual_interface_is_noted_and_has_its_own_commands(tree: Tree) -> None:
    change = DOWN | {"linkinfo": {"info_kind": "vcan"}}
    interface(tree, change)
    findings = check_can(tree, FD)
    assert grave(findings) == {"can.exists": NOTE, "can.up": ERROR, "can.fd": ERROR}
    assert only(findings, "can.up").command == "sudo ip link set can0 mtu 72 up"
    assert only(findings, "can.fd").command.endswith("sudo ip link set can0 mtu 72 up")


def test_vcan_has_its_own_commands_even_without_ip(tree: Tree) -> None:
    vcan0 = CanConfig(channel="vcan0")
    add = "sudo ip link add vcan0 type vcan && sudo ip link set vcan0 up"
    assert only(check_can(tree, vcan0), "can.exists").command == add
    tree.file("/sys/class/net/can1/type", "280\n")
    assert only(check_can(tree, vcan0), "can.exists").command == add
    for name, text in (
        ("type", "280"),
        ("flags", "0x80"),
        ("mtu", "16"),
    ):
        tree.file(f"/sys/class/net/vcan0/{name}", f"{text}\n")
    found = check_can(tree, vcan0)
    assert only(found, "can.up").command == "sudo ip link set vcan0 up"


def test_missing_can_driver_and_another_kind_of_interface_are_reported(tree: Tree) -> None:
    interface(tree, {"type": "1"})
    found = only(check_can(tree, PLAIN), "can.exists")
    assert found.severity == ERROR
    assert found.text == "can0 is not a CAN interface"
    assert grave(check_can(tree, CanConfig(interface="pcan"))) == {"can.driver": NOTE}


def test_slcan_is_not_asked_for_a_restart_that_it_cannot_do(tree: Tree) -> None:
    """The slcan driver of the kernel has fixed rates, no bit timing and no restart."""
    rates = {"bittiming_bitrate": 500000, "bitrate_const": [250000, 500000]}
    change = info(bittiming=None, restart_ms=0, clock=0, **rates)
    interface(tree, change, hardware=False)
    findings = check_can(tree, PLAIN)
    assert grave(findings) == {"can.restart": NOTE}
    assert "restart-ms" not in only(findings, "can.restart").command
    assert only(findings, "can.bitrate").severity == OK
    merged(change, info(state="BUS-OFF"))
    interface(tree, change, hardware=False)
    off = only(check_can(tree, PLAIN), "can.state")
    assert off.command == "sudo ip link set can0 down; sudo ip link set can0 up"


@pytest.mark.parametrize("shown", [None, "[]", "Device does not exist."])
def test_without_ip_or_its_json_the_rest_is_checked(tree: Tree, shown: str | None) -> None:
    interface(tree, DOWN)
    del tree.programs["ip",]
    if shown is not None:
        tree.programs["ip",] = shown
    assert grave(check_can(tree, PLAIN)) == {"can.up": ERROR, "can.details": NOTE}


@pytest.mark.parametrize(
    ("driver", "restart_ms", "warns"),
    [("mcp251xfd", 100, True), ("mcp251xfd", 0, False), ("mcp251x", 100, False)],
)
def test_restart_ms_is_warned_about_only_with_a_driver_that_crashes(
    tree: Tree, driver: str, restart_ms: int, warns: bool
) -> None:
    interface(tree, info(restart_ms=restart_ms))
    (tree.root / "sys/class/net/can0/device/driver").symlink_to(f"../../bus/spi/drivers/{driver}")
    findings = check_can(tree, PLAIN)
    said = [each for each in findings if "6916" in each.text]
    assert bool(said) == warns
    assert all(each.command.endswith("type can restart-ms 0") for each in said)


@pytest.mark.parametrize("is_enabled", [False, True])
def test_restarts_need_the_enabled_unit(tree: Tree, is_enabled: bool) -> None:
    interface(tree, {})
    wants = tree.root / "etc/systemd/system/multi-user.target.wants"
    wants.mkdir(parents=True)
    if is_enabled:
        unit = "kontronik-can-gw-restart@can0.path"
        (wants / unit).symlink_to("/etc/systemd/system/kontronik-can-gw-restart@.path")
    findings = check_can(tree, CanConfig(restart_after_s=0.5))
    assert ("can.restart_unit" in grave(findings)) == (not is_enabled)
    said = only(findings, "can.restart_unit").text
    assert "Only gateways of root and of the service's user can request a restart" in said
    assert "can.restart_unit" not in {each.check for each in check_can(tree, PLAIN)}
