"""What masters' tools make of the shipped EDS, downloaded: dcf-tools' dcfgen (Lely, ros2_canopen) and the canopen package."""

import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from dialogue import NO_HEARTBEAT, Bench, live
from wire import wire_to

from kontronik_can_gw.config.keys import shipped

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
    """The objects of a concise DCF (CiA 302-3): count, then index, sub-index, size and data of each."""
    (count,), at = struct.unpack_from("<L", data), 4
    for _ in range(count):
        index, sub, size = struct.unpack_from("<HBL", data, at)
        yield index, sub, data[at + 7 : at + 7 + size]
        at += 7 + size
    assert at == len(data)


def test_each_object_of_dcfgens_concise_dcf_is_accepted_and_the_pdos_are_what_the_bus_file_says(
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


def test_the_canopen_package_saves_a_pdo_that_it_did_not_read_before() -> None:
    bench = Bench(changes=NO_HEARTBEAT)
    node = wire_to(bench).add_node(1, str(EDS))
    pdo = node.tpdo[5]
    pdo.cob_id, pdo.trans_type, pdo.event_timer = 0x1F1, 254, 100
    pdo.enabled = pdo.rtr_allowed = True
    pdo.add_variable(0x2000, 2)
    pdo.save()
    assert bench.number(0x1804, 1) == 0x1F1
    bench.start()
    bench.uart(live(battery_voltage=2442))
    assert (0x1F1, b"\x8a\x09") in [(frame.can_id, frame.data) for frame in bench.take()]
