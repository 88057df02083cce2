"""The list of flights, and the files that a child process makes from captures."""

import fcntl
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import run
from live_bench import FedBus, ServedPage, wait_until
from recordings import capture_bytes

from kontronik_can_gw.desk.live import flights as flights_module
from kontronik_can_gw.desk.live.flights import Flights, recordings_in
from kontronik_can_gw.desk.recordings.inputs import open_input
from kontronik_can_gw.desk.report.flight import flight_of

pytestmark = pytest.mark.promise("live-page")

DAMAGED = Path(__file__).parents[1] / "golden/captures/damaged.kcap"
ASK = {"X_Kontronik_Page": "1"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with three captures, the newest one of two parts."""
    found = tmp_path / "captures"
    found.mkdir()
    names = ["20260101T100000Z-aaaaaa-00000", "20260102T100000Z-bbbbbb-00000"]
    for age, name in enumerate([*names, "20260102T100000Z-bbbbbb-00001"]):
        path = found / f"{name}.kcap"
        path.write_bytes(capture_bytes(seed=3 + age % 2))
        os.utime(path, (1_767_000_000 + age, 1_767_000_000 + age))
    (found / "note.txt").write_text("not a capture")
    return found


@pytest.fixture
def page(folder: Path, tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(FedBus(["esc1"]), None, Flights(folder, 0, tmp_path / "cache")) as served:
        yield served


def listed(page: ServedPage) -> list[dict[str, Any]]:
    status, _, body = page.get("/flights.json")
    assert status == 200
    found: list[dict[str, Any]] = json.loads(body)["flights"]
    return found


def state(page: ServedPage, flight: int, kind: str) -> Any:
    return listed(page)[flight]["states"][kind]


def made(page: ServedPage, flight: int, kind: str) -> dict[str, Any]:
    """Order a file and wait until it is made. Return its flight."""
    found = listed(page)[flight]
    assert page.get(f"/make/{found['id']}/{kind}", **ASK)[0] == 202
    wait_until(lambda: state(page, flight, kind) == "made", f"a {kind}", 60)
    return found


def test_recordings_are_listed_newest_first_with_their_parts(folder: Path) -> None:
    found = recordings_in(folder)
    assert [recording.name for recording in found] == [
        "20260102T100000Z-bbbbbb",
        "20260101T100000Z-aaaaaa",
    ]
    assert [len(recording.paths) for recording in found] == [2, 1]


def test_numbers_equal_the_evaluated_flight(page: ServedPage, folder: Path) -> None:
    wait_until(lambda: all(flight["summary"] for flight in listed(page)), "all summaries", 60)
    summary = listed(page)[1]["summary"]
    with open_input(folder / "20260101T100000Z-aaaaaa-00000.kcap") as recording:
        flight = flight_of(recording)
        start_ns = recording.wall_ns(flight.origin_ns)
    assert start_ns is not None
    currents = [esc.extremes["battery_current"].value for esc in flight.escs]
    voltages = [esc.extremes["battery_voltage"].value for esc in flight.escs]
    assert summary["current"] == max(currents)
    assert summary["voltage"] == min(voltages)
    assert summary["energy"] == round(sum(esc.energy_wh or 0 for esc in flight.escs), 2)
    assert summary["start"] == start_ns // 1_000_000
    assert summary["duration"] == round((flight.end_ns - flight.start_ns) / 1e9, 1)


def test_report_equals_that_of_the_command_and_is_kept(
    page: ServedPage, folder: Path, tmp_path: Path
) -> None:
    flight = made(page, 1, "report")
    path = f"/flights/{flight['id']}/report"
    status, headers, body = page.get(path)
    assert status == 200
    policy = headers["content-security-policy"]
    assert "sha256-" in policy
    assert "frame-ancestors 'none'" in policy
    output = tmp_path / "same.html"
    source = folder / "20260101T100000Z-aaaaaa-00000.kcap"
    assert run("report", source, "-o", output).code == 0
    assert body == output.read_bytes()
    kept = {file: file.stat().st_mtime_ns for file in (tmp_path / "cache/flights").glob("*.report")}
    made(page, 1, "report")
    assert kept == {file: file.stat().st_mtime_ns for file in kept}
    with source.open("ab") as file:
        file.write(b"more")
    assert state(page, 0, "report") is None  # it is the newest one now
    made(page, 1, "report")
    assert not any(file.exists() for file in kept)


def test_tables_and_captures_are_downloads(page: ServedPage, folder: Path) -> None:
    for kind in ("csv", "parquet"):
        flight = made(page, 0, kind)
        status, headers, body = page.get(f"/flights/{flight['id']}/{kind}")
        assert status == 200
        assert f'filename="{flight["name"]}.{kind}"' in headers["content-disposition"]
        assert len(body) > 1000
    for part in (0, 1):
        status, headers, body = page.get(f"/flights/{flight['id']}/capture/{part}")
        assert status == 200
        assert body == (folder / f"{flight['name']}-0000{part}.kcap").read_bytes()
        assert "attachment" in headers["content-disposition"]
    assert page.get(f"/flights/{flight['id']}/capture/2")[0] == 404


def test_damaged_empty_and_unfinished_captures_are_explained(
    page: ServedPage, folder: Path
) -> None:
    for old in folder.iterdir():
        old.unlink()
    shutil.copy(DAMAGED, folder / "a.kcap")
    (folder / "b.kcap").touch()
    (folder / "c.kcap").write_bytes(b"rubbish" * 1000)
    writing = folder / "d.kcap"
    writing.write_bytes(capture_bytes()[:-5000])
    with writing.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)

        def explained() -> dict[str, Any] | None:
            found = {flight["name"]: flight for flight in listed(page)}
            if not found["a"]["summary"] or not found["b"]["states"]["summary"]:
                return None
            return found if found["c"]["states"]["summary"] else None

        found = wait_until(explained, "all summaries", 60)
        assert found["d"]["isWritten"]
        assert found["d"]["summary"] is None
    assert found["a"]["summary"]["damage"] > 0
    assert "is empty" in found["b"]["states"]["summary"]["failed"]
    assert "c.kcap" in found["c"]["states"]["summary"]["failed"]
    assert str(folder) not in str(found)
    flight = next(each for each in listed(page) if each["name"] == "b")
    page.get(f"/make/{flight['id']}/report", **ASK)
    place = [each["name"] for each in listed(page)].index("b")
    wait_until(lambda: "failed" in (state(page, place, "report") or {}), "the failure", 60)


@pytest.mark.parametrize("what", ["missing", "file", "none"])
def test_folder_that_cannot_be_read_is_one_line(tmp_path: Path, what: str) -> None:
    given = None if what == "none" else tmp_path / what
    (tmp_path / "file").write_text("")
    with ServedPage(FedBus(["esc1"]), None, Flights(given, 0, tmp_path)) as page:
        content = json.loads(page.get("/flights.json")[2])
        assert content["flights"] == []
        expected = {
            "missing": "No such file",
            "file": "Not a directory",
            "none": "record.directory",
        }
        assert expected[what] in content["problem"]


def test_five_hundred_captures_are_listed_and_the_newest_summary_is_first(
    page: ServedPage, folder: Path
) -> None:
    for number in range(500):
        path = folder / f"2026{number:04}.kcap"
        path.write_bytes(capture_bytes(seconds=1))
        os.utime(path, (1_768_000_000 + number, 1_768_000_000 + number))
    assert len(listed(page)) == 502
    wait_until(lambda: listed(page)[0]["summary"], "the newest summary", 60)
    assert sum(flight["summary"] is not None for flight in listed(page)) < 400


def test_requests_name_recordings_by_their_id_only(page: ServedPage) -> None:
    (flight, _) = listed(page)
    for path in (
        f"/flights/{flight['name']}/report",
        "/flights/../captures/report",
        "/flights/%2e%2e/capture/0",
        f"/flights/{flight['id']}/..%2f..%2fetc",
        f"/flights/{flight['id']}/capture/-1",
        f"/flights/{flight['id']}/unknown",
        f"/make/{flight['name']}/report",
        f"/make/{flight['id']}/unknown",
    ):
        assert page.get(path, **ASK)[0] == 404, path
    assert page.get(f"/make/{flight['id']}/report")[0] == 403
    assert state(page, 0, "report") is None


def test_one_file_is_made_at_a_time_and_a_report_goes_before_summaries(page: ServedPage) -> None:
    for flight in listed(page):
        for kind in ("report", "csv"):
            page.get(f"/make/{flight['id']}/{kind}", **ASK)
    left = True
    while left:
        states = [state for flight in listed(page) for state in flight["states"].values()]
        assert sum(isinstance(state, float | int) for state in states) <= 1
        left = any(isinstance(state, float | int) or state == "waiting" for state in states)
        time.sleep(0.05)
    assert state(page, 0, "report") == state(page, 1, "csv") == "made"


def test_child_process_has_limits_and_low_priority() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        flights_module._restrict(child.pid)
        assert os.getpriority(os.PRIO_PROCESS, child.pid) == 19
        data, _ = resource.prlimit(child.pid, resource.RLIMIT_DATA)
        cpu, _ = resource.prlimit(child.pid, resource.RLIMIT_CPU)
        assert 0 < data <= 1 << 30
        assert 0 < cpu <= 3600
        assert Path(f"/proc/{child.pid}/oom_score_adj").read_text() == "900\n"
        child.communicate(b"\n")


def test_child_process_that_takes_too_long_is_ended(
    page: ServedPage, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "sleeps.py").write_text("import time; time.sleep(1000)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(flights_module, "_LIMIT_S", 1)
    commands = {**flights_module._COMMANDS, "csv": ("sleeps",)}
    monkeypatch.setattr(flights_module, "_COMMANDS", commands)
    flight = listed(page)[0]
    page.get(f"/make/{flight['id']}/csv", **ASK)
    wait_until(lambda: "failed" in (state(page, 0, "csv") or {}), "the failure", 60)
    assert "too much memory or time" in state(page, 0, "csv")["failed"]


def test_short_disk_is_told_on_the_page(folder: Path, tmp_path: Path) -> None:
    flights = Flights(folder, 1 << 60, tmp_path)
    with ServedPage(FedBus(["esc1"]), None, flights):
        wait_until(lambda: "MB free" in flights.disk(), "the line")
