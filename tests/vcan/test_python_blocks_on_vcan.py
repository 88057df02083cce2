"""Python blocks of the docs run as printed, against a gateway on can0."""

import re
import shutil
from pathlib import Path

import pytest
from shell_blocks import PROJECT, Block, blocks, run_block

from kontronik_can_gw.canopen.storage import decode

pytestmark = [
    pytest.mark.promise("docs"),
    pytest.mark.extended,
]

BLOCKS = blocks(language="python")
EXAMPLES = [block for block in BLOCKS if "canopen.Network()" in block.text]
RECEIVER_PAGE = "docs/testing-your-receiver.md"
NEEDS_ROS = "examples/ros2/README.md"

GATEWAY = """
mount -t sysfs sys /sys  # shows this network namespace
mount -t tmpfs run /run  # the gateway is killed at the end, and its status is left there
ip link set lo up
ip link add can0 type vcan
ip link set can0 up
kontronik-can-gw eds -o kontronik_esc.eds
errors=$(for second in $(seq 2 3 120); do echo "--error bec_overcurrent@${{second}}s+1s"; done)
kontronik-can-gw simulate --link esc1 $errors &
until [ -e esc1 ]; do sleep 0.1; done
cat >canopen.toml <<END
[canopen]
enabled = true
node_id = {node_id}
store = "$PWD/store"
[[esc]]
port = "esc1"
END
run() {{
    : >gateway.log
    kontronik-can-gw run -c canopen.toml 2>>gateway.log &
    until grep -q "esc1: telemetry ok" gateway.log; do sleep 0.1; done
}}
run
"""
AFTER_RESTART = """
kill $!
wait $! || :
run
cat >restarted.py <<END
import can
with can.Bus(interface="socketcan", channel="can0") as bus:
    bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
    while bus.recv(60).arbitration_id != 0x1A1: pass
END
python restarted.py
"""
PATIENT = "import canopen.sdo.client; canopen.sdo.client.SdoClient.RESPONSE_TIMEOUT = 60.0"
"""Code before an example, so that the master waits for answers even on a busy machine."""


def output_of(
    block: Block,
    folder: Path,
    node_id: int = 1,
    after: str = "",
) -> str:
    """Run an example with a gateway with one ESC on can0. Return the output of the example."""
    (folder / "example.py").write_text(block.text)
    started = f"python -c \"{PATIENT}; exec(open('example.py').read(), {{}})\""
    shown = Block(block.place, "", f"{started} >example.out\n{after}")
    run_block(
        shown,
        folder,
        GATEWAY.format(node_id=node_id),
        "unshare",
        "--net",
        "--mount",
    )
    return (folder / "example.out").read_text()


def example(*words: str) -> list[Block]:
    """Return the examples that contain all of these words."""
    found = [block for block in EXAMPLES if all(word in block.text for word in words)]
    assert found, words
    return found


def test_every_python_block_is_run_or_needs_ros() -> None:
    run = {block.place for block in EXAMPLES}
    others = {block.place.partition(":")[0] for block in BLOCKS if block.place not in run}
    assert others == {RECEIVER_PAGE, NEEDS_ROS}
    assert {place.partition(":")[0] for place in run} == {"docs/canopen.md"}


def test_example_polls_values(vcan: str, tmp_path: Path) -> None:
    (block,) = example("Battery voltage")
    said = output_of(block, tmp_path)
    assert re.search(r"^voltage 2\d\.\d+ V$", said, re.MULTILINE)
    assert said.endswith("link 2\n")


def test_example_receives_pdos(vcan: str, tmp_path: Path) -> None:
    (block,) = example("wait_for_reception")
    said = output_of(block, tmp_path).splitlines()
    assert len(said) == 15
    assert [line.rpartition(" ")[0] for line in said[:3]] == [
        "Live data.Electrical speed",
        "Live data.Battery voltage",
        "Live data.Battery current",
    ]
    assert all(2000 < int(line.rpartition(" ")[2]) < 3000 for line in said if "voltage" in line)


def test_example_receives_emergencies_and_reads_the_history(vcan: str, tmp_path: Path) -> None:
    (block,) = example("emcy")
    said = output_of(block, tmp_path)
    assert re.search(r"^(2220|0000)h, error word", said, re.MULTILINE)
    assert re.search(r"^register \d+$", said, re.MULTILINE)
    assert "history 1: 2220h" in said


def test_example_stores_settings_and_a_pdo_across_a_restart(vcan: str, tmp_path: Path) -> None:
    (block,) = example("store()")
    output_of(block, tmp_path, after=AFTER_RESTART)
    stored = decode((tmp_path / "store" / "esc1.params").read_bytes())
    own = {key: data for key, data in stored.values.items() if key >> 8 >= 0x2000}
    assert own == {0x210001: b"\x07"}
    assert stored.values[0x101700] == (500).to_bytes(2, "little")
    assert stored.values[0x180401] == (0x400001A1).to_bytes(4, "little")


def test_example_sets_the_node_id_of_a_waiting_node(vcan: str, tmp_path: Path) -> None:
    (block,) = example("fast_scan")
    assert output_of(block, tmp_path, node_id=255).startswith("found True")
    assert decode((tmp_path / "store" / "esc1.params").read_bytes()).node_id == 5


def test_receiver_is_tested_with_the_example(vcan: str, tmp_path: Path) -> None:
    shutil.copytree(PROJECT / "examples", tmp_path / "examples")
    (block,) = (block for block in BLOCKS if block.place.startswith(f"{RECEIVER_PAGE}:"))
    folder = tmp_path / "examples" / "receiver"
    (folder / "test_page.py").write_text(block.text)
    shown = Block(block.place, "", "python -m pytest -p no:cacheprovider test_page.py")
    said = run_block(shown, folder, f"export CAN_CHANNEL={vcan}")
    assert "1 passed" in said
