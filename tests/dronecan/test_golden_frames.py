"""Frames and types byte by byte: golden ones, and random ones as the package ``dronecan`` makes and reads them."""

import math
import random
import struct

import pytest
from dronecan_bench import Reader, dronecan, peers_frames

from kontronik_can_gw.dronecan import types
from kontronik_can_gw.dronecan.transport import (
    Assembler,
    message_id,
    response_id,
    transfer,
)
from kontronik_can_gw.dronecan.types import DataType
from kontronik_can_gw.frames import CanFrame

equipment, protocol = dronecan.uavcan.equipment, dronecan.uavcan.protocol
UNIQUE_ID = bytes(range(1, 17))


def shown(frames: list[CanFrame]) -> str:
    """As candump shows them, the id once."""
    assert len({frame.can_id for frame in frames}) == 1
    assert all(frame.extended for frame in frames)
    data = " ".join(f"#{frame.data.hex().upper()}" for frame in frames)
    return f"{frames[0].can_id:08X}{data}"


def message(kind: DataType, payload: bytes, priority: int = 16) -> list[CanFrame]:
    return transfer(message_id(kind.number, 42, priority), kind.seed, payload, 5, False)


def test_golden_messages() -> None:
    """Made by another implementation, of node 42, with transfer id 5."""
    status = types.status(7, 24.23, 47.3, 30.0, 6303, 42, 3)
    assert shown(message(types.STATUS, status)) == (
        "10040A2A#A1F1070000000F85 #4EEA51BD5C9F1825 #150C45"
    )
    extended = types.status_extended(50, 48, -256, 0, 0x12345, 3)
    assert shown(message(types.STATUS_EXTENDED, extended)) == "10040C2A#64C00200452323C5"
    state = types.NODE_STATUS.pack(100, types.OK << 6 | types.OPERATIONAL << 3, 0xBEEF)
    assert shown(message(types.NODE_STATUS, state, 24)) == "1801552A#6400000000EFBEC5"
    warm = types.TEMPERATURE.pack(1, 300.0, False)
    assert shown(message(types.TEMPERATURE, warm)) == "1004562A#0100B05C00C5"


def test_a_golden_answer() -> None:
    state = types.NODE_STATUS.pack(100, types.OK << 6 | types.OPERATIONAL << 3, 0xBEEF)
    info = types.GET_NODE_INFO.pack(state, 1, 2, 0, 0, 0, 3, 4, UNIQUE_ID, 0) + b"org.example.esc"
    request = 0x10018000 | 42 << 8 | 0x80 | 10
    answer = transfer(response_id(request), types.GET_NODE_INFO.seed, info, 5, True)
    assert shown(answer) == (
        "10010AAA#6A76640000000085 #EFBE010200000025 #0000000000000005 #0000000304010225 #0304050607080905"
        " #0A0B0C0D0E0F1025 #006F72672E657805 #616D706C652E6525 #736345"
    )


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        (types.STATUS, equipment.esc.Status),
        (types.STATUS_EXTENDED, equipment.esc.StatusExtended),
        (types.NODE_STATUS, protocol.NodeStatus),
        (types.CIRCUIT_STATUS, equipment.power.CircuitStatus),
        (types.TEMPERATURE, equipment.device.Temperature),
        (types.LOG_MESSAGE, protocol.debug.LogMessage),
        (types.ALLOCATION, protocol.dynamic_node_id.Allocation),
        (types.GET_NODE_INFO, protocol.GetNodeInfo.Request),
        (types.RESTART_NODE, protocol.RestartNode.Request),
        (types.GET_SET, protocol.param.GetSet.Request),
    ],
)
def test_numbers_and_signatures_are_those_of_the_package(kind: DataType, named: object) -> None:
    theirs = dronecan.get_dronecan_data_type(named())  # type: ignore[operator]
    assert kind[:2] == (theirs.default_dtid, theirs.base_crc)


def half(value: float) -> float:
    """The nearest number of a 16-bit float."""
    found: float = struct.unpack("<e", struct.pack("<e", value))[0]
    return found


