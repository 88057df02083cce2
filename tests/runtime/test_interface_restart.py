"""Requests to restart an interface from which no frame leaves: times, numbers, log lines."""

import logging
import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from test_can_link import ACTIVE, Bench, Kernel, kernel, locks_of_its_own  # noqa: F401  fixtures

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.runtime.can.interface_restart import (
    FOLDER,
    MAX_PAUSE_NS,
    InterfaceRestart,
    remedy,
    request,
    request_file,
)
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts
from kontronik_can_gw.runtime.system import folders
from kontronik_can_gw.runtime.system.fault_log import FaultLog
from kontronik_can_gw.times import MS, SECOND


class Hung:
    """An interface that sends nothing, and a restart after half a second."""

    def __init__(self, kernel: Kernel, after_s: float = 0.5) -> None:  # noqa: F811
        self.asked: list[int] = []
        self.bench = Bench(kernel)
        self.gateway = self.bench.gateway
        self.restart = InterfaceRestart(
            CanConfig(restart_after_s=after_s), self.gateway, FaultLog(), self._ask
        )
        self.begin = 5 * SECOND

    def _ask(self, channel: str) -> None:
        assert channel == "can0"
        self.asked.append(self.now)

    def run(self, seconds: float, restarts: bool) -> list[float]:
        """Let the outage last. Return the times of the requests after its begin, in seconds."""
        since = self.begin
        for ms in range(round(seconds * 1000)):
            self.now = self.begin + ms * MS
            count = len(self.asked)
            self.restart.follow(since, self.now)
            if restarts and len(self.asked) > count:
                self.restart.went_down(self.now + 20 * MS)
                since = self.now + 40 * MS
        return [(at - self.begin) / SECOND for at in self.asked]


def test_the_first_restart_is_in_time_and_later_ones_back_off(kernel: Kernel) -> None:  # noqa: F811
    it = Hung(kernel)
    asked = it.run(60, restarts=True)
    pauses = [round(after - before, 2) for before, after in pairwise(asked)]
    assert asked[0] == 0.5
    assert pauses[:5] == [1.04, 2.04, 4.04, 8.04, 10.04]
    assert set(pauses[5:]) == {MAX_PAUSE_NS / SECOND + 0.04}
    assert it.gateway.status.can_restarts == len(asked)
    it.restart.follow(None, it.now)
    it.asked.clear()
    it.begin = it.now
    assert it.run(1, restarts=True) == [0.5], "a frame has left, so the pause is short again"


def test_an_outage_is_reported_once_and_its_restarts_at_its_end(
    kernel: Kernel,  # noqa: F811
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    it = Hung(kernel)
    it.run(30, restarts=True)
    it.restart.follow(None, it.now)
    assert caplog.messages == [
        "CAN can0: no frame left it, so it is restarted",
        f"CAN can0: works again after {len(it.asked)} restarts",
    ]


def test_a_missing_unit_is_reported_once_with_the_remedy(
    kernel: Kernel,  # noqa: F811
    caplog: pytest.LogCaptureFixture,
) -> None:
    it = Hung(kernel)
    it.run(60, restarts=False)
    (line,) = caplog.messages
    assert "sudo systemctl enable --now kontronik-can-gw-restart@can0.path" in line
    assert it.gateway.status.can_restarts == 0


def test_requests_without_an_answer_back_off(kernel: Kernel) -> None:  # noqa: F811
    asked = Hung(kernel).run(60, restarts=False)
    assert asked[0] == 0.5
    pauses = [after - before for before, after in pairwise(asked)]
    assert pauses[:2] == [4.0, 8.0]
    assert set(pauses[2:]) == {MAX_PAUSE_NS / SECOND}


def test_an_outage_does_not_end_while_the_gateway_holds_its_frames(
    kernel: Kernel,  # noqa: F811
    caplog: pytest.LogCaptureFixture,
) -> None:
    """In quiet mode, no first frame is sent after a restart, so no frame shows that it worked."""
    caplog.set_level(logging.INFO, "kontronik_can_gw")
    it = Hung(kernel)
    it.run(1, restarts=True)
    it.gateway.hold(it.now)
    it.restart.follow(None, it.now)
    assert caplog.messages == ["CAN can0: no frame left it, so it is restarted"]
    it.gateway.release(it.now)
    it.restart.follow(None, it.now)
    assert caplog.messages[1:] == ["CAN can0: works again after one restart"]


@pytest.mark.parametrize(("after_s", "interface"), [(0, "socketcan"), (0.5, "virtual")])
def test_nothing_is_requested_without_the_key_or_socketcan(
    kernel: Kernel,  # noqa: F811
    after_s: float,
    interface: str,
) -> None:
    it = Hung(kernel)
    config = CanConfig(interface=interface, restart_after_s=after_s)
    it.restart = InterfaceRestart(config, it.gateway, FaultLog(), it._ask)
    assert it.run(30, restarts=False) == []


def test_an_interface_that_another_program_restarts_is_not_counted(
    kernel: Kernel,  # noqa: F811
) -> None:
    it = Hung(kernel)
    it.restart.went_down(it.begin)
    assert it.gateway.status.can_restarts == 0


def test_a_link_that_hangs_asks_for_a_restart_and_counts_it(kernel: Kernel) -> None:  # noqa: F811
    bench = Bench(kernel)
    asked: list[str] = []
    bench.can._restart = InterfaceRestart(
        CanConfig(restart_after_s=0.5), bench.gateway, FaultLog(), asked.append
    )
    bench.begin()
    bench.port.frame_ns = MS // 4
    bench.port.block()
    bench.turn(1200)
    assert asked == ["can0"]
    bench.changes(LinkFacts(exists=True, up=False))
    bench.turn(30)
    bench.changes(ACTIVE)
    bench.turn(300)
    assert bench.gateway.status.can_restarts == 1
    assert not bench.gateway.is_held


def test_a_request_changes_the_file_of_the_interface(tmp_path: Path) -> None:
    request("can7")
    first = request_file("can7").stat().st_mtime_ns
    assert request_file("can7") == tmp_path / "run/kontronik-can-gw/restart/can7"
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
def test_a_request_opens_only_a_regular_file(
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


def test_an_ordinary_user_is_told_that_nobody_follows_the_request(
    kernel: Kernel,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    it = Hung(kernel)
    request("can0")
    it.run(5, restarts=False)
    assert "Enable the unit: sudo systemctl enable --now" in caplog.text
    it.restart = InterfaceRestart(CanConfig(restart_after_s=0.5), it.gateway, FaultLog(), it._ask)
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
    bench = Bench(kernel)
    asked: list[str] = []
    bench.can._restart = InterfaceRestart(
        CanConfig(restart_after_s=0.5), bench.gateway, FaultLog(), asked.append
    )
    bench.begin()
    bench.goes_off()
    assert kernel.facts is not None
    kernel.facts = kernel.facts._replace(restart_ms=restart_ms)
    bench.turn(1200)
    assert bool(asked) == is_asked
