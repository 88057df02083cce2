"""The rows of plain bytes in blocks are those of the streaming way: times, every value and its type, what is told of damage."""

import random
from pathlib import Path

import pytest
from flights import SHIPPED, Wandering, bus_layout, random_layout
from hypothesis import given, settings
from hypothesis import strategies as st
from packer_oracle import Msg, Sig
from protocol.streams import damaged

from kontronik_can_gw.offline.bulk.feed import Feed
from kontronik_can_gw.offline.bulk.rows import can_read, read_rows
from kontronik_can_gw.offline.inputs import CHUNK, DumpInput
from kontronik_can_gw.offline.layouts import BusLayout
from kontronik_can_gw.offline.samples import SampledGateway
from kontronik_can_gw.offline.tables import Block
from kontronik_can_gw.protocol import Device
from kontronik_can_gw.protocol.codec import Layout
from kontronik_can_gw.simulator import EscOptions, Faults, SimulatedEsc
from kontronik_can_gw.telemetry import SECOND, EscSettings

Rows = list[tuple[int, list[object]]]


def in_blocks(recording: DumpInput, chosen: list[int], block: int, least: int) -> tuple[Rows, list[str], int]:
    """The rows, what is told of damage, how many rows came in blocks."""
    period, reader = recording._period_ns, recording.reader
    assert can_read(period, recording.size)
    gateway = SampledGateway(recording.setup, recording.bus.layout, reader, 0, frames_count=False)
    feed = Feed(recording.size, period)
    texts = [[text for _, text in reader.columns[index].texts] for index in chosen]
    rows: Rows = []
    count = 0
    with recording._path.open("rb") as file:
        for found in read_rows(gateway, reader, chosen, file.read, feed, period, block, least):
            if isinstance(found, Block):
                count += len(found)
                rows += [(time_ns, list(values)) for time_ns, _, values in found.rows(texts)]
            else:
                rows.append((found.time_ns, [found.values[index] for index in chosen]))
    return rows, feed.damage, count


def check(
    path: Path,
    stream: bytes,
    layout: BusLayout = SHIPPED,
    rate: float = 100,
    block: int = 1000,
    least: int = 4,
    chosen: list[int] | None = None,
) -> tuple[int, int]:
    """Both ways give the same. How many rows came in blocks, of how many."""
    path.write_bytes(stream)
    recording = DumpInput(path, layout, rate)
    columns = recording.reader.columns
    if chosen is None:
        chosen = list(range(len(columns)))
    expected = [(sample.time_ns, [sample.values[index] for index in chosen]) for sample in recording.samples()]
    found, damage, count = in_blocks(recording, chosen, block, least)
    for number, (one, other) in enumerate(zip(found, expected, strict=False)):
        assert one[0] == other[0], f"row {number}"
        if repr(one[1]) != repr(other[1]):  # tells 0 from 0.0 too
            different = [
                (columns[index].message, columns[index].name, value, wanted)
                for index, value, wanted in zip(chosen, one[1], other[1], strict=True)
                if repr(value) != repr(wanted)
            ]
            raise AssertionError(f"row {number} of {len(expected)}: {different}")
    assert len(found) == len(expected)
    assert damage == recording.damage
    return count, len(expected)


@pytest.mark.parametrize("layout", list(Layout))
@pytest.mark.parametrize("block", [6, 100, 16_384])
def test_a_clean_stream_is_read_in_blocks(tmp_path: Path, layout: Layout, block: int) -> None:
    """Suspect frames and all: in the legacy layout, an operating state above the known ones."""
    count, rows = check(tmp_path / "a.bin", Wandering(random.Random(1), layout).frames(1500), block=block)
    assert count > rows * (0.8 if block > 6 else 0.5)


@pytest.mark.parametrize("device", list(Device))
def test_a_simulated_esc(tmp_path: Path, device: Device) -> None:
    """The JIVEPro does not supply the BEC current."""
    esc = SimulatedEsc(EscOptions(device=device), seed=int(device))
    stream = b"".join(sent.wire for sent in esc.frames_until(20 * SECOND))
    count, rows = check(tmp_path / "a.bin", stream)
    assert count > rows * 0.9


@pytest.mark.parametrize("rate", [2, 20, 101, 12_345, 1e6])
def test_any_rate(tmp_path: Path, rate: float) -> None:
    """At 100 Hz and above an info frame goes into the row in front of it; slowly enough, information goes stale."""
    source = Wandering(random.Random(7))
    stream = source.frames(400, 9, infos=2) + source.frames(300, 100) + source.frames(450, 0) + source.frames(200, 50)
    check(tmp_path / "a.bin", stream, rate=rate, block=130)


@pytest.mark.parametrize("info_each", [1, 2, 10, 1100, 0])
def test_information_often_seldom_and_never(tmp_path: Path, info_each: int) -> None:
    stream = Wandering(random.Random(info_each)).frames(2500, info_each)
    count, rows = check(tmp_path / "a.bin", stream, block=500)
    assert count > rows * 0.5 or info_each == 1


def test_another_device_and_another_layout(tmp_path: Path) -> None:
    source = Wandering(random.Random(3), device=3)
    stream = source.frames(500, 50)
    source.becomes(1)
    stream += source.frames(500, 50)
    source.becomes(3)
    stream += source.frames(500, 50)
    source.layout = Layout.LEGACY
    stream += source.frames(500, 50)
    source.layout = Layout.V4
    count, rows = check(tmp_path / "a.bin", stream + source.frames(700, 0))
    assert count > rows * 0.4


