"""Properties of nodes with any input.

No exception is raised, states change by the standard, and equal input gives equal output.
"""

from typing import Any

import pytest
from dialogue import NO_HEARTBEAT, Bench, default, info, live
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.status import CanState

pytestmark = pytest.mark.promise("nmt")

FEW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
NODES = 2

known_ids = st.sampled_from(
    [0, 0x80, 0x81, 0x181, 0x581, 0x601, 0x602, 0x67F, 0x701, 0x705, 0x7E4, 0x7E5]
)
# fmt: off
objects = st.sampled_from(
    [
        0x1000, 0x1003, 0x1005, 0x1008, 0x1010, 0x1011, 0x1014, 0x1016, 0x1017, 0x1019, 0x1021,
        0x1029, 0x1800, 0x1801, 0x1A00, 0x1F80, 0x2000, 0x2020, 0x2100, 0x2101, 0x2102, 0x603F,
        0x3000,
    ]
)
# fmt: on


@st.composite
def sdo_requests(draw: st.DrawFn) -> CanFrame:
    """Draw requests to known objects with useful values."""
    command = draw(
        st.sampled_from(bytes.fromhex("2F 2B 23 21 22 40 60 70 00 10 01 80 A0 A4 C2 C6"))
    )
    words = [b"save", b"load", b"rset", bytes(4), b"\x81\1\0\x40", b"\x81\1\0\xc0", b"\xc8\0\5\0"]
    value = draw(st.one_of(st.binary(min_size=4, max_size=4), st.sampled_from(words)))
    index = draw(objects)
    sub = draw(st.integers(0, 9))
    node_id = draw(st.integers(1, NODES))
    multiplexer = index.to_bytes(2, "little") + bytes((sub,))
    return CanFrame(0x600 + node_id, bytes((command,)) + multiplexer + value)


@st.composite
def lss_requests(draw: st.DrawFn) -> CanFrame:
    services = [0x04, 0x11, 0x13, 0x15, 0x17, 0x40, 0x43, 0x46, 0x4C, 0x51, 0x5A, 0x5E]
    service = draw(st.sampled_from(services))
    value = draw(st.sampled_from([0, 1, 2, 9, 128, 255]))
    return CanFrame(0x7E5, bytes((service, value)) + bytes(6))


any_frames = st.builds(
    CanFrame,
    st.one_of(known_ids, st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF)),
    st.one_of(st.binary(max_size=8), st.binary(max_size=64)),
    extended=st.booleans(),
    fd=st.booleans(),
    remote=st.booleans(),
)
plain_frames = st.tuples(known_ids, st.binary(max_size=8)).map(lambda frame: CanFrame(*frame))
nmt_frames = st.builds(
    lambda command, node: CanFrame(0, bytes((command, node))),
    st.sampled_from([1, 2, 128, 129, 130]),
    st.sampled_from([0, 1, 2]),
)
frames = st.one_of(
    any_frames,
    plain_frames,
    nmt_frames,
    sdo_requests(),
    lss_requests(),
)
happenings = st.one_of(
    st.tuples(st.just("frame"), frames),
    st.tuples(st.just("uart"), st.integers(0, NODES - 1), st.integers(0, 0xFFFFFFFF)),
    st.tuples(st.just("info"), st.integers(0, NODES - 1)),
    st.tuples(st.just("bytes"), st.integers(0, NODES - 1), st.binary(max_size=60)),
    st.tuples(st.just("can"), st.sampled_from(CanState)),
    st.tuples(st.sampled_from(["lost", "opened"]), st.integers(0, NODES - 1)),
    st.tuples(st.sampled_from(["overrun", "returned"])),
    st.tuples(st.just("saved"), st.booleans()),
    st.tuples(st.just("wait"), st.integers(0, 3000)),
)


def happen(bench: Bench, what: tuple[Any, ...]) -> None:
    gateway = bench.gateway
    now = bench.now
    match what:
        case "frame", frame:
            gateway.receive_frame(frame, now, now)
        case "uart", esc, word:
            data = live(operating_errors=word, electrical_speed=word)
            gateway.receive_bytes(esc, data, now, now)
        case "info", esc:
            data = info(device_and_variant=1 << 10, cell_count=6)
            gateway.receive_bytes(esc, data, now, now)
        case "bytes", esc, data:
            gateway.receive_bytes(esc, data, now, now)
        case "can", state:
            gateway.set_can_state(state, now)
        case "lost", esc:
            gateway.port(esc, False, now)
        case "opened", esc:
            gateway.port(esc, True, now)
        case ("overrun",):
            gateway.receive_overrun(now)
        case ("returned",):
            gateway.can_returned(now)
        case "saved", ok:
            bench.answer_saves(None if ok else "disk full")
        case "wait", ms:
            bench.wait(ms)
    bench._collect()


