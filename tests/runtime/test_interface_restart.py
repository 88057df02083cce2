"""Requests to restart an interface from which no frame leaves: times, numbers, log lines."""

import logging
import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from test_can_link import ACTIVE, Bench, Kernel, kernel, locks_of_its_own  # noqa: F401  fixtures

from kontronik_can_gw.gateway.gate_table import MAX_PAUSE_NS
from kontronik_can_gw.runtime.can.interface_restart import FOLDER, remedy, request, request_file
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("restarts")

DOWN = LinkFacts(exists=True, up=False)


class Hung:
    """An interface that accepts frames and sends none, and a restart after half a second."""

    def __init__(
        self,
        kernel: Kernel,  # noqa: F811
        after_s: float = 0.5,
        interface: str = "socketcan",
    ) -> None:
        self.asked: list[int] = []
        self.bench = Bench(kernel, restart_after_s=after_s, interface=interface)
        self.bench.can.transmitter.ask_restart = self._ask
        self.bench.begin()
        self.begin = self.bench.now

    def _ask(self, channel: str) -> None:
        assert channel == "can0"
        self.asked.append(self.bench.now)

    def hang(self) -> None:
        self.bench.port.frame_ns = MS // 4
        self.bench.port.block()

    def restart(self) -> None:
        """Set the interface down and up. It hangs again."""
        self.bench.changes(DOWN)
        self.bench.turn(20)
        self.bench.changes(ACTIVE)
        self.bench.turn(1)

    def run(self, seconds: float, restarts: bool) -> list[float]:
        """Let the outage last. Return the pauses between the requests, in seconds."""
        until = self.bench.now + round(seconds * SECOND)
        while self.bench.now < until:
            count = len(self.asked)
            self.bench.turn(1)
            if restarts and len(self.asked) > count:
                self.restart()
                self.hang()
        return [round((after - before) / SECOND, 1) for before, after in pairwise(self.asked)]


def test_first_restart_is_in_time_and_later_ones_back_off(kernel: Kernel) -> None:  # noqa: F811
    it = Hung(kernel)
    it.hang()
    pauses = it.run(60, restarts=True)
    assert 0.5 <= (it.asked[0] - it.begin) / SECOND < 0.8
    assert pauses[:4] == [1.0, 2.0, 4.0, 8.0]
    assert set(pauses[4:]) == {MAX_PAUSE_NS / SECOND}
    assert it.bench.gateway.status.can_restarts == len(it.asked)
    it.restart()
    it.bench.turn(4000)  # frames leave again
    it.asked.clear()
    it.begin = it.bench.now
    it.hang()
    it.run(1, restarts=True)
    assert 0.5 <= (it.asked[0] - it.begin) / SECOND < 0.8, "the pause is short again"


