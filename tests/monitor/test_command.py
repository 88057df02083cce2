"""The command: --once and lines from python-can's in-process bus and from files; clear lines for mistakes; nothing is ever sent."""

import argparse
import contextlib
import io
import itertools
import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, Self

import can
import pytest
from capture_bench import START, Bench, made
from monitor_tools import Timed, flight, layout_of, with_errors, write_log

from kontronik_can_gw.capture import block, data_payload, json_payload
from kontronik_can_gw.cli import main
from kontronik_can_gw.cli.monitor import Recording, can_config
from kontronik_can_gw.config import shipped
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.offline.inputs import open_input
from kontronik_can_gw.offline.layouts import layout_of_dbc
from kontronik_can_gw.protocol.states import OperatingError
from kontronik_can_gw.simulator import SECOND_NS, EscOptions, SimulatedEsc

_numbers = itertools.count()
DBC = shipped("dbc/kontronik_esc.dbc")
ONE = layout_of(["esc1"])


class Done(argparse.Namespace):
    code: int
    out: str
    err: str


def run(*words: object, out: io.StringIO | None = None) -> Done:
    """The command within this process; an exception fails the test."""
    out, err = out or io.StringIO(), io.StringIO()
    code: object
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main(["monitor", *map(str, words)])
        except SystemExit as end:
            code = end.code
    return Done(code=code, out=out.getvalue(), err=err.getvalue())


@pytest.fixture
def channel() -> str:
    return f"monitor-{os.getpid()}-{next(_numbers)}"


class Player:
    """A participant that sends frames at their pace on the virtual bus, and keeps what others send."""

    def __init__(self, channel: str, frames: Timed) -> None:
        self.foreign: list[can.Message] = []
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._frames = frames
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)

    def _play(self) -> None:
        begin = time.monotonic_ns()
        for now, frame in self._frames:
            while time.monotonic_ns() - begin < now and not self._stop.wait(0.002):
                pass
            if self._stop.is_set():
                return
            self._bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5)
        while (message := self._bus.recv(0)) is not None:
            self.foreign.append(message)
        self._bus.shutdown()


def document(done: Done) -> dict[str, Any]:
    assert done.code == 0, done.err
    assert done.out.count("\n") == 1, "one line"
    found = json.loads(done.out)
    assert isinstance(found, dict)
    return found


# --- from the bus


def test_once_prints_a_line_when_all_cyclic_messages_have_come(channel: str) -> None:
    with Player(channel, flight(ONE, 20, [with_errors(OperatingError.UNDERVOLTAGE)])) as player:
        begin = time.monotonic()
        done = run("--dbc", DBC, "--interface", "virtual", "--channel", channel, "--once", "--timeout", 15)
        took = time.monotonic() - begin
    found = document(done)
    assert took < 12, "it waited for the timeout"
    assert found["interface"] == channel
    assert found["dbc"] == "kontronik_esc.dbc"
    assert found["gateway"]["state"] == "Running"
    assert time.time() - time.mktime(time.strptime(found["time"][:19], "%Y-%m-%dT%H:%M:%S")) < 60
    (esc,) = found["escs"]
    assert esc["name"] == "esc1"
    assert esc["link"] == "Ok"
    assert esc["errors"] == ["undervoltage"]
    assert 20 < esc["values"]["battery_voltage"] < 26
    assert esc["values"]["frame_rate"] is None or 90 <= esc["values"]["frame_rate"] <= 110
    assert player.foreign == [], "the monitor sent something"


def test_once_takes_what_there_is_at_the_timeout(channel: str) -> None:
    speed = next(plan.can_id for plan in ONE.layout.messages if plan.name == "EscSpeed")
    frames = [(now, frame) for now, frame in flight(ONE, 10) if frame.can_id == speed]
    with Player(channel, frames):
        found = document(run("--dbc", DBC, "--interface", "virtual", "--channel", channel, "--once", "--timeout", 0.5))
    values = found["escs"][0]["values"]
    assert values["battery_voltage"] is not None
    assert values["battery_current"] is None
    assert found["escs"][0]["state"] is None
    assert found["gateway"]["state"] is None


def test_once_without_any_frame_is_one_line_and_exit_code_1(channel: str) -> None:
    done = run("--interface", "virtual", "--channel", channel, "--once", "--timeout", 0.2)
    assert (done.code, done.out) == (1, "")
    assert done.err.count("\n") == 1
    assert f"no frame of kontronik_esc.dbc on {channel} for 0.2 s. Is the gateway running" in done.err


