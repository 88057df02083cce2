"""The conformance test on a real vcan: the gateway's node, and a slave of another project."""

import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from conformance_report import PAGE, conformance, gateway_with_a_node
from foreign_tools import FOREIGN, NODE_CANOPEN, PACKAGES, need

pytestmark = pytest.mark.promise("cia-301")

VERDICT = re.compile(r"(passed|failed|deviates|not supported) +([a-z0-9-]+): ")


def verdicts_in(text: str) -> dict[str, str]:
    """Return the verdict of each item in the output of the command."""
    found = {}
    for line in text.splitlines():
        match = VERDICT.match(line)
        assert match is not None, line
        found[match[2]] = match[1]
    return found


def test_gateways_node_fulfils_all_items_of_the_report(vcan: str, tmp_path: Path) -> None:
    with gateway_with_a_node(vcan, tmp_path):
        done = conformance(vcan)
    verdicts = verdicts_in(done.stdout)
    assert "failed" not in verdicts.values(), done.stdout
    assert done.returncode == 0, done.stderr
    assert len(verdicts) >= 90
    documented = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("| `"):
            cells = line.removeprefix("| `").removesuffix(" |").split(" | ")
            documented[cells[0].rstrip("`")] = cells[-1].partition(":")[0]
    assert documented == verdicts, "make conformance writes the report again"


@pytest.mark.extended
def test_slave_of_another_project_is_judged(vcan: str, tmp_path: Path) -> None:
    """The slave in JavaScript is complete, but not strict."""
    need(NODE_CANOPEN.is_dir(), "canopen for node")
    eds = tmp_path / "slave.eds"
    command = ["node", str(FOREIGN / "node_slave.js"), str(PACKAGES / "node"), vcan, "9", str(eds)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as slave:
        try:
            assert slave.stdout is not None
            assert slave.stdout.readline() == "ready\n"
            done = conformance(vcan, "--node", 9, "--eds", eds, "--limit", 1)
        finally:
            slave.kill()
    verdicts = verdicts_in(done.stdout)
    counted = Counter(verdicts.values())
    assert done.returncode == 1
    assert counted["passed"] > 30, done.stdout
    assert counted["failed"] > 3, done.stdout
    for name in ("sdo-block-upload", "sdo-segmented-upload", "nmt-start", "pdo-each-third-sync"):
        assert verdicts[name] == "passed", done.stdout
    # its EDS says more than its server does
    for name in ("sdo-too-short", "sdo-no-sub-index-of-a-variable", "pdo-restricted-cob-ids"):
        assert verdicts[name] == "failed", done.stdout
