"""Recordings through pipes: rows appear as their data arrive, and a signal keeps their rows."""

import array
import fcntl
import os
import pty
import resource
import select
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import IO, Any

import pytest
from command_line import refused, run
from log_files import opened, some_frames, write_log
from pyarrow import parquet  # type: ignore[import-untyped]
from recordings import candump_log, capture_bytes, convert, dump_bytes

from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.recordings.stream import Stream, StreamReader

pytestmark = pytest.mark.promise("streams")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
_HUNG_S = 60
FORMATS = {"candump": ".log", "asc": ".asc", "blf": ".blf", "trc": ".trc", "mf4-log": ".mf4"}


@contextmanager
def started(*words: object, **options: object) -> Iterator["subprocess.Popen[bytes]"]:
    """Start a command whose standard input and output are pipes."""
    command = [*PROGRAM, *map(str, words)]
    every = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **every | options) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def send(process: "subprocess.Popen[bytes]", data: bytes) -> None:
    """Write to a command without ending its input."""
    assert process.stdin is not None
    process.stdin.write(data)
    process.stdin.flush()


def lines_from(process: "subprocess.Popen[bytes]", count: int) -> list[bytes]:
    """Return the next lines of a command's output. Fails if the command hangs."""
    assert process.stdout is not None
    found = b""
    while found.count(b"\n") < count:
        assert select.select([process.stdout], [], [], _HUNG_S)[0], found
        more = os.read(process.stdout.fileno(), 1 << 16)
        assert more, found
        found += more
    return found.splitlines()


def ended(process: "subprocess.Popen[bytes]") -> tuple[int, str]:
    """Wait for the end of a command. Returns its exit code and its messages."""
    _, messages = process.communicate(timeout=_HUNG_S)
    return process.returncode, messages.decode()


def candump_lines(tmp_path: Path) -> list[bytes]:
    return candump_log(tmp_path / "whole.log").read_bytes().splitlines(keepends=True)


def rows_of(source: Path) -> list[bytes]:
    """Return the header and the rows of a recording as CSV."""
    target = source.with_suffix(".expected")
    assert convert("-q", source, target, "--to", "csv") == 0
    return target.read_bytes().splitlines()


def test_rows_of_candump_appear_before_the_stream_ends(tmp_path: Path) -> None:
    lines = candump_lines(tmp_path)
    expected = rows_of(tmp_path / "whole.log")
    with started("convert", "-", "-", "--to", "csv") as process:
        send(process, lines[0])
        # with its header the command shows that one line was enough to find the format
        done = 1
        while not _ends_row(lines, done):
            done += 1
        send(process, b"".join(lines[1 : done + 1]))
        assert lines_from(process, 2) == expected[:2]
        for begin in range(done + 1, done + 100):
            send(process, lines[begin])
        shown = lines_from(process, 5)
        assert shown == expected[2 : 2 + len(shown)]
        assert process.poll() is None


def _ends_row(lines: list[bytes], number: int) -> bool:
    """Return True if the id of this line was in a line before, so that a new row begins."""
    frames = [line.split()[2] for line in lines[: number + 1]]
    *before, last = [frame.partition(b"#")[0] for frame in frames]
    return last in before


def test_rows_of_uart_bytes_appear_one_frame_later(tmp_path: Path) -> None:
    source = tmp_path / "esc.bytes"
    source.write_bytes(dump_bytes())
    frames = [b"KOD" + frame for frame in dump_bytes().split(b"KOD")[1:]]
    expected = rows_of(source)
    with started("decode", "-", "--csv") as process:
        send(process, frames[0] + frames[1])
        assert lines_from(process, 2) == expected[:2]
        for number in range(2, 12):
            send(process, frames[number])
            if frames[number - 1].startswith(b"KODL") and frames[number].startswith(b"KODL"):
                assert lines_from(process, 1) == [expected[number]]
        assert process.poll() is None


