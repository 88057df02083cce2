"""A candump log gives the same frames whether its lines arrive together or one by one."""

import io
import random
from collections.abc import Iterator

import pytest

from kontronik_can_gw.desk.recordings.can_logs.text import LONGEST_LINE, CandumpReader
from kontronik_can_gw.desk.recordings.recording import LogFrame

pytestmark = pytest.mark.promise("logs")

LINES = (
    b"(1700000000.000001) can0 681#0011223344556677 R\n",
    b"(1700000000.000002) can1 681#00 T\n",
    b"(1700000000.000003) can0 1ABCDEF0#0102\n",
    b"(12.345678) vcan0 7FF#\n",
    b"(0.000000) can0 000#AA\n",
    b"(3999999999.999999) can0 123#AA\n",
)
OTHERS = (
    b"(4000000000.000000) can0 123#AA\n",
    b"(9999999999.999999) can0 123#AA\n",
    b"(1700000000.1) can0 123#AA\n",
    b"(1700000000.123456789) can0 123#AA R\n",
    b"(1700000000.000001) can0 681#00112 R\n",
    b"(1700000000.000001) can0 681#1 T\n",
    b"(1700000000.000001) can0 681#001122334455667788 R\n",
    b"(1700000000.000001) can0 800#00\n",
    b"(1700000000.000001) can0 123#aabb r\n",
    b"(1700000000.000001) can0 123##1001122334455667788AABBCC R\n",
    b"(1700000000.000001) can0 123##100112233445566778899 R\n",
    b"(1700000000.000001) can0 123#R4 R\n",
    b"(1700000000.000001) can0 123#R\n",
    b"(1700000000.000001) can0 20000080#0000000000000000 R\n",
    b"(1700000000.000001) can0 123#1122334455667788_E T\n",
    b"(1700000000.000005)  can0  123#00\r\n",
    b" (1700000000.000005) can0 123#00 \n",
    b"(1700000000.000001) can0 123#00 X\n",
    b"(1700000000.000001) can0 12#00\n",
    b"(1700000000.000001) can0\n",
    b"\n",
    b"\0\n",
    b"hello (1700000000.000001) can0 123#00\n",
    b"x" * LONGEST_LINE + b"(1700000000.000001) can0 123#00\n",
    bytes(3 * LONGEST_LINE + 5) + b"\n",
    b"(1700000000.000001) " + b"c" * 65 + b" 123#00\n",
)


class _Pieces(io.RawIOBase):
    """Data that arrive in pieces."""

    def __init__(self, data: bytes, sizes: Iterator[int]) -> None:
        super().__init__()
        self._data, self._sizes = data, sizes

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:  # type: ignore[no-untyped-def]
        size = min(next(self._sizes), len(buffer))
        piece, self._data = self._data[:size], self._data[size:]
        buffer[: len(piece)] = piece
        return len(piece)


def read(data: bytes, sizes: Iterator[int]) -> tuple[list[LogFrame], list[str]]:
    """Frames and damage of a log that arrives in pieces of these sizes."""
    reader = CandumpReader(io.BufferedReader(_Pieces(data, sizes), 1 << 16))
    found = list(reader)
    return found, reader.damage


def always(size: int) -> Iterator[int]:
    while True:
        yield size


def line_by_line(data: bytes) -> tuple[list[LogFrame], list[str]]:
    """As single bytes arrive no buffer ever holds a whole line, so each line is read alone."""
    return read(data, always(1))


@pytest.mark.parametrize("line", [*LINES, *OTHERS])
def test_line_is_read_the_same_alone_and_among_others(line: bytes) -> None:
    around = LINES[0] * 3, LINES[1] * 2
    data = line.join(around)
    frames, damage = read(data, always(1 << 16))
    assert (frames, damage) == line_by_line(data)
    assert all(type(frame) is LogFrame for frame in frames)
    assert len(frames) == 5 + (line in LINES) or line not in LINES
    assert damage in ([], ["1 damaged line: 4"])


def test_usual_lines_are_read_as_they_are_written() -> None:
    frames, damage = read(b"".join(LINES), always(1 << 16))
    assert damage == []
    assert [item.time_ns for item in frames[:4]] == [
        *(1_700_000_000_000_000_000 + 1000 * n for n in (1, 2, 3)),
        12_345_678_000,
    ]
    assert [item.channel for item in frames[:4]] == ["can0", "can1", "can0", "vcan0"]
    assert [item.received for item in frames[:4]] == [True, False, None, None]
    assert [item.frame.can_id for item in frames[:4]] == [0x681, 0x681, 0x1ABCDEF0, 0x7FF]
    assert [item.frame.extended for item in frames[:4]] == [False, False, True, False]
    assert frames[0].frame.data == bytes.fromhex("0011223344556677")


@pytest.mark.parametrize("seed", range(8))
def test_frames_and_damage_do_not_depend_on_how_a_log_arrives(seed: int) -> None:
    chance = random.Random(seed)
    some = [chance.choice((*LINES * 20, *OTHERS)) for _ in range(400)]
    damaged = bytearray(b"".join(some))
    for _ in range(20 * (seed % 2)):
        damaged[chance.randrange(len(damaged))] = chance.randrange(256)
    data = bytes(damaged) + chance.choice((b"", b"(1700000000.5) can0 681#00", b"rubbish"))
    expected = line_by_line(data)
    assert len(expected[0]) > 200
    assert read(data, always(1 << 16)) == expected
    sizes = random.Random(seed)
    assert read(data, iter(lambda: sizes.choice((1, 7, 40, 5000, 1 << 16)), 0)) == expected
