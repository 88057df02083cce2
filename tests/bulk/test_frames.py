"""The CAN frames of plain bytes in blocks are those of the streaming way, one by one and byte for byte as a log."""

import io
import random
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import cantools.database
import numpy as np
import pytest
from cantools.database.can import Database
from hypothesis import given, settings
from hypothesis import strategies as st
from packer_oracle import LayoutMaker, Msg, Sig, bindings, dbc_text
from protocol.reference import random_frame
from protocol.sheet import FORM_ROWS
from protocol.streams import FRAGMENTS, damaged

from kontronik_can_gw.config import shipped
from kontronik_can_gw.dbc_output.layout import DbcSettings
from kontronik_can_gw.dbc_output.prepare import prepare
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.offline.bulk.candump import Lines
from kontronik_can_gw.offline.bulk.feed import Feed
from kontronik_can_gw.offline.bulk.frames import can_follow, follow
from kontronik_can_gw.offline.bulk.sending import CanFrames, Part
from kontronik_can_gw.offline.can_logs import CanLogWriter
from kontronik_can_gw.offline.convert import LogConversion, Output
from kontronik_can_gw.offline.inputs import CHUNK, DumpInput
from kontronik_can_gw.offline.layouts import BusLayout, layout_of_dbc
from kontronik_can_gw.offline.replay import TimedFrame
from kontronik_can_gw.protocol import Device, InfoData, LiveData, encode
from kontronik_can_gw.protocol.codec import Layout
from kontronik_can_gw.protocol.fields import device_and_variant, rows
from kontronik_can_gw.simulator import EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.telemetry import SECOND, EscSettings

CYCLIC, EVENT, ON_CHANGE, CYCLIC_AND_EVENT, CYCLIC_AND_ON_CHANGE = range(5)
ESC = EscSettings("esc1")
SHIPPED = layout_of_dbc(shipped("dbc/kontronik_esc.dbc"))


# --- both ways ----------------------------------------------------------------------------------------------------------


def one_by_one(recording: DumpInput) -> tuple[bytes, list[TimedFrame]]:
    """The log and the frames by the streaming way."""
    file = io.BytesIO()
    writer = CanLogWriter(file, "candump", None)
    frames = list(recording.frames())
    for time_ns, frame, received in frames:
        writer.write(time_ns, frame, received)
    writer.close()
    return file.getvalue(), frames


def in_blocks(recording: DumpInput, block: int, least: int) -> tuple[bytes, list[str], int, int]:
    """The log, what is told of damage, how many frames came in blocks, and in how many blocks."""
    layout, period = recording.bus.layout, recording._period_ns
    gateway = recording.setup.gateway(layout, 0)
    assert can_follow(gateway, layout, period, recording.size)
    feed = Feed(recording.size, period)
    lines = Lines(layout.messages)
    out = io.BytesIO()
    writer = CanLogWriter(out, "candump", None)
    count, blocks = 0, 0
    with recording._path.open("rb") as file:
        for found in follow(gateway, layout, file.read, feed, period, block, least):
            if isinstance(found, CanFrames):
                out.write(lines.text(found, 0))
                count += len(found)
                blocks += 1
            else:
                for time_ns, frame, received in found:
                    writer.write(time_ns, frame, received)
    return out.getvalue(), feed.damage, count, blocks


def check(
    path: Path,
    stream: bytes,
    layout: BusLayout | None = None,
    rate: float = 100,
    block: int = 1000,
    least: int = 4,
) -> tuple[int, int]:
    """Both ways give the same. How many frames came in blocks, of how many."""
    path.write_bytes(stream)
    recording = DumpInput(path, layout, rate)
    expected, frames = one_by_one(recording)
    found, damage, count, blocks = in_blocks(recording, block, least)
    if found != expected:
        pairs = zip(found.splitlines(), expected.splitlines(), strict=False)
        number, different = next(((n, pair) for n, pair in enumerate(pairs) if pair[0] != pair[1]), (-1, None))
        raise AssertionError(f"line {number}: {different}, {count} frames in {blocks} blocks")
    assert damage == recording.damage
    return count, len(frames)


