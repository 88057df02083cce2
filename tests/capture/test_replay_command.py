"""The command ``replay`` as a person uses it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from capture_bench import START, Bench, capture, made
from command_line import refused, written

from kontronik_can_gw.capture.format import EntryKind
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("replay")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]


def test_can_log_is_refused_because_it_has_no_bytes_of_escs(tmp_path: Path) -> None:
    log = written(tmp_path / "a.log", "(1.000000) can0 688#0000000000000000\n")
    assert "which has no bytes of ESCs" in refused(2, "replay", log, "--on", "pty")


@contextmanager
def playing(*words: object) -> Iterator[subprocess.Popen[str]]:
    """Run a replay in a separate process."""
    command = [*PROGRAM, "replay", *map(str, words), "--on", "pty"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as player:
        yield player


def test_replay_stops_immediately_at_sigint(tmp_path: Path) -> None:
    bench = Bench(*made(1))
    bench.gateway.start(START)
    bench.take(START)
    bench.gateway.advance(START + 3600 * SECOND)
    bench.take(START + 3600 * SECOND)
    path = capture(tmp_path / "a.kcap", bench.setup, bench.entries)
    with playing(path) as player:
        assert player.stdout
        assert player.stderr
        assert player.stdout.readline().startswith("e0 "), "it runs"
        player.send_signal(signal.SIGINT)
        assert player.wait(600) == 0, "in an hour it would end by itself"
        assert "stopped" in player.stderr.read()


def test_terminal_receives_the_bytes_of_its_esc(tmp_path: Path) -> None:
    bench = Bench(*made(2)).live(5, 2)
    path = capture(tmp_path / "a.kcap", bench.setup, bench.entries)
    found = bytearray()
    with playing(path, "--link", tmp_path / "esc{n}", "--speed", 4) as player:
        assert player.stdout
        assert [player.stdout.readline().split()[0] for _ in range(2)] == ["e0", "e1"]
        player.send_signal(signal.SIGSTOP)  # until the reader is ready
        fd = os.open(tmp_path / "esc2", os.O_RDONLY | os.O_NOCTTY)
        player.send_signal(signal.SIGCONT)
        with suppress(OSError):  # the other end is closed
            while data := os.read(fd, 4096):
                found += data
        os.close(fd)
        assert player.wait(600) == 0
    with_bytes = [entry for entry in bench.entries if entry.kind == EntryKind.BYTES]
    assert found == b"".join(entry.data for entry in with_bytes if entry.esc == 1)
