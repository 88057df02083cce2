"""The CAN port on a fake socket, and on python-can's in-process bus, which a thread reads."""

import errno
import itertools
import os
import queue
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import can
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import CanFrame, id_block
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.runtime.can import socketcan_port
from kontronik_can_gw.runtime.can.can_port import RECEIVE_LIMIT, CanPort
from kontronik_can_gw.runtime.can.open_can import QUEUE_LENGTH, DriverPort, OwnFrames, open_can
from kontronik_can_gw.runtime.can.socketcan_port import SocketCanPort
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS, SECOND

pytestmark = pytest.mark.promise("filters")

SOL = socket.SOL_SOCKET
EXTENDED = 0x80000000
REMOTE = 0x40000000
ERROR = 0x20000000
_numbers = itertools.count()


def wait_for(
    condition: Callable[[], bool],
    what: str,
    seconds: float = 120,
) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{what}: not within {seconds} s"
        time.sleep(0.002)


# --- a fake socket


class FakeSocket:
    """A raw CAN socket.

    ``inbox`` has the packets to receive and, as numbers, errors. ``drops`` counts the frames for
    which the kernel had no room.
    """

    def __init__(self) -> None:
        self.inbox: list[bytes | int] = []
        self.sent: list[bytes] = []
        self.full: int | None = None
        """The queue is full after this number of frames."""
        self.options: dict[int, bytes | int] = {}
        self.ancillary: list[tuple[int, int, bytes]] = []
        self.drops = 0
        self.fault = self.bind_fault = 0
        self.is_closed = False
        self.refusals: list[int] = []
        """Errors of the next sends."""

    def setsockopt(self, _level: int, name: int, value: bytes | int) -> None:
        if self.fault:
            raise OSError(self.fault, os.strerror(self.fault))
        self.options[name] = value

    def getsockopt(self, _level: int, _name: int, size: int) -> bytes:
        return struct.pack("=9I", *[0] * 8, self.drops)[:size]

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def fileno(self) -> int:
        return 99

    def close(self) -> None:
        self.is_closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def bind(self, _address: tuple[str]) -> None:
        if self.bind_fault:
            raise OSError(self.bind_fault, os.strerror(self.bind_fault))

    def send(self, data: bytes) -> None:
        if self.refusals:
            number = self.refusals.pop(0)
            raise OSError(number, os.strerror(number))
        if len(self.sent) == self.full:
            raise OSError(errno.ENOBUFS, "No buffer space available")
        self.sent.append(data)

    def recvmsg(
        self,
        _size: int,
        _ancillary_size: int,
    ) -> tuple[bytes, list[tuple[int, int, bytes]], int, None]:
        if not self.inbox:
            raise BlockingIOError
        data = self.inbox.pop(0)
        if isinstance(data, int):
            raise OSError(data, os.strerror(data))
        return data, self.ancillary, 0, None


def frames_of(port: CanPort) -> list[CanFrame]:
    """Receive frames and return them without their times."""
    return [frame for frame, _ in port.receive()]


@pytest.fixture
def fake() -> FakeSocket:
    return FakeSocket()


@pytest.fixture
def port(fake: FakeSocket) -> CanPort:
    return SocketCanPort(fake)  # type: ignore[arg-type]


def packet(can_id: int, data: bytes = b"") -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data)


def filters_of(fake: FakeSocket) -> list[tuple[int, int]]:
    packed = fake.options[socket.CAN_RAW_FILTER]
    assert isinstance(packed, bytes)
    return list(struct.iter_unpack("=II", packed))


def test_new_socket_receives_neither_data_frames_nor_its_own_frames(
    port: CanPort,
    fake: FakeSocket,
) -> None:
    """Its own frames would look as if another device used its ids."""
    assert fake.options[socket.CAN_RAW_FILTER] == b""
    assert fake.options[socket.CAN_RAW_RECV_OWN_MSGS] == 0
    assert fake.options[socket.SO_RCVBUF] == 1 << 20, (
        "frames wait there while the process is held up"
    )