# --- streams ------------------------------------------------------------------------------------------------------------


class Flight:
    """Frames whose values wander: a field changes with each frame by a probability of its own."""

    def __init__(self, source: random.Random, layout: Layout = Layout.V4, device: int = 1) -> None:
        self.random = source
        self.layout = layout
        self.live = LiveData(battery_voltage=2400, operating_state=12)
        self.word = device_and_variant(device, 120)
        self.restless = {name: source.choice([0, 0.002, 0.02, 0.3, 1]) for name in LiveData._fields}

    def frames(self, count: int, info_each: int = 100) -> bytes:
        """Live frames, with an info frame behind each so many."""
        parts = []
        for number in range(count):
            values = {
                name: self._value(*rows(LiveData)[name].type_range)
                for name, share in self.restless.items()
                if self.random.random() < share
            }
            self.live = self.live._replace(**values)
            parts.append(encode(self.live, self.layout))
            if info_each and number % info_each == info_each - 1:
                parts.append(self.info())
        return b"".join(parts)

    def info(self) -> bytes:
        cells = self.random.choice([6, 6, 6, 12, 0])
        errors = self.random.choice([0, 0, 0, self.random.getrandbits(19)])
        return encode(InfoData(self.word, 0x0110, errors, cells, max_battery_voltage=2500), self.layout)

    def _value(self, low: int, high: int) -> int:
        return self.random.choice([low, high, 0, 1, self.random.randint(low, high), self.random.randint(low, high)])


def flight(seed: int, count: int, layout: Layout = Layout.V4, info_each: int = 100) -> bytes:
    return Flight(random.Random(seed), layout).frames(count, info_each)


# --- layouts ------------------------------------------------------------------------------------------------------------


def bus_layout(messages: Sequence[tuple[Msg, int, int, int]], esc: EscSettings = ESC) -> BusLayout:
    """Messages with send type, cycle and minimum distance in ms."""
    more = "\n".join(
        f'BA_ "GenMsgSendType" BO_ {m.dbc_id} {kind};\nBA_ "GenMsgCycleTime" BO_ {m.dbc_id} {cycle};\n'
        f'BA_ "GenMsgDelayTime" BO_ {m.dbc_id} {delay};'
        for m, kind, cycle, delay in messages
    )
    database = cantools.database.load_string(dbc_text([m for m, *_ in messages], more), "dbc")
    assert isinstance(database, Database)
    bound = DbcSettings(bindings([m for m, *_ in messages]))
    database, layout = prepare(database, "my.dbc", [esc], bound, fd_allowed=True)
    return BusLayout(database, layout, [esc])


def sig(name: str, start: int, length: int = 8, **more: object) -> Sig:
    return Sig(name, start, length, **more)  # type: ignore[arg-type]


def crc_message(can_id: int = 0x123, extended: bool = False) -> Msg:
    signals = [
        sig("Crc", 0),
        sig("Alive", 8, 4),
        sig("BatteryVoltage", 16, 16, unit="V", factor="0.01"),
        sig("Temp", 32, 8, signed=True, unit="degC", bind="power_stage_temperature"),
    ]
    return Msg("Protected", can_id, 8, signals, extended)


def paged_message() -> Msg:
    signals = [
        sig("Selector", 0, 4, mux="M"),
        sig("Alive", 4, 4),
        sig("BatteryVoltage", 8, 16, unit="V", factor="0.01", mux="m0"),
        sig("OperatingState", 8, 8, mux="m1"),
        sig("CellCount", 16, 8, mux="m1"),
        sig("OperatingErrors", 8, 32, mux="m5"),
    ]
    return Msg("Paged", 0x18FF1234, 8, signals, extended=True)