def test_outage_is_reported_once_and_its_restarts_at_its_end(
    kernel: Kernel,  # noqa: F811
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    it = Hung(kernel)
    it.hang()
    it.run(30, restarts=True)
    it.restart()
    it.bench.turn(4000)
    lines = [line for line in caplog.messages if "restart" in line and "down" not in line]
    assert lines == [
        "CAN can0: no frame left it, so it is restarted",
        f"CAN can0: works again after {len(it.asked)} restarts",
    ]


def test_missing_unit_is_reported_once_with_the_remedy(
    kernel: Kernel,  # noqa: F811
    caplog: pytest.LogCaptureFixture,
) -> None:
    it = Hung(kernel)
    it.hang()
    it.run(60, restarts=False)
    (line,) = [line for line in caplog.messages if "restarted" in line]
    assert "sudo systemctl enable --now kontronik-can-gw-restart@can0.path" in line
    assert it.bench.gateway.status.can_restarts == 0


def test_requests_without_an_answer_back_off(kernel: Kernel) -> None:  # noqa: F811
    it = Hung(kernel)
    it.hang()
    pauses = it.run(60, restarts=False)
    assert pauses[:2] == [4.0, 8.0]
    assert set(pauses[2:]) == {MAX_PAUSE_NS / SECOND}


@pytest.mark.parametrize("is_free_at_times", [False, True])
def test_adapter_with_a_buffer_of_its_own_is_restarted_ever_more_rarely(
    kernel: Kernel,  # noqa: F811
    is_free_at_times: bool,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It takes three frames after each restart, or when the bus is free for 20 ms, and hangs."""
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    it = Hung(kernel)
    it.hang()
    turns = 20_000
    for turn in range(turns):
        count = len(it.asked)
        it.bench.turn(1)
        if len(it.asked) > count:
            it.restart()
            it.hang()
            it.bench.port.passes = 3
        if is_free_at_times and turn % 600 == 0:
            it.bench.port.passes += 3
    assert 1 <= len(it.asked) <= 6, "after 0.5, 1, 2, 4 and 8 s"
    assert not [line for line in caplog.messages if "works again" in line]


@pytest.mark.parametrize(("after_s", "interface"), [(0, "socketcan"), (0.5, "virtual")])
def test_nothing_is_requested_without_the_key_or_socketcan(
    kernel: Kernel,  # noqa: F811
    after_s: float,
    interface: str,
) -> None:
    it = Hung(kernel, after_s, interface)
    it.hang()
    it.run(30, restarts=False)
    assert it.asked == []


def test_interface_that_another_program_restarts_is_not_counted(
    kernel: Kernel,  # noqa: F811
) -> None:
    it = Hung(kernel)
    it.restart()
    assert it.bench.gateway.status.can_restarts == 0


def test_link_that_hangs_asks_for_a_restart_and_counts_it(kernel: Kernel) -> None:  # noqa: F811
    it = Hung(kernel)
    bench = it.bench
    it.hang()
    bench.turn(1200)
    assert len(it.asked) == 1
    bench.changes(DOWN)
    bench.turn(30)
    bench.changes(ACTIVE)
    bench.turn(300)
    assert bench.gateway.status.can_restarts == 1
    assert not bench.gateway.is_held


def test_request_changes_the_file_of_the_interface(tmp_path: Path) -> None:
    request("can7")
    first = request_file("can7").stat().st_mtime_ns
    assert request_file("can7") == tmp_path / "run/kontronik-can-gw/restart/can7"
    os.utime(request_file("can7"), ns=(first, first - SECOND))
    request("can7")
    assert request_file("can7").stat().st_mtime_ns >= first
    assert request_file("can7").read_bytes() == b""


def _link_to_a_file(path: Path, target: Path) -> None:
    target.write_text("content")
    path.symlink_to(target)


def _link_to_no_file(path: Path, target: Path) -> None:
    path.symlink_to(target)


def _fifo(path: Path, _target: Path) -> None:
    os.mkfifo(path)


def _link_of_the_folder(path: Path, target: Path) -> None:
    path.parent.rmdir()
    target.mkdir()
    path.parent.symlink_to(target)


@pytest.mark.parametrize("make", [_link_to_a_file, _link_to_no_file, _fifo, _link_of_the_folder])
def test_request_opens_only_a_regular_file(
    tmp_path: Path,
    make: Callable[[Path, Path], None],
) -> None:
    """The folder belongs to the service's user, and the gateway may run as root."""
    path = request_file("can7")
    path.parent.mkdir(parents=True)
    target = tmp_path / "target"
    make(path, target)
    before = target.read_text() if target.is_file() else sorted(tmp_path.rglob("*"))
    request("can7")
    assert before == (target.read_text() if target.is_file() else sorted(tmp_path.rglob("*")))
    if make is not _link_of_the_folder:
        assert f"{path}: it is not a regular file. Remove it" in remedy("can7")


def test_ordinary_user_is_told_that_nobody_follows_the_request(
    kernel: Kernel,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    it = Hung(kernel)
    request("can0")
    it.hang()
    it.run(5, restarts=False)
    assert "Enable the unit: sudo systemctl enable --now" in caplog.text
    it.bench.can.close()
    it = Hung(kernel)
    it.hang()
    caplog.clear()
    monkeypatch.setattr(folders, "is_of_service", lambda purpose: purpose != FOLDER)
    it.run(5, restarts=False)
    assert "Only gateways of root and of the service's user can request a restart" in caplog.text
    assert "Enable the unit" not in caplog.text


@pytest.mark.parametrize(("restart_ms", "is_asked"), [(0, True), (100, False)])
def test_bus_off_is_restarted_only_if_it_does_not_end_by_itself(
    kernel: Kernel,  # noqa: F811
    restart_ms: int,
    is_asked: bool,
) -> None:
    it = Hung(kernel)
    it.bench.goes_off()
    assert kernel.facts is not None
    kernel.facts = kernel.facts._replace(restart_ms=restart_ms)
    it.bench.turn(1200)
    assert bool(it.asked) == is_asked