@settings(max_examples=80)
@given(st.sets(st.integers(0, 0x7FF)), st.sets(st.integers(0, 0x1FFFFFFF), max_size=600))
@example(set(range(0x800)), set())
@example(set(range(0, 0x800, 2)), set())
@example(set(range(100, 612)), set())
@example(set(range(0, 3 * 513, 3)), set())
def test_any_ids_fit_into_the_kernels_filters(short_ids: set[int], long_ids: set[int]) -> None:
    ids = short_ids | {each | EXTENDED for each in long_ids}
    filters = socketcan_port.kernel_filters(frozenset(ids))
    assert len(filters) <= 512
    assert all(mask & (EXTENDED | REMOTE) == EXTENDED | REMOTE for _, mask in filters)
    by_mask: dict[int, set[int]] = {}
    for wanted, mask in filters:
        by_mask.setdefault(mask, set()).add(wanted & mask)

    def passes(can_id: int) -> bool:
        return any(can_id & mask in wanted for mask, wanted in by_mask.items())

    assert all(passes(each) for each in ids)
    if len(ids) <= 512:  # there is a filter for each
        assert {each for each in range(0x800) if passes(each)} == short_ids
        twins = {each | EXTENDED for each in short_ids} - ids
        assert not any(passes(each) for each in twins)


def test_only_data_frames_with_wanted_ids_are_received(port: CanPort, fake: FakeSocket) -> None:
    port.set_receive_ids({0x601, 0, 0x602 | EXTENDED, id_block(0x80AA, 0xFFFF)})
    assert (EXTENDED | 0x80AA, EXTENDED | REMOTE | 0xFFFF) in filters_of(fake), "one for a block"
    fake.inbox = [
        packet(0x601, b"abc"),
        packet(0x602, b"waited when the filter changed"[:8]),
        packet(0x601 | EXTENDED, b"x"),
        packet(0x601 | REMOTE),
        packet(0x602 | EXTENDED, b"y"),
        struct.pack("=IBB2x64s", 0x601, 6, 1, b"CAN FD"),
        packet(ERROR | 0x40, bytes(8)),
        packet(0x000, bytes(2)),
        packet(0x1E0180AA | EXTENDED, b"1"),
        packet(0x80AB | EXTENDED, b"another"),
        packet(0x0AA, b"11 bits"),
        packet(0x80AA | EXTENDED | REMOTE, b"remote"),
    ]
    assert frames_of(port) == [
        CanFrame(0x601, b"abc"),
        CanFrame(0x602, b"y", extended=True),
        CanFrame(0x601, b"CAN FD", fd=True),
        CanFrame(0x000, bytes(2)),
        CanFrame(0x1E0180AA, b"1", True),
    ]
    assert port.receive() == []
    assert port.state is CanState.BUS_OFF