# --- the shipped layout -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", list(Layout))
@pytest.mark.parametrize("block", [5, 100, 16383])
def test_a_clean_flight(tmp_path: Path, layout: Layout, block: int) -> None:
    count, whole = check(tmp_path / "a.bin", flight(1, 3000, layout), block=block)
    assert count > whole * 0.9


@pytest.mark.parametrize("device", list(Device))
def test_a_simulated_esc(tmp_path: Path, device: Device) -> None:
    esc = SimulatedEsc(EscOptions(device=device), seed=int(device))
    stream = b"".join(sent.wire for sent in esc.frames_until(60 * SECOND))
    count, whole = check(tmp_path / "a.bin", stream, block=2000)
    assert count > whole * 0.9


@pytest.mark.parametrize("seed", range(4))
def test_a_simulated_esc_on_a_bad_line(tmp_path: Path, seed: int) -> None:
    faults = Faults(noise=0.02, lost_bytes=0.0002, flipped_bits=0.00002)
    esc = SimulatedEsc(EscOptions(faults=faults), seed=seed)
    stream = b"".join(sent.wire for sent in esc.frames_until(60 * SECOND))
    count, whole = check(tmp_path / "a.bin", stream)
    assert count > whole * 0.3


@pytest.mark.parametrize("rate", [0.5, 7, 99.9, 333.3, 20_000])
@pytest.mark.parametrize("info_each", [0, 3])
def test_any_rate(tmp_path: Path, rate: float, info_each: int) -> None:
    count = 450 if rate < 50 else 2500
    check(tmp_path / "a.bin", flight(int(rate), count, info_each=info_each), rate=rate, block=777)


@pytest.mark.parametrize("seed", range(8))
def test_damage_of_every_kind(tmp_path: Path, seed: int) -> None:
    source = random.Random(seed)
    fly = Flight(source, source.choice(list(Layout)))
    parts = []
    for _ in range(6):
        parts.append(fly.frames(source.choice([3, 40, 150, 700]), source.choice([0, 1, 20, 100])))
        change = source.randrange(8)
        if change == 0:
            fly.word = device_and_variant(source.choice([1, 2, 3, 3, 7]), source.randrange(1024))
        elif change == 1:
            fly.layout = source.choice(list(Layout))
        elif change == 2:
            parts.append(source.randbytes(source.choice([1, 50, 3000])))
        elif change == 3:
            parts.append(source.choice(FRAGMENTS) * source.randrange(1, 30))
        elif change == 4:
            parts.append(b"".join(random_frame(source.choice(FORM_ROWS), source) for _ in range(60)))
        elif change == 5:
            parts.append(fly.info() * source.randrange(1, 40))
        elif change == 6:
            parts.append(random_frame(source.choice(FORM_ROWS), source)[: source.randrange(44)])
    stream = damaged(b"".join(parts), source, source.choice([0, 0, 3, 20]))
    check(tmp_path / "a.bin", stream, rate=source.choice([5, 100, 100, 1000]), block=source.choice([50, 300, 8192]))


@given(
    st.lists(
        st.tuples(st.integers(0, 300), st.one_of(st.sampled_from(FRAGMENTS), st.binary(max_size=100))), max_size=4
    ),
    st.sampled_from([8.0, 100.0, 400.0]),
)
@settings(max_examples=25, deadline=None)
def test_anything_between_frames(
    tmp_path_factory: pytest.TempPathFactory, parts: list[tuple[int, bytes]], rate: float
) -> None:
    stream = flight(2, 120) + b"".join(flight(count, count, info_each=30) + rubbish for count, rubbish in parts)
    check(tmp_path_factory.mktemp("any") / "a.bin", stream, rate=rate, block=90, least=2)


