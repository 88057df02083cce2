"""An interface whose driver takes long to open or close delays neither ports nor loop.

The ports are real, the driver is simulated, and slcan runs on a pseudo terminal.
"""

import os
import pty
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from can.interfaces import slcan
from wire_world import Bus, World, layout_of

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.can import can_link, can_opener
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.runtime.native_poller import poller_for
from kontronik_can_gw.runtime.system.sd_notify import Notifier
from kontronik_can_gw.times import SECOND

pytestmark = pytest.mark.promise("slow-drivers")

ESCS = (EscSettings("esc1", timeout_ns=60_000_000_000),)
LIMIT_S = 60
"""Time limit in s. Only a hang takes that long."""


class Driver:
    """A driver of python-can that opens, and closes, only when it is allowed to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun = threading.Event()
        self.may_open = threading.Event()
        self.may_close = threading.Event()
        self.opened = 0
        self.closed_by: list[str] = []
        """Names of the threads that closed it."""
        self.error: RunError | None = None
        self.bus = SlowBus(self)
        monkeypatch.setattr(can_opener, "open_can", self._open)

    def _open(self, _config: CanConfig) -> Bus:
        assert threading.current_thread().name == "can-opener"
        self.begun.set()
        assert self.may_open.wait(LIMIT_S)
        if self.error is not None:
            raise self.error
        self.opened += 1
        return self.bus


class SlowBus(Bus):
    is_socket = False

    def __init__(self, driver: Driver) -> None:
        super().__init__(World())
        self.driver = driver

    def fileno(self) -> int | None:  # type: ignore[override]
        return None

    def close(self) -> None:
        assert self.driver.may_close.wait(LIMIT_S)
        self.driver.closed_by.append(threading.current_thread().name)


class Status(Notifier):
    def __init__(self) -> None:
        super().__init__({})
        self.is_ready = False

    def ready(self, status: str = "") -> None:
        self.is_ready = True


@pytest.fixture
def uart() -> Iterator[tuple[int, str]]:
    """Yield a serial port: the descriptor of the ESC's side, the path of the gateway's side."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


class Running:
    """A loop with one port. The test runs each iteration."""

    def __init__(
        self,
        uart: tuple[int, str],
        interface: str,
        channel: str,
        wait: bool,
    ) -> None:
        self.esc, path = uart
        self.status = Status()
        gateway = Gateway(CoreSettings(ESCS, layout_of(ESCS)), 0)
        config = CanConfig(interface=interface, channel=channel)
        poller = poller_for(gateway)
        self.loop = Loop(
            gateway,
            [path],
            config,
            wait,
            poller=poller,
            notifier=self.status,
        )
        self.loop.open()
        self.loop.begin()
        self.sent = 0

    def turn_until(self, condition: Callable[[], bool]) -> None:
        """Turn the loop, woken by a frame of the ESC each time, until the condition holds.

        The opener is a thread, so how many iterations it takes depends on the machine. Only a hang
        reaches the limit.
        """
        end = time.monotonic() + LIMIT_S
        while time.monotonic() < end:
            if condition():
                return
            self.feed()
            self.loop.turn()
        raise AssertionError("it did not happen")

    def feed(self) -> None:
        self.sent += 1
        os.write(self.esc, encode(LiveData(electrical_speed=self.sent), WireLayout.V4))
        assert select.select([], [self.esc], [], LIMIT_S)[1]

    @property
    def received(self) -> int:
        return int(self.loop.gateway.escs[0].counters.live)


def wait_for_opener() -> None:
    """Wait until the opener's thread has ended. The loop does not wait for it."""
    for thread in threading.enumerate():
        if thread.name == "can-opener":
            thread.join(LIMIT_S)