def make_source(tmp_path: Path, kind: str) -> Path:
    if kind == "capture":
        source = tmp_path / "flight.kcap"
        source.write_bytes(capture_bytes())
        return source
    if kind == "bytes":
        source = tmp_path / "esc.bytes"
        source.write_bytes(dump_bytes(faults=True))
        return source
    log = candump_log(tmp_path / "flight.log")
    if kind == "candump":
        return log
    source = tmp_path / f"flight{FORMATS[kind]}"
    assert convert("-q", log, source, "--to", kind) == 0
    return source


@pytest.mark.parametrize("kind", ["capture", "bytes", *FORMATS])
def test_pipe_gives_the_table_of_the_file(tmp_path: Path, kind: str) -> None:
    source = make_source(tmp_path, kind)
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    expected = rows_of(source)
    assert len(expected) > 100
    writer = Thread(target=lambda: fifo.write_bytes(source.read_bytes()))
    writer.start()
    assert convert("-q", fifo, tmp_path / "fifo.csv") == 0
    writer.join()
    assert (tmp_path / "fifo.csv").read_bytes().splitlines() == expected
    with started("convert", "-q", "-", tmp_path / "stdin.csv") as process:
        send(process, source.read_bytes())
        assert ended(process)[0] == 0
    assert (tmp_path / "stdin.csv").read_bytes().splitlines() == expected


@pytest.mark.parametrize(
    ("form", "number"),
    [("csv", signal.SIGINT), ("csv", signal.SIGTERM), ("parquet", signal.SIGINT)],
)
def test_signal_ends_a_stream_and_keeps_its_rows(
    tmp_path: Path,
    form: str,
    number: signal.Signals,
) -> None:
    lines = candump_lines(tmp_path)[:300]
    part = tmp_path / "part.log"
    part.write_bytes(b"".join(lines))
    expected = rows_of(part)
    target = tmp_path / f"out.{form}"
    with started("convert", "-", target) as process:
        send(process, b"".join(lines) + b"(1700000000.5) can0 681#00")  # a line that is cut
        while process.poll() is None and not _is_waiting_with_rows(target):
            select.select([], [], [], 0.01)
        process.send_signal(number)
        code, messages = ended(process)
    assert code == 130
    assert f"{target}: {len(expected) - 1} rows of" in messages
    assert "damaged" not in messages
    assert not target.with_name(f"{target.name}.part").exists()
    if form == "csv":
        assert target.read_bytes().splitlines() == expected
    else:
        assert parquet.read_table(target).num_rows == len(expected) - 1


def _is_waiting_with_rows(target: Path) -> bool:
    """Return True if the command has written to its file, so that it handles signals."""
    part = target.with_name(f"{target.name}.part")
    return part.exists() and part.stat().st_size > 0