def test_the_configuration_says_where_unless_it_is_given(tmp_path: Path, channel: str) -> None:
    toml = tmp_path / "g.toml"
    toml.write_text(
        f'[can]\ninterface = "virtual"\nchannel = "{channel}"\n[[esc]]\nport = "/dev/ttyX"\nname = "main"\n'
    )
    with Player(channel, flight(ONE, 5)):
        assert document(run("-c", toml, "--once"))["escs"][0]["name"] == "main"
    done = run("-c", toml, "--channel", channel + "other", "--once", "--timeout", 0.1)
    assert f"on {channel}other" in done.err


def test_lines_are_written_where_there_is_no_terminal(channel: str) -> None:
    out = io.StringIO()

    def interrupt() -> None:
        end = time.monotonic() + 30
        while out.getvalue().count("\n") < 4 and time.monotonic() < end:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    waiting = threading.Thread(target=interrupt)
    with Player(channel, flight(ONE, 20)) as player:
        waiting.start()
        done = run("--interface", "virtual", "--channel", channel, "--interval", 0.2, out=out)
        waiting.join()
    assert done.code == 0
    lines = done.out.splitlines()
    assert 4 <= len(lines) <= 6
    assert all("  esc1  link " in line for line in lines)
    assert "\x1b" not in done.out
    assert "seen on" in done.err
    assert player.foreign == []


def test_nothing_in_the_monitor_can_send() -> None:
    """The way to the bus has no method to send with, and its sources call none."""
    import ast
    import inspect

    from kontronik_can_gw.cli import monitor, monitor_screen
    from kontronik_can_gw.offline import monitor as model
    from kontronik_can_gw.runtime import bus_listener

    assert not [name for name in dir(bus_listener.BusListener) if "send" in name]
    for module in (monitor, monitor_screen, model, bus_listener):
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.Attribute):
                assert "send" not in node.attr, f"{module.__name__}:{node.lineno}"


def test_the_port_of_an_esc_is_never_opened_as_a_can_adapter(tmp_path: Path) -> None:
    """Some adapters are written to at opening; to an ESC nothing may be written."""
    port = tmp_path / "ttyESC"
    port.touch()
    toml = tmp_path / "g.toml"
    toml.write_text(f'[can]\ninterface = "virtual"\n[[esc]]\nport = "{port}"\n')
    done = run("-c", toml, "--interface", "slcan", "--channel", f"{port}@115200")
    assert done.code == 2
    assert "nothing may be sent to an ESC" in done.err


def test_without_a_configuration_fd_is_asked_for_only_where_the_dbc_has_it() -> None:
    config = can_config(layout_of_dbc(DBC), None, None)
    assert (config.interface, config.channel, config.fd) == ("socketcan", "can0", False)


# --- from a file


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("logs") / "flight.log", flight(ONE, 12))


def test_once_of_a_log_tells_what_holds_at_its_end(log: Path) -> None:
    found = document(run(log, "--once"))
    frames = flight(ONE, 12)
    assert found["file"] == "flight.log"
    assert found["frames"] == len(frames)
    last: dict[str, Any] = {}
    for _, frame in frames:
        last.update(ONE.database.decode_message(frame.can_id, frame.data))  # type: ignore[arg-type]
    values = found["escs"][0]["values"]
    assert values["battery_voltage"] == pytest.approx(last["BatteryVoltage"])
    assert values["consumed_charge"] == last["ConsumedCharge"]
    assert found["time"].startswith("2026-09-21T")


def test_a_log_is_played_in_lines(log: Path) -> None:
    begin = time.monotonic()
    done = run(log, "--speed", 10, "--interval", 0.25)
    took = time.monotonic() - begin
    assert done.code == 0
    assert 1.0 <= took <= 20
    lines = done.out.splitlines()
    assert 3 <= len(lines) <= 20
    assert lines[-1].lstrip().startswith("12.0 s")
    assert (
        done.err
        == f"kontronik-can-gw: {len(flight(ONE, 12))} frames of kontronik_esc.dbc seen on flight.log, none sent\n"
    )


def test_a_log_without_our_frames_is_told_so(tmp_path: Path) -> None:
    file = write_log(tmp_path / "x.log", [(n * SECOND_NS, CanFrame(0x123, b"\0")) for n in range(3)])
    done = run(file, "--once")
    assert (done.code, done.out) == (1, "")
    assert "x.log: holds no frame of kontronik_esc.dbc. Give its DBC (--dbc)." in done.err
    done = run(file, "--speed", 1000)
    assert done.code == 0
    assert "x.log holds no frame of kontronik_esc.dbc" in done.err


