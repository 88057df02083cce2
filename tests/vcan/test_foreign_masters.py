"""A CANopen master of others (canopen for node, in JavaScript) against the gateway; tshark decodes what they said.

It comes from tests/foreign/install.sh and shares no code with the gateway or with its usual test master.
"""

import itertools
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from foreign_tools import (
    NODE_CANOPEN,
    NodeMaster,
    Refused,
    has_tshark,
    need,
    tshark,
)
from vcan_tools import Bench, Candump, GatewayProcess, bench, wait_for

from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.esc.kontronik.simulator import ErrorWindow, EscOptions, Faults, Phase
from kontronik_can_gw.esc.kontronik.states import OperatingError, OperatingState

pytestmark = pytest.mark.extended

Start = Callable[..., GatewayProcess]

EDS = shipped("eds/kontronik_esc.eds")
PRODUCT, REVISION, SERIAL = 0x4B4F4E01, 0x00010000, 0x00100200
# something changes all the time
LIVELY = (
    Phase("up", 0.5, 80, OperatingState.Forward, 0.5),
    Phase("down", 0.5, 20, OperatingState.Forward, 0.5),
)
LOSS_MS = 10_000
"""Until telemetry counts as lost, where that is to happen: no machine stands still for so long."""
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
# CiA 301 data types: bytes of a number; strings and domains have any length
SIZES = {0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4}
READ_ONLY, WRITE_ONLY = 0x06010002, 0x06010001
NO_OBJECT, NO_SUB, TOO_HIGH, TOO_LOW = 0x06020000, 0x06090011, 0x06090031, 0x06090032
TOO_LONG, NO_DATA, DEVICE_STATE = 0x06070012, 0x08000024, 0x08000022


def canopen_only(
    interface: str, run: Bench, folder: Path, node_id: int, timeout_ms: int = 60_000
) -> str:
    """A configuration with nodes and no DBC."""
    escs = "".join(
        f'[[esc]]\nport = "{port.path}"\npole_pairs = 7\ntelemetry_timeout_ms = {timeout_ms}\n'
        for port in run.ports
    )
    return f"""
[can]
interface = "socketcan"
channel = "{interface}"
bitrate = 500000
[dbc]
enabled = false
[canopen]
enabled = true
node_id = {node_id}
serial = {SERIAL}
store = "{folder}"
{escs}"""


def start_nodes(
    vcan: str, start: Start, run: Bench, folder: Path, node_id: int, timeout_ms: int = 60_000
) -> GatewayProcess:
    """The gateway, starting its nodes, and telemetry running. The ports are named in the log when the CAN side is open."""
    gateway = start(canopen_only(vcan, run, folder, node_id, timeout_ms))
    gateway.wait_for_line(f"esc{len(run.ports)}: /dev/pts")
    run.start()
    return gateway


def u32(value: int) -> bytes:
    return struct.pack("<I", value)


def sent_speeds(run: Bench, index: int = 0) -> set[tuple[int, int, int]]:
    return {(d.electrical_speed, d.battery_voltage, d.battery_current) for d in run.live(index)}


# --- canopen for node


@pytest.fixture
def node_master(vcan: str) -> Iterator[NodeMaster]:
    need(NODE_CANOPEN.exists(), "canopen for node")
    with NodeMaster(vcan) as master:
        yield master


def refusal(transfer: Callable[..., object], *arguments: object, **more: object) -> int | None:
    """The code of a transfer that is refused."""
    with pytest.raises(Refused) as refused:
        transfer(*arguments, **more)
    return refused.value.code


def scanned(master: NodeMaster, serial: int) -> dict[str, int]:
    """What a fastscan finds that has to find the vendor-ID, 0, bit by bit: every one of its requests is answered.

    (One that knows nothing: the examples of docs/canopen.md.)
    """
    known = {"productCode": PRODUCT, "revisionNumber": REVISION, "serialNumber": serial}
    return cast(dict[str, int], master("fastscan", **known))


