"""What `doctor` says of a CAN interface. The documents are those of `ip -json -details -statistics link show`."""

import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from doctor_trees import Tree, grave, only

from kontronik_can_gw.config import CanConfig
from kontronik_can_gw.runtime.doctor.can_interface import check_can
from kontronik_can_gw.runtime.doctor.findings import Finding, Severity
from kontronik_can_gw.runtime.locks import SYSTEM_FOLDER, file_name, messages_lock, node_lock

Change = Callable[[dict[str, Any]], object]
PLAIN = CanConfig()


def controller() -> dict[str, Any]:
    """An adapter with everything as it should be."""
    return {
        "ifname": "can0",
        "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
        "mtu": 16,
        "operstate": "UP",
        "txqlen": 128,
        "link_type": "can",
        "linkinfo": {
            "info_kind": "can",
            "info_data": {
                "state": "ERROR-ACTIVE",
                "berr_counter": {"tx": 0, "rx": 0},
                "restart_ms": 100,
                "bittiming": {"bitrate": 500000, "sample_point": "0.875", "tq": 125},
                "clock": 8000000,
            },
            "info_xstats": {
                "restarts": 0,
                "bus_error": 0,
                "arbitration_lost": 0,
                "error_warning": 0,
                "error_passive": 0,
                "bus_off": 0,
            },
        },
        "stats64": {
            "rx": {"bytes": 0, "packets": 0, "errors": 0, "dropped": 0, "over_errors": 0, "multicast": 0},
            "tx": {"bytes": 0, "packets": 0, "errors": 0, "dropped": 0, "carrier_errors": 0, "collisions": 0},
        },
    }


def slcan() -> dict[str, Any]:
    """The kernel's slcan driver: fixed rates, no bit timing, no restart."""
    found = controller()
    found["linkinfo"]["info_data"] = {
        "ctrlmode_supported": ["LISTEN-ONLY"],
        "state": "ERROR-ACTIVE",
        "restart_ms": 0,
        "bittiming_bitrate": 500000,
        "bitrate_const": [10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000, 1000000],
        "clock": 0,
    }
    return found


def info(found: dict[str, Any]) -> dict[str, Any]:
    data: dict[str, Any] = found["linkinfo"]["info_data"]
    return data


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    made = Tree(tmp_path)
    made.file("/proc/net/protocols", "protocol  size sockets\nCAN_RAW    1024      0\nTCP  1 1\n")
    return made


def interface(tree: Tree, found: dict[str, Any], hardware: bool = True) -> None:
    """Let there be can0, as `ip` shows it."""
    tree.file("/sys/class/net/can0/type", "280\n")
    if hardware:
        tree.folder("/sys/class/net/can0/device")
    tree.programs["ip",] = json.dumps([found])


def check(tree: Tree, can: CanConfig = PLAIN) -> list[Finding]:
    return check_can(tree, can)


def changed(tree: Tree, change: Change, can: CanConfig = PLAIN) -> list[Finding]:
    """The findings for a good adapter with one change."""
    found = controller()
    change(found)
    interface(tree, found)
    return check(tree, can)


def test_a_good_interface_has_nothing_but_ok(tree: Tree) -> None:
    interface(tree, controller())
    findings = check(tree)
    assert grave(findings) == {}
    assert {finding.group for finding in findings} == {"CAN can0"}
    assert only(findings, "can.bitrate").text == "500000 bit/s, as can.bitrate says"
    assert only(findings, "can.sample_point").text == "sample point 87.5%"


def test_a_missing_interface_is_told_with_those_there_are(tree: Tree) -> None:
    found = only(check(tree), "can.exists")
    assert found.severity is Severity.ERROR
    assert found.command == "sudo ip link add can0 type vcan && sudo ip link set can0 up"
    tree.file("/sys/class/net/can1/type", "280\n")
    tree.file("/sys/class/net/eth0/type", "1\n")
    assert only(check(tree), "can.exists").remedy == "Set can.channel: can1"


def test_a_network_card_is_no_can_interface(tree: Tree) -> None:
    found = only(changed(tree, lambda f: f.update(link_type="ether")), "can.exists")
    assert found.severity is Severity.ERROR


def test_an_interface_that_is_down_is_told_with_the_whole_command(tree: Tree) -> None:
    findings = changed(tree, lambda f: (f["flags"].remove("UP"), info(f).update(state="STOPPED")))
    found = only(findings, "can.up")
    assert found.severity is Severity.ERROR
    assert found.command == "sudo ip link set can0 up type can bitrate 500000 restart-ms 100"
    assert not [f for f in findings if f.check == "can.state"]


