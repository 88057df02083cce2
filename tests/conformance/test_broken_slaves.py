"""Each rule that a slave breaks is found by the item about this rule, and by no fault of the test.

The slaves are the gateway's node behind a proxy, in simulated time.
"""

import pytest
from broken_slaves import BROKEN, BrokenSlave
from simulated_slave import Proxy, simulated_slave

from kontronik_can_gw.desk.conformance.run import ItemVerdict, all_items, run
from kontronik_can_gw.desk.conformance.slave import Slave
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("conformance")

_TPDOS_EMCY_AND_LSS = (0x081, 0x181, 0x7E4)


def verdicts(slave: Slave, *names: str) -> dict[str, str]:
    """Return the verdicts of these items, or of all items."""
    items = [item for item in all_items() if not names or item.name in names]
    return {result.item.name: result.verdict.value for result in run(slave, items, {})}


def test_conforming_slave_passes_all_items() -> None:
    found = verdicts(simulated_slave())
    assert len(found) == len(all_items())
    failed = {name for name, verdict in found.items() if verdict != ItemVerdict.PASSED.value}
    assert failed == {"od-vendor-id-is-assigned"}


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.name)
def test_broken_slave_fails_the_item_about_its_fault(broken: BrokenSlave) -> None:
    slave = simulated_slave(broken.from_master, broken.from_node)
    assert verdicts(slave, broken.item) == {broken.item: "failed"}


def test_there_are_slaves_for_all_services_of_the_standards() -> None:
    found = {broken.item for broken in BROKEN}
    assert len(BROKEN) >= 28
    for prefix in ("nmt-", "heartbeat-", "sdo-", "od-", "pdo-", "sync-", "emcy-", "store-", "lss-"):
        assert any(name.startswith(prefix) for name in found), prefix


def test_silence_of_a_service_that_does_not_work_is_not_passed() -> None:
    """A slave without TPDOs, emergencies and LSS has none at a wrong time either."""

    def send_no_such_frame(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
        return [] if frame.can_id in _TPDOS_EMCY_AND_LSS else [frame]

    silent = [item.name for item in all_items() if item.needs.startswith(("pdo", "emcy", "lss"))]
    found = verdicts(simulated_slave(from_node=send_no_such_frame), *silent)
    assert len(found) >= 11
    assert set(found.values()) == {"not supported"}


def test_size_that_is_not_indicated_is_no_fault() -> None:
    """CiA 301 allows expedited uploads without a size."""

    def hide_size(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
        is_expedited = frame.can_id == 0x581 and frame.data[0] & 0xE3 == 0x43
        if is_expedited:
            return [frame._replace(data=b"\x42" + frame.data[1:])]
        return [frame]

    found = verdicts(simulated_slave(from_node=hide_size))
    assert {name for name, verdict in found.items() if verdict == "failed"} == {
        "od-vendor-id-is-assigned"
    }


def test_upload_by_segments_instead_of_blocks_is_named() -> None:
    """LocalNode answers a block upload with a segmented one, which was not permitted."""

    def answer_by_segments(frame: CanFrame, _proxy: Proxy) -> list[CanFrame]:
        if frame.can_id == 0x601 and frame.data[0] == 0xA4:
            return [frame._replace(data=b"\x40" + frame.data[1:4] + bytes(4))]
        return [frame]

    (item,) = [item for item in all_items() if item.name == "sdo-block-upload"]
    (result,) = run(simulated_slave(from_master=answer_by_segments), [item], {})
    assert result.answer == "command specifier 41h instead of a block upload"


def test_each_item_that_must_be_silent_names_one_that_exists() -> None:
    names = {item.name for item in all_items()}
    needed = {item.needs for item in all_items() if item.needs}
    assert needed <= names