@pytest.mark.parametrize("wait", [True, False])
def test_ports_are_served_while_a_driver_opens_and_frames_follow(
    wait: bool,
    uart: tuple[int, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(monkeypatch)
    driver.may_close.set()
    it = Running(uart, "slcan", "/dev/none", wait)
    it.turn_until(lambda: it.received >= 50)
    assert not it.loop.can.is_open
    assert it.received == it.sent, "nothing is lost meanwhile"
    assert it.status.is_ready == wait
    driver.may_open.set()
    it.turn_until(lambda: bool(driver.bus.sent))
    assert it.loop.can.is_open
    assert it.status.is_ready
    it.loop.end()
    wait_for_opener()
    assert driver.opened == 1
    assert driver.closed_by == ["can-opener"]


def test_driver_that_takes_long_to_close_does_not_hold_up_the_end(
    uart: tuple[int, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thread is not joined. It ends with the process, or when the driver has returned."""
    driver = Driver(monkeypatch)
    driver.may_open.set()
    it = Running(uart, "slcan", "/dev/none", wait=True)
    it.turn_until(lambda: bool(driver.bus.sent))
    it.loop.end()
    assert driver.closed_by == [], "the end did not wait for it"
    driver.may_close.set()
    wait_for_opener()
    assert driver.closed_by == ["can-opener"]


def test_driver_that_fails_at_start_ends_a_loop_that_may_not_wait(
    uart: tuple[int, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(monkeypatch)
    driver.error = RunError("CAN slcan /dev/none: cannot be opened: there is none.")
    driver.may_open.set()
    it = Running(uart, "slcan", "/dev/none", wait=False)
    with pytest.raises(RunError, match="there is none"):
        it.turn_until(lambda: False)
    assert not it.status.is_ready
    it.loop.end()
    it = Running(uart, "slcan", "/dev/none", wait=True)
    it.turn_until(lambda: it.loop.can.due < 1 << 62)
    assert "there is none. Trying again." in "".join(it.loop.conditions.recent)
    driver.error = None
    driver.may_close.set()
    it.turn_until(lambda: bool(driver.bus.sent))
    it.loop.end()


@pytest.mark.promise("interface-reopens")
def test_lost_driver_is_closed_beside_the_loop_and_opened_again(
    uart: tuple[int, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(monkeypatch)
    driver.may_open.set()
    it = Running(uart, "slcan", "/dev/none", wait=True)
    it.turn_until(lambda: bool(driver.bus.sent))
    driver.bus.answer = Sent.GONE
    it.turn_until(lambda: not it.loop.can.is_open)
    before = it.received
    it.turn_until(lambda: it.received >= before + 50)
    assert (driver.opened, driver.closed_by) == (1, []), "it still closes"
    driver.bus.answer = Sent.OK
    count = len(driver.bus.sent)
    driver.may_close.set()
    it.turn_until(lambda: len(driver.bus.sent) > count)
    assert driver.opened == 2
    assert driver.closed_by == ["can-opener"]
    it.loop.end()


def test_port_that_opens_after_the_end_is_closed(
    uart: tuple[int, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(monkeypatch)
    driver.may_close.set()
    it = Running(uart, "slcan", "/dev/none", wait=True)
    assert driver.begun.wait(LIMIT_S)
    it.loop.end()
    driver.may_open.set()
    wait_for_opener()
    assert driver.opened == 1
    assert driver.closed_by == ["can-opener"]


@pytest.mark.parametrize("error", [None, RunError("CAN slcan /dev/none: there is none.")])
def test_driver_that_does_not_return_from_opening_is_logged(
    error: RunError | None,
    uart: tuple[int, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(can_link, "SLOW_OPENING_NS", 1000 * SECOND)  # no test takes that long
    driver = Driver(monkeypatch)
    driver.may_close.set()
    before = time.monotonic_ns()
    it = Running(uart, "slcan", "/dev/none", wait=True)
    after = time.monotonic_ns()
    it.turn_until(lambda: it.received >= 1)
    it.loop._housekeeping.run(before + 999 * SECOND)
    told = [line for line in it.loop.conditions.recent if "CAN" in line]
    assert told == []
    for seconds in (1000, 1001):
        it.loop._housekeeping.run(after + seconds * SECOND)
    (line,) = (line for line in it.loop.conditions.recent if "CAN" in line)
    assert "CAN slcan /dev/none: still opening, because the driver does not return." in line
    driver.error = error
    driver.may_open.set()
    it.turn_until(lambda: len([line for line in it.loop.conditions.recent if "CAN" in line]) > 1)
    last = [line for line in it.loop.conditions.recent if "CAN" in line][1]
    expected = "CAN slcan /dev/none is open, after " if error is None else f"{error} Trying again."
    assert expected in last
    assert not it.loop.conditions.is_on(it.loop.can.opening_condition)
    it.loop.end()


class Slcan(threading.Thread):
    """An slcan adapter on a pseudo terminal that acknowledges commands and frames.

    ``frames`` has the frames that it received.
    """

    def __init__(self, link: Path) -> None:
        super().__init__(daemon=True)
        self.frames: list[bytes] = []
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        link.symlink_to(os.ttyname(self._slave))

    def run(self) -> None:
        waiting = b""
        while True:
            try:
                waiting += os.read(self._master, 4096)
            except OSError:
                return
            *lines, waiting = waiting.split(b"\r")
            for line in lines:
                is_frame = line[:1] in (b"t", b"T")
                if is_frame:
                    self.frames.append(line)
                os.write(self._master, b"z\r" if is_frame else b"\r")


class Clock:
    """Replacement for the module `time` in python-can's slcan driver. The test ends its sleep."""

    time = staticmethod(time.time)

    def __init__(self, may_wake: threading.Event) -> None:
        self._may_wake = may_wake

    def sleep(self, seconds: float) -> None:
        assert seconds >= 1, "the driver has slept for two seconds so far"
        assert self._may_wake.wait(LIMIT_S)


def test_slcan_sleeps_while_it_opens_and_no_byte_is_lost(
    uart: tuple[int, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """python-can's driver sleeps after it has opened the port, here until the test wakes it."""
    may_wake = threading.Event()
    monkeypatch.setattr(slcan, "time", Clock(may_wake))
    adapter = Slcan(tmp_path / "slcan")
    adapter.start()
    it = Running(uart, "slcan", str(tmp_path / "slcan"), wait=False)
    it.turn_until(lambda: it.received >= 50)
    assert it.received == it.sent
    assert not it.loop.can.is_open
    may_wake.set()
    it.turn_until(lambda: bool(adapter.frames))
    it.loop.end()
    assert it.received >= it.sent - 1, "the last one may not be read yet"
    counters: Mapping[str, Any] = it.loop.gateway.escs[0].counters.as_dict()
    assert counters["dropped_bytes"] == counters["crc_errors"] == 0