@pytest.mark.parametrize("bitrate", [250000, 0])
def test_another_bit_rate_is_an_error(tree: Tree, bitrate: int) -> None:
    found = only(changed(tree, lambda f: info(f)["bittiming"].update(bitrate=bitrate)), "can.bitrate")
    assert found.severity is Severity.ERROR
    assert found.command.endswith("sudo ip link set can0 up type can bitrate 500000")


def test_an_interface_that_was_never_set_up_is_told_once_with_the_command_that_sets_all(tree: Tree) -> None:
    def change(found: dict[str, Any]) -> None:
        found["flags"].remove("UP")
        info(found).pop("bittiming")
        info(found).update(state="STOPPED", restart_ms=0)

    assert grave(changed(tree, change)) == {"can.up": Severity.ERROR}


def test_an_unusual_sample_point_is_noted(tree: Tree) -> None:
    found = only(changed(tree, lambda f: info(f)["bittiming"].update(sample_point="0.600")), "can.sample_point")
    assert found.severity is Severity.NOTE


@pytest.mark.parametrize(("restart_ms", "severity"), [(0, Severity.ERROR), (5000, Severity.WARNING), (1, Severity.OK)])
def test_bus_off_must_not_be_for_ever(tree: Tree, restart_ms: int, severity: Severity) -> None:
    found = only(changed(tree, lambda f: info(f).update(restart_ms=restart_ms)), "can.restart")
    assert found.severity is severity
    assert ("restart-ms 100" in found.command) is (severity is not Severity.OK)


def test_slcan_cannot_restart_and_is_not_told_to(tree: Tree) -> None:
    interface(tree, slcan(), hardware=False)
    findings = check(tree)
    assert grave(findings) == {"can.restart": Severity.NOTE}
    assert "restart-ms" not in only(findings, "can.restart").command
    assert only(findings, "can.bitrate").severity is Severity.OK


@pytest.mark.parametrize(
    ("length", "severity"), [(1, Severity.WARNING), (7, Severity.WARNING), (10, Severity.OK), (1000, Severity.OK)]
)
def test_the_queue_has_room_for_more_than_the_gateways_share(tree: Tree, length: int, severity: Severity) -> None:
    found = only(changed(tree, lambda f: f.update(txqlen=length)), "can.queue")
    assert found.severity is severity
    assert ("txqueuelen 128" in found.command) is (severity is not Severity.OK)


@pytest.mark.parametrize(
    ("state", "severity"),
    [
        ("ERROR-ACTIVE", Severity.OK),
        ("ERROR-WARNING", Severity.WARNING),
        ("ERROR-PASSIVE", Severity.WARNING),
        ("BUS-OFF", Severity.ERROR),
        ("SLEEPING", Severity.WARNING),
    ],
)
def test_the_controllers_state_is_told_with_its_error_counters(tree: Tree, state: str, severity: Severity) -> None:
    found = only(changed(tree, lambda f: info(f).update(state=state, berr_counter={"tx": 128, "rx": 7})), "can.state")
    assert found.severity is severity
    assert "transmit 128, receive 7" in found.text
    assert severity is Severity.OK or found.remedy or found.command


@pytest.mark.parametrize(
    ("mode", "severity"),
    [("LISTEN-ONLY", Severity.ERROR), ("LOOPBACK", Severity.ERROR), ("ONE-SHOT", Severity.WARNING)],
)
def test_modes_in_which_frames_do_not_reach_the_bus_are_told(tree: Tree, mode: str, severity: Severity) -> None:
    found = only(changed(tree, lambda f: info(f).update(ctrlmode=[mode, "BERR-REPORTING"])), "can.mode")
    assert found.severity is severity
    assert found.command.endswith(f"{mode.lower()} off")


def test_harmless_modes_are_not_told(tree: Tree) -> None:
    assert grave(changed(tree, lambda f: info(f).update(ctrlmode=["TRIPLE-SAMPLING", "BERR-REPORTING"]))) == {}


def test_can_fd_must_be_on_where_the_configuration_wants_it(tree: Tree) -> None:
    needs = CanConfig(fd=True)
    found = only(changed(tree, lambda _: None, needs), "can.fd")
    assert found.severity is Severity.ERROR
    assert "dbitrate 2000000 fd on" in found.command
    on: Change = lambda f: (f.update(mtu=72), info(f).update(data_bittiming={"bitrate": 2000000}))  # noqa: E731
    assert grave(changed(tree, on, needs)) == {}
    slow: Change = lambda f: (f.update(mtu=72), info(f).update(data_bittiming={"bitrate": 4000000}))  # noqa: E731
    assert only(changed(tree, slow, needs), "can.data_bitrate").severity is Severity.ERROR


