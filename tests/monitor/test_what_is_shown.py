"""The link while its message is behind the values, the share of a capture's time, and which characters a locale has."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from capture_bench import START, Bench, made
from monitor_tools import STEP_NS, Timed, flight, layout_of

from kontronik_can_gw.capture import block, data_payload, json_payload
from kontronik_can_gw.cli.monitor import Recording, is_c_locale, last_ns
from kontronik_can_gw.dbc_output.layout import normalize
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.offline.inputs import open_input
from kontronik_can_gw.offline.monitor import Monitor
from kontronik_can_gw.simulator import SECOND_NS, EscOptions, SimulatedEsc

ONE = layout_of(["esc1"])
LINK_ID = next(
    plan.can_id for plan in ONE.layout.messages if any(s.source and s.source.name == "link_state" for s in plan.signals)
)


# --- the link


def gapped() -> Timed:
    """What the gateway sends of an ESC whose telemetry stays away from 2 s to 5 s."""
    esc = SimulatedEsc(EscOptions(), seed=1)
    gateway = Gateway(ONE.escs, ONE.layout, 0)
    gateway.port_opened(0, 0)
    gateway.start(0)
    frames: Timed = []
    for now in range(0, 8 * SECOND_NS, STEP_NS):
        for sent in esc.frames_until(now):
            if not 2 * SECOND_NS <= now < 5 * SECOND_NS:
                gateway.receive_bytes(0, sent.wire, now, now)
        gateway.advance(now)
        frames += [(now, frame) for frame in gateway.take_frames()]
    return frames


def test_a_link_is_never_lost_beside_a_value() -> None:
    raw_was_behind = 0
    monitor = Monitor(ONE)
    (esc,) = monitor.escs
    shown: list[str | None] = []
    late: list[tuple[int, CanFrame]] = []
    for now, frame in gapped():
        # of the link's messages one was on its way when the values came, and the next comes a cycle later
        if frame.can_id != LINK_ID or not 4.9 <= now / SECOND_NS < 5.1:
            late.append((now, frame))
        elif late[-1][0] < 5 * SECOND_NS - STEP_NS:
            late.append((now + 120_000_000, frame))
    for now, frame in sorted(late, key=lambda item: item[0]):
        monitor.take(frame, now)
        monitor.advance(now)
        raw = esc.value("link_state")
        shown.append(esc.link)
        if now > 5 * SECOND_NS and esc.number("battery_voltage") is not None:
            assert normalize(esc.link or "") == "ok"
            raw_was_behind += normalize(str(raw)) != "ok"
    assert raw_was_behind
    assert "Lost" in shown
    assert shown[-1] == "Ok"


def test_a_link_that_is_said_to_be_lost_behind_the_values_is_lost() -> None:
    """As where the values of a DBC have no code for not available, and stay."""
    monitor = Monitor(ONE)
    (esc,) = monitor.escs
    lost = next(f for now, f in gapped() if f.can_id == LINK_ID and now > 4 * SECOND_NS)
    frames = flight(ONE, 3)
    for now, frame in frames:
        monitor.take(frame, now)
    assert esc.link == "Ok"
    monitor.take(lost, frames[-1][0])
    monitor.take(lost, frames[-1][0])
    assert esc.number("battery_voltage") is not None
    assert esc.link == "Lost"
    document = monitor.document()["escs"][0]
    assert document["link"] == "Lost"


# --- how far a recording is


def write_capture(path: Path, seconds: float) -> Path:
    bench = Bench(*made(1)).live(3, seconds)
    header = bench.setup.header() | {"run": "r", "part": 0, "created_ns": START, "monotonic_ns": START, "wall_ns": 1}
    parts = [block(b"H", 0, json_payload(header))]
    for number, at in enumerate(range(0, len(bench.entries), 300)):
        parts.append(block(b"D", number + 1, data_payload(bench.entries[at : at + 300])))
    path.write_bytes(b"".join([*parts, block(b"E", len(parts), b"")]))
    return path


def test_a_captures_share_is_that_of_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from kontronik_can_gw.cli import monitor

    class Clock:
        now = 50.0

        def monotonic(self) -> float:
            return self.now

        def sleep(self, seconds: float) -> None:
            self.now += seconds

    clock = Clock()
    path = write_capture(tmp_path / "a.kcap", 20)
    monkeypatch.setattr(monitor, "time", clock)
    with open_input(path) as opened:
        entries = [entry.time_ns for entry in opened.entries()]  # type: ignore[attr-defined]
        assert last_ns(opened) == entries[-1]
        recording = Recording(opened, 1)
        first, lasts = recording.now(), (entries[-1] - recording.now()) / SECOND_NS
        told = 0
        while not recording.ended:
            recording.pump(lambda _frame, _now: None, clock.now + 0.1)
            if found := re.fullmatch(r"0:\d\d  (\d+) %", recording.where().progress):
                wanted = 100 * (recording.now() - first) / SECOND_NS / lasts
                assert wanted - 1.01 <= int(found[1]) <= wanted
                told += 1
        assert told > 150
        assert "END OF FILE" in recording.where().progress


def test_a_share_that_is_not_known_is_not_shown(tmp_path: Path) -> None:
    path = write_capture(tmp_path / "a.kcap", 3)
    content = path.read_bytes()
    with open_input(path) as opened:
        path.write_bytes(content[:1] + b"x" * len(content))
        assert last_ns(opened) is None
    dump = tmp_path / "a.bin"
    dump.write_bytes(b"".join(s.wire for s in SimulatedEsc(EscOptions()).frames_until(3 * SECOND_NS)))
    with open_input(dump) as opened:
        recording = Recording(opened, 1)
        assert recording.where().progress == "0:00"


# --- characters


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"LC_ALL": "C"}, True),
        ({"LC_ALL": "POSIX", "LANG": "de_DE.UTF-8"}, True),
        ({"LC_ALL": "C", "LC_CTYPE": "C.UTF-8"}, True),
        ({"LC_ALL": "", "LC_CTYPE": "", "LANG": "C"}, True),
        ({}, True),
        ({"LC_ALL": "C.UTF-8"}, False),
        ({"LC_CTYPE": "C.utf8", "LANG": "C"}, False),
        ({"LANG": "de_DE.UTF-8"}, False),
        ({"LC_CTYPE": "en_US"}, False),
    ],
)
def test_the_locale_of_the_person_counts(environment: dict[str, str], expected: bool) -> None:
    assert is_c_locale(environment) is expected


@pytest.mark.parametrize(
    ("locale", "is_ascii"), [({"LC_ALL": "C"}, True), ({"LANG": "C"}, True), ({}, True), ({"LANG": "C.UTF-8"}, False)]
)
def test_bars_are_ascii_in_a_locale_without_utf8(tmp_path: Path, locale: dict[str, str], is_ascii: bool) -> None:
    """On a real terminal: Python itself works in UTF-8 in all of these."""
    import pty

    path = write_capture(tmp_path / "a.kcap", 4)
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("LC_", "LANG", "PYTHON"))}
    environment |= {"TERM": "xterm", "COLUMNS": "100", "LINES": "30"} | locale
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "kontronik_can_gw", "monitor", str(path)]
    process = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, env=environment)
    os.close(slave)
    seen = b""
    end = time.monotonic() + 30
    wanted = (b"##", "▇".encode())
    while not any(each in seen for each in wanted) and time.monotonic() < end:
        seen += os.read(master, 65536)
    process.terminate()
    process.wait(10)
    os.close(master)
    assert seen.isascii() is is_ascii
    assert wanted[not is_ascii] in seen
