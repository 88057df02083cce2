"""Services of our nodes: requests of the package ``dronecan``, too many, and invalid requests."""

from typing import Any

import pytest
from dronecan_bench import Bench, dronecan, loaded, peers_frames

from kontronik_can_gw.dronecan.nodes import MAX_ANSWERS
from kontronik_can_gw.frames import EXTENDED, CanFrame

pytestmark = pytest.mark.promise("dronecan-services")

protocol = dronecan.uavcan.protocol
GetSet = protocol.param.GetSet


def test_node_info_identifies_the_node_and_a_restart_is_refused() -> None:
    bench = Bench(2, per_esc_nodes=True, name="com.example.gw").run(2.2)
    infos = [bench.ask(protocol.GetNodeInfo.Request(), node_id) for node_id in (42, 43)]
    names = [bytes(info.name.to_bytes()) for info in infos]
    assert names == [b"com.example.gw.e0", b"com.example.gw.e1"]
    ids = [bytes(info.hardware_version.unique_id.to_bytes()) for info in infos]
    assert len({each[:6] for each in ids}) == 2  # allocation servers get these six bytes first
    assert infos[0].status.uptime_sec == 2
    assert infos[0].hardware_version.major == 1
    magic = protocol.RestartNode.Request().MAGIC_NUMBER
    assert not bench.ask(protocol.RestartNode.Request(magic_number=magic)).ok  # refused
    other = Bench(given=loaded(name="com.example.gw.e0"))  # the same name: the same on this machine
    again = other.ask(protocol.GetNodeInfo.Request())
    assert bytes(again.hardware_version.unique_id.to_bytes()) == ids[0]


def ask_for_parameter(
    bench: Bench,
    name: str = "",
    index: int = 0,
    given: tuple[str, Any] = ("", 0),
) -> object:
    """Return name and value of a parameter after a GetSet request, or None if it does not exist."""
    request = GetSet.Request(index=index)
    request.name.from_bytes(name.encode())
    field, new = given
    if field == "string_value":
        request.value.string_value.from_bytes(new)
    elif field:
        setattr(request.value, field, new)
    answer = bench.ask(request)
    found = bytes(answer.name.to_bytes()).decode()
    kind = dronecan.get_active_union_field(answer.value)
    assert (kind == "empty") == (not found)
    if not found:
        return None
    value = getattr(answer.value, kind)
    if kind == "string_value":
        value = bytes(value.to_bytes()).decode()
    return found, value


def test_parameters_are_listed_and_read_by_name_and_cannot_be_set() -> None:
    bench = Bench(2, first_index=4, rpm="output").run(0.1)
    expected = [("rate_hz", 50), ("extended_hz", 0), ("rpm", "output")]
    for number in (0, 1):
        expected.append((f"e{number}.esc_index", 4 + number))
        expected.append((f"e{number}.pole_pairs", 7))
        expected.append((f"e{number}.gear", pytest.approx(10)))
    for given in (
        ("integer_value", 1),
        ("real_value", 2.5),
        ("boolean_value", 1),
        ("string_value", b"electrical"),
    ):
        for index, one in enumerate(expected):
            assert ask_for_parameter(bench, index=index, given=given) == one
        bench.run(1)
    listed = [ask_for_parameter(bench, index=index) for index in range(len(expected) + 2)]
    assert listed == [*expected, None, None]
    assert [ask_for_parameter(bench, name, index=77) for name, _ in expected] == expected
    assert ask_for_parameter(bench, "xyzzy") is None


def test_commands_of_an_autopilot_are_never_received() -> None:
    """Our filters reject RawCommand and the other messages that control an ESC."""
    bench = Bench(4, per_esc_nodes=True, node_id=0)
    blocks = bench.gateway.receive_ids
    assert blocks
    for kind in (1030, 1031, 1010, 1011):  # RawCommand, RPMCommand, actuator commands
        for priority in range(32):
            for source in range(1, 128):
                key = EXTENDED | priority << 24 | kind << 8 | source
                for block in blocks:
                    mask = 0xFFFFFFFF & ~(block >> 32)
                    assert (key ^ block) & mask


def test_flood_of_requests_is_answered_only_in_part() -> None:
    bench = Bench().run(0.5)
    for _ in range(2000):
        bench.receive(*peers_frames(protocol.GetNodeInfo.Request(), 100, to=42))
    facts = bench.output.facts()
    assert facts["requests_answered"] == MAX_ANSWERS
    assert facts["requests_unanswered"] == 2000 - MAX_ANSWERS
    bench.clear()
    assert len(bench.run(1).of("Status")) == 50  # measurements are still sent
    assert bench.ask(protocol.GetNodeInfo.Request()) is not None


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x601, b"\x40\x18\x10\x04\0\0\0\0"),
        CanFrame(0x1E01AAE5, b"\xc0", True, remote=True),
        CanFrame(0x1E01AAE5, b"\xc0", True, fd=True),
        CanFrame(0x1E01AAE5, b"", True),
        CanFrame(0x1E01AB65, b"\xc0", True),  # to 43
        CanFrame(0x1E012AE5, b"\xc0", True),  # a response
        CanFrame(0x1E01AA80, b"\xc0", True),  # without a source
        CanFrame(0x1E63AAE5, b"\xc0", True),  # a service that we do not have
        *(  # truncated requests of GetSet
            CanFrame(0x1E0BAAE4, bytes.fromhex(data) + b"\xc0", True)
            for data in ("", "00", "0004", "000405", "0001000000", "0005", "0007", "00040a41")
        ),
    ],
)
def test_frames_that_are_no_request_to_us_are_not_answered(frame: CanFrame) -> None:
    bench = Bench().run(0.1)
    bench.output.receive(frame, bench.now, bench.now)
    assert not bench.output.frames
    assert bench.ask(GetSet.Request(index=0)) is not None


@pytest.mark.promise("conflicts")
def test_another_device_with_our_node_id_is_reported_and_sending_continues() -> None:
    bench = Bench(2, per_esc_nodes=True, canopen=True, dbc=True).run(0.5)
    taken = bench.gateway.conflicts.take
    bench.receive(*peers_frames(protocol.NodeStatus(), 43))
    (begun,) = taken()
    assert begun.ids == "29-bit ids with 2Bh in their bits 7Fh"
    assert begun.whose == "DroneCAN node-ID 43"
    states = [node["state"] for node in bench.nodes]
    assert states == ["operational", "another device has this node-ID"]
    bench.run(1)
    assert [bench.of("NodeStatus", node)[-1].payload.health for node in (42, 43)] == [0, 1]
    assert not [frame for _, frame in bench.frames if 0x81 <= frame.can_id <= 0xFF]  # no CANopen id
    for source in (43, 43, 43):  # one conflict, whatever type and priority the frames have
        frames = peers_frames(protocol.debug.LogMessage(), source, transfer_priority=3)
        bench.receive(*frames)
    assert not taken()
    bench.run(11)
    assert [each.is_over for each in taken()] == [True]
    assert {node["state"] for node in bench.nodes} == {"operational"}