@given(st.lists(happenings, max_size=50))
@FEW
def test_any_input_raises_nothing_and_gives_reproducible_valid_frames(
    story: list[tuple[Any, ...]],
) -> None:
    one = Bench(NODES)
    other = Bench(NODES)
    for what in story:
        happen(one, what)
        happen(other, what)
        assert one.heard == other.heard
        assert one.gateway.next_deadline() == other.gateway.next_deadline()
        assert one.gateway.receive_ids == other.gateway.receive_ids
    for frame in one.take():
        assert 0 <= frame.can_id <= 0x7FF
        assert len(frame.data) <= 8
        assert not (frame.extended or frame.fd or frame.remote)


# --- states

STATE_AFTER = {1: 5, 2: 4, 128: 127, 129: 127, 130: 127}


@given(st.lists(st.one_of(any_frames, plain_frames, nmt_frames, sdo_requests(), lss_requests())))
@FEW
def test_only_nmt_commands_change_states_and_only_asked_nodes_answer(
    story: list[CanFrame],
) -> None:
    """Other ids cause no frame. A node's own ids from another device cause one EMCY 8150h."""
    bench = Bench(NODES, changes={**NO_HEARTBEAT, **default(0x1029, 1, 1)})
    for frame in story:
        if frame.can_id in (0x601, 0x602) and frame.data[1:3] == b"\x01\x21":
            continue  # 2101h sets another node-ID at the next reset
        if frame.can_id == 0x7E5 and frame.data[:1] == b"\x11":
            continue  # so does LSS
        is_plain = not (frame.extended or frame.remote or frame.fd)
        is_nmt = is_plain and frame.can_id == 0 and len(frame.data) == 2
        command = frame.data if is_nmt else b"\0\0"
        meant = [node for node in bench.nodes if command[1] in (0, node.node_id)]
        wanted = {node: int(node.state) for node in bench.nodes}
        wanted |= {node: STATE_AFTER.get(command[0], wanted[node]) for node in meant}
        booted = {0x700 + node.node_id for node in meant if command[0] in (129, 130)}
        listened = bench.gateway.receive_ids
        asked = {node.node_id for node in bench.nodes if frame.can_id == 0x600 + node.node_id}
        happen(bench, ("frame", frame))
        heard = bench.take()
        assert {node: int(node.state) for node in bench.nodes} == wanted
        beats = [f for f in heard if f.can_id >> 7 == 0x700 >> 7 and f.can_id < 0x780]
        assert {f.can_id for f in beats} == booted
        assert [f.data for f in beats] == [b"\0"] * len(booted)
        if frame.extended or frame.remote or frame.can_id not in listened:
            assert heard == []
        elif frame.fd:
            assert [part.data[:2] for part in heard] in ([], [b"\x50\x81"])
        for answer in heard:
            assert not 0x581 <= answer.can_id <= 0x5FF or answer.can_id - 0x580 in asked
            assert answer.can_id != 0x7E4 or frame.can_id == 0x7E5


@pytest.mark.promise("pdo")
@given(st.lists(happenings, max_size=40))
@FEW
def test_no_pdo_is_sent_outside_operational_and_no_emergency_when_stopped(
    story: list[tuple[Any, ...]],
) -> None:
    bench = Bench(NODES)
    for what in story:
        if what[0] == "frame" and what[1].can_id in (0x601, 0x602, 0x7E5):
            continue  # such a frame may change COB-IDs and node-IDs
        before = [node.state for node in bench.nodes]
        happen(bench, what)
        for frame in bench.take():
            service = frame.can_id & 0x780
            number = (frame.can_id & 0x7F) - 1
            if before[number] == bench.nodes[number].state:
                assert service not in (0x180, 0x280, 0x380, 0x480) or before[number] == 5
                is_nmt = what[0] == "frame" and what[1].can_id == 0
                assert service != 0x80 or before[number] != 4 or is_nmt
