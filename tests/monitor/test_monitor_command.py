"""The command: --once and lines from a bus and from files; clear lines for mistakes; nothing is ever sent."""

import ast
import inspect
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from capture_bench import Bench, capture_file, made
from command_line import Done, run, written
from simulated_bus import Clock, flight, layout_of, write_log

from kontronik_can_gw.cli import monitor
from kontronik_can_gw.config.keys import shipped
from kontronik_can_gw.desk import member, sources
from kontronik_can_gw.desk.monitor import model, screen, watch
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.sources import Recording
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS, SimulatedEsc
from kontronik_can_gw.runtime import bus_listener

DBC = shipped("dbc/kontronik_esc.dbc")
ONE = layout_of(["esc1"])


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in (sources, watch):
        monkeypatch.setattr(module, "time", clock)
    return clock


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """What the command does with signals is undone."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    assert {number: signal.getsignal(number) for number in before} == before


def document(done: Done) -> dict[str, Any]:
    assert (done.code, done.out.count("\n")) == (0, 1), done.err
    found: dict[str, Any] = json.loads(done.out)
    return found


def test_nothing_in_the_monitor_can_send() -> None:
    """The way to the bus has no method to send with, and its sources call none."""
    assert not [name for name in dir(bus_listener.BusListener) if "send" in name]
    for module in (monitor, member, model, screen, sources, watch, bus_listener):
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.Attribute):
                assert "send" not in node.attr, f"{module.__name__}:{node.lineno}"


@pytest.mark.parametrize("command", [["monitor"], ["mqtt", "--broker", "127.0.0.1:1"]])
def test_the_port_of_an_esc_is_never_opened_as_a_can_adapter(
    tmp_path: Path, command: list[str]
) -> None:
    """Some adapters are written to at opening; to an ESC nothing may be written."""
    port = written(tmp_path / "ttyESC", "")
    toml = written(tmp_path / "g.toml", f'[can]\ninterface = "virtual"\n[[esc]]\nport = "{port}"\n')
    done = run(*command, "-c", toml, "--interface", "slcan", "--channel", f"{port}@115200")
    assert done.code == 2
    assert "nothing may be sent to an ESC" in done.err


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("logs") / "flight.log", flight(ONE, 12))


def test_once_of_a_log_shows_what_holds_at_its_end(log: Path) -> None:
    found = document(run("monitor", log, "--once"))
    frames = flight(ONE, 12)
    assert (found["file"], found["frames"]) == ("flight.log", len(frames))
    last: dict[str, Any] = {}
    for _, frame in frames:
        last.update(ONE.database.decode_message(frame.can_id, frame.data))  # type: ignore[arg-type]
    values = found["escs"][0]["values"]
    assert values["battery_voltage"] == pytest.approx(last["BatteryVoltage"])
    assert values["consumed_charge"] == last["ConsumedCharge"]
    assert found["time"].startswith("2026-09-21T")


def test_a_capture_is_watched_through_its_own_dbc(tmp_path: Path, clock: Clock) -> None:
    bench = Bench(*made(2)).live(3, 8, wild=False)
    file = written(tmp_path / "x.kcap", capture_file(bench.setup, bench.entries))
    found = document(run("monitor", file, "--once"))
    assert [esc["name"] for esc in found["escs"]] == ["e0", "e1"]
    assert found["time"].startswith("2023-11-14T")
    assert found["frames"] == len(bench.sent)
    assert all(20 < esc["values"]["battery_voltage"] < 26 for esc in found["escs"])
    assert "\ne1 " in run("monitor", file, "--speed", 4).out
    done = run("monitor", file, "--dbc", DBC)
    assert (done.code, done.out) == (2, "")
    assert "x.kcap: is a capture, which holds its own DBC. Leave -c and --dbc out." in done.err


def test_plain_bytes_of_a_uart_are_watched(tmp_path: Path) -> None:
    sent = SimulatedEsc(seed=1).frames_until(9 * SECOND_NS)
    file = written(tmp_path / "bytes.bin", b"".join(one.wire for one in sent))
    found = document(run("monitor", file, "--once"))
    assert found["time"] is None
    assert found["escs"][0]["link"] == "Ok"
    assert found["escs"][0]["values"]["motor_speed"] > 0


@pytest.mark.parametrize("speed", [0.5, 4])
def test_a_recording_is_played_at_its_pace(log: Path, clock: Clock, speed: float) -> None:
    late: list[float] = []
    with open_input(log) as opened:
        recording = Recording(opened, speed)
        first, begun = recording.now(), clock.now

        def take(_: object, now: int) -> None:
            late.append(clock.now - begun - (now - first) / SECOND_NS / speed)

        while not recording.ended:
            recording.pump(take, clock.now + 0.1)
    assert len(late) == len(flight(ONE, 12))
    assert -1e-6 <= min(late) <= max(late) <= 0.11
    assert "END OF FILE" in recording.progress