def test_long_rubbish_over_the_borders_of_what_is_read(tmp_path: Path) -> None:
    source = random.Random(3)
    rubbish = source.randbytes(CHUNK + 5000)
    stream = flight(1, 3000) + rubbish + flight(2, 3000) + rubbish[:70_000] + flight(3, 9000)
    count, whole = check(tmp_path / "a.bin", stream, block=4000)
    assert count > whole * 0.9
    cut = CHUNK - len(flight(4, 6000))
    stream = flight(4, 6000) + rubbish[: cut + 100] + flight(5, 7000)
    check(tmp_path / "a.bin", stream, block=4000)


def test_the_least_and_the_greatest_values(tmp_path: Path) -> None:
    """Energy of more than 64 bits."""
    most = LiveData(*(row.type_range[1] for row in rows(LiveData).values()))
    least = LiveData(*(row.type_range[0] for row in rows(LiveData).values()))
    stream = (
        encode(most, Layout.LEGACY) * 2000 + encode(least, Layout.LEGACY) * 500 + encode(most, Layout.LEGACY) * 2000
    )
    check(tmp_path / "a.bin", stream, rate=0.5)
    check(tmp_path / "a.bin", stream, rate=100)


@pytest.mark.parametrize(
    "stream", [b"", b"KODL", b"KODL" * 30, bytes(500)], ids=["empty", "header", "headers", "zeros"]
)
def test_nothing_to_find(tmp_path: Path, stream: bytes) -> None:
    assert check(tmp_path / "a.bin", stream) == (0, 0) or stream


# --- other layouts ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [CYCLIC, EVENT, ON_CHANGE, CYCLIC_AND_EVENT, CYCLIC_AND_ON_CHANGE])
@pytest.mark.parametrize(("cycle", "delay"), [(10, 0), (35, 7), (20, 50), (1000, 500)])
@pytest.mark.parametrize("maker", [crc_message, paged_message])
def test_every_way_to_send(tmp_path: Path, kind: int, cycle: int, delay: int, maker: object) -> None:
    message = crc_message() if maker is crc_message else paged_message()
    layout = bus_layout([(message, kind, cycle, delay)])
    count, whole = check(tmp_path / "a.bin", flight(kind + cycle, 500, info_each=50), layout, block=200)
    assert count > whole * 0.5 or whole < 20
    source = random.Random(cycle)
    check(tmp_path / "a.bin", damaged(flight(5, 300, info_each=20), source, 2), layout, 300, block=100)


@pytest.mark.parametrize("seed", range(12))
def test_random_layouts(tmp_path: Path, seed: int) -> None:
    """Signals of all sources, types, places; multiplexed, of both id lengths, of CAN FD; sent in every way."""
    source = random.Random(seed)
    esc = EscSettings("esc1", pole_pairs=source.choice([1, 7]), cell_count=source.choice([0, 0, 12]))
    maker = LayoutMaker(source, [esc])
    timed = []
    for _ in range(source.choice([3, 12])):
        message = maker.message()
        timed.append(
            (message, source.randrange(5), source.choice([10, 20, 33, 100, 500]), source.choice([0, 0, 5, 20, 100]))
        )
    layout = bus_layout(timed, esc)
    fly = Flight(source, source.choice(list(Layout)), source.choice([1, 3]))
    stream = fly.frames(400, source.choice([0, 7, 100])) + fly.frames(300, 25)
    stream = damaged(stream, source, source.choice([0, 0, 2]))
    path, rate = tmp_path / "a.bin", source.choice([4, 100, 100, 250])
    path.write_bytes(stream)
    recording = DumpInput(path, layout, rate)
    if not can_follow(recording.setup.gateway(layout.layout, 0), layout.layout, recording._period_ns, len(stream)):
        assert recording.bulk_frames() is None
        return
    check(path, stream, layout, rate, block=source.choice([64, 500]))


# --- the conversion -----------------------------------------------------------------------------------------------------


