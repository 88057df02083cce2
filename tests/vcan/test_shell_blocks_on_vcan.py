"""Shell blocks of README, docs and examples that need a CAN interface work as described."""

import csv
import shutil
from pathlib import Path

import pytest
from shell_blocks import Block, blocks, make_files, run_block

pytestmark = [
    pytest.mark.promise("docs"),
    pytest.mark.extended,
]

BEFORE = """
sudo() { "$@"; }
# A foreground command that never ends gets a signal when it shows an ESC with telemetry. The state
# that `status` shows is up to a second old, and a reader needs longer for the line before.
kontronik-can-gw() {
    case $BASHPID.$1 in $$.run | $$.monitor) ;;
        $$.status) until command kontronik-can-gw "$@"; do sleep 0.1; done; return ;;
        *) command kontronik-can-gw "$@"; return ;; esac
    : >said
    command kontronik-can-gw "$@" >said 2>&1 &
    until grep -Eq "esc1.*( ok|heard)" said || ! kill -0 $! 2>/dev/null; do sleep 0.1; done
    kill $! 2>/dev/null || :
    wait $! || { cat said; return 1; }
}
mount -t sysfs sys /sys  # shows this network namespace
mount -t tmpfs run /run  # `status` finds no gateway that another test killed
unset KONTRONIK_RUN XDG_RUNTIME_DIR
ip link set lo up
"""
RUNNING = """
for channel in can0 can1; do
    ip link add $channel type vcan
    ip link set $channel up
    kontronik-can-gw simulate --link $channel.esc &
    kontronik-can-gw init - |
        sed "s#^port = .*#port = \\"$channel.esc\\"#; s#\\"can0\\"#\\"$channel\\"#" >$channel.toml
    kontronik-can-gw run --wait -c $channel.toml &
done
"""
INTERFACES = """
for channel in can0 vcan0; do ip link add $channel type vcan && ip link set $channel up; done
kontronik-can-gw simulate --link esc1 &
until [ -e esc1 ]; do sleep 0.1; done
"""


def before(text: str) -> str:
    """Return the commands before a block: interfaces, and running gateways to monitor."""
    if "ip link add" in text:
        return BEFORE
    if "monitor" in text:
        return BEFORE + RUNNING
    return BEFORE + INTERFACES


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    make_files(folder, "can0", 10)
    return folder


@pytest.mark.parametrize("block", blocks("vcan"), ids=lambda block: block.place)
def test_shell_block_can_be_typed_as_it_is(
    vcan: str,
    block: Block,
    files: Path,
    tmp_path: Path,
) -> None:
    folder = tmp_path / "f"
    shutil.copytree(files, folder, symlinks=True)
    run_block(block, folder, before(block.text), "unshare", "--net", "--mount")
    if block.place.startswith("README.md:"):
        assert_voltages(folder / "try" / "values.csv")


def assert_voltages(table: Path) -> None:
    """Check that README's block for newcomers ends with a table of the simulated ESC's voltages.

    The number of rows is not judged. The block ends as soon as `status` shows telemetry of an ESC,
    and the number of frames until then depends on the speed of the machine.
    """
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    (column,) = (name for name in rows[0] if name.partition(" ")[0] == "battery_voltage")
    voltages = [float(row[column]) for row in rows if row[column]]
    assert voltages, f"none of {len(rows)} rows has a voltage"
    assert 20 < min(voltages) <= max(voltages) < 26