def test_random_measurements_are_read_as_they_were_sent() -> None:
    rng, reader = random.Random(1), Reader()
    for turn in range(2000):
        volts, amperes, celsius = (rng.uniform(-700, 700) for _ in range(3))
        rpm, percent, index = rng.randrange(-131072, 131072), rng.randrange(128), rng.randrange(32)
        errors = rng.randrange(1 << 32)
        made = message(
            types.STATUS, types.status(errors, volts, amperes, celsius, rpm, percent, index)
        )
        found = [reader.read(turn, frame) for frame in made][-1]
        assert found is not None
        got = found.payload
        read = (got.error_count, got.voltage, got.current, got.temperature)
        assert read == (errors, half(volts), half(amperes), half(celsius + 273.15))
        assert (got.rpm, got.power_rating_pct, got.esc_index) == (rpm, percent, index)
        parts = [rng.randrange(128), rng.randrange(128), rng.randrange(-256, 256)]
        parts += [rng.randrange(512), rng.randrange(1 << 19), index]
        made = message(types.STATUS_EXTENDED, types.status_extended(*parts))
        found = reader.read(turn, made[0])
        assert found is not None
        got = found.payload
        assert [got.input_pct, got.output_pct, got.motor_temperature_degC] == parts[:3]
        assert [got.motor_angle, got.status_flags, got.esc_index] == parts[3:]


def test_what_is_out_of_a_types_range_is_its_limit_and_what_is_unknown_is_nan() -> None:
    reader = Reader()
    made = message(types.STATUS, types.status(0, 1e9, -1e9, None, 1 << 20, 200, 31))
    found = [reader.read(0, frame) for frame in made][-1]
    assert found is not None
    got = found.payload
    assert (got.voltage, got.current, got.rpm, got.power_rating_pct) == (65504, -65504, 131071, 127)
    assert math.isnan(got.temperature)
    assert got.esc_index == 31
    found = [
        reader.read(0, f) for f in message(types.STATUS, types.status(0, 0, 0, 0, -(1 << 20), 0, 0))
    ][-1]
    assert found is not None
    assert found.payload.rpm == -131072


def test_transfers_of_the_package_are_put_together_however_they_are_mixed() -> None:
    """Transfers of several nodes with frames in between, some doubled; each comes out once, whole."""
    rng, assembler = random.Random(2), Assembler()
    wanted: list[bytes] = []
    found: list[bytes] = []
    streams: list[list[CanFrame]] = []
    for source in range(1, 30):
        request = protocol.param.GetSet.Request(index=source)
        request.name.from_bytes(rng.randbytes(rng.randrange(93)))
        made = peers_frames(request, source, to=42, transfer_id=rng.randrange(32))
        begins = b"" if len(made) == 1 else None
        data = b"".join(frame.data[:-1] for frame in made)
        wanted.append(data if begins is not None else data[2:])
        streams.append(made)
    while streams:
        stream = rng.choice(streams)
        frame = stream.pop(0)
        for _ in range(rng.choice([1, 1, 2]) if len(frame.data) == 8 else 1):
            whole = assembler.receive(frame.can_id, frame.data, types.GET_SET.seed, 0)
            if whole is not None:
                found.append(whole)
        streams = [each for each in streams if each]
    assert sorted(found) == sorted(wanted)


def test_a_transfer_that_is_damaged_or_late_is_dropped() -> None:
    request = protocol.param.GetSet.Request(index=1)
    request.name.from_bytes(b"e0.pole_pairs")
    frames = peers_frames(request, 9, to=42)

    def received(changed: list[CanFrame], pause_ns: int = 0) -> bool:
        assembler, now, whole = Assembler(), 0, None
        for frame in changed:
            whole = assembler.receive(frame.can_id, frame.data, types.GET_SET.seed, now)
            now += pause_ns
        return whole is not None

    assert received(frames)
    assert received(frames, 800_000_000)
    assert not received(frames, 2_000_000_001)
    assert not received(frames[1:])
    assert not received([frames[0], *frames[2:]])
    for place, frame in enumerate(frames):
        for bit in range(8 * (len(frame.data) - 1)):
            data = bytearray(frame.data)
            data[bit // 8] ^= 1 << bit % 8
            changed = frame._replace(data=bytes(data))
            assert not received([*frames[:place], changed, *frames[place + 1 :]])