@pytest.mark.parametrize("seed", range(4))
def test_a_bad_line(tmp_path: Path, seed: int) -> None:
    """The link is degraded for a while now and then."""
    spoilt = Faults(noise=0.05 * (seed % 3), lost_bytes=0.0002, flipped_bits=0.00002)
    esc = SimulatedEsc(EscOptions(device=Device.KOLIBRI, faults=spoilt), seed=seed)
    stream = b"".join(sent.wire for sent in esc.frames_until(20 * SECOND))
    check(tmp_path / "a.bin", stream, block=random.Random(seed).choice([50, 1000]))


@pytest.mark.parametrize("length", [65, 300, CHUNK + 70])
def test_rubbish_over_the_limits_of_what_is_read_at_once(tmp_path: Path, length: int) -> None:
    """Where no frame comes for long, bytes are given to the gateway before the next one comes."""
    source = Wandering(random.Random(length))
    stream = source.frames(6400)
    while len(stream) < CHUNK - 140:
        stream += source.frames(1, 0)
    assert len(stream) < CHUNK - 64
    stream += random.Random(1).randbytes(length) + source.frames(300)
    for rate in (100, 2.1, 2.3, 2.9):  # a second may end between the two frames
        check(tmp_path / "a.bin", stream, rate=rate)


@given(st.integers(0, 1 << 32))
@settings(max_examples=15, deadline=None)
def test_any_damage(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    source = random.Random(seed)
    esc = Wandering(source, source.choice(list(Layout)), source.choice([1, 3]))
    stream = b""
    for _ in range(source.choice([1, 3])):
        esc.layout = source.choice([esc.layout, esc.layout, *Layout])
        stream += damaged(
            esc.frames(source.choice([80, 500]), source.choice([0, 7, 100])), source, source.choice([0, 1, 4])
        )
    path = tmp_path_factory.getbasetemp() / "damaged.bin"
    check(
        path,
        stream,
        rate=source.choice([4, 50, 100, 250]),
        block=source.choice([20, 1000]),
        least=source.choice([1, 16]),
    )


@pytest.mark.parametrize("seed", range(4))
def test_random_layouts(tmp_path: Path, seed: int) -> None:
    source = random.Random(seed)
    layout = random_layout(source, source.choice([3, 12]))
    esc = Wandering(source, source.choice(list(Layout)), source.choice([1, 3]))
    stream = damaged(
        esc.frames(500, source.choice([0, 7, 100])) + esc.frames(300, 25), source, source.choice([0, 0, 2])
    )
    check(tmp_path / "a.bin", stream, layout, source.choice([4, 100, 100, 250]), source.choice([64, 500]))


def test_values_of_the_gateway_beside_information_and_flags_that_are_lost(tmp_path: Path) -> None:
    """The first message is read with information only. In the others all values may be out of range, and the flags with them."""
    messages = [
        Msg("Rare", 0x100, 8, [Sig("CellCount", 0, 8), Sig("Uptime", 8, 32, unit="s")]),
        Msg(
            "Flags",
            0x101,
            2,
            [
                Sig("Undervoltage", 0, 1),
                Sig("Volt", 8, 8, unit="V", texts={255: "NotAvailable"}, bind="battery_voltage"),
            ],
        ),
        Msg(
            "Tests",
            0x102,
            2,
            [Sig("TestUndervoltage", 0, 1), Sig("Cells", 8, 2, texts={3: "NotAvailable"}, bind="cell_count")],
        ),
    ]
    source = random.Random(5)
    layout = bus_layout(messages, EscSettings("esc1"), source)
    for info_each in (3, 40):
        esc = Wandering(source)
        esc.restless |= {"battery_voltage": 0.3, "operating_errors": 0.3, "cell_count": 0.5, "selftest_errors": 0.5}
        count, rows = check(tmp_path / "a.bin", esc.frames(900, info_each), layout, block=70)
        assert count > rows * 0.5


def test_some_columns_only(tmp_path: Path) -> None:
    columns = DumpInput(_written(tmp_path, b"KOD"), SHIPPED).reader.columns
    source = random.Random(2)
    stream = Wandering(source).frames(400)
    for _ in range(6):
        check(tmp_path / "a.bin", stream, chosen=source.sample(range(len(columns)), source.choice([1, 3, 20])))


def test_energy_that_no_64_bits_hold(tmp_path: Path) -> None:
    """100 kW for an hour at two frames a second."""
    esc = Wandering(random.Random(1))
    esc.restless = dict.fromkeys(esc.restless, 0.0)
    esc.live = esc.live._replace(battery_voltage=65_535, battery_current=32_767, electrical_speed=5)
    esc.restless["battery_current"] = 0.01
    count, rows = check(tmp_path / "a.bin", esc.frames(7200, 10), rate=2)
    assert count > rows * 0.9


def test_nothing(tmp_path: Path) -> None:
    for stream in (b"KOD", b"KODL" + bytes(60), Wandering(random.Random(1)).frames(1)):
        check(tmp_path / "a.bin", stream)


def _written(tmp_path: Path, stream: bytes) -> Path:
    path = tmp_path / "b.bin"
    path.write_bytes(stream)
    return path
