"""A CANopen master of another project, canopen for node in JavaScript. tshark decodes the frames.

tests/foreign/install.sh installs the master. It shares no code with the gateway or with its usual
test master.
"""

import itertools
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from foreign_tools import NODE_CANOPEN, NodeMaster, has_tshark, need, refusal, tshark
from harness import PtyPort
from vcan_tools import (
    EDS,
    SERIAL,
    GatewayProcess,
    Witness,
    canopen_table,
    configuration,
    feeding,
    recording,
    sent_by,
    wait_for,
)

pytestmark = [
    pytest.mark.promise("foreign-masters"),
    pytest.mark.extended,
]

Start = Callable[..., GatewayProcess]

PRODUCT = 0x4B4F4E01
REVISION = 0x00010000
LOSES = "telemetry_timeout_ms = 10000"
"""Timeout if telemetry must be lost. It is longer than any hold-up of the machine."""
BOOT_UP = 0
STOPPED = 4
OPERATIONAL = 5
PRE_OPERATIONAL = 127
BOOTED = [BOOT_UP, PRE_OPERATIONAL]
SIZES = {0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4}
"""Bytes of a number by CiA 301 data type. Strings and domains have any length."""
WRITE_ONLY = 0x06010001
NO_OBJECT = 0x06020000
NO_SUB = 0x06090011
TOO_HIGH = 0x06090031
TOO_LOW = 0x06090032
TOO_LONG = 0x06070012
NO_DATA = 0x08000024


@pytest.fixture
def master(vcan: str) -> Iterator[NodeMaster]:
    need(NODE_CANOPEN.exists(), "canopen for node")
    with NodeMaster(vcan) as master:
        yield master


def start_nodes(
    vcan: str,
    start: Start,
    ports: list[PtyPort],
    folder: Path,
    node_id: int,
) -> GatewayProcess:
    """Start the gateway with nodes and without DBC. Telemetry runs."""
    tables = "[dbc]\nenabled = false\n" + canopen_table(folder, node_id)
    gateway = start(configuration(vcan, ports, tables, LOSES))
    gateway.wait_for_line(f"esc{len(ports)}: /")
    for port in ports:
        port.on = True
    return gateway


def u32(value: int) -> bytes:
    return struct.pack("<I", value)


def test_node_canopen_reads_every_object_and_writes_in_every_way(
    vcan: str,
    master: NodeMaster,
    start_gateway: Start,
    tmp_path: Path,
) -> None:
    with feeding(tmp_path) as ports:
        start_nodes(vcan, start_gateway, ports, tmp_path / "store", 5)
        master("add", node=5)
        wait_for(lambda: master.states(5) != [], "a heartbeat")
        wait_for(lambda: bool(ports[0].info_sent), "an info frame")
        objects = master("eds", file=str(EDS))
        assert len(objects) > 200
        for index, sub, name, data_type, access in objects:
            place = f"{index:04X}:{sub} {name}"
            if access == "wo":
                assert refusal(master.upload, 5, index, sub) == WRITE_ONLY, place
                continue
            if index == 0x1003 and sub:  # no error has occurred yet
                assert refusal(master.upload, 5, index, sub) == NO_DATA, place
                continue
            got = master.upload(5, index, sub)
            assert len(got) == SIZES.get(data_type, len(got)), f"{place}: {got.hex()}"
            if access == "const":
                assert master.upload(5, index, sub, block=True) == got, place
        assert refusal(master.upload, 5, 0x2222) == NO_OBJECT
        assert refusal(master.upload, 5, 0x2000, 0x22) == NO_SUB
        assert master.upload(5, 0x1021, block=True) == EDS.read_bytes()
        assert master.upload(5, 0x1021) == EDS.read_bytes()  # segmented

        for value, block in ((11, False), (12, True)):
            master.download(5, 0x2100, 2, u32(value), block)
            assert master.upload(5, 0x2100, 2) == u32(value)
            for data, code in (b"\0", TOO_LOW), (b"\x65", TOO_HIGH), (b"\1\2\3\4\5\6", TOO_LONG):
                assert refusal(master.download, 5, 0x2100, 1, data, block) == code, (data, block)
        for signature, index, kept in ((b"save", 0x1010, 12), (b"load", 0x1011, 49)):  # gear 9.8
            master.download(5, index, 1, signature)
            begin = len(master.states(5))
            master("nmt", command="resetNode", node=5)

            def has_booted(begin: int = begin) -> bool:
                return master.states(5)[begin:] == BOOTED

            wait_for(has_booted, "a boot-up")
            assert master.upload(5, 0x2100, 2) == u32(kept)


IDENTITY = {"vendorId": 0, "productCode": PRODUCT, "revisionNumber": REVISION}


def scanned(master: NodeMaster, serial: int) -> None:
    """Find a node by a fastscan that has to determine the vendor-ID 0 bit by bit.

    Every request of this scan is answered. The examples of docs/canopen.md scan without any known
    part.
    """
    known = {"productCode": PRODUCT, "revisionNumber": REVISION, "serialNumber": serial}
    assert master("fastscan", **known) == IDENTITY | {"serialNumber": serial}


def named(master: NodeMaster, node_id: int) -> None:
    master("lss", command="configureNodeId", args=[node_id])
    master("waiting")


