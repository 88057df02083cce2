"""Error frames and remote frames of a log are copied if the format has them, and counted if not."""

import struct
from pathlib import Path

import can
import pytest
from capture_bench import Bench, capture_file, made
from command_line import run
from log_files import READERS, SUFFIX, opened
from recordings import candump_log

from kontronik_can_gw.capture.format import Entry, EntryKind, frame_data
from kontronik_can_gw.desk.recordings.can_logs.writer import CanLogWriter
from kontronik_can_gw.desk.recordings.recording import ERROR, LogFrame
from kontronik_can_gw.frames import CanFrame

pytestmark = pytest.mark.promise("logs")

MS = 1_000_000
WALL_NS = 1_700_000_000_000 * MS
DATA = CanFrame(0x688, bytes.fromhex("000000C409001400"))
NO_ACK = CanFrame(ERROR | 0xA4, bytes.fromhex("0000190000000000"))
ASKS = CanFrame(0x681, bytes(8), remote=True)
ASKS_NOTHING = CanFrame(0x12345, b"", extended=True, remote=True)
FRAMES = [DATA, NO_ACK, ASKS, DATA, ASKS_NOTHING, NO_ACK, ASKS, DATA]


def _logged(path: Path) -> list[LogFrame]:
    with opened(path) as log:
        found = [item for batch in log.batches() for item in batch]
        assert log.damage == []
    return found  # type: ignore[return-value]


def _kinds(found: list[LogFrame]) -> list[tuple[str, int, bytes]]:
    """Return the kind, the id and the data of frames. Error frames have no id and no data here."""
    kinds: list[tuple[str, int, bytes]] = []
    for item in found:
        if item.frame.can_id & ERROR:
            kinds.append((item.kind, 0, b""))
        else:
            kinds.append((item.kind, item.frame.can_id, item.frame.data))
    return kinds


@pytest.mark.parametrize("format_", sorted(READERS))
def test_error_and_remote_frames_are_read_back_as_they_were_written(
    tmp_path: Path, format_: str
) -> None:
    items = [LogFrame(n * MS, frame, n % 3 > 0, "can0") for n, frame in enumerate(FRAMES)]
    path = tmp_path / f"log{SUFFIX[format_]}"
    with path.open("wb") as file:
        writer = CanLogWriter(file, format_, WALL_NS)
        writer.write(items)
        writer.close()
    expected = items
    if format_ == "trc":  # python-can has no error frames in it
        expected = [item for item in items if item.frame is not NO_ACK]
        assert writer.left_out == {"error frame": 2}
    else:
        assert not writer.left_out
    found = _logged(path)
    assert _kinds(found) == _kinds(expected)
    for item, wanted in zip(found, expected, strict=True):
        assert item.frame.extended == wanted.frame.extended
    if format_ in ("candump", "blf", "mf4"):  # ASC does not have the class
        assert [item.frame for item in found] == [item.frame for item in expected]
    with READERS[format_](path) as reader:
        kinds = [(m.is_error_frame, m.is_remote_frame) for m in reader]
    assert kinds == [(item.frame is NO_ACK, item.frame.remote) for item in expected]


def test_tables_reports_and_screens_count_error_and_remote_frames(tmp_path: Path) -> None:
    log = candump_log(tmp_path / "flight.log")
    lines = log.read_text().splitlines(keepends=True)
    plain = run("convert", "-q", log, "-", "--to", "csv").out
    stamp = lines[10].split()[0]
    lines[10:10] = [
        f"{stamp} can0 20000004#0004000000000000\n",
        f"{stamp} can0 688#R8\n",
        f"{stamp} can0 12345678#R\n",
    ]
    log.write_text("".join(lines))
    note = f"{log}: 1 error frame and 2 remote frames left out\n"
    done = run("convert", log, "-", "--to", "csv")
    assert done.out == plain, "a remote frame has no values"
    assert note in done.err
    assert note in run("report", log, "-o", tmp_path / "page.html").err
    page = (tmp_path / "page.html").read_text()
    assert "<dt>Frames</dt><dd>1 error frame and 2 remote frames left out</dd>" in page
    done = run("monitor", "--once", log)
    assert "warning: 1 error frame and 2 remote frames left out" in done.err
    done = run("convert", log, tmp_path / "copy.trc")
    assert "; 1 error frame left out, which trc does not support" in done.err
    done = run("convert", log, tmp_path / "copy.log")
    assert "left out" not in done.err
    copied = (tmp_path / "copy.log").read_text().splitlines()
    for copy, line in zip(copied, lines, strict=True):
        assert copy.split()[:3] == line.split()[:3]


def test_error_and_remote_frames_of_another_channel_are_not_counted(tmp_path: Path) -> None:
    log = tmp_path / "two.log"
    log.write_text(
        "(1700000000.000000) can0 20000004#0004000000000000\n"
        "(1700000000.000000) can1 20000004#0004000000000000\n"
        "(1700000000.000100) can0 688#000000C409001400\n"
        "(1700000000.000200) can1 688#R8\n"
        "(1700000000.010100) can0 688#000000C409001401\n"
    )
    done = run("convert", log, tmp_path / "out.csv")
    assert f"{log}: 1 error frame left out\n" in done.err