def test_node_canopen_polls_every_object_of_the_eds(
    vcan: str, node_master: NodeMaster, start_gateway: Start, tmp_path: Path
) -> None:
    with bench(EscOptions()) as run:
        start_nodes(vcan, start_gateway, run, tmp_path, 5)
        node_master("add", node=5)
        wait_for(lambda: node_master.states(5) != [], "a heartbeat")
        wait_for(lambda: bool(run.info(0)), "an info frame")
        objects = node_master("eds", file=str(EDS))
        assert len(objects) > 200
        upload, download = node_master.upload, node_master.download
        for index, sub, name, data_type, access in objects:
            where = f"{index:04X}:{sub} {name}"
            if access == "wo":
                assert refusal(upload, 5, index, sub) == WRITE_ONLY, where
                continue
            if index == 0x1003 and sub:  # nothing has happened yet
                assert refusal(upload, 5, index, sub) == NO_DATA, where
                continue
            got = upload(5, index, sub)
            assert len(got) == SIZES.get(data_type, len(got)), f"{where}: {got.hex()}"
            if access in ("ro", "const"):
                assert refusal(download, 5, index, sub, got or b"\0") == READ_ONLY, where
            if access == "const":
                assert upload(5, index, sub, block=True) == got, where

        known = {(index, sub) for index, sub, *_ in objects}
        indices = {index for index, _ in known}
        for index in sorted({neighbour for i in indices for neighbour in (i - 1, i + 1)} - indices):
            assert refusal(upload, 5, index) == NO_OBJECT, hex(index)
        for index in sorted(indices):
            sub = 1 + max(s for i, s in known if i == index)
            assert refusal(upload, 5, index, sub) == NO_SUB, (hex(index), sub)

        file = EDS.read_bytes()
        assert node_master.upload(5, 0x1021, block=True) == file
        assert node_master.upload(5, 0x1021) == file  # segmented


def test_node_canopen_downloads_in_every_way(
    vcan: str, node_master: NodeMaster, start_gateway: Start, tmp_path: Path
) -> None:
    with bench(EscOptions()) as run:
        start_nodes(vcan, start_gateway, run, tmp_path, 5)
        node_master("add", node=5)
        wait_for(lambda: node_master.states(5) != [], "a heartbeat")
        for value, block in ((11, False), (12, True)):
            node_master.download(5, 0x2100, 2, u32(value), block)
            assert node_master.upload(5, 0x2100, 2) == u32(value)
        too_long = {b"\1\2": TOO_LONG, b"\1\2\3\4\5\6": TOO_LONG}
        for data, code in {b"\0": TOO_LOW, b"\x65": TOO_HIGH, **too_long}.items():
            for block in (False, True):
                found = refusal(node_master.download, 5, 0x2100, 1, data, block)
                assert found == code, (data, block)
        assert node_master.upload(5, 0x2100, 1) == b"\7"
        node_master.download(5, 0x1010, 1, b"save")
        assert list(tmp_path.rglob("*")), "nothing was stored"
        node_master("nmt", command="resetNode", node=5)
        wait_for(lambda: BOOT_UP in node_master.states(5), "a boot-up")
        wait_for(lambda: node_master.states(5)[-1] == PRE_OPERATIONAL, "a heartbeat")
        assert node_master.upload(5, 0x2100, 2) == u32(12)
        node_master.download(5, 0x1011, 1, b"load")
        node_master("nmt", command="resetNode", node=5)
        wait_for(
            lambda: node_master.states(5)[-2:] == [BOOT_UP, PRE_OPERATIONAL], "another boot-up"
        )
        wait_for(lambda: node_master.upload(5, 0x2100, 2) == u32(1), "the default")


