"""CAN logs are written and read as by python-can, frame by frame and to the microsecond."""

import struct
import zlib
from itertools import chain
from pathlib import Path

import can
import pytest
from command_line import run
from log_files import (
    READERS,
    SUFFIX,
    WALL_NS,
    at_wall,
    message_of,
    opened,
    read_by_library,
    read_log,
    some_frames,
    write_log,
)

from kontronik_can_gw.desk.recordings.log_input import log_format
from kontronik_can_gw.desk.recordings.recording import LogFrame
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("logs")

FORMATS = sorted(READERS)
WITH_FD = sorted(set(FORMATS) - {"trc"})


@pytest.mark.parametrize("format_", FORMATS)
def test_written_log_is_read_equal_by_python_can_and_by_us(tmp_path: Path, format_: str) -> None:
    path = tmp_path / f"log{SUFFIX[format_]}"
    for seed in range(3 if format_ == "mf4" else 12):
        items = some_frames(100, seed, fd=format_ in WITH_FD)
        write_log(path, format_, items)
        assert read_by_library(path, format_) == at_wall(items)
        if format_ == "mf4":  # whose times are floats
            continue
        assert read_log(path) == (at_wall(items), [])
        write_log(path, format_, items, None)
        assert read_log(path) == (items, [])


@pytest.mark.parametrize("format_", FORMATS)
def test_log_written_by_python_can_is_read(tmp_path: Path, format_: str) -> None:
    items = at_wall(some_frames(300, fd=format_ in WITH_FD))
    path = tmp_path / f"log{SUFFIX[format_]}"
    with can.Logger(path) as writer:
        for item in items:
            writer(message_of(item))
    found, damage = read_log(path)
    assert damage == []
    assert [item[1:] for item in found] == [item[1:] for item in items]
    if format_ == "asc":
        # python-can writes 5 ms as 500 in the header. The start may be wrong, not the distances.
        shift = found[0][0] - items[0][0]
        found = [(time_ns - shift, *rest) for time_ns, *rest in found]  # type: ignore[misc]
    for one, other in zip(found, items, strict=True):
        assert abs(one[0] - other[0]) <= 1000


def test_candump_log_of_other_tools_is_read(tmp_path: Path) -> None:
    path = tmp_path / "other.log"
    path.write_text(
        "(1700000000.000001) can0 681#0011\n"
        "(1700000000.000002)  can1  00000123#\n"
        "(1700000000.000003) can0 123#R4\n"
        "(1700000000.000004) can0 20000080#0000000000000000\n"
        "\n"
        "(1700000000.000005) can0 123##3001122\r\n"
        "(1700000000.000006) vcan0 123#1122334455667788_E T\n"
        "(1700000000.000007) can0 7FF#AA R"
    )
    with opened(path) as log:
        found = list(log.frames())
        assert log.damage == []
    at = 1_700_000_000_000_000_000
    assert found == [
        (at + 1000, CanFrame(0x681, b"\x00\x11"), False),
        (at + 2000, CanFrame(0x123, b"", True), False),
        (at + 5000, CanFrame(0x123, b"\x00\x11\x22", fd=True), False),
        (at + 6000, CanFrame(0x123, bytes.fromhex("1122334455667788")), False),
        (at + 7000, CanFrame(0x7FF, b"\xaa"), True),
    ]


def test_asc_with_decimal_base_and_relative_times_is_read(tmp_path: Path) -> None:
    path = tmp_path / "decimal.asc"
    path.write_text(
        "date Wed Nov 15 10:13:20.250 am 2023\n"
        "base dec  timestamps relative\n"
        "internal events logged\n"
        "// version 9.0.0\n"
        "   0.000000 Start of measurement\n"
        "   0.010000 1  1665            Rx   d 3 0 17 255  Length = 112 BitCount = 60\n"
        "   0.010000 CAN 1 Status:chip status error active\n"
        "   0.010000 2  291x            Tx   d 0\n"
        "   0.010000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%\n"
        "   0.000500 1  ErrorFrame\n"
        "   0.000500 1  291             Rx   r\n"
        "End TriggerBlock\n"
    )
    with opened(path) as log:
        found = list(log.frames())
        assert log.damage == []
        assert log.wall_ns(0) is not None
        assert (log.wall_ns(0) or 0) % 1_000_000_000 == 250_000_000
    assert found == [
        (10_000_000, CanFrame(1665, b"\x00\x11\xff"), True),
        (30_000_000, CanFrame(291, b"", True), False),
    ]


def test_content_decides_on_the_format_and_not_the_suffix(tmp_path: Path) -> None:
    for format_ in FORMATS:
        path = tmp_path / f"{format_}.bin"
        write_log(path, format_, some_frames(5))
        assert log_format(path.read_bytes()) == format_


@pytest.mark.parametrize("gap_s", [1, 3600])
@pytest.mark.parametrize("format_", ["asc", "trc"])
def test_each_head_of_joined_logs_begins_a_session_with_its_date(
    tmp_path: Path, format_: str, gap_s: int
) -> None:
    items = some_frames(50)
    last_s = items[-1][0] // 10**9 + 1
    starts = [WALL_NS + number * (last_s + gap_s) * 10**9 for number in range(3)]
    joined = b""
    expected = []
    for number, start_ns in enumerate(starts):
        part = tmp_path / f"{number}.{format_}"
        write_log(part, format_, items, start_ns)
        joined += part.read_bytes()
        expected += read_log(part)[0]
    path = tmp_path / f"joined.{format_}"
    path.write_bytes(joined)
    found, damage = read_log(path)
    assert damage == []
    assert found == expected


