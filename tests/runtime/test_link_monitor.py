"""rtnetlink messages: some are built here byte by byte, others come from the real kernel."""

import os
import select
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kontronik_can_gw.runtime.can import link_monitor
from kontronik_can_gw.runtime.can.link_monitor import LinkFacts, LinkMonitor
from kontronik_can_gw.status import CanState

pytestmark = pytest.mark.promise("interface-reopens")


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def link_message(
    kind: int = 16,
    name: str = "can0",
    flags: int = 0x10041,
    can: bytes | None = b"",
) -> bytes:
    info = b""
    if can is not None:
        info = attribute(18, attribute(1, b"can\0") + attribute(2, can))
    head = struct.pack("=BxHiII", 0, 280, 3, flags, 0)
    body = head + attribute(3, name.encode() + b"\0") + info
    return struct.pack("=IHHII", 16 + len(body), kind, 0, 0, 0) + body


def can_data(state: int = 0) -> bytes:
    """Return the attributes of a controller at 125 kbit/s without automatic restart.

    Its error counters are 130 and 7.
    """
    parts = {
        1: struct.pack("=8I", 125_000, 875, *range(6)),
        4: struct.pack("=I", state),
        6: bytes(4),
        8: struct.pack("=HH", 130, 7),
    }
    return b"".join(attribute(kind, value) for kind, value in parts.items())


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


def monitor_of(*datagrams: bytes | int) -> tuple[LinkMonitor, FakeSocket]:
    monitor = LinkMonitor("can0")
    fake = FakeSocket(*datagrams)
    monitor.close()
    monitor._socket = fake  # type: ignore[assignment]
    return monitor, fake


def heard(*datagrams: bytes | int) -> list[LinkFacts]:
    return monitor_of(*datagrams)[0].take()


@pytest.mark.parametrize(
    ("number", "flags", "state", "runs"),
    [
        (0, 0x10041, CanState.ERROR_ACTIVE, True),
        (2, 0x10041, CanState.ERROR_PASSIVE, True),
        (3, 0x1, CanState.BUS_OFF, False),
        (3, 0x41, CanState.BUS_OFF, False),
        (3, 0x10001, CanState.BUS_OFF, False),
        (4, 0x10041, None, True),  # stopped
        (77, 0x10041, None, True),
    ],
)
def test_state_of_a_controller_is_read_from_its_report(
    number: int,
    flags: int,
    state: CanState | None,
    runs: bool,
) -> None:
    """An interface in bus-off is up but does not run."""
    expected = LinkFacts(
        True,
        True,
        "can",
        state,
        125_000,
        0,
        (130, 7),
        runs,
    )
    assert heard(link_message(can=can_data(number), flags=flags)) == [expected]


def test_other_interfaces_are_ignored_and_a_removed_one_is_gone() -> None:
    others = link_message(name="can1") + link_message(kind=17, name="eth0")
    datagram = others + link_message() + link_message(kind=17)
    assert [facts.exists for facts in heard(datagram)] == [True, False]


def test_kernel_is_asked_again_after_an_overrun() -> None:
    monitor, fake = monitor_of(105, link_message())
    assert len(monitor.take()) == 1
    assert len(fake.sent) == 1


@given(st.integers(1, len(LINK)), st.integers(0, 255), st.integers(0, 200), st.binary(max_size=200))
def test_damaged_messages_raise_no_exception(
    end: int,
    value: int,
    place: int,
    rubbish: bytes,
) -> None:
    message = bytearray(LINK)
    message[min(place, len(message) - 1)] = value
    heard(bytes(message[:end]), rubbish or b"?")


def test_real_kernel_reports_an_interface_and_a_missing_one() -> None:
    found = []
    for name in ("lo", "nocan77"):
        monitor = link_monitor.link_monitor(name)
        assert monitor is not None
        monitor.ask()
        assert select.select([monitor.fileno()], [], [], 2)[0]
        found.append(monitor.take()[-1])
        monitor.close()
    is_up = bool(int(Path("/sys/class/net/lo/flags").read_text(), 16) & 1)  # IFF_UP
    assert found[0].exists
    assert found[0].up == is_up
    assert found[0].state is None
    assert found[1] == LinkFacts(False)
