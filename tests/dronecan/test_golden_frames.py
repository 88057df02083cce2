"""Frames and types byte by byte.

Some are golden frames, others are random ones that the package ``dronecan`` creates and reads.
"""

import random
import struct
from collections.abc import Iterable
from typing import Any

import pytest
from dronecan_bench import Reader, dronecan, peers_frames
from packer_oracle import random_live

from kontronik_can_gw.core.python_core import PythonCore
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.core.slots import SlotSettings
from kontronik_can_gw.dronecan import wire
from kontronik_can_gw.dronecan.esc_report import fill, plans_of
from kontronik_can_gw.dronecan.wire import Assembler, DataType, message_id, response_id
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.states import OperatingState
from kontronik_can_gw.esc.protocols import PROTOCOLS
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.native.load import make_core
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.signals.transfer import transfer

pytestmark = pytest.mark.promise("dronecan")

protocol = dronecan.uavcan.protocol
UNIQUE_ID = bytes(range(1, 17))


def shown(frames: list[CanFrame]) -> str:
    """Return frames in the format of candump, with their id once."""
    (can_id,) = {frame.can_id for frame in frames if frame.extended}
    return f"{can_id:08X}" + " ".join(f"#{frame.data.hex().upper()}" for frame in frames)


class Measuring:
    """A core with one ESC that sends one message of it. The C core is used if it exists."""

    def __init__(
        self,
        kind: DataType,
        is_pure: bool,
        speed: str = "electrical_speed",
        has_direction: bool = True,
    ) -> None:
        escs = [EscSettings()]
        layout = MessageLayout("", "", ())
        self.core: Any = PythonCore(CoreSettings(escs, layout), 0)
        if not is_pure:
            self.core = make_core(CoreSettings(escs, layout, slots=1), 0)
            if self.core.language != "C":
                pytest.skip(self.core.note)
        self.kind = kind
        self.now = 0
        self.plan = plans_of(PROTOCOLS[0], speed, has_direction)[kind]
        self.slot = self.core.slot(0)
        self.slot.start(0)

    def sent(
        self,
        live: LiveData,
        index: int,
        errors: int = 0,
        turns: int = 1,
    ) -> list[CanFrame]:
        """Return the frames of node 42 with priority 16 for the last of ``turns`` ESC frames."""
        can_id = message_id(self.kind.number, 42, 16)
        bits = fill(self.kind, index, errors)
        self.slot.configure(SlotSettings(self.plan, can_id, True, 1, 3, bits, 64), self.now)
        for _ in range(turns):
            self.now += 10_000_000
            self.core.receive(0, encode(live, WireLayout.V4), self.now, self.now)
            frames: list[CanFrame] = self.core.take(self.now)
        return frames

    def read(self, live: LiveData, index: int, errors: int = 0) -> Any:
        """Return the message as the package reads it."""
        reader = Reader()
        found = [reader.read(0, frame) for frame in self.sent(live, index, errors)][-1]
        assert found is not None
        return found.payload


pure = pytest.mark.parametrize("is_pure", [True, False])


@pure
def test_messages_equal_the_golden_frames(is_pure: bool) -> None:
    """Another implementation created the frames of node 42 with transfer id 5."""
    live = LiveData(6303, 2423, 473, power_stage_temperature=30, output_opening=42)
    assert shown(Measuring(wire.STATUS, is_pure).sent(live, 3, 7, turns=6)) == (
        "10040A2A#A1F1070000000F85 #4EEA51BD5C9F1825 #150C45"
    )
    live = LiveData(throttle=-50, output_opening=48, operating_errors=0x12345)
    extended = Measuring(wire.STATUS_EXTENDED, is_pure).sent(live, 3, turns=6)
    assert shown(extended) == "10040C2A#64C00200452323C5"
    state = wire.NODE_STATUS.pack(100, wire.OK << 6 | wire.OPERATIONAL << 3, 0xBEEF)
    frames = transfer(message_id(wire.NODE_STATUS.number, 42, 24), wire.NODE_STATUS.seed, state, 5)
    assert shown(frames) == "1801552A#6400000000EFBEC5"