def test_node_canopen_hears_heartbeats_pdos_and_emergencies(
    vcan: str, node_master: NodeMaster, start_gateway: Start, tmp_path: Path
) -> None:
    hot = ErrorWindow(OperatingError.POWER_STAGE_OVERTEMP_ERROR, 3_000_000_000, 1_000_000_000)
    with bench(EscOptions(profile=LIVELY, faults=Faults(errors=(hot,)))) as run:
        node_master("add", node=7)
        start_nodes(vcan, start_gateway, run, tmp_path, 7, LOSS_MS)
        wait_for(
            lambda: node_master.states(7) == [BOOT_UP, PRE_OPERATIONAL], "boot-up and heartbeat"
        )
        ids = [node_master("receivePdo", node=7, file=str(EDS), number=n) for n in (1, 2, 3, 4)]
        assert ids == [0x187, 0x287, 0x387, 0x487]
        assert not node_master.of("pdo")
        node_master("nmt", command="startNode", node=7)

        def pdos(cob_id: int) -> list[dict[str, float]]:
            return [
                dict(told["values"]) for told in node_master.of("pdo") if told["cob_id"] == cob_id
            ]

        wait_for(lambda: all(len(pdos(cob_id)) >= 3 for cob_id in ids), "changes in all four PDOs")
        wait_for(lambda: bool(node_master.of("emergency")), "an emergency")
        wait_for(lambda: len(node_master.of("emergency")) >= 2, "its end")
        wait_for(lambda: node_master.states(7)[-1] == OPERATIONAL, "OPERATIONAL")

        run.stop()
        wait_for(lambda: len(node_master.of("emergency")) >= 3, "telemetry lost")
        assert refusal(node_master.upload, 7, 0x2000, 1) == DEVICE_STATE
        assert node_master.upload(7, 0x2020, 1)[0] & 0x3F == 4  # lost
        sent = run.live(0)
        counts = Counter(told["cob_id"] for told in node_master.of("pdo"))
        run.start()
        wait_for(lambda: len(node_master.of("emergency")) >= 4, "telemetry back")
        wait_for(lambda: len(pdos(0x187)) > counts[0x187] + 3, "PDO 1 again")

        emergencies = node_master.of("emergency")[:4]
        assert [told["code"] for told in emergencies] == [0x4210, 0, 0x7510, 0]
        assert {told["cob_id"] for told in emergencies} == {0x87}
        sources = [bytes.fromhex(told["info"])[0] for told in emergencies]
        assert (sources[0], sources[2]) == (OperatingError.POWER_STAGE_OVERTEMP_ERROR, 0xFF)
        wanted = {(d.electrical_speed, d.battery_voltage, d.battery_current) for d in sent}
        values = [tuple(pdo.values()) for pdo in pdos(0x187)[: counts[0x187]]]
        assert set(values) <= wanted
        wanted_2 = {
            (d.motor_current, d.peak_current, d.consumed_charge, d.throttle, d.output_opening)
            for d in sent
        }
        assert {tuple(pdo.values()) for pdo in pdos(0x287)[: counts[0x287]]} <= wanted_2

        for command, state in (
            ("enterPreOperational", PRE_OPERATIONAL),
            ("startNode", OPERATIONAL),
            ("stopNode", STOPPED),
            ("resetCommunication", PRE_OPERATIONAL),
        ):
            node_master("nmt", command=command, node=7)
            wait_for(lambda wanted=state: node_master.states(7)[-1] == wanted, command)  # type: ignore[misc]
        assert node_master.states(7)[-2:] == [BOOT_UP, PRE_OPERATIONAL]


def test_node_canopen_names_nodes_by_lss(
    vcan: str, node_master: NodeMaster, start_gateway: Start, tmp_path: Path
) -> None:
    with bench(EscOptions(), EscOptions()) as run, Candump(vcan) as dump:
        gateway = start_nodes(vcan, start_gateway, run, tmp_path, 255)
        gateway.wait_for_line("esc2: CANopen node waits for LSS")
        found = []
        for node_id, serial in ((0x31, SERIAL + 1), (0x32, SERIAL)):
            identity = scanned(node_master, serial)
            found.append(identity)
            for name, field in (
                ("inquireVendorId", "vendorId"),
                ("inquireProductCode", "productCode"),
                ("inquireRevisionNumber", "revisionNumber"),
                ("inquireSerialNumber", "serialNumber"),
            ):
                assert node_master("lss", command=name) == identity[field]
            for wrong in (0, 128, 254):
                code = refusal(node_master, "lss", command="configureNodeId", args=[wrong])
                assert code == 1, wrong
            node_master("lss", command="configureNodeId", args=[node_id])
            node_master("lss", command="storeConfiguration")
            node_master("waiting")
            wait_for(lambda n=node_id: dump.of(0x700 + n) != [], "a boot-up")  # type: ignore[misc]
        assert [i["serialNumber"] for i in sorted(found, key=str)] == [SERIAL, SERIAL + 1]
        assert {(i["vendorId"], i["productCode"], i["revisionNumber"]) for i in found} == {
            (0, PRODUCT, REVISION)
        }
        assert node_master("fastscan", timeout=500) is None

        # a configured node is found by its whole identity, and gets another node-ID that holds from the next reset on
        node_master("select", **found[0])
        node_master("lss", command="configureNodeId", args=[0x41])
        node_master("waiting")
        node_master("nmt", command="resetCommunication", node=0x31)
        wait_for(lambda: dump.of(0x741) != [], "a boot-up with the new node-ID")
        last_of_the_old = dump.of(0x731)[-1].time
        assert last_of_the_old <= dump.of(0x741)[0].time


