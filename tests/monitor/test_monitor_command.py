"""The command ``monitor``: ``--once`` and ``--stream`` from a bus and from files, and mistakes.

The command never sends a frame.
"""

import ast
import inspect
import json
import shutil
import signal
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from capture_bench import Bench, capture_file, made
from command_line import Done, refused, run, written
from simulated_bus import START_S, Clock, flight, layout_of, write_log

from kontronik_can_gw.cli import monitor
from kontronik_can_gw.cli import source as source_of_commands
from kontronik_can_gw.config.keys import CanConfig, shipped
from kontronik_can_gw.desk import member, sources
from kontronik_can_gw.desk.monitor import model, screen, status, watch
from kontronik_can_gw.desk.receiver import bus_listener
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.sources import PlayedRecording
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.simulator import SECOND_NS, SimulatedEsc

pytestmark = pytest.mark.promise("monitor")

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
    """Assert that the command restores the handlers of signals."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    assert {number: signal.getsignal(number) for number in before} == before


def document(done: Done) -> dict[str, Any]:
    assert done.code == 0, done.err
    assert done.out.count("\n") == 1, done.err
    found: dict[str, Any] = json.loads(done.out)
    return found


def test_monitor_has_no_code_that_sends() -> None:
    """The listener has no method that sends, and the modules call no such method."""
    assert not [name for name in dir(bus_listener.BusListener) if "send" in name]
    for module in (monitor, member, model, screen, sources, watch, bus_listener):
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.Attribute):
                assert "send" not in node.attr, f"{module.__name__}:{node.lineno}"


@pytest.mark.parametrize(
    "command",
    [
        ["monitor"],
        ["mqtt", "--broker", "127.0.0.1:1"],
    ],
)
def test_port_of_an_esc_is_never_opened_as_a_can_adapter(
    tmp_path: Path, command: list[str]
) -> None:
    """Opening some adapters writes to them, and nothing may be written to an ESC."""
    port = written(tmp_path / "ttyESC", "")
    text = f'[can]\ninterface = "virtual"\n[[esc]]\nport = "{port}"\n'
    toml = written(tmp_path / "g.toml", text)
    done = run(*command, "-c", toml, "--interface", "slcan", "--channel", f"{port}@115200")
    assert done.code == 2
    assert "Nothing may be sent to an ESC" in done.err


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("logs") / "flight.log", flight(ONE, 12))


def test_once_shows_the_values_at_the_end_of_a_log(log: Path) -> None:
    found = document(run("monitor", log, "--once"))
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


def test_capture_is_shown_with_its_own_dbc(tmp_path: Path, clock: Clock) -> None:
    bench = Bench(*made(2)).live(3, 8, wild=False)
    file = written(tmp_path / "x.kcap", capture_file(bench.setup, bench.entries))
    found = document(run("monitor", file, "--once"))
    assert [esc["name"] for esc in found["escs"]] == ["e0", "e1"]
    assert found["time"].startswith("2023-11-15T03:")
    assert found["time"].endswith("+05:30"), "local time"
    assert found["frames"] == len(bench.sent)
    assert all(20 < esc["values"]["battery_voltage"] < 26 for esc in found["escs"])
    assert "\ne1 " in run("monitor", file, "--speed", 4).out
    done = run("monitor", file, "--dbc", DBC)
    assert done.code == 2
    assert done.out == ""
    assert "x.kcap: is a capture, which contains its own DBC. Leave -c and --dbc out." in done.err


def test_plain_bytes_of_a_uart_are_shown(tmp_path: Path) -> None:
    sent = SimulatedEsc(seed=1).frames_until(9 * SECOND_NS)
    file = written(tmp_path / "bytes.bin", b"".join(one.wire for one in sent))
    found = document(run("monitor", file, "--once"))
    assert found["time"] is None
    assert found["escs"][0]["link"] == "Ok"
    assert found["escs"][0]["values"]["motor_speed"] > 0


@pytest.mark.parametrize("speed", [0.5, 4])
def test_recording_is_played_in_real_time(log: Path, clock: Clock, speed: float) -> None:
    late: list[float] = []
    with open_input(log) as opened:
        recording = PlayedRecording(opened, speed)
        first = recording.now()
        begun = clock.now

        def take(_: object, now: int) -> None:
            late.append(clock.now - begun - (now - first) / SECOND_NS / speed)

        while not recording.has_ended:
            recording.pump(take, clock.now + 0.1)
    assert len(late) == len(flight(ONE, 12))
    assert -1e-6 <= min(late) <= max(late) <= 0.11
    assert "END OF FILE" in recording.progress


# --- a line of JSON each second


def seconds_of(document: dict[str, Any]) -> float:
    """Return the Unix time of a line."""
    return datetime.fromisoformat(document["time"]).timestamp()


def documents(done: Done) -> list[dict[str, Any]]:
    assert done.code == 0, done.err
    assert "Traceback" not in done.err
    return [json.loads(line) for line in done.out.splitlines()]


def test_stream_writes_a_line_each_second_of_a_recording(log: Path, clock: Clock) -> None:
    frames = flight(ONE, 12)
    found = documents(run("monitor", log, "--stream"))
    begin = frames[0][0]
    monitor = model.Monitor(ONE)
    monitor.advance(begin)
    waiting = list(frames)
    for number, one in enumerate(found[:-1], 1):
        due = begin + number * SECOND_NS
        while waiting and waiting[0][0] < due:
            now, frame = waiting.pop(0)
            monitor.take(frame, now)
        monitor.advance(due)
        assert seconds_of(one) == START_S + number
        expected = json.loads(json.dumps(monitor.document()))
        assert one["escs"][0]["values"] == expected["escs"][0]["values"]
        assert one["frames"] == len(frames) - len(waiting)
    assert len(found) == 12
    assert found[-1]["frames"] == len(frames)
    assert {one["problem"] for one in found} == {None}


def test_stream_has_no_old_values_in_a_gap_of_a_recording(tmp_path: Path, clock: Clock) -> None:
    frames = flight(ONE, 4)
    later = [(now + 60 * SECOND_NS, frame) for now, frame in frames]
    file = write_log(tmp_path / "gap.log", frames + later)
    found = documents(run("monitor", file, "--stream", "--speed", 30))
    voltages = [one["escs"][0]["values"]["battery_voltage"] for one in found]
    assert len(found) == 64
    assert all(voltages[:3])
    assert set(voltages[5:59]) == {None}
    assert all(voltages[60:])


def test_stream_of_a_bus_leaves_out_missed_seconds() -> None:
    class HeldUp(sources.Source):
        clock = 0

        def pump(self, take: sources.Take, until_s: float) -> None:
            self.clock += SECOND_NS if self.clock < 2 * SECOND_NS else 3600 * SECOND_NS

        def now(self) -> int:
            return self.clock

        def wall_ns(self) -> int:
            return START_S * SECOND_NS + self.clock

    found: list[dict[str, Any]] = []
    source = HeldUp("can0", ONE)
    watch.stream(source, model.Monitor(ONE), found.append, lambda: len(found) >= 4)
    assert [seconds_of(one) - START_S for one in found] == [1, 2, 3602, 7202]


def test_stream_of_a_bus_without_frames_gives_the_reason() -> None:
    class Silent(sources.Source):
        clock = 0

        def pump(self, take: sources.Take, until_s: float) -> None:
            self.clock += SECOND_NS // 2
            self.problem = "" if self.clock <= SECOND_NS else "CAN interface can0: is down."

        def now(self) -> int:
            return self.clock

        def wall_ns(self) -> int:
            return START_S * SECOND_NS + self.clock

    found: list[dict[str, Any]] = []
    source = Silent("can0", ONE)
    watch.stream(source, model.Monitor(ONE), found.append, lambda: len(found) == 3)
    assert [one["problem"] for one in found] == [None, *["CAN interface can0: is down."] * 2]
    assert [one["interface"] for one in found] == ["can0"] * 3
    for one in found:
        assert set(one["escs"][0]["values"].values()) == {None}


@pytest.mark.parametrize(
    ("channel", "state", "age_s"), [("can0", "quiet", 0), ("can1", "quiet", 0),
                                    ("can0", "running", 0), ("can0", "quiet", 60)],
)  # fmt: skip
def test_once_on_a_silent_bus_knows_a_quiet_gateway_of_this_machine(
    channel: str,
    state: str,
    age_s: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Silent(sources.Source):
        clock = 3 * SECOND_NS  # the default time of --once
        hints = ("Is the gateway running?",)

        def pump(self, take: sources.Take, until_s: float) -> None:
            self.clock += SECOND_NS

        def now(self) -> int:
            return self.clock

    file = tmp_path / "status.json"
    seen = {"can": {"channel": channel}, "gateway": {"state": state}}
    code = status.NOT_RUNNING if age_s else status.HEALTHY
    found = status.Seen(file, code, state, document=seen)
    monkeypatch.setattr(status, "look_at", lambda _file, _now: found)
    monkeypatch.setattr(status, "published_files", lambda: [file])
    monitor = model.Monitor(ONE)
    monitor.advance(0)
    if (channel, state, age_s) == ("can0", "quiet", 0):
        shown = watch.once(Silent("can0", ONE), monitor, 0, lambda: False)
        assert shown["gateway"]["state"] == "Quiet"
        assert shown["frames"] == 0
    else:
        with pytest.raises(RunError, match=r"no frame of .* Is the gateway running\?"):
            watch.once(Silent("can0", ONE), monitor, 0, lambda: False)


# --- the name of an interface or of a recording


@pytest.mark.parametrize(
    ("name", "words", "channel"),
    [
        ("vcan7", (), "vcan7"),  # neither exists: the error is about an interface
        ("lo", (), "lo"),  # an interface, although there is such a file
        ("bus", ("--interface", "virtual"), "bus"),
        ("./lo", (), None),
        ("flight", (), None),
        ("missing.log", (), None),
    ],
)
def test_name_may_be_an_interface_or_a_recording(
    name: str,
    words: tuple[str, ...],
    channel: str | None,
    log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for file in ("lo", "flight"):
        shutil.copy(log, tmp_path / file)
    monkeypatch.chdir(tmp_path)
    opened: list[str] = []

    def open_bus(_bus: object, config: CanConfig, _patient: bool) -> None:
        opened.append(config.channel)
        raise RunError("not opened")

    monkeypatch.setattr(source_of_commands, "Bus", open_bus)
    done = run("monitor", name, "--once", *words)
    if channel is None:
        assert opened == []
        assert done.code == (2 if name == "missing.log" else 0)
    else:
        assert opened == [channel]
        assert done.code == 1


def test_interface_is_named_once() -> None:
    said = refused(2, "monitor", "vcan7", "--channel", "vcan8")
    assert said == "--channel vcan8: vcan7 names the interface. Leave one out."
    assert "is for a recording" in refused(2, "monitor", "vcan7", "--speed", 2)


def test_interface_of_the_command_line_overrides_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toml = written(tmp_path / "g.toml", '[can]\nchannel = "can3"\n[[esc]]\nport = "x"\n')
    opened: list[str] = []
    monkeypatch.setattr(
        source_of_commands, "Bus", lambda _bus, config, _patient: opened.append(config.channel)
    )
    for words in (("vcan7",), ()):
        with pytest.raises(TypeError, match="context manager"):
            run("monitor", *words, "-c", toml)
    assert opened == ["vcan7", "can3"]