def test_relative_times_of_a_joined_asc_begin_anew(tmp_path: Path) -> None:
    text = ""
    for hour, base in ((10, "hex"), (11, "dec")):
        text += f"date Tue Nov 14 {hour}:00:00.000 2023\nbase {base}  timestamps relative\n"
        text += "  1.000000 1  ErrorFrame\n"
        text += "  1.000000 1  100  Rx   d 1 10\n" * 2
    path = tmp_path / "joined.asc"
    path.write_text(text)
    found = []
    with opened(path) as log:
        for item in chain.from_iterable(log.batches()):
            assert isinstance(item, LogFrame)
            found.append((item.time_ns // 10**9, item.frame.can_id))
    error = 0x20000080
    assert found == [
        (1, error),
        (2, 0x100),
        (3, 0x100),
        (3601, error),
        (3602, 100),
        (3603, 100),
    ]


@pytest.mark.parametrize("unit", ["10 us", "1 ns"])
def test_times_before_the_start_of_a_blf_are_read(tmp_path: Path, unit: str) -> None:
    """Pre-trigger buffers write them, as in a log whose start was changed later."""
    items = some_frames(50)
    path = tmp_path / "log.blf"
    write_log(path, "blf", items)
    whole = zlib_blocks_of(path)
    flags, factor = (1, 10_000) if unit == "10 us" else (2, 1)
    at = 0
    times = []
    while (at := whole.find(b"LOBJ", at)) >= 0:
        _, time = struct.unpack_from("<L4xQ", whole, at + 16)
        early = (time - 10**10) // factor
        times.append(early * factor)
        struct.pack_into("<L", whole, at + 16, flags)
        struct.pack_into("<q", whole, at + 24, early)
        at += 4
    head = path.read_bytes()[:144]
    container = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(whole), 10, 0, len(whole))
    path.write_bytes(head + container + whole)
    found, damage = read_log(path)
    assert not [line for line in damage if "cut off" not in line]
    start_ns = WALL_NS // 10**6 * 10**6
    assert sorted(time_ns - start_ns for time_ns, _, _ in found) == sorted(times)
    assert min(times) < 0 < max(times)


def zlib_blocks_of(path: Path) -> bytearray:
    """Return the objects in the containers of a BLF log."""
    data = path.read_bytes()
    at = 144
    found = bytearray()
    while data[at : at + 4] == b"LOBJ":
        (size,) = struct.unpack_from("<L", data, at + 8)
        found += zlib.decompress(data[at + 32 : at + size])
        at += size + size % 4
    return found


def test_can_fd_frames_are_left_out_of_trc_with_a_warning(tmp_path: Path) -> None:
    some = some_frames(100, fd=True)
    source = tmp_path / "fd.log"
    write_log(source, "candump", some)
    said = run("convert", source, tmp_path / "fd.trc").err
    wide = sum(frame.fd for _, frame, _ in some)
    assert f"{wide} CAN FD frames left out, which trc does not support" in said
    found = [item[1:] for item in read_log(tmp_path / "fd.trc")[0]]
    assert found == [item[1:] for item in some if not item[1].fd]


def test_part_has_all_frames_of_a_log_whose_interfaces_are_not_in_order(tmp_path: Path) -> None:
    """The frames of the second interface are stored up to a second too late."""
    lines = []
    for ms in range(0, 6000, 5):
        lines.append(f"({1_700_000_000 + ms / 1000:.6f}) can0 100#{ms:04X}")
        earlier = ms - 800
        if earlier >= 0:
            lines.append(f"({1_700_000_000 + earlier / 1000:.6f}) can1 101#{earlier:04X}")
    source = tmp_path / "two.log"
    part = tmp_path / "part.log"
    source.write_text("\n".join(lines) + "\n")
    run("convert", source, part, "--from", "1", "--until", "3")
    items, _ = read_log(part)
    for can_id in (0x100, 0x101):
        frames = [frame for _, frame, _ in items if frame.can_id == can_id]
        times = [int.from_bytes(frame.data) for frame in frames]
        assert times == list(range(1000, 3001, 5))


def test_direction_that_a_log_does_not_state_is_not_written(tmp_path: Path) -> None:
    lines = [
        "(1700000000.000000) can0 688#000000C409001400",
        "(1700000000.001000) can0 688#000000C409001400 R",
        "(1700000000.002000) can0 688#000000C409001400 T",
        "(1700000000.003000) can1 12345678##1000102030405060708090A0B",
        "(1700000000.004000) can1 681#R",
        "(1700000000.005000) can1 20000004#0004000000000000",
    ]
    log = tmp_path / "mixed.log"
    log.write_text("\n".join(lines) + "\n")
    assert run("convert", "-q", log, "-", "--to", "candump").out.splitlines() == lines
    trc = tmp_path / "old.trc"  # version 1.0 has no column for it
    trc.write_text(
        ";##########\n  1)  1842  0688  8  00 00 00 C4 09 00 14 00\n"
        "  2)  1843  0008  4  ERROR  00 19 08 08\n"
    )
    written = run("convert", "-q", trc, "-", "--to", "candump").out.splitlines()
    assert [line.split()[3:] for line in written] == [[], []]