def test_answer_equals_the_golden_frames() -> None:
    state = wire.NODE_STATUS.pack(100, wire.OK << 6 | wire.OPERATIONAL << 3, 0xBEEF)
    info = wire.GET_NODE_INFO.pack(state, 1, 2, 0, 0, 0, 3, 4, UNIQUE_ID, 0) + b"org.example.esc"
    request = 0x10018000 | 42 << 8 | 0x80 | 10
    answer = transfer(response_id(request), wire.GET_NODE_INFO.seed, info, 5)
    assert shown(answer) == (
        "10010AAA#6A76640000000085 #EFBE010200000025 #0000000000000005 #0000000304010225"
        " #0304050607080905 #0A0B0C0D0E0F1025 #006F72672E657805 #616D706C652E6525 #736345"
    )


BACKWARD = {OperatingState.Sync_Backward, OperatingState.Backward}


@pure
@pytest.mark.parametrize("has_direction", [True, False])
@pytest.mark.parametrize(
    "speed",
    [0, 1, 40_583, 131_071, 131_072, 131_073, 1_000_000, 0xFFFF_FFFF],
)
def test_rpm_is_negative_in_the_backward_states_only(
    is_pure: bool,
    has_direction: bool,
    speed: int,
) -> None:
    measuring = Measuring(wire.STATUS, is_pure, has_direction=has_direction)
    for state in (*range(32), 0x96, 0xFF):
        got = measuring.read(LiveData(speed, operating_state=state), 0)
        if has_direction and state in BACKWARD:
            assert got.rpm == max(-speed, -131_072)
        else:
            assert got.rpm == min(speed, 131_071)


def half(value: float) -> float:
    """Return the nearest number of a 16-bit float."""
    found: float = struct.unpack("<e", struct.pack("<e", value))[0]
    return found


@pure
def test_random_measurements_are_read_as_they_were_sent(is_pure: bool) -> None:
    rng = random.Random(1)
    status = Measuring(wire.STATUS, is_pure)
    extended = Measuring(wire.STATUS_EXTENDED, is_pure)
    for _ in range(500):
        live = random_live(rng)
        live = live._replace(throttle=max(-127, live.throttle))
        index = rng.randrange(32)
        errors = rng.choice((0, 1, 300, (1 << 32) - 1))
        got = status.read(live, index, errors)
        volts = live.battery_voltage / 100
        amperes = live.battery_current / 10
        kelvin = live.power_stage_temperature + 273.15
        found = (got.error_count, got.voltage, got.current, got.temperature, got.esc_index)
        assert found == (errors, half(volts), half(amperes), half(kelvin), index)
        is_backward = live.operating_state in BACKWARD
        rpm = -live.electrical_speed if is_backward else live.electrical_speed
        assert got.rpm == max(-131_072, min(rpm, 131_071))
        assert got.power_rating_pct == min(live.output_opening, 127)
        got = extended.read(live, index)
        word = live.operating_errors
        assert got.input_pct == abs(live.throttle)
        assert got.output_pct == min(live.output_opening, 127)
        assert got.motor_temperature_degC == -256
        assert got.motor_angle == 0
        assert got.esc_index == index
        assert got.status_flags == word & 0x3FFFF | (word > 0x3FFFF) << 18


def request(source: int, name: bytes, number: int = 1) -> list[CanFrame]:
    made = protocol.param.GetSet.Request(index=source)
    made.name.from_bytes(name)
    return peers_frames(made, source, to=42, transfer_id=number)


def received(frames: Iterable[CanFrame], pause_ns: int = 0) -> list[bytes]:
    """Return the transfers of frames that arrive with this pause in between."""
    assembler = Assembler()
    seed = wire.GET_SET.seed
    found = [
        assembler.receive(frame.can_id, frame.data, seed, number * pause_ns)
        for number, frame in enumerate(frames)
    ]
    return [each for each in found if each is not None]


def test_transfers_are_assembled_from_mixed_frames() -> None:
    """Frames of several nodes are mixed, and some are repeated. Each transfer is read once."""
    rng = random.Random(2)
    wanted: list[bytes] = []
    mixed: list[CanFrame] = []
    streams: list[list[CanFrame]] = []
    for source in range(1, 30):
        made = request(source, rng.randbytes(rng.randrange(93)), rng.randrange(32))
        data = b"".join(frame.data[:-1] for frame in made)
        wanted.append(data if len(made) == 1 else data[2:])
        streams.append(made)
    while streams:
        stream = rng.choice(streams)
        frame = stream.pop(0)
        count = rng.choice([1, 1, 2]) if len(frame.data) == 8 else 1
        mixed += [frame] * count
        streams = [each for each in streams if each]
    assert sorted(received(mixed)) == sorted(wanted)


def test_transfer_that_is_damaged_or_late_is_dropped() -> None:
    frames = request(9, b"e0.pole_pairs")
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
