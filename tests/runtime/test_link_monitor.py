"""rtnetlink messages: built here byte by byte, and the real kernel's about the loopback interface."""

import os
import select
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.gateway_status import CanState
from kontronik_can_gw.runtime import link_monitor
from kontronik_can_gw.runtime.link_monitor import LinkFacts, LinkMonitor


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def link_message(
    kind: int = 16, name: str = "can0", flags: int = 0x10041, can: bytes | None = b""
) -> bytes:
    info = b"" if can is None else attribute(18, attribute(1, b"can\0") + attribute(2, can))
    body = struct.pack("=BxHiII", 0, 280, 3, flags, 0) + attribute(3, name.encode() + b"\0") + info
    return struct.pack("=IHHII", 16 + len(body), kind, 0, 0, 0) + body


def can_data(
    state: int = 0,
    bitrate: int = 250_000,
    restart_ms: int = 100,
    counters: tuple[int, int] = (0, 0),
) -> bytes:
    timing = struct.pack("=8I", bitrate, 875, *range(6))
    parts = (
        attribute(1, timing)
        + attribute(4, struct.pack("=I", state))
        + attribute(6, struct.pack("=I", restart_ms))
    )
    return parts + attribute(8, struct.pack("=HH", *counters))


LINK = link_message(can=can_data())


class FakeSocket:
    def __init__(self, *datagrams: bytes | int) -> None:
        self.datagrams = list(datagrams)
        self.sent: list[bytes] = []

    def recv(self, _size: int) -> bytes:
        if not self.datagrams:
            raise BlockingIOError
        first = self.datagrams.pop(0)
        if isinstance(first, int):
            raise OSError(first, os.strerror(first))
        return first

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def close(self) -> None:
        pass


def monitor_of(*datagrams: bytes | int, name: str = "can0") -> tuple[LinkMonitor, FakeSocket]:
    monitor, fake = LinkMonitor(name), FakeSocket(*datagrams)
    monitor.close()
    monitor._socket = fake  # type: ignore[assignment]
    return monitor, fake


def heard(*datagrams: bytes | int, name: str = "can0") -> list[LinkFacts]:
    return monitor_of(*datagrams, name=name)[0].take()


@pytest.mark.parametrize(
    ("number", "state"),
    [
        (0, CanState.ERROR_ACTIVE),
        (2, CanState.ERROR_PASSIVE),
        (4, None),  # stopped
        (77, None),
    ],
)
def test_what_a_controller_reports(number: int, state: CanState | None) -> None:
    data = can_data(state=number, bitrate=125_000, restart_ms=0, counters=(130, 7))
    assert heard(link_message(can=data)) == [
        LinkFacts(True, True, "can", state, 125_000, 0, (130, 7))
    ]


@pytest.mark.parametrize("flags", [0x1, 0x41, 0x10001])
def test_a_controller_in_bus_off_is_up_and_does_not_run(flags: int) -> None:
    (facts,) = heard(link_message(can=can_data(state=3), flags=flags))
    assert (facts.up, facts.running, facts.state) == (True, False, CanState.BUS_OFF)


def test_other_interfaces_are_none_of_ours_and_a_removed_one_is_gone() -> None:
    datagram = (
        link_message(name="can1")
        + link_message()
        + link_message(kind=17, name="eth0")
        + link_message(kind=17)
    )
    assert [facts.exists for facts in heard(datagram)] == [True, False]


def test_after_an_overrun_the_kernel_is_asked_anew() -> None:
    monitor, fake = monitor_of(105, link_message())
    assert len(monitor.take()) == 1
    assert len(fake.sent) == 1


@given(st.integers(1, len(LINK)), st.integers(0, 255), st.integers(0, 200), st.binary(max_size=200))
def test_damage_and_rubbish_raise_nothing(end: int, value: int, place: int, rubbish: bytes) -> None:
    message = bytearray(LINK)
    message[min(place, len(message) - 1)] = value
    heard(bytes(message[:end]), rubbish or b"?")


def test_the_real_kernel_tells_of_an_interface_and_that_there_is_none() -> None:
    found = []
    for name in ("lo", "nocan77"):
        monitor = link_monitor.link_monitor(name)
        assert monitor is not None
        monitor.ask()
        assert select.select([monitor.fileno()], [], [], 2)[0]
        found.append(monitor.take()[-1])
        monitor.close()
    is_up = bool(int(Path("/sys/class/net/lo/flags").read_text(), 16) & 1)  # IFF_UP
    assert (found[0].exists, found[0].up, found[0].state) == (True, is_up, None)
    assert found[1] == LinkFacts(False)
