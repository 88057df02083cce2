"""The conformance test against LocalNode of the canopen package, which is not a complete slave.

Its gaps were measured by hand (see the requirements of our node), and the test must find them. So
this also shows that the items can fail.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import can
import canopen
import pytest
from command_line import refused, run

from kontronik_can_gw.cli import COMMANDS
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk.conformance.run import all_items

pytestmark = pytest.mark.promise("conformance")

EDS = str(shipped("eds/kontronik_esc.eds"))
MUST_FAIL = {
    "nmt-boot-up-after-reset-node",
    "nmt-no-sdo-while-stopped",
    "sdo-no-sub-index-of-a-variable",
    "sdo-value-too-high",
    "sdo-value-too-low",
    "sdo-segment-without-a-transfer",
    "pdo-each-sync",
    "pdo-restricted-cob-ids",
    "pdo-mapping-too-long",
    "emcy-lost-heartbeat",
    "lss-inquire-node-id",
    "store-and-restore",
}
MUST_PASS = {
    "sdo-device-type",
    "sdo-no-object",
    "sdo-written-value-is-read-back",
    "sdo-segmented-upload",
    "sdo-write-to-a-read-only-object",
    "od-no-communication-object-beyond-the-eds",
    "nmt-node-guarding",
    "eds-lists-of-objects",
    "eds-mandatory-objects",
}


@contextmanager
def local_node(channel: str, node_id: int) -> Iterator[canopen.LocalNode]:
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel)
    node = canopen.LocalNode(node_id, EDS)
    network.add_node(node)
    try:
        yield node
    finally:
        node.nmt.stop_heartbeat()  # type: ignore[no-untyped-call]
        network.disconnect()


def conformance(channel: str, *words: object) -> tuple[object, dict[str, str], str]:
    """Run the command. Return its exit code, the verdict of each item, and the messages."""
    bus = ("--interface", "virtual", "--channel", channel)
    done = run("conformance", *bus, "--limit", 0.3, *words)
    verdicts = {}
    for line in done.out.splitlines():
        verdict, _, rest = line.partition("  ")
        verdicts[rest.partition(":")[0].strip()] = verdict.strip()
    return done.code, verdicts, done.err


def test_gaps_of_an_incomplete_slave_are_found(tmp_path: Path) -> None:
    table = tmp_path / "report.md"
    results = tmp_path / "results.xml"
    with local_node("gaps", 5):
        outputs = ("-o", table, "--junit", results)
        code, verdicts, messages = conformance("gaps", "--node", 5, *outputs)
    assert code == 1
    failed = {name for name, verdict in verdicts.items() if verdict == "failed"}
    passed = {name for name, verdict in verdicts.items() if verdict == "passed"}
    assert failed >= MUST_FAIL
    assert passed >= MUST_PASS
    assert list(verdicts) == [item.name for item in all_items()]
    assert f"{len(verdicts)} items: {len(passed)} passed, {len(failed)} failed" in messages
    text = table.read_text()
    for name in verdicts:
        assert f"| `{name}` |" in text
    suite = ET.parse(results).getroot()
    assert int(suite.attrib["tests"]) == len(verdicts)
    assert int(suite.attrib["failures"]) == len(failed) == len(suite.findall("testcase/failure"))


def test_deviation_with_a_reason_is_not_a_failure(tmp_path: Path) -> None:
    deviations = tmp_path / "deviations.toml"
    deviations.write_text('nmt-boot-up-after-reset-node = "it has no boot-up message"\n')
    with local_node("deviation", 1):
        words = ("--only", "nmt-boot-up-after-reset-node")
        code, verdicts, _ = conformance("deviation", *words)
        assert (code, [*verdicts.values()]) == (1, ["failed"])
        code, verdicts, messages = conformance("deviation", *words, "--deviations", deviations)
    assert (code, [*verdicts.values()]) == (0, ["deviates"])
    assert "1 items: 0 passed, 0 failed, 1 deviates" in messages


def test_reasons_of_the_gateway_apply_only_to_its_own_eds(tmp_path: Path) -> None:
    words = ("--only", "od-vendor-id-is-assigned")
    eds = tmp_path / "mine.eds"
    eds.write_bytes(Path(EDS).read_bytes())
    with local_node("reasons", 1):
        code, verdicts, _ = conformance("reasons", *words)
        assert (code, [*verdicts.values()]) == (0, ["deviates"])
        code, verdicts, _ = conformance("reasons", *words, "--eds", eds)
        assert (code, [*verdicts.values()]) == (1, ["failed"])


def test_slave_that_stores_nothing_is_no_failure(tmp_path: Path) -> None:
    words = ("--only", "store-capability", "--only", "store-and-restore")
    with local_node("no_store", 1) as node:
        dictionary: Any = node.object_dictionary
        dictionary[0x1010][1].default = 0
        _, verdicts, _ = conformance("no_store", *words)
    assert set(verdicts.values()) == {"not supported"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--node", 0), "--node 0: a node-ID is a number from 1 to 127"),
        (("--eds", "none.eds"), "none.eds: cannot be read: No such file or directory."),
        (("--deviations", "none.toml"), "none.toml: cannot be read: No such file or directory."),
        (("--only", "nmtt"), "--only nmtt: no item has this name. There are: nmt-boot-up-"),
        (("--interface", "socketkan"), "Did you mean socketcan?"),
    ],
)
def test_wrong_usage_is_refused(
    words: tuple[object, ...], message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refused(2, "conformance", *words)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('nmt-strat = "x"', "there is no item 'nmt-strat'. Did you mean nmt-start?"),
        ("nmt-start = 1", "nmt-start: give the reason of the deviation as a text."),
        ("nmt-start", "is not valid TOML"),
    ],
)
def test_wrong_file_of_deviations_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "deviations.toml"
    path.write_text(text)
    assert message in refused(2, "conformance", "--deviations", path)


def test_file_that_is_not_an_eds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.eds"
    path.write_text("[FileInfo]\nFileName=x.eds\n")
    assert "does not have the object 1000h" in refused(2, "conformance", "--eds", path)


def test_slave_that_does_not_answer_is_reported() -> None:
    said = refused(1, "conformance", "--interface", "virtual", "--channel", "empty", "--limit", 0.1)
    assert "node 1 on empty: does not answer. Is it on this bus" in said


def test_other_nodes_on_the_bus_prevent_lss() -> None:
    """LSS commands without an identity would also change them."""
    stop = threading.Event()

    def send_heartbeats() -> None:
        with can.Bus(interface="virtual", channel="others") as bus:
            while not stop.wait(0.005):
                bus.send(can.Message(arbitration_id=0x709, data=b"\x05", is_extended_id=False))

    sender = threading.Thread(target=send_heartbeats)
    sender.start()
    try:
        with local_node("others", 1):
            _, verdicts, _ = conformance("others", "--only", "lss-switch-global")
    finally:
        stop.set()
        sender.join()
    assert verdicts == {"lss-switch-global": "not supported"}


def test_list_has_each_item_with_its_clause() -> None:
    assert "conformance" in COMMANDS
    lines = run("conformance", "--list").out.splitlines()
    assert len(lines) == len(all_items()) >= 90
    assert all("CiA 30" in line for line in lines)