def test_a_capture_is_watched_through_its_own_dbc(tmp_path: Path) -> None:
    bench = Bench(*made(2)).live(3, 8, wild=False)
    header = bench.setup.header() | {"run": "r", "part": 0, "monotonic_ns": START, "wall_ns": 1_700_000_000 * SECOND_NS}
    parts = [block(b"H", 0, json_payload(header)), block(b"D", 1, data_payload(bench.entries)), block(b"E", 2, b"")]
    file = tmp_path / "x.kcap"
    file.write_bytes(b"".join(parts))
    found = document(run(file, "--once"))
    assert [esc["name"] for esc in found["escs"]] == ["e0", "e1"]
    assert found["time"].startswith("2023-11-14T")
    assert found["frames"] == len(bench.sent)
    assert all(20 < esc["values"]["battery_voltage"] < 26 for esc in found["escs"])
    done = run(file, "--speed", 20, "--interval", 0.1)
    assert done.code == 0
    assert "  e1  link " in done.out
    done = run(file, "--dbc", DBC)
    assert (done.code, done.out) == (2, "")
    assert "x.kcap: is a capture, which holds its own DBC. Leave -c and --dbc out." in done.err


def test_plain_bytes_of_a_uart_are_watched(tmp_path: Path) -> None:
    esc = SimulatedEsc(EscOptions(), seed=1)
    file = tmp_path / "bytes.bin"
    file.write_bytes(b"".join(sent.wire for sent in esc.frames_until(9 * SECOND_NS)))
    found = document(run(file, "--once"))
    assert found["time"] is None
    assert found["escs"][0]["link"] == "Ok"
    assert found["escs"][0]["values"]["motor_speed"] > 0


class Clock:
    """Time that only passes when it is slept or told to."""

    def __init__(self) -> None:
        self.now = 50.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    from kontronik_can_gw.cli import monitor

    made = Clock()
    monkeypatch.setattr(monitor, "time", made)
    return made


@pytest.mark.parametrize("speed", [0.5, 1, 4])
def test_a_recording_is_played_at_its_pace(log: Path, clock: Clock, speed: float) -> None:
    taken: list[tuple[float, int]] = []
    with open_input(log) as opened:
        recording = Recording(opened, speed)
        first = recording.now()
        while not recording.ended:
            recording.pump(lambda _frame, now: taken.append((clock.now, now)), clock.now + 0.1)
    assert len(taken) == len(flight(ONE, 12))
    for when, now in taken:
        due = 50 + (now - first) / SECOND_NS / speed
        assert -1e-6 <= when - due <= 0.11
    assert "END OF FILE" in recording.where().progress


def test_a_recording_that_pauses_stands_still(log: Path, clock: Clock) -> None:
    taken: list[CanFrame] = []
    with open_input(log) as opened:
        recording = Recording(opened, 1)
        for _ in range(10):
            recording.pump(lambda frame, _now: taken.append(frame), clock.now + 0.1)
        count, now = len(taken), recording.now()
        recording.paused = True
        for _ in range(50):
            recording.pump(lambda frame, _now: taken.append(frame), clock.now + 0.1)
        assert (len(taken), recording.now()) == (count, now)
        assert "PAUSED" in recording.where().progress
        recording.paused = False
        clock.now += 1000  # the machine slept
        recording.pump(lambda frame, _now: taken.append(frame), clock.now + 0.1)
        assert len(taken) > count
        assert recording.now() - now < SECOND_NS, "it goes on where it was"


# --- mistakes


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--speed", "2"], 2, "--speed: is for a FILE"),
        (["--timeout", "2"], 2, "--timeout: is for --once"),
        (["x.log", "--channel", "can1"], 2, "--interface and --channel mean nothing"),
        (["x.log"], 1, "x.log: there is no such file"),
        (["--interface", "sockcan"], 2, "Did you mean socketcan?"),
        (["--interface", "socketcan", "--channel", "nocan7"], 1, "CAN interface nocan7: "),
        (["--dbc", "no.dbc"], 2, "no.dbc"),
        (["-c", "no.toml"], 2, "no.toml"),
        (["--once", "--timeout", "0"], 2, "not a number of seconds"),
        (["x.log", "--speed", "fast"], 2, "not a factor"),
        (["-c", "a", "--dbc", "b"], 2, "not allowed with"),
    ],
)
def test_a_mistake_is_one_line_with_the_remedy(
    words: list[str], code: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run(*words)
    assert (done.code, done.out) == (code, "")
    assert said in done.err.splitlines()[-1]
    assert "Traceback" not in done.err


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """What the command does with signals is undone."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    assert {number: signal.getsignal(number) for number in before} == before
    with contextlib.suppress(ValueError):
        signal.set_wakeup_fd(-1)