def test_asc_lines_with_error_and_remote_frames_are_read(tmp_path: Path) -> None:
    path = tmp_path / "log.asc"
    path.write_text(
        "date Wed Nov 15 10:13:20.250 am 2023\n"
        "base hex  timestamps absolute\n"
        "   0.001 1  ErrorFrame\n"
        "   0.002 2 ErrorFrame Flags = 0xe CodeExt = 0x20a2 "
        "Code = 0x82 ID = 0 DLC = 0 Position = 5\n"
        "   0.003 CANFD   1 Rx  ErrorFrame  "
        "Not Acknowledge error, dominant error flag fffe c7 31ca Arb.\n"
        "   0.004 1  681             Rx   r\n"
        "   0.005 1  12345x          Tx   r 8 Length = 1704000 BitCount = 145 ID = 74565x\n"
        "   0.006 CANFD   2 Tx   681  0 0 4 0  0 0 0 0 0 0 0 0\n"
    )
    found = _logged(path)
    error = CanFrame(ERROR | 0x80, bytes(8))
    assert [(item.time_ns // MS, item.frame, item.channel) for item in found] == [
        (1, error, "1"),
        (2, error, "2"),
        (3, error, "1"),
        (4, CanFrame(0x681, b"", remote=True), "1"),
        (5, CanFrame(0x12345, bytes(8), extended=True, remote=True), "1"),
        (6, CanFrame(0x681, bytes(4), remote=True), "2"),
    ]


@pytest.mark.parametrize(
    ("head", "line", "channel"),
    [
        ("", "  1)  1842  0008  4  ERROR  00 19 08 08", "1"),
        (";$FILEVERSION=1.1\n", "  1)  1842.0  Error  0008  4  00 19 08 08", "1"),
        (";$FILEVERSION=1.3\n", "  1)  1842.0 2  Error  0008  -  4  00 19 08 08", "2"),
        (";$FILEVERSION=2.0\n;$COLUMNS=N,O,T,I,d,l,D\n",
         "1 1842.000 ER - Rx 5 04 00 02 00 00", "1"),
        (";$FILEVERSION=2.1\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n",
         "1 1842.000 ER 3 - Rx - 5 04 00 02 00 00", "3"),
    ],
)  # fmt: skip
def test_error_frames_of_trc_are_read(tmp_path: Path, head: str, line: str, channel: str) -> None:
    path = tmp_path / "log.trc"
    path.write_text(f"{head};##########\n;$STARTTIME=45244.0\n{line}\n")
    received = True if head else None  # version 1.0 does not state it
    assert _logged(path) == [
        LogFrame(1842 * MS, CanFrame(ERROR | 0x80, bytes(8)), received, channel)
    ]


@pytest.mark.parametrize("kind", [2, 104])
def test_error_objects_of_blf_that_python_can_skips_are_read(tmp_path: Path, kind: int) -> None:
    """CAN_ERROR begins with a channel of two bytes, CAN_FD_ERROR_64 with a channel of one byte."""
    path = tmp_path / "log.blf"
    if kind == 2:
        data = bytes((2, 0, 1, 0, 0, 0, 0, 0))
    else:
        data = bytes((2, *range(1, 46)))
    with can.BLFWriter(path, max_container_size=150) as writer:
        for number in range(6):
            now = 1_700_000_000 + number / 100
            writer.on_message_received(
                can.Message(now, 0x688, False, data=DATA.data, channel=1, is_rx=True)
            )
            if kind == 2:
                writer._add_object(kind, data, now + 0.001)
            else:  # a header of version 2, which is longer
                head = struct.pack("<4sHHLL", b"LOBJ", 40, 2, 40 + len(data), kind)
                times = struct.pack("<LBxHQ8x", 2, 0, 0, (number * 10 + 1) * MS)
                writer._buffer.append(head + times + data + bytes(len(data) % 4))
                writer._buffer_size += len(writer._buffer[-1])
                writer._flush()
    found = _logged(path)
    kinds = [(item.kind, item.channel) for item in found]
    assert kinds == [("CAN frame", "2"), ("error frame", "2")] * 6
    milliseconds = [round(item.time_ns / MS) for item in found]
    assert milliseconds == [0, 1, 10, 11, 20, 21, 30, 31, 40, 41, 50, 51]


def test_remote_frames_of_a_capture_are_remote_frames_in_a_log(tmp_path: Path) -> None:
    bench = Bench(*made()).live(3, 0.5)
    entries = list(bench.entries)
    now = entries[40].time_ns
    entries.insert(41, Entry(now, EntryKind.FRAME, 0, frame_data(ASKS), 0, now))
    path = tmp_path / "a.kcap"
    path.write_bytes(capture_file(bench.setup, entries))
    assert run("convert", path, tmp_path / "a.log").code == 0
    assert " 681#R8 R\n" in (tmp_path / "a.log").read_text()
    for suffix in (".asc", ".blf", ".trc"):
        assert run("convert", path, tmp_path / f"a{suffix}").code == 0
        remote = [item for item in _logged(tmp_path / f"a{suffix}") if item.frame.remote]
        assert [(item.frame, item.received) for item in remote if item.frame.can_id == 0x681] == [
            (ASKS, True)
        ]