# --- tshark


def is_abort(frame: SimpleNamespace) -> bool:
    """An abort, and not the last segment of a block, which looks like one to tshark: it keeps no state."""
    return frame.sdo_abort != "" and int(frame.sdo_command, 0) == 0x80


def test_tshark_reads_what_was_said(
    vcan: str, node_master: NodeMaster, start_gateway: Start, tmp_path: Path
) -> None:
    need(has_tshark(), "tshark")
    with bench(EscOptions(profile=LIVELY)) as run:
        with Candump(vcan) as dump:
            gateway = start_nodes(vcan, start_gateway, run, tmp_path / "store", 255, LOSS_MS)
            gateway.wait_for_line("esc1: CANopen node waits for LSS")
            assert scanned(node_master, SERIAL)["serialNumber"] == SERIAL
            node_master("add", node=0x55)
            node_master("lss", command="configureNodeId", args=[0x55])
            node_master("waiting")
            wait_for(
                lambda: node_master.states(0x55) == [BOOT_UP, PRE_OPERATIONAL],
                "boot-up and heartbeat",
            )
            name = node_master.upload(0x55, 0x1008)
            assert node_master.upload(0x55, 0x1008, block=True) == name
            for index, sub in ((0x2222, 0), (0x2000, 0x22), (0x2102, 1)):
                refusal(node_master.upload, 0x55, index, sub)
            node_master.download(0x55, 0x2100, 2, u32(3))
            node_master.download(0x55, 0x2100, 2, u32(4), block=True)
            node_master("receivePdo", node=0x55, file=str(EDS), number=1)
            node_master("nmt", command="startNode", node=0x55)
            wait_for(lambda: len(node_master.of("pdo")) > 10, "PDOs")
            wait_for(lambda: node_master.states(0x55)[-1] == OPERATIONAL, "OPERATIONAL")
            run.stop()
            wait_for(lambda: node_master.of("emergency") != [], "an emergency")
            node_master("nmt", command="stopNode", node=0x55)
            wait_for(lambda: node_master.states(0x55)[-1] == STOPPED, "STOPPED")
        frames = tshark(dump.frames, tmp_path / "bus.log")

    told = [frame.can_id for frame in dump.frames]
    assert len(frames) == len(told) > 100
    assert [f for f in frames if f.malformed] == []
    assert [int(f.can_id, 0) for f in frames] == told
    assert {int(f.function, 0) for f in frames} == {id_ >> 7 for id_ in told}

    def of(cob_id: int) -> list[SimpleNamespace]:
        return [f for f in frames if int(f.can_id, 0) == cob_id]

    states = [state for state, _ in itertools.groupby(int(f.state, 0) for f in of(0x755))]
    assert states == [BOOT_UP, PRE_OPERATIONAL, OPERATIONAL, STOPPED]
    assert [int(f.nmt_command, 0) for f in of(0)] == [1, 2]
    parts = [(f.sdo_index, f.sdo_sub, f.sdo_abort) for f in of(0x5D5) if is_abort(f)]
    aborts = [tuple(int(part, 0) for part in each) for each in parts]
    assert aborts == [(0x2222, 0, NO_OBJECT), (0x2000, 0x22, NO_SUB), (0x2102, 1, WRITE_ONLY)]
    echoed = [f.sdo_abort for f in of(0x655) if is_abort(f)]
    assert len(echoed) == len(aborts), "the master returns an abort; one more would be its own"
    assert {f.sdo_index for f in of(0x655)} >= {"0x1008", "0x2100", "0x1800", "0x1a00"}
    assert [int(f.emcy_code, 0) for f in of(0xD5)] == [0x7510]
    answers = [int(f.lss_command, 0) for f in of(0x7E4)]
    assert set(answers) == {0x4F, 0x11}
    assert {int(f.lss_command, 0) for f in of(0x7E5)} == {0x51, 0x11, 0x04}
    pdos = {struct.unpack("<IHh", bytes.fromhex(f.pdo.replace(":", ""))) for f in of(0x1D5)}
    assert pdos
    assert pdos <= sent_speeds(run)