def convert(recording: DumpInput, target: Path, start: float | None, end: float | None) -> tuple[str | None, bytes]:
    """What was said, and the log; without a log b''."""
    conversion = LogConversion("candump", *(None if at is None else round(at * SECOND) for at in (start, end)))
    with Output(target, "candump") as out:
        told = conversion(recording, out, lambda _: None)
    written = target.read_bytes() if target.exists() else b""
    target.unlink(missing_ok=True)
    return told, written


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (None, None),
        (0, 0),
        (3.3, None),
        (None, 7.77),
        (5, 5.001),
        (9.99, 10.01),
        (12.5, 29),
        (40, None),
        (29.9, 60),
        (8, 3),
    ],
)
@pytest.mark.parametrize("harm", [0, 3])
def test_a_part_of_it(tmp_path: Path, start: float | None, end: float | None, harm: int) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(damaged(flight(7, 3000), random.Random(1), harm))
    recording = DumpInput(path)
    found = convert(recording, tmp_path / "a.log", start, end), recording.damage, recording.position
    other = DumpInput(path)
    other.bulk_frames = lambda: None  # type: ignore[method-assign]
    expected = convert(other, tmp_path / "a.log", start, end), other.damage
    assert found[0] == expected[0]
    if end is None:  # a part that ends is not read to the end
        assert found[1] == expected[1]
        assert found[2] == path.stat().st_size


def test_a_message_that_changes_with_time_goes_the_streaming_way(tmp_path: Path) -> None:
    layout = bus_layout([(Msg("Age", 0x200, 2, [sig("DataAge", 0, 16, unit="ms")]), ON_CHANGE, 0, 0)])
    path = tmp_path / "a.bin"
    path.write_bytes(flight(1, 300))
    recording = DumpInput(path, layout)
    assert recording.bulk_frames() is None
    told, log = convert(recording, tmp_path / "a.log", None, None)
    assert log == one_by_one(recording)[0]
    assert told is not None


def test_without_numpy_it_goes_the_streaming_way(tmp_path: Path) -> None:
    path, target = tmp_path / "a.bin", tmp_path / "a.log"
    path.write_bytes(flight(1, 300))
    code = (
        "import sys; sys.modules['numpy'] = None\n"
        "from kontronik_can_gw.cli import main\n"
        "sys.exit(main(['convert', '-q', *sys.argv[1:]]))"
    )
    subprocess.run([sys.executable, "-c", code, path, target], check=True)
    assert target.read_bytes() == one_by_one(DumpInput(path))[0]


@pytest.mark.parametrize("seconds", [0, 8, 98, 99_998, 9_999_999])
def test_times_with_more_and_more_digits(seconds: int) -> None:
    """A second gets a digit more amid a block, and where half a microsecond makes it so."""
    times = np.array([0, 1, 499, 500, 999_999_499, 999_999_500, 10**9, 2 * 10**9 - 501, 2 * 10**9 - 500, 3 * 10**9])
    times = np.sort(np.concatenate([times, times + 10**9])) + seconds * SECOND
    plans = SHIPPED.layout.messages
    chance = np.random.default_rng(seconds)
    messages, data = chance.integers(0, len(plans), len(times)), chance.integers(0, 256, (len(times), 8), np.uint8)
    parts = []
    for index in range(len(plans)):
        places = np.flatnonzero(messages == index)
        parts.append(Part(index, times[places], places, data[places]))
    expected = io.BytesIO()
    writer = CanLogWriter(expected, "candump", None)
    for time_ns, message, row in zip(times.tolist(), messages.tolist(), data, strict=True):
        writer.write(time_ns, CanFrame(plans[message].can_id, row.tobytes()), False)
    assert bytes(Lines(plans).text(CanFrames(parts), 0)) == expected.getvalue()
    few = CanFrames(parts).between(int(times[3]), int(times[7]))
    assert bytes(Lines(plans).text(few, 0)) == b"".join(expected.getvalue().splitlines(keepends=True)[3:8])