def test_what_was_counted_is_told(tree: Tree) -> None:
    def change(found: dict[str, Any]) -> None:
        found["linkinfo"]["info_xstats"].update(bus_off=3, error_passive=5)
        found["stats64"]["tx"]["dropped"] = 9

    findings = changed(tree, change)
    assert only(findings, "can.bus_off").severity is Severity.WARNING
    assert "3 times" in only(findings, "can.bus_off").text
    assert only(findings, "can.statistics").text == "counted so far: 5 error passive, 9 tx dropped"


def test_a_termination_that_can_be_switched_is_noted(tree: Tree) -> None:
    assert "120 ohm" in only(changed(tree, lambda f: info(f).update(termination=120)), "can.termination").text
    assert "off" in only(changed(tree, lambda f: info(f).update(termination=0)), "can.termination").text


def test_a_virtual_interface_is_told_as_such_and_has_no_controller(tree: Tree) -> None:
    found = controller() | {"linkinfo": {"info_kind": "vcan"}, "txqlen": 1000, "mtu": 72}
    interface(tree, found, hardware=False)
    findings = check(tree, CanConfig(fd=True))
    assert grave(findings) == {"can.exists": Severity.NOTE}
    assert "virtual" in only(findings, "can.exists").text
    found["mtu"] = 16
    interface(tree, found, hardware=False)
    assert only(check(tree, CanConfig(fd=True)), "can.fd").command.endswith("mtu 72 up")


@pytest.mark.parametrize("shown", [None, "", "[]", "[{}", "Device does not exist.", '[{"linkinfo": []}]'])
def test_without_ip_or_with_one_that_knows_no_json_sys_is_read(tree: Tree, shown: str | None) -> None:
    folder = "/sys/class/net/can0"
    numbers = {"type": "280", "flags": "0x40041", "mtu": "16", "tx_queue_len": "10"}
    for name, text in numbers.items():
        tree.file(f"{folder}/{name}", text + "\n")
    tree.file(f"{folder}/statistics/tx_dropped", "4\n")
    if shown is not None:
        tree.programs["ip",] = shown
    findings = check(tree)
    assert grave(findings) == {"can.details": Severity.NOTE, "can.statistics": Severity.NOTE}
    tree.file(f"{folder}/flags", "0x40040\n")
    assert only(check(tree), "can.up").severity is Severity.ERROR


def test_a_kernel_without_socketcan_is_told_with_the_package(tmp_path: Path) -> None:
    tree = Tree(tmp_path)
    found = only(check(tree), "can.kernel")
    assert found.severity is Severity.ERROR
    assert f"linux-modules-extra-{platform.release()}" in found.command
    tree.file(
        f"/lib/modules/{platform.release()}/modules.dep", "kernel/net/can/can-raw.ko.xz: kernel/net/can/can.ko.xz\n"
    )
    assert only(check(tree), "can.kernel").severity is Severity.OK


def test_another_gateway_on_this_interface_is_noted(tree: Tree) -> None:
    interface(tree, controller())
    tree.file("/proc/self/ns/net", "")
    namespace = tree.path("/proc/self/ns/net").stat().st_ino
    names = [node_lock("can0", 10), node_lock("can0", 2), messages_lock("can0", 0x680), node_lock("can1", 7)]
    files = [file_name(name, namespace) for name in names] + [file_name(node_lock("can0", 3), namespace + 1)]
    left = file_name(node_lock("can0", 4), namespace)
    lines = []
    for file in [*files, left]:
        tree.file(f"{SYSTEM_FOLDER}/{file}", "")
        status = tree.path(f"{SYSTEM_FOLDER}/{file}").stat()
        place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
        lines.append(f"1: FLOCK  ADVISORY  WRITE 90 {place} 0 EOF")
    tree.file("/proc/locks", "\n".join(lines[:-1]) + "\n")
    tree.process(90, "python3", "-m", "kontronik_can_gw", "run")
    found = only(check(tree), "can.gateway")
    assert found.severity is Severity.NOTE
    assert found.text == "kontronik-can-gw (pid 90) already sends CANopen node 2, 10 and the messages from 680h on"


def test_the_driver_of_another_interface_is_only_loaded(tree: Tree) -> None:
    findings = check(tree, CanConfig("virtual", "x"))
    assert [f.check for f in findings] == ["can.driver"]
    assert findings[0].severity is Severity.OK


def test_a_driver_that_cannot_be_loaded_is_an_error(tree: Tree, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("can.interfaces.BACKENDS", {"strange": ("no_such_module_of_a_vendor", "Bus")})
    found = only(check(tree, CanConfig("strange", "x")), "can.driver")
    assert found.severity is Severity.ERROR
    assert "no_such_module_of_a_vendor" in found.text