def test_node_canopen_sets_node_ids_by_lss(
    vcan: str,
    master: NodeMaster,
    start_gateway: Start,
    tmp_path: Path,
) -> None:
    with feeding(tmp_path, 2) as ports, recording(vcan) as watch:
        gateway = start_nodes(vcan, start_gateway, ports, tmp_path / "store", 255)
        gateway.wait_for_line("esc2: CANopen node waits for LSS")
        for node_id, serial in ((0x31, SERIAL + 1), (0x32, SERIAL)):
            scanned(master, serial)
            assert master("lss", command="inquireSerialNumber") == serial
            for wrong in (0, 128, 254):
                code = refusal(master, "lss", command="configureNodeId", args=[wrong])
                assert code == 1, wrong
            master("lss", command="storeConfiguration")
            named(master, node_id)
            wait_for(lambda n=node_id: watch.of(0x700 + n) != [], "a boot-up")  # type: ignore[misc]
        assert master("fastscan", timeout=500) is None

        # A configured node is found by its whole identity. Its new node-ID applies after a reset.
        master("select", **IDENTITY, serialNumber=SERIAL + 1)
        named(master, 0x41)
        master("nmt", command="resetCommunication", node=0x31)
        wait_for(lambda: watch.of(0x741) != [], "a boot-up with the new node-ID")
        assert watch.of(0x731)[-1].time <= watch.of(0x741)[0].time


# --- tshark


def session(master: NodeMaster, esc: PtyPort, watch: Witness) -> None:
    """Use every service with a node that waits for its node-ID."""
    scanned(master, SERIAL)
    master("add", node=0x55)
    named(master, 0x55)
    wait_for(lambda: master.states(0x55) == BOOTED, "a heartbeat")
    name = master.upload(0x55, 0x1008)
    assert master.upload(0x55, 0x1008, block=True) == name
    for index, sub in ((0x2222, 0), (0x2000, 0x22), (0x2102, 1)):
        refusal(master.upload, 0x55, index, sub)
    master.download(0x55, 0x2100, 2, u32(3))
    master.download(0x55, 0x2100, 2, u32(4), block=True)
    master("nmt", command="startNode", node=0x55)
    wait_for(lambda: len(watch.of(0x1D5)) > 10, "PDOs")
    wait_for(lambda: master.states(0x55)[-1] == OPERATIONAL, "OPERATIONAL")
    esc.on = False
    wait_for(lambda: master.of("emergency") != [], "an emergency")
    master("nmt", command="stopNode", node=0x55)
    wait_for(lambda: master.states(0x55)[-1] == STOPPED, "STOPPED")


def is_abort(frame: SimpleNamespace) -> bool:
    """Return whether a frame is an abort.

    tshark keeps no state, and takes the last segment of a block for an abort too.
    """
    return frame.sdo_abort != "" and int(frame.sdo_command, 0) == 0x80


def test_tshark_decodes_all_frames_of_a_session(
    vcan: str,
    master: NodeMaster,
    start_gateway: Start,
    tmp_path: Path,
) -> None:
    need(has_tshark(), "tshark")
    with feeding(tmp_path) as ports:
        with recording(vcan) as watch:
            gateway = start_nodes(vcan, start_gateway, ports, tmp_path / "store", 255)
            gateway.wait_for_line("esc1: CANopen node waits for LSS")
            session(master, ports[0], watch)
        frames = tshark(watch.recorded, tmp_path / "bus.log")
    ids = [frame.can_id for frame in watch.recorded]
    assert [int(f.can_id, 0) for f in frames] == ids
    assert [f for f in frames if f.malformed] == []
    assert {int(f.function, 0) for f in frames} == {can_id >> 7 for can_id in ids}

    def of(cob_id: int) -> list[SimpleNamespace]:
        return [f for f in frames if int(f.can_id, 0) == cob_id]

    every_state = [int(frame.state, 0) for frame in of(0x755)]
    states = [state for state, _ in itertools.groupby(every_state)]
    assert states == [BOOT_UP, PRE_OPERATIONAL, OPERATIONAL, STOPPED]
    assert [int(f.nmt_command, 0) for f in of(0)] == [1, 2]
    aborts = []
    for frame in of(0x5D5):
        if is_abort(frame):
            place = int(frame.sdo_index, 0), int(frame.sdo_sub, 0)
            aborts.append((*place, int(frame.sdo_abort, 0)))
    assert aborts == [(0x2222, 0, NO_OBJECT), (0x2000, 0x22, NO_SUB), (0x2102, 1, WRITE_ONLY)]
    echoed = [f.sdo_abort for f in of(0x655) if is_abort(f)]
    assert len(echoed) == len(aborts), "the master only echoes aborts and sends none itself"
    assert {f.sdo_index for f in of(0x655)} >= {"0x1008", "0x2100"}
    assert [int(f.emcy_code, 0) for f in of(0xD5)] == [0x7510]
    assert {int(f.lss_command, 0) for f in of(0x7E4)} == {0x4F, 0x11}
    assert {int(f.lss_command, 0) for f in of(0x7E5)} == {0x51, 0x11, 0x04}
    contents = [bytes.fromhex(frame.pdo.replace(":", "")) for frame in of(0x1D5)]
    pdos = {struct.unpack("<IHh", data) for data in contents}
    assert pdos
    assert pdos <= {tuple(live[:3]) for live in sent_by(ports[0])}
