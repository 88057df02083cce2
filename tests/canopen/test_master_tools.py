"""The shipped EDS with masters of other projects, and LSS (CiA 305).

The masters are dcf-tools' dcfgen (Lely, ros2_canopen) and the canopen package.
"""

import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import canopen
import canopen.lss
import pytest
from dialogue import NO_HEARTBEAT, QUIET, Bench, live
from wire import wire_to

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.status import UNCONFIGURED

pytestmark = pytest.mark.promise("foreign-masters")

EDS = shipped("eds/kontronik_esc.eds")
BUS = """
master: {{node_id: 127}}
left:
  node_id: 5
  dcf: {eds}
  tpdo:
    1:
      cob_id: auto
      transmission: 1
      mapping: [{{index: 0x2000, sub_index: 2}}, {{index: 0x2000, sub_index: 15}}]
    2:
      enabled: true
      cob_id: 0x1A0
      inhibit_time: 100
    5:
      cob_id: auto
      event_timer: 100
      mapping: [{{index: 0x2020, sub_index: 1}}, {{index: 0x2020, sub_index: 2}}]
"""


def concise(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield index, sub-index and data of each object of a concise DCF (CiA 302-3)."""
    (count,) = struct.unpack_from("<L", data)
    at = 4
    for _ in range(count):
        index, sub, size = struct.unpack_from("<HBL", data, at)
        yield index, sub, data[at + 7 : at + 7 + size]
        at += 7 + size
    assert at == len(data)


def test_dcfgens_concise_dcf_is_accepted_and_sets_the_pdos(
    tmp_path: Path,
) -> None:
    (tmp_path / "bus.yml").write_text(BUS.format(eds=EDS))
    program = ["-W", "ignore", "-c", "from dcfgen.cli import main; main()", "-d", ".", "bus.yml"]
    subprocess.run([sys.executable, *program], cwd=tmp_path, check=True, capture_output=True)
    objects = list(concise((tmp_path / "left.bin").read_bytes()))
    comm = [(sub, data) for index, sub, data in objects if 0x1800 <= index < 0x1A00]
    cob_ids = [int.from_bytes(data, "little") for sub, data in comm if sub == 1]
    wanted = [0x80000185, 0x185, 0x800001A0, 0x1A0, 0x80000680, 0x680]
    assert cob_ids == wanted, "bit 30 is 0 in all"

    bench = Bench(node_ids=[5], changes=NO_HEARTBEAT)
    for index, sub, data in objects:
        assert bench.write(index, sub, data, node=5) is None, f"{index:04X}h:{sub:02X}"
    written = [bench.number(0x1800 + n, 1, node=5) for n in (0, 1, 4)]
    assert written == [0x185, 0x1A0, 0x680], "kept as written"
    bench.start()
    bench.uart(live(battery_voltage=2442, operating_state=26, motor_current=3))
    sent = [(frame.can_id, frame.data[:3].hex()) for frame in bench.take()]
    assert sent == [(0x1A0, "030000"), (0x385, "000000"), (0x485, "000000"), (0x680, "0201")]
    bench.put(0x80, b"")
    assert [(f.can_id, f.data.hex()) for f in bench.take()] == [(0x185, "8a091a")]
    for cob_id in (0x185, 0x1A0, 0x680):
        bench.put(cob_id, b"", remote=True)
    assert bench.take() == [], "no RTR is answered"
    bench.wait(100)
    assert 0x680 in {frame.can_id for frame in bench.take()}, "the event timer"


def test_canopen_package_can_save_a_pdo_without_reading_it_first() -> None:
    bench = Bench(changes=NO_HEARTBEAT)
    node = wire_to(bench).add_node(1, str(EDS))
    pdo = node.tpdo[5]
    pdo.cob_id = 0x1F1
    pdo.trans_type = 254
    pdo.event_timer = 100
    pdo.enabled = pdo.rtr_allowed = True
    pdo.add_variable(0x2000, 2)
    pdo.save()
    assert bench.number(0x1804, 1) == 0x1F1
    bench.start()
    bench.uart(live(battery_voltage=2442))
    assert (0x1F1, b"\x8a\x09") in [(frame.can_id, frame.data) for frame in bench.take()]


# --- LSS


def master_of(bench: Bench) -> Any:
    """Return a foreign master whose requests all nodes receive."""
    master: Any = wire_to(bench).lss
    master.RESPONSE_TIMEOUT = 0.0002  # an answer is available before it waits
    return master


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove the foreign master's pauses of 200 ms after each part of an identity."""
    monkeypatch.setattr(canopen.lss, "time", SimpleNamespace(sleep=lambda _: None))


@pytest.mark.promise("lss")
def test_foreign_master_finds_slaves_by_fastscan_and_sets_node_ids() -> None:
    bench = Bench(node_ids=[UNCONFIGURED] * 6 + [100], changes=QUIET)
    master = master_of(bench)
    for number in range(1, 7):
        ok, found = master.fast_scan()
        place = found[3] - 77
        assert ok
        assert tuple(found) == bench.nodes[place].identity.identity
        assert [n for n, node in enumerate(bench.nodes) if node.lss.is_configuring] == [place]
        master.configure_node_id(number)
        assert master.inquire_lss_address(canopen.lss.CS_INQUIRE_SERIAL_NUMBER) == found[3]
        master.send_switch_state_global(master.WAITING_STATE)
        assert bench.nodes[place].node_id == number
    assert master.fast_scan() == (False, None)


@pytest.mark.promise("lss")
def test_foreign_master_configures_and_stores_a_node_id() -> None:
    bench = Bench(node_ids=[UNCONFIGURED] * 3, changes=QUIET)
    master = master_of(bench)
    identity = bench.nodes[1].identity.identity
    assert master.send_switch_state_selective(*identity)
    assert [node.lss.is_configuring for node in bench.nodes] == [False, True, False]
    assert tuple(map(master.inquire_lss_address, range(0x5A, 0x5E))) == identity
    assert master.inquire_node_id() == UNCONFIGURED
    master.configure_node_id(0x2A)
    for refused, value in ((master.configure_node_id, 0), (master.configure_bit_timing, 2)):
        with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
            refused(value)
    master.activate_bit_timing(100)
    master.store_configuration()
    assert [stored.node_id for stored in bench.on_disk] == [None, 0x2A, None]
