"""The whole program as a service manager runs it: ready, alive and ended.

It also cannot start, or starts with closed standard streams.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from vcan_tools import feeding

from kontronik_can_gw.cli import main
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.runtime.status.statistics import open_statistics

pytestmark = pytest.mark.promise("service")

PROGRAM = [sys.executable, "-m", "kontronik_can_gw"]
ENOUGH = 36_000
"""Bytes of a capture with some seconds of telemetry."""

LIMIT_S = 120
"""Time limit in s for an expected event. No test depends on its duration."""


CONFIGURATION = """
can = {{interface = "virtual"}}
canopen = {{enabled = true, self_start = true, store = "{folder}/store"}}
record = {{can_log = "blf"}}
run = {{realtime_priority = 7}}
[[esc]]
port = "{ports[0]}"
telemetry_timeout_ms = 60000  # a busy machine may feed an ESC late
[[esc]]
port = "{ports[1]}"
telemetry_timeout_ms = 60000
"""


def size_of(folder: Path) -> int:
    return sum(part.stat().st_size for part in folder.iterdir())


@pytest.mark.rights
def test_service_notifies_ready_and_alive_records_and_notifies_its_end(
    tmp_path: Path,
) -> None:
    """The configuration is of 0.5.0. Its CAN log beside the capture is no longer written."""
    config, file, errors = (tmp_path / name for name in ("g.toml", "status.json", "errors"))
    manager = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
    environment = os.environ | manager | {"RUNTIME_DIRECTORY": str(tmp_path)}
    environment.pop("WATCHDOG_PID", None)
    captures = tmp_path / "captures"
    command = [*PROGRAM, "run", "-c", str(config), "--wait", "--record", str(captures)]
    with (
        feeding(tmp_path, 2) as escs,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening,
        errors.open("w") as log,
    ):
        config.write_text(CONFIGURATION.format(folder=tmp_path, ports=[esc.path for esc in escs]))
        for esc in escs:
            esc.on = True
        listening.bind(manager["NOTIFY_SOCKET"])
        listening.settimeout(LIMIT_S)
        process = subprocess.Popen(command, stderr=log, env=environment)
        try:
            said = ""
            end = time.monotonic() + LIMIT_S

            def heard(condition: Callable[[], bool]) -> None:
                nonlocal said
                while not condition():
                    assert time.monotonic() < end, errors.read_text()
                    said += listening.recv(4096).decode() + "\n"

            heard(lambda: "READY=1" in said)
            assert "WATCHDOG" not in said.partition("READY=1")[0]
            heard(lambda: "STATUS=" in said)
            policy = os.sched_getscheduler(process.pid)
            priority = os.sched_getparam(process.pid).sched_priority
            before = said.count("WATCHDOG=1")
            heard(lambda: said.count("WATCHDOG=1") >= before + 4 and file.exists())
            heard(lambda: "esc2: telemetry ok" in errors.read_text())
            # a busy machine can feed one ESC later than the other
            heard(lambda: all(esc["firmware"] for esc in json.loads(file.read_text())["escs"]))
            recorded = size_of(captures)
            heard(lambda: size_of(captures) > recorded + ENOUGH)
            assert json.loads(file.read_text())["escs"][0]["name"] == "esc1"
            process.send_signal(signal.SIGHUP)  # as if the terminal is closed
            heard(lambda: "STOPPING=1" in said)
            assert process.wait(LIMIT_S) == 0
        finally:
            process.kill()
            process.wait()
    assert not file.exists()
    logged = errors.read_text()
    assert "record.can_log: was removed and is ignored. Use `kontronik-can-gw convert" in logged
    last = logged.splitlines()[-1]
    totals = (
        r"stopped by SIGHUP after [\d.]+ s: (\d+) live frames received, 0 CRC errors, "
        r"telemetry lost 0 times; (\d+) CAN frames sent, 0 dropped, bus-off 0 times"
    )
    found_totals = re.search(totals, last)
    assert found_totals is not None, last
    assert min(map(int, found_totals.groups())) > 20
    if "not permitted" in logged:
        assert "Running without it." in logged
        assert policy == os.SCHED_OTHER
    else:
        assert policy == os.SCHED_FIFO
        assert priority == 7
    assert {path.suffix for path in captures.iterdir()} == {".kcap"}
    converted = tmp_path / "converted.log"
    subprocess.run([*PROGRAM, "convert", "-q", str(captures), str(converted)], check=True)
    assert len(converted.read_text().splitlines()) > 300
    with open_input(captures) as found:
        list(found.frames())
        assert found.damage == []
        assert "KOSMIK 101, firmware 1.14, V4 layout" in found.provenance["esc1"]
        assert re.fullmatch(r".*\.dbc, layout [0-9A-F]{8}", found.provenance["DBC"])


def test_service_that_cannot_start_reports_why_and_waits_before_it_ends(tmp_path: Path) -> None:
    config = tmp_path / "gateway.toml"
    config.write_text("nonsense")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(LIMIT_S)
        process = subprocess.Popen(
            [*PROGRAM, "run", "-c", str(config)],
            stderr=subprocess.PIPE,
            env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")},
        )
        said = listening.recv(4096).decode()
        assert said.startswith("STATUS=cannot start: ")
        assert process.poll() is None
        process.terminate()
        _, errors = process.communicate(timeout=LIMIT_S)
    assert b"is not valid TOML" in errors
    assert b"Traceback" not in errors


def test_port_never_gets_the_number_of_a_closed_standard_stream(tmp_path: Path) -> None:
    """If descriptor 2 is closed, a port could get its number.

    Messages to standard error would then be sent to the ESC.
    """
    code = (
        "import os; [os.close(n) for n in (0, 1, 2)]\n"
        "from kontronik_can_gw.cli import main\n"
        "code = main(['schema'])\n"
        f"fd = os.open({str(tmp_path / 'x')!r}, os.O_CREAT | os.O_WRONLY)\n"
        "os.write(fd, b'%d %d' % (fd, code))\n"
    )
    subprocess.run([sys.executable, "-c", code], check=False, timeout=LIMIT_S)
    fd, exit_code = (tmp_path / "x").read_text().split()
    assert int(fd) > 2
    assert exit_code == "0"


ELSEWHERE = """
from pathlib import Path
from kontronik_can_gw.runtime.system import folders
folders.RUN, folders.TEMPORARY = Path({folder!r}, "run"), Path({folder!r}, "tmp")
"""
BY_HAND = '[can]\ninterface = "virtual"\n{more}[[esc]]\nport = "{port}"\n'


def test_status_finds_gateways_run_by_hand_until_they_end(tmp_path: Path) -> None:
    """They run with and without ``statistics.file``.

    One gateway is killed, and its file is removed when the next gateway starts.
    """
    for name in ("run", "tmp"):
        (tmp_path / name).mkdir()
    (tmp_path / "sitecustomize.py").write_text(ELSEWHERE.format(folder=str(tmp_path)))
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    environment.pop("XDG_RUNTIME_DIR", None)
    running: dict[str, subprocess.Popen[bytes]] = {}

    def start(name: str, port: str, more: str = "") -> None:
        (tmp_path / f"{name}.toml").write_text(BY_HAND.format(port=port, more=more))
        command = [*PROGRAM, "run", "-c", str(tmp_path / f"{name}.toml")]
        running[name] = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)

    def status(*words: object) -> tuple[int, set[str]]:
        """Return the exit code, and the configurations of the gateways that are shown."""
        command = [*PROGRAM, "status", "--json", *map(str, words)]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True)
        gateways = json.loads(done.stdout)["gateways"]
        documents = [each["document"] for each in gateways if each["document"]]
        names = {Path(document["configuration"]).stem for document in documents}
        return done.returncode, names

    def until(expected: tuple[int, set[str]]) -> None:
        end = time.monotonic() + LIMIT_S
        found = status()
        while found != expected:
            assert time.monotonic() < end, (found, expected)
            found = status()

    with feeding(tmp_path, 2) as escs:
        for esc in escs:
            esc.on = True
        try:
            start("plain", escs[0].path)
            start("named", escs[1].path, '[statistics]\nfile = "own/state.json"\n')
            (tmp_path / "own").mkdir()
            until((0, {"plain", "named"}))
            assert status("-c", tmp_path / "plain.toml") == (0, {"plain"})
            assert status("-c", tmp_path / "named.toml") == (0, {"named"})
            assert (tmp_path / "own" / "state.json").is_file()
            running["plain"].terminate()
            assert running["plain"].wait(LIMIT_S) == 0
            assert status() == (0, {"named"})
            running["named"].kill()
            running["named"].wait()
            until((3, {"named"}))
            start("next", escs[0].path)
            until((0, {"next"}))
            running["next"].terminate()
            assert running["next"].wait(LIMIT_S) == 0
            assert status() == (3, set())
        finally:
            for process in running.values():
                process.kill()
                process.wait()
    assert not list(tmp_path.glob("*/**/status/*"))


def test_second_gateway_with_the_same_configuration_has_no_status(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    warnings: list[str] = []
    first = open_statistics(None, tmp_path / "gateway.toml", warnings.append)
    assert first is not None
    assert open_statistics(None, tmp_path / "gateway.toml", warnings.append) is None
    (warning,) = warnings
    assert "`kontronik-can-gw status` cannot show this gateway: " in warning
    assert "another gateway writes it" in warning
    first.close()


def test_gateway_that_cannot_start_reports_only_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    file = tmp_path / "gateway.toml"
    file.write_text('[can]\nchannel = "nocan7"\n[[esc]]\nport = "/dev/none"\npole_pairs = 7\n')
    first = open_statistics(None, file, lambda _: None)
    assert first is not None
    assert main(["run", "-c", str(file)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "/dev/none: no such serial port" in line
    first.close()


EVENTS = """
can = {{interface = "virtual"}}
record = {{directory = "captures", on_event = true, before_s = 1, after_s = 1, min_free_mb = 0}}
statistics = {{file = "status.json"}}
[[esc]]
port = "{port}"
telemetry_timeout_ms = 60000  # a busy machine may feed an ESC late
"""


@contextmanager
def recording_gateway(folder: Path, port: str, events: bool) -> Iterator[subprocess.Popen[bytes]]:
    """Run a gateway with its log in the file "errors". End it with SIGTERM."""
    text = EVENTS.format(port=port)
    if not events:
        text = text.replace("on_event = true, ", "")
    config = folder / "g.toml"
    config.write_text(text)
    with (folder / "errors").open("w") as log:
        process = subprocess.Popen([*PROGRAM, "run", "-c", str(config)], stderr=log)
        try:
            yield process
            process.send_signal(signal.SIGTERM)
            assert process.wait(LIMIT_S) == 0
        finally:
            process.kill()
            process.wait()


def wait_for(condition: Callable[[], object], process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.05)


def test_signal_and_a_lost_port_are_recorded_by_the_running_program(tmp_path: Path) -> None:
    status = tmp_path / "status.json"
    log = tmp_path / "errors"

    def event() -> dict[str, str]:
        document = json.loads(status.read_text()) if status.exists() else {}
        return (document.get("recording") or {}).get("event") or {}

    with feeding(tmp_path) as escs, recording_gateway(tmp_path, escs[0].path, True) as process:
        escs[0].on = True
        wait_for(lambda: "esc1: telemetry ok" in log.read_text(), process)
        assert not any((tmp_path / "captures").iterdir())
        process.send_signal(signal.SIGUSR1)
        wait_for(lambda: event().get("file"), process)
        assert event()["reason"] == "signal USR1"
        first = event()["file"]
        wait_for(lambda: json.loads(status.read_text())["recording"]["file"] == "", process)
        Path(escs[0].path).unlink()
        escs[0].close()
        wait_for(lambda: event()["file"] != first, process)
        assert (event()["esc"], event()["reason"]) == ("esc1", "telemetry lost")
    logged = log.read_text()
    assert f"event: signal USR1: recording to {first}" in logged
    assert "event: esc1: telemetry lost: recording to " in logged
    captures = sorted((tmp_path / "captures").iterdir())
    assert len(captures) == 2
    for capture in captures:
        with open_input(capture) as found:
            list(found.frames())
            assert found.damage == []
            assert "(" in found.provenance["recorded because of"]


def test_signal_usr1_has_no_effect_without_recording_on_events(tmp_path: Path) -> None:
    log = tmp_path / "errors"
    with feeding(tmp_path) as escs, recording_gateway(tmp_path, escs[0].path, False) as process:
        wait_for(lambda: "CAN virtual" in log.read_text(), process)
        process.send_signal(signal.SIGUSR1)
        escs[0].on = True
        wait_for(lambda: "esc1: telemetry ok" in log.read_text(), process)
    assert "stopped by SIGTERM" in log.read_text()
