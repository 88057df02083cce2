"""Each SYNC of several read at once counts. 2021h:7 counts PDOs that a newer one replaced."""

import pytest
from dialogue import NO_HEARTBEAT, QUIET, Bench, live, tpdo

from kontronik_can_gw.canopen.objects import GATEWAY
from kontronik_can_gw.canopen.pdo import MAX_WAITING
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("sync")

REPLACED = (GATEWAY, 7)
VOLTAGE = 0x20000210
LIVE_COUNTER = 0x20200208


def synced(kind: int, *mapped: int) -> Bench:
    """Return a started node whose only TPDO has this transmission type."""
    return Bench(changes={**QUIET, **tpdo(1, kind, 0, 0, *mapped)}).start()


def read_at_once(bench: Bench, count: int) -> list[bytes]:
    """Read ``count`` SYNCs in one iteration of the loop. Return the PDOs that follow."""
    for _ in range(count):
        bench.gateway.receive_frame(CanFrame(0x80, b""), bench.now, bench.now)
    bench.gateway.advance(bench.now)
    bench._collect()
    bench.wait(1)
    return [frame.data for frame in bench.take() if frame.can_id == 0x181]


@pytest.mark.parametrize(
    ("kind", "syncs", "expected", "replaced"),
    [
        (1, 4, 1, 3),
        (2, 4, 2, 0),
        (2, 5, 2, 0),
        (3, 4, 1, 0),
        (2, 2 * (MAX_WAITING + 3), MAX_WAITING + 1, 2),
        (240, 480, 2, 0),
    ],
)
def test_each_sync_read_at_once_counts(kind: int, syncs: int, expected: int, replaced: int) -> None:
    bench = synced(kind, LIVE_COUNTER)
    assert len(read_at_once(bench, syncs)) == expected
    assert bench.number(*REPLACED) == replaced


def test_count_continues_after_syncs_that_were_read_at_once() -> None:
    bench = synced(2, LIVE_COUNTER)
    assert len(read_at_once(bench, 3)) == 1
    assert len(read_at_once(bench, 1)) == 1


def test_type_0_sends_once_and_replaces_nothing() -> None:
    bench = synced(0, LIVE_COUNTER)
    assert len(read_at_once(bench, 4)) == 1
    assert bench.number(*REPLACED) == 0


def test_waiting_pdo_carries_the_values_of_its_own_turn() -> None:
    bench = synced(2, VOLTAGE)
    bench.uart(live(battery_voltage=2442))
    for _ in range(4):
        bench.gateway.receive_frame(CanFrame(0x80, b""), bench.now, bench.now)
    bench._collect()
    bench.uart(live(battery_voltage=2443))
    bench.wait(1)
    assert [f.data.hex() for f in bench.take() if f.can_id == 0x181] == ["8a09", "8b09"]


@pytest.mark.parametrize("command", ["02 01", "80 01", "82 01"])
def test_waiting_pdos_are_not_sent_after_the_node_has_left_operational(command: str) -> None:
    bench = synced(2, LIVE_COUNTER)
    for _ in range(8):
        bench.gateway.receive_frame(CanFrame(0x80, b""), bench.now, bench.now)
    bench.put(0, command)
    bench.wait(1)
    assert [frame for frame in bench.take() if frame.can_id == 0x181] == []


def test_waiting_pdos_are_not_sent_after_their_type_has_changed() -> None:
    bench = synced(2, LIVE_COUNTER)
    for _ in range(8):
        bench.gateway.receive_frame(CanFrame(0x80, b""), bench.now, bench.now)
    bench._collect()
    assert bench.write(0x1800, 2, 1, size=1) is None
    bench.wait(1)
    assert len([frame for frame in bench.take() if frame.can_id == 0x181]) == 1


def test_no_pdo_waits_while_telemetry_is_lost() -> None:
    bench = synced(2, VOLTAGE)
    assert read_at_once(bench, 8) == []
    bench.uart(live(battery_voltage=2442))
    assert len(read_at_once(bench, 2)) == 1


def test_all_pdos_and_nodes_answer_syncs_that_were_read_at_once() -> None:
    changes = {**QUIET, **tpdo(1, 2, 0, 0, LIVE_COUNTER), **tpdo(2, 3, 0, 0, LIVE_COUNTER)}
    bench = Bench(2, changes={**changes, **NO_HEARTBEAT}).start()
    read_at_once(bench, 0)
    for _ in range(6):
        bench.gateway.receive_frame(CanFrame(0x80, b""), bench.now, bench.now)
    bench._collect()
    bench.wait(1)
    ids = [frame.can_id for frame in bench.take()]
    assert {each: ids.count(each) for each in ids} == {0x181: 3, 0x182: 3, 0x281: 2, 0x282: 2}