def test_port_is_drained_when_nothing_waits(port: CanPort, fake: FakeSocket) -> None:
    port.set_receive_ids({1})
    fake.inbox = [packet(1), packet(ERROR | 0x04, b"\0\x10")] * RECEIVE_LIMIT
    found = [(len(port.receive()), port.is_drained) for _ in range(3)]
    assert found == [(RECEIVE_LIMIT // 2, False), (RECEIVE_LIMIT // 2, False), (0, True)]


@pytest.mark.parametrize(
    "number",
    [errno.ENETDOWN, errno.ENODEV, errno.EIO],
)
def test_error_does_not_end_reception(port: CanPort, fake: FakeSocket, number: int) -> None:
    port.set_receive_ids({1})
    fake.inbox = [packet(1, b"a"), number, packet(1, b"b")]
    assert frames_of(port) == [CanFrame(1, b"a")]
    assert port.state is (CanState.UNKNOWN if number == errno.EIO else CanState.DOWN)
    assert port.is_gone is (number == errno.ENODEV)
    assert frames_of(port) == [CanFrame(1, b"b")]
    assert port.send(CanFrame(2, b"")) is (Sent.GONE if number == errno.ENODEV else Sent.OK)
    fake.fault = errno.ENODEV
    port.set_receive_ids({1})
    assert port.is_gone, "an interface may go while filters are set, too"


def test_frames_are_sent_in_the_format_of_the_kernel(port: CanPort, fake: FakeSocket) -> None:
    assert port.send(CanFrame(0x6D8, b"abc")) is Sent.OK
    assert port.send(CanFrame(0x6D8, b"abcdefgh", extended=True)) is Sent.OK
    assert port.send(CanFrame(0x1, bytes(64), fd=True)) is Sent.OK
    assert struct.unpack("=IB3x8s", fake.sent[0]) == (0x6D8, 3, b"abc" + bytes(5))
    assert struct.unpack("=IB3x8s", fake.sent[1]) == (0x8000_06D8, 8, b"abcdefgh")
    assert struct.unpack("=IBB2x64s", fake.sent[2]) == (1, 64, 1, bytes(64))
    port.send(CanFrame(0x701, b"", remote=True))
    assert fake.sent[3] == packet(0x701 | REMOTE)
    assert port.state is CanState.ERROR_ACTIVE


@pytest.mark.parametrize(
    ("faults", "answer", "state"),
    [
        ([errno.ENOBUFS], Sent.BUSY, CanState.UNKNOWN),
        ([errno.ENOMEM], Sent.BUSY, CanState.UNKNOWN),
        ([errno.EAGAIN], Sent.FULL, CanState.UNKNOWN),
        ([errno.ENETDOWN], Sent.OK, CanState.ERROR_ACTIVE),  # an old report: it is up again
        ([errno.ENETDOWN] * 2, Sent.DOWN, CanState.DOWN),
        ([errno.ENXIO], Sent.GONE, CanState.DOWN),
        ([errno.ENODEV], Sent.GONE, CanState.DOWN),
        ([errno.EBADF], Sent.GONE, CanState.DOWN),
    ],
)
def test_error_of_the_kernel_shows_the_state_of_the_interface(
    port: CanPort,
    fake: FakeSocket,
    faults: list[int],
    answer: Sent,
    state: CanState,
) -> None:
    fake.refusals = list(faults)
    frame = CanFrame(1, b"\1")
    assert port.send(frame) == answer
    assert port.state == state
    if answer is not Sent.GONE:
        assert port.send(frame) is Sent.OK, "it is tried again"


@pytest.mark.parametrize(
    ("kind", "detail", "state"),
    [
        (0x40, 0, CanState.BUS_OFF),
        (0x100, 0, CanState.ERROR_ACTIVE),
        (0x04, 0x04, CanState.ERROR_WARNING),
        (0x04, 0x10, CanState.ERROR_PASSIVE),
        (0x04, 0x30, CanState.ERROR_PASSIVE),
        (0x04, 0x40, CanState.ERROR_ACTIVE),
        (0x04, 0x00, CanState.UNKNOWN),
        (0x20, 0x40, CanState.UNKNOWN),  # a missing acknowledge does not show the state
    ],
)
def test_error_frames_show_the_controllers_state_and_never_block_the_loop(
    port: CanPort,
    fake: FakeSocket,
    kind: int,
    detail: int,
    state: CanState,
) -> None:
    fake.inbox = [packet(ERROR | kind, bytes((0, detail)) + bytes(6)), b"short"] * 500
    assert port.receive() == []
    assert port.state is state
    assert port.bus_off_count == (state is CanState.BUS_OFF)
    assert len(fake.inbox) >= 900


@pytest.mark.parametrize(
    ("ancillary", "came"),
    [
        ([(SOL, 64, struct.pack("=qq", 1_700_000_000, 250_000_000))], 41_750 * MS),
        ([(SOL, 40, bytes(4)), (SOL, 64, struct.pack("=qq", 1_700_000_000, 0))], 41_500 * MS),
        ([(SOL, 64, bytes(3))], None),
        ([], None),
    ],
)
def test_kernels_time_of_a_frame_is_converted_to_the_monotonic_clock(
    port: CanPort,
    fake: FakeSocket,
    monkeypatch: pytest.MonkeyPatch,
    ancillary: list[tuple[int, int, bytes]],
    came: int | None,
) -> None:
    clock = SimpleNamespace(
        time_ns=lambda: 1_700_000_000_500_000_000,
        monotonic_ns=lambda: 42 * SECOND,
    )
    monkeypatch.setattr(socketcan_port, "time", clock)
    port.set_receive_ids({1})
    fake.inbox = [packet(1)]
    fake.ancillary = ancillary
    assert fake.options[64] == 1, "the kernel is asked for them"
    assert port.receive() == [(CanFrame(1, b""), came)]


def test_frames_lost_by_controller_or_kernel_are_counted_once(
    port: CanPort,
    fake: FakeSocket,
) -> None:
    port.set_receive_ids({1})
    fake.inbox = [packet(ERROR | 0x04, b"\0\x01")]
    port.receive()
    assert port.overruns == 1
    fake.drops = 5
    for expected in (2, 2):
        # Only if more frames wait than one call reads may the kernel have lost some.
        fake.inbox = [packet(1)] * (RECEIVE_LIMIT + 1)
        port.receive()
        assert port.overruns == expected


@pytest.fixture
def opened(fake: FakeSocket, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeSocket:
    """Return the socket that ``open_socketcan`` gets. tmp_path replaces /sys/class/net."""
    real = socket.socket

    def make(family: int, *rest: int) -> Any:
        return fake if family == socket.AF_CAN else real(family, *rest)

    monkeypatch.setattr(socket, "socket", make)
    monkeypatch.setattr(socketcan_port, "Path", lambda _, *parts: tmp_path.joinpath(*parts))
    (tmp_path / "lo").mkdir()
    (tmp_path / "can0").mkdir()
    (tmp_path / "can0" / "flags").write_text("0x1\n")
    (tmp_path / "can0" / "mtu").write_text("16\n")
    return fake


def test_interface_is_opened_with_error_frames_and_can_fd_if_asked(
    opened: FakeSocket,
    tmp_path: Path,
) -> None:
    socketcan_port.open_socketcan(CanConfig()).close()
    assert opened.options[socketcan_port._CAN_RAW_ERR_FILTER] == 0x1FFFFFFF
    assert socket.CAN_RAW_FD_FRAMES not in opened.options
    with pytest.raises(RunError, match="CAN FD is not switched on"):
        socketcan_port.open_socketcan(CanConfig(fd=True))
    (tmp_path / "can0" / "mtu").write_text("72\n")
    socketcan_port.open_socketcan(CanConfig(fd=True)).close()
    assert opened.options[socket.CAN_RAW_FD_FRAMES] == 1


def test_interface_that_cannot_be_used_leaves_no_socket_open(
    opened: FakeSocket,
    tmp_path: Path,
) -> None:
    (tmp_path / "can0" / "flags").write_text("0x0\n")
    with pytest.raises(RunError, match="can0: is down"):
        socketcan_port.open_socketcan(CanConfig())
    assert opened.is_closed
    (tmp_path / "can0" / "flags").write_text("0x1\n")
    opened.is_closed = False
    opened.bind_fault = errno.ENODEV
    with pytest.raises(RunError, match="does not exist"):
        socketcan_port.open_socketcan(CanConfig())
    assert opened.is_closed
    opened.is_closed = False
    opened.bind_fault = 0
    port = socketcan_port.open_socketcan(CanConfig())
    assert not opened.is_closed
    port.close()


FRAMES = [CanFrame(0x100 + n, bytes((n,))) for n in range(6)]


@pytest.mark.promise("late-frames")
@pytest.mark.parametrize("stopped_before", range(7))
def test_frames_that_became_late_in_a_turn_are_not_sent(
    port: CanPort,
    fake: FakeSocket,
    stopped_before: int,
) -> None:
    """The process is stopped before one of the frames. Only the earlier frames are sent."""
    steps = itertools.count()

    def clock() -> int:
        return 1000 if next(steps) < stopped_before else 1001

    answer = port.send_all(FRAMES, clock, 1000)
    if stopped_before == 6:
        assert answer == (6, Sent.OK)
    else:
        assert answer == (stopped_before, Sent.LATE)
    assert [data[8] for data in fake.sent] == list(range(stopped_before))[:6]


class DatagramSocket(socket.socket):
    """A socket whose waiting data the kernel counts in the same way as a CAN socket's."""

    def setsockopt(self, level: int, *rest: Any) -> None:
        if level != socket.SOL_CAN_RAW:
            super().setsockopt(level, *rest)


@pytest.mark.promise("six-frames")
def test_kernel_holds_at_most_six_frames() -> None:
    """Newer values cannot overtake frames that wait in the kernel."""
    ours, others = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with others, DatagramSocket(fileno=ours.detach()) as mine:
        port = SocketCanPort(mine)
        answers = [port.send(CanFrame(n, bytes(8))) for n in range(30)]
    taken = answers.index(Sent.FULL)
    assert 1 <= taken <= 6
    assert set(answers[taken:]) == {Sent.FULL}


# --- python-can's own bus, read by a thread


def readers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "can-reader"]


@contextmanager
def virtual() -> Iterator[tuple[DriverPort, can.BusABC]]:
    """Yield a port on a separate bus, and another participant of that bus."""
    channel = f"reception-{os.getpid()}-{next(_numbers)}"
    port = open_can(CanConfig("virtual", channel))
    assert isinstance(port, DriverPort)
    try:
        with can.Bus(interface="virtual", channel=channel) as other:
            yield port, other
    finally:
        port.close()
    assert readers() == [], "a thread was left"


def readable(port: CanPort, seconds: float = 120) -> bool:
    fd = port.fileno()
    assert fd is not None
    return bool(select.select([fd], [], [], seconds)[0])


def receive(port: CanPort, count: int) -> list[CanFrame]:
    """Wait for this number of frames at the descriptor, as a loop does."""
    frames: list[CanFrame] = []
    while len(frames) < count:
        assert readable(port), f"{len(frames)} of {count} frames"
        frames += frames_of(port)
    return frames


def message(can_id: int, data: bytes = b"", **flags: Any) -> can.Message:
    flags.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=can_id, data=data, **flags)


def test_python_can_interface_that_refuses_a_frame_is_busy() -> None:
    class Refusing:
        def send(self, _message: can.Message, timeout: float) -> None:
            assert timeout == 0
            raise can.CanOperationError("full")

    refusing = DriverPort(Refusing())  # type: ignore[arg-type]
    assert refusing.fileno() is None
    assert refusing.send(CanFrame(1, b"")) is Sent.BUSY


class ReturningBus:
    """A bus that returns each sent frame like a frame of another device, as udp_multicast does."""

    def __init__(self) -> None:
        self.inbox: queue.Queue[can.Message] = queue.Queue()
        self.is_full = False

    def set_filters(self, _filters: object) -> None: ...

    def shutdown(self) -> None: ...

    def recv(self, timeout: float) -> can.Message | None:
        try:
            return self.inbox.get(timeout=timeout)
        except queue.Empty:
            return None

    def send(self, sent: can.Message, timeout: float) -> None:
        if self.is_full:
            raise can.CanOperationError("full")
        self.inbox.put(sent)


def test_frames_that_the_interface_returns_are_not_received() -> None:
    bus = ReturningBus()
    port = DriverPort(bus, OwnFrames())  # type: ignore[arg-type]
    own = CanFrame(0x680, b"own", page=2)
    other = CanFrame(0x680, b"other")
    try:
        port.set_receive_ids({0x680})
        for _ in range(3):
            assert port.send(own) is Sent.OK
        bus.send(message(0x680, b"other"), 0)
        assert receive(port, 1) == [other]
        bus.is_full = True
        assert port.send(own) is Sent.BUSY
        bus.is_full = False
        bus.send(message(0x680, b"own"), 0)  # another device sends the same frame
        assert receive(port, 1) == [own._replace(page=0)]
    finally:
        port.close()


def test_identical_frame_of_another_device_is_received() -> None:
    own_frames = OwnFrames()
    frame = CanFrame(0x680, b"same")
    own_frames.add(frame, 0)
    assert [own_frames.take(frame) for _ in range(2)] == [True, False]
    own_frames.add(frame, 0)
    own_frames.add(CanFrame(0x681, b""), 11 * SECOND)
    assert not own_frames.take(frame), "it was lost ten seconds ago"


@pytest.mark.parametrize(
    ("interface", "returns"),
    [
        ("udp_multicast", True),
        ("virtual", False),
    ],
)
def test_udp_multicast_is_known_to_return_own_frames(
    interface: str,
    returns: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No packet leaves this process: the bus is simulated."""
    monkeypatch.setattr(can, "Bus", lambda **_: ReturningBus())
    port = open_can(CanConfig(interface, "x"))
    try:
        port.set_receive_ids({0x680})
        assert port.send(CanFrame(0x680, b"own")) is Sent.OK
        assert port.send(CanFrame(0x680, b"last")) is Sent.OK
        port._bus.inbox.put(message(0x680, b"other"))  # type: ignore[attr-defined]
        expected = [CanFrame(0x680, data) for data in (b"own", b"last", b"other")]
        if returns:
            expected = expected[2:]
        assert receive(port, len(expected)) == expected
    finally:
        port.close()


def test_one_thread_delivers_the_wanted_frames_in_order() -> None:
    with virtual() as (port, other):
        port.set_receive_ids(frozenset())
        assert port.fileno() is None
        assert port.receive() == []
        assert readers() == []
        port.set_receive_ids({0x601})
        port.set_receive_ids({0x601, 0x602, id_block(0x80AA, 0xFFFF)})
        assert len(readers()) == 1
        assert not port.is_socket, "a descriptor to wait on does not mean that it can send"
        for n in range(100):
            other.send(message(0x123, b"foreign"))
            other.send(message(0x601, is_extended_id=True))
            other.send(message(0x80AB, is_extended_id=True))
            other.send(message(0x601, is_remote_frame=True))
            other.send(message(0x601, is_error_frame=True))
            other.send(message(0x601 + n % 2, bytes((n,))))
        assert receive(port, 100) == [CanFrame(0x601 + n % 2, bytes((n,))) for n in range(100)]
        other.send(message(0x1F0180AA, is_extended_id=True))
        assert receive(port, 1) == [CanFrame(0x1F0180AA, b"", extended=True)]
        assert not readable(port, 0)
        port.set_receive_ids({0x603})
        other.send(message(0x601))
        other.send(message(0x603))
        assert receive(port, 1) == [CanFrame(0x603, b"")]


def test_threads_queue_is_bounded_and_keeps_the_oldest_frames() -> None:
    with virtual() as (port, other):
        port.set_receive_ids({1})
        for n in range(QUEUE_LENGTH + 20):
            other.send(message(1, n.to_bytes(2, "little")))
        wait_for(lambda: port._dropped == 20, "20 dropped frames")
        frames: list[CanFrame] = []
        while len(frames) < QUEUE_LENGTH:
            assert readable(port), "what is left keeps the descriptor readable"
            part = frames_of(port)
            assert 0 < len(part) <= RECEIVE_LIMIT
            frames += part
        assert not readable(port, 0)
        numbers = [int.from_bytes(frame.data, "little") for frame in frames]
        assert numbers == list(range(QUEUE_LENGTH))
        assert port.overruns == 1


@pytest.mark.parametrize(
    "error",
    [can.CanOperationError("unplugged"), OSError(errno.EIO, "I/O"), TypeError("closed")],
)
def test_adapter_that_fails_is_reported_as_gone(
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
) -> None:
    with virtual() as (port, other):
        port.set_receive_ids({1})
        other.send(message(1, b"before"))
        assert receive(port, 1) == [CanFrame(1, b"before")]

        def failing(timeout: float | None) -> None:
            raise error

        monkeypatch.setattr(port._bus, "recv", failing)
        assert readable(port), "the loop is woken"
        assert port.receive() == []
        assert port.is_gone
        assert port.state == CanState.DOWN
        wait_for(lambda: readers() == [], "the thread's end")
        assert port.send(CanFrame(2, b"")) is Sent.GONE


def test_frames_are_filtered_here_if_the_driver_cannot_filter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[object] = []

    def no_lists(filters: object) -> None:
        asked.append(filters)
        if filters is not None or len(asked) > 2:
            raise can.CanOperationError("no")

    with virtual() as (port, other):
        monkeypatch.setattr(port._bus, "set_filters", no_lists)
        port.set_receive_ids({1})
        assert asked == [[{"can_id": 1, "can_mask": 0x7FF, "extended": False}], None]
        assert not port.is_gone
        other.send(message(2))
        other.send(message(1))
        assert receive(port, 1) == [CanFrame(1, b"")]
        port.set_receive_ids({2})
        assert port.is_gone
