"""``replay`` as a person uses it."""

import signal
import subprocess
import sys
import threading
from pathlib import Path

import can
import pytest
from capture_bench import START, Bench, capture, made
from command_line import refused, run, written
from test_inputs import plain_run

from kontronik_can_gw.desk.recordings.pacing import Pace
from kontronik_can_gw.esc.telemetry import MS, SECOND

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]


@pytest.fixture(scope="module")
def bench() -> Bench:
    return plain_run(3, escs=2)[0]


@pytest.fixture
def recording(bench: Bench, tmp_path: Path) -> Path:
    return capture(tmp_path / "flight.kcap", bench.setup, bench.entries)


def replay(*words: object) -> tuple[object, str, str]:
    done = run("replay", *words)
    return done.code, done.out, done.err


def read(log: Path) -> list[tuple[int, bytes]]:
    with can.LogReader(log) as reader:
        return [(m.arbitration_id, bytes(m.data)) for m in reader]


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc", ".mf4"])
def test_a_log_of_each_kind_holds_what_was_sent(
    suffix: str, bench: Bench, recording: Path, tmp_path: Path
) -> None:
    target = tmp_path / f"out{suffix}"
    done = run("convert", "-q", recording, target, *["--to", "mf4-log"][: 2 * (suffix == ".mf4")])
    assert (done.code, done.out, done.err) == (0, "", "")
    assert read(target) == [(f.frame.can_id, f.frame.data) for f in bench.sent]
    assert not list(tmp_path.glob("*.part"))


def test_a_log_of_a_log_is_the_same_log(recording: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "1.log", tmp_path / "2.log"
    assert run("convert", recording, first).code == 0
    assert run("convert", first, second).code == 0
    assert first.read_bytes() == second.read_bytes()


def test_a_log_is_not_written_over_itself_and_has_no_bytes_of_escs(tmp_path: Path) -> None:
    log = written(tmp_path / "a.log", "(1.000000) can0 688#0000000000000000\n")
    assert "is IN. Give another OUT" in refused(2, "convert", log, log, "--force")
    assert "log of CAN frames, which has no bytes of ESCs" in refused(
        2, "replay", log, "--on", "pty"
    )


def test_it_stops_at_once_when_asked(tmp_path: Path) -> None:
    bench = Bench(*made(1))
    bench.gateway.start(START)
    bench.take(START)
    bench.gateway.advance(START + 3600 * SECOND)
    bench.take(START + 3600 * SECOND)
    path = capture(tmp_path / "a.kcap", bench.setup, bench.entries)
    words = ["replay", str(path), "--on", "pty"]
    with subprocess.Popen(
        [*PROGRAM, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as player:
        assert player.stdout
        assert player.stderr
        assert player.stdout.readline().startswith("e0 "), "it runs"
        player.send_signal(signal.SIGINT)
        assert player.wait(600) == 0, "in an hour it would end by itself"
        assert "stopped" in player.stderr.read()


# --- recorded time against real time


def test_the_pace_is_that_of_the_recording() -> None:
    now = 50 * SECOND
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        nonlocal now
        slept.append(seconds)
        now += int(seconds * SECOND) + 2 * MS  # always a little late

    pace = Pace(2.0, lambda: now, sleep)
    for when in range(1000, 1000 + 10 * SECOND, 500 * MS):
        assert pace.wait(when)
    assert abs(now - 50 * SECOND - 4.75 * SECOND) <= 3 * MS  # no lateness adds up
    assert pace.latest_ns <= 3 * MS
    assert max(slept) <= 1.0


def test_as_fast_as_possible_never_sleeps() -> None:
    pace = Pace(None, lambda: 0, lambda _s: pytest.fail("slept"))
    assert all(pace.wait(when) for when in (0, SECOND, 100 * SECOND))


def test_a_pause_ends_when_it_is_stopped() -> None:
    pace = Pace(1.0)
    assert pace.wait(0)
    threading.Timer(0.05, pace.stop).start()
    assert not pace.wait(3600 * SECOND)