def test_signal_before_any_row_leaves_no_file(tmp_path: Path) -> None:
    line = candump_lines(tmp_path)[0]
    with started("convert", "-", "-", "--to", "candump") as process:
        send(process, line + line)
        lines_from(process, 1)
        process.send_signal(signal.SIGINT)
        assert ended(process)[0] == 130
    with started("convert", "-", tmp_path / "out.csv") as process:
        send(process, b"(1700000000.000000) can0 123#00\n" * 2000)
        assert process.stdin is not None
        # the command has read all of it when the pipe is empty
        while process.poll() is None and _bytes_in(process.stdin):
            select.select([], [], [], 0.01)
        process.send_signal(signal.SIGINT)
        code, messages = ended(process)
    assert code == 130
    assert messages.endswith("stopped: nothing was written\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["whole.log"]


def test_interrupt_inside_exec_is_an_exit_code(tmp_path: Path) -> None:
    """Dataclasses call exec() while a module loads. After that, python -m kills itself."""
    tmp_path.joinpath("interrupted.py").write_text(
        "import runpy\n"
        "from kontronik_can_gw.cli import convert\n"
        "def interrupt(*_):\n"
        "    exec('raise KeyboardInterrupt')\n"
        "convert._convert = interrupt\n"
        "runpy.run_module('kontronik_can_gw', run_name='__main__', alter_sys=True)\n"
    )
    command = [sys.executable, "-m", "interrupted", "convert", "in.kcap", "out.csv"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 130
    assert done.stderr == b"kontronik-can-gw convert: stopped: nothing was written\n"


def _bytes_in(pipe: IO[bytes]) -> int:
    count = array.array("i", [0])
    fcntl.ioctl(pipe.fileno(), termios.FIONREAD, count)
    return count[0]


def test_full_disk_keeps_the_rows_of_a_stream(tmp_path: Path) -> None:
    lines = candump_lines(tmp_path)
    target = tmp_path / "out.csv"
    expected = rows_of(tmp_path / "whole.log")

    def small() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    with started("convert", "-", target, preexec_fn=small) as process:
        send(process, b"".join(lines))
        code, messages = ended(process)
    part = tmp_path / "out.csv.part"
    assert code == 1
    told = f"{target}: cannot be written: File too large. The data so far are in {part}.\n"
    assert messages.endswith(told)
    kept = part.read_bytes().splitlines()[:-1]  # the last one may be cut
    assert len(kept) > 10
    assert kept == expected[: len(kept)]


@pytest.mark.parametrize("command", ["convert", "decode", "report"])
def test_devices_are_refused_and_not_opened(
    tmp_path: Path,
    command: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A device may be the port of an ESC."""
    more: dict[str, list[object]] = {
        "convert": [tmp_path / "o.csv"],
        "decode": [],
        "report": ["-o", tmp_path / "o.html"],
    }
    master, slave = pty.openpty()
    device = os.ttyname(slave)
    opened_paths: list[str] = []
    real_open = os.open

    def noted_open(path: Any, *rest: Any, **options: Any) -> int:
        opened_paths.append(str(path))
        return real_open(path, *rest, **options)

    monkeypatch.setattr(os, "open", noted_open)
    stdin = os.dup(0)
    try:
        for path in (device, "/dev/zero"):
            assert refused(2, command, path, *more[command]).startswith(f"{path}: is a device")
        os.dup2(slave, 0)
        said = refused(2, command, "-", *more[command])
        assert said.startswith("standard input: is a terminal or another device.")
    finally:
        os.dup2(stdin, 0)
        for fd in (stdin, master, slave):
            os.close(fd)
    assert device not in opened_paths
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("content", [b"", b"\n \n", b"neither of them\n"])
def test_pipe_without_a_recording_is_refused(tmp_path: Path, content: bytes) -> None:
    with started("convert", "-", tmp_path / "out.csv") as process:
        send(process, content)
        code, messages = ended(process)
    assert code == 2
    reason = "is neither a capture nor a CAN log" if content.strip() else "is empty"
    assert f"standard input: {reason}" in messages


def test_spooled_capture_is_called_standard_input(tmp_path: Path) -> None:
    with started("convert", "-", tmp_path / "out.csv") as process:
        send(process, b"KCB1" * 30)
        code, messages = ended(process)
    assert code == 2
    assert messages.startswith("kontronik-can-gw convert: standard input: has no readable header")


@pytest.mark.parametrize("kind", ["bytes", "candump", "blf"])
def test_page_of_a_pipe_has_the_data_of_the_file(tmp_path: Path, kind: str) -> None:
    source = make_source(tmp_path, kind)
    with started("report", "-", "-o", tmp_path / "pipe.html") as process:
        send(process, source.read_bytes())
        assert ended(process)[0] == 0
    assert run("report", source, "-o", tmp_path / "file.html").code == 0
    of_pipe = (tmp_path / "pipe.html").read_text()
    of_file = (tmp_path / "file.html").read_text()
    assert "<title>standard input</title>" in of_pipe
    _, _, data_of_pipe = of_pipe.partition(' id="data">')
    _, _, data_of_file = of_file.partition(' id="data">')
    assert data_of_pipe == data_of_file


def test_monitor_shows_a_stream_before_it_ends(tmp_path: Path) -> None:
    """After the last frame the values expire, although the stream has not ended."""
    with started("monitor", "-") as process:
        send(process, b"".join(candump_lines(tmp_path)))
        assert process.stdout is not None
        shown = b""
        has_values = False
        while not (has_values and shown.endswith(b"errors: -\n")):
            assert select.select([process.stdout], [], [], _HUNG_S)[0], shown
            shown += os.read(process.stdout.fileno(), 1 << 16)
            has_values = has_values or b" ok " in shown
        process.send_signal(signal.SIGTERM)
        assert ended(process)[0] == 0


def test_bytes_of_a_pipe_are_replayed() -> None:
    with started("replay", "-", "--on", "pty", "--speed", "max", "--delay", "0") as process:
        send(process, dump_bytes())
        code, messages = ended(process)
    assert code == 0, messages
    assert f"{len(dump_bytes())} bytes to 1 pseudo terminals" in messages


# --- the stream itself


@contextmanager
def piped() -> Iterator[tuple[Stream, Callable[[bytes], int]]]:
    """Yield a stream, and a function that writes to its other end."""
    reads, writes = os.pipe()
    stream = Stream(reads, "pipe")
    try:
        yield stream, lambda data: os.write(writes, data)
    finally:
        stream.close()
        os.close(writes)


def test_read_returns_the_waiting_bytes_and_reports_each_wait() -> None:
    waits: list[str] = []
    with piped() as (stream, write):
        reader = StreamReader(stream)

        def before_wait() -> None:
            waits.append("wait")
            write(b"later\n")

        stream.before_wait = before_wait
        write(b"first\nsec")
        assert reader.readline() == b"first\n"
        assert waits == []
        write(b"ond\n")
        assert reader.readline() == b"second\n"
        assert waits == []
        assert reader.readline() == b"later\n"
        assert waits == ["wait"]


def test_ended_stream_gives_the_rest_of_the_pipe_without_a_cut_line() -> None:
    with piped() as (stream, write):
        reader = StreamReader(stream)
        write(b"first\nsecond\nthi")
        stream.end()
        assert [reader.readline() for _ in range(3)] == [b"first\n", b"second\n", b""]
        assert reader.read() == b""


def test_waiting_read_is_ended() -> None:
    with piped() as (stream, _):
        stream.before_wait = stream.end
        assert StreamReader(stream).read1(10) == b""


def test_inspected_head_is_read_again() -> None:
    with piped() as (stream, write):
        write(b"head")
        assert stream.look()
        write(b" and more")
        assert stream.look()
        assert stream.head == b"head and more"
        reader = StreamReader(stream)
        assert reader.read1(6) == b"head a"
        assert reader.read1(100) == b"nd more"


def test_frames_in_order_are_given_without_the_next_one(tmp_path: Path) -> None:
    """Only a frame after a step of the clock must wait for the next frame."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    items = some_frames(5)
    write_log(tmp_path / "some.log", "candump", items)
    holder = os.open(fifo, os.O_RDWR)
    os.write(holder, (tmp_path / "some.log").read_bytes())
    with opened(fifo) as log:
        frames = log.frames()
        assert [next(frames).frame for _ in items] == [frame for _, frame, _ in items]
    os.close(holder)


def test_one_frame_of_an_esc_is_enough_to_find_the_format(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    holder = os.open(fifo, os.O_RDWR)
    _, frame, *_ = dump_bytes().split(b"KOD")
    os.write(holder, b"\xff\x00noise" + b"KOD" + frame)
    with open_input(fifo) as recording:
        assert recording.provenance["times"].startswith("assumed")
        assert recording.stream is not None
    os.close(holder)
