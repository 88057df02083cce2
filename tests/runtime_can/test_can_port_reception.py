"""Reception of the CAN port: on a socket that is none, and with python-can's in-process bus, whose reader is a thread."""

import errno
import itertools
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import can
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kontronik_can_gw.config import CanConfig
from kontronik_can_gw.dbc_output.layout import Layout
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway import Gateway
from kontronik_can_gw.mailboxes import Sent
from kontronik_can_gw.offline.pty import PtyEsc
from kontronik_can_gw.runtime import can_port, can_side
from kontronik_can_gw.runtime.bus_reader import QUEUE_LENGTH
from kontronik_can_gw.runtime.can_port import RECEIVE_LIMIT, CanPort, one_by_one
from kontronik_can_gw.runtime.link_monitor import LinkFacts
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.sources import CanState
from kontronik_can_gw.telemetry import MS, SECOND, EscSettings

EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
NO_MESSAGES = Layout("x", "Gw", ())
_numbers = itertools.count()


def wait_for(condition: Callable[[], bool], what: str, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{what}: not within {seconds} s"
        time.sleep(0.002)


# --- a socket that is none


class FakeSocket:
    """A raw CAN socket: ``inbox`` is what comes (numbers are errors), ``drops`` what the kernel had no room for."""

    def __init__(self) -> None:
        self.inbox: list[bytes | int] = []
        self.sent: list[bytes] = []
        self.options: dict[int, bytes | int] = {}
        self.ancillary: list[tuple[int, int, bytes]] = []
        self.drops = 0
        self.fault = 0

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

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def recvmsg(self, _size: int, _ancillary_size: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, None]:
        if not self.inbox:
            raise BlockingIOError
        data = self.inbox.pop(0)
        if isinstance(data, int):
            raise OSError(data, os.strerror(data))
        return data, self.ancillary, 0, None


def frames_of(port: CanPort) -> list[CanFrame]:
    """What comes, without its times."""
    return [frame for frame, _ in port.receive()]


@pytest.fixture
def socket_port(monkeypatch: pytest.MonkeyPatch) -> tuple[CanPort, FakeSocket]:
    fake = FakeSocket()
    monkeypatch.setattr(can_port, "_open", lambda _: SimpleNamespace(socket=fake))
    return CanPort(CanConfig()), fake


def packet(can_id: int, data: bytes = b"") -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data)


def filters_of(fake: FakeSocket) -> list[tuple[int, int]]:
    packed = fake.options[socket.CAN_RAW_FILTER]
    assert isinstance(packed, bytes)
    return list(struct.iter_unpack("=II", packed))


def test_a_filter_names_each_id_and_shuts_out_its_29_bit_and_remote_twins(
    socket_port: tuple[CanPort, FakeSocket],
) -> None:
    port, fake = socket_port
    port.set_receive_ids({0x601, 0x000, 0x80})
    assert filters_of(fake) == [(can_id, 0xC00007FF) for can_id in (0x000, 0x80, 0x601)]
    port.set_receive_ids(frozenset())
    assert filters_of(fake) == []
    assert fake.options[socket.CAN_RAW_RECV_OWN_MSGS] == 0


@settings(deadline=None)  # a busy machine is no fault
@given(st.sets(st.integers(0, 0x7FF)))
@example(set(range(0x800)))
@example(set(range(0, 0x800, 2)))
@example(set(range(100, 612)))
@example(set(range(0, 3 * 513, 3)))
def test_any_set_of_ids_fits_into_the_kernels_filters(ids: set[int]) -> None:
    filters = can_port._kernel_filters(frozenset(ids))
    assert len(filters) <= 512
    by_mask: dict[int, set[int]] = {}
    for wanted, mask in filters:
        by_mask.setdefault(mask, set()).add(wanted & mask)
    through = {each for each in range(0x800) if any(each & mask in wanted for mask, wanted in by_mask.items())}
    assert ids <= through
    assert len(ids) > 512 or through == ids
    assert all(mask & (EXTENDED | REMOTE) == EXTENDED | REMOTE for _, mask in filters)


@settings(max_examples=50, deadline=None)
@given(st.sets(st.integers(0, 0x1FFFFFFF), max_size=600), st.sets(st.integers(0, 0x7FF), max_size=300))
def test_ids_of_both_lengths_fit_too_and_are_not_mixed_up(long_ids: set[int], short_ids: set[int]) -> None:
    ids = frozenset({each | EXTENDED for each in long_ids} | short_ids)
    filters = can_port._kernel_filters(ids)
    assert len(filters) <= 512
    for each in ids:
        assert any(each & mask == wanted & mask for wanted, mask in filters)
    if len(ids) <= 512:
        for each in ids:
            other = each ^ EXTENDED
            if EXTENDED > other > 0x7FF:
                continue
            assert other in ids or not any(other & mask == wanted & mask for wanted, mask in filters)


@pytest.mark.parametrize("wrong", [-1, 0x800, EXTENDED - 1, EXTENDED | 0x2000_0000, 1 << 32])
def test_what_is_no_id_is_refused(socket_port: tuple[CanPort, FakeSocket], wrong: int) -> None:
    with pytest.raises(ValueError, match="no identifiers"):
        socket_port[0].set_receive_ids([0x601, wrong])


def test_only_data_frames_with_the_wanted_ids_are_handed_on(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    port.set_receive_ids({0x601, 0, 0x602 | EXTENDED})
    fake.inbox = [
        packet(0x601, b"abc"),
        packet(0x602, b"waited when the filter changed"[:8]),
        packet(0x601 | EXTENDED, b"x"),
        packet(0x601 | REMOTE),
        packet(0x602 | EXTENDED, b"y"),
        struct.pack("=IBB2x64s", 0x601, 6, 1, b"CAN FD"),
        packet(ERROR | 0x40, bytes(8)),
        packet(0x000, bytes(2)),
    ]
    assert frames_of(port) == [
        CanFrame(0x601, b"abc"),
        CanFrame(0x602, b"y", extended=True),
        CanFrame(0x601, b"CAN FD", fd=True),
        CanFrame(0x000, bytes(2)),
    ]
    assert port.receive() == []
    assert port.state is CanState.BUS_OFF


def test_a_call_takes_a_bounded_number_of_frames(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    port.set_receive_ids({1})
    fake.inbox = [packet(1, bytes((n,))) for n in range(200)]
    sizes = [len(port.receive()) for _ in range(5)]
    assert sizes == [RECEIVE_LIMIT] * 3 + [200 - 3 * RECEIVE_LIMIT, 0]


def test_a_port_is_drained_when_nothing_waits_however_few_frames_were_passed_on(
    socket_port: tuple[CanPort, FakeSocket],
) -> None:
    port, fake = socket_port
    port.set_receive_ids({1})
    fake.inbox = [packet(1), packet(ERROR | 0x04, b"\0\x10")] * RECEIVE_LIMIT
    found = []
    for _ in range(3):
        found.append((len(port.receive()), port.drained))
    assert found == [(RECEIVE_LIMIT // 2, False), (RECEIVE_LIMIT // 2, False), (0, True)]


def test_each_way_into_bus_off_is_counted_once(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    off, restarted = packet(ERROR | 0x40, bytes(8)), packet(ERROR | 0x100, bytes(8))
    fake.inbox = [off, off, restarted, off, packet(ERROR | 0x04, b"\0\x10"), off]
    port.receive()
    assert port.bus_off_count == 3


def test_lost_frames_are_noticed_in_the_controller_and_in_the_socket(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    port.set_receive_ids({1})
    fake.inbox = [packet(ERROR | 0x04, b"\0\x01" + bytes(6))]
    port.receive()
    assert (port.overruns, port.state) == (1, CanState.UNKNOWN)
    fake.drops = 5
    fake.inbox = [packet(1)] * 100
    port.receive()
    port.receive()
    assert port.overruns == 2
    fake.drops = 50
    fake.inbox = [packet(1)] * 300
    port.discard()
    assert fake.inbox == []
    fake.inbox = [packet(1)] * 100
    port.receive()
    assert port.overruns == 2, "what was to be thrown away is not missed"


@pytest.mark.parametrize("number", [errno.ENETDOWN, errno.ENODEV, errno.EIO])
def test_an_error_does_not_end_reception(socket_port: tuple[CanPort, FakeSocket], number: int) -> None:
    port, fake = socket_port
    port.set_receive_ids({1})
    fake.inbox = [packet(1, b"a"), number, packet(1, b"b")]
    assert frames_of(port) == [CanFrame(1, b"a")]
    assert port.state is (CanState.UNKNOWN if number == errno.EIO else CanState.DOWN)
    assert port.gone is (number == errno.ENODEV)
    assert frames_of(port) == [CanFrame(1, b"b")]
    assert port.send(CanFrame(2, b"")) is (Sent.GONE if number == errno.ENODEV else Sent.OK)


def test_an_interface_that_goes_while_filters_are_set_is_gone(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    fake.fault = errno.ENODEV
    port.set_receive_ids({1})
    assert port.gone
    assert port.send(CanFrame(2, b"")) is Sent.GONE


def test_a_remote_frame_is_sent_as_one(socket_port: tuple[CanPort, FakeSocket]) -> None:
    port, fake = socket_port
    port.send(CanFrame(0x701, b"", remote=True))
    assert fake.sent == [packet(0x701 | REMOTE)]


@pytest.mark.parametrize(
    ("ancillary", "came"),
    [
        ([(socket.SOL_SOCKET, 64, struct.pack("=qq", 1_700_000_000, 250_000_000))], 41_750 * MS),
        ([(socket.SOL_SOCKET, 35, struct.pack("=ii", 1_700_000_000, 250_000_000))], 41_750 * MS),
        (
            [(socket.SOL_SOCKET, 40, bytes(4)), (socket.SOL_SOCKET, 35, struct.pack("=qq", 1_700_000_000, 0))],
            41_500 * MS,
        ),
        ([(socket.SOL_SOCKET, 64, bytes(3))], None),
        ([(socket.IPPROTO_TCP, 64, bytes(16))], None),
        ([], None),
    ],
)
def test_the_kernels_time_of_a_frame_is_told_on_the_monotonic_clock(
    socket_port: tuple[CanPort, FakeSocket],
    monkeypatch: pytest.MonkeyPatch,
    ancillary: list[tuple[int, int, bytes]],
    came: int | None,
) -> None:
    clock = SimpleNamespace(time_ns=lambda: 1_700_000_000_500_000_000, monotonic_ns=lambda: 42 * SECOND)
    monkeypatch.setattr(can_port, "time", clock)
    port, fake = socket_port
    port.set_receive_ids({1})
    fake.inbox, fake.ancillary = [packet(1)], ancillary
    assert fake.options[64] == 1, "the kernel is asked for them"
    assert port.receive() == [(CanFrame(1, b""), came)]


class DatagramSocket(socket.socket):
    """As a CAN socket: the kernel counts what waits in it in the same way."""

    def setsockopt(self, level: int, *rest: Any) -> None:
        if level != socket.SOL_CAN_RAW:
            super().setsockopt(level, *rest)


def test_the_kernel_holds_six_frames_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """What waits there cannot be overtaken by newer values."""
    ours, others = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with others, DatagramSocket(fileno=ours.detach()) as mine:
        monkeypatch.setattr(can_port, "_open", lambda _: SimpleNamespace(socket=mine))
        port = CanPort(CanConfig())
        answers = [port.send(CanFrame(n, bytes(8))) for n in range(30)]
    taken = answers.index(Sent.FULL)
    assert 1 <= taken <= 6
    assert set(answers[taken:]) == {Sent.FULL}


# --- python-can's own bus, read by a thread


def readers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "can-reader"]


@contextmanager
def virtual() -> Iterator[tuple[CanPort, can.BusABC]]:
    """A port on a bus of its own, and another participant."""
    channel = f"reception-{os.getpid()}-{next(_numbers)}"
    port = CanPort(CanConfig("virtual", channel))
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
    """Wait for so many frames as a loop does: by the descriptor."""
    frames: list[CanFrame] = []
    while len(frames) < count:
        assert readable(port), f"{len(frames)} of {count} frames"
        frames += frames_of(port)
    return frames


def message(can_id: int, data: bytes = b"", **flags: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=flags.pop("is_extended_id", False), **flags)


def test_without_ids_there_is_no_thread_and_nothing_to_wait_for() -> None:
    with virtual() as (port, other):
        port.set_receive_ids(frozenset())
        other.send(message(0x601))
        assert (port.fileno(), port.receive(), readers()) == (None, [], [])
        assert not port.tells_busy_from_gone


def test_one_thread_brings_the_wanted_frames_in_order() -> None:
    with virtual() as (port, other):
        port.set_receive_ids({0x601})
        port.set_receive_ids({0x601, 0x602})
        assert len(readers()) == 1
        assert not port.tells_busy_from_gone, "a descriptor to wait on says nothing of sending"
        for n in range(100):
            other.send(message(0x123, b"foreign"))
            other.send(message(0x601, is_extended_id=True))
            other.send(message(0x601, is_remote_frame=True))
            other.send(message(0x601, is_error_frame=True))
            other.send(message(0x601 + n % 2, bytes((n,))))
        assert receive(port, 100) == [CanFrame(0x601 + n % 2, bytes((n,))) for n in range(100)]
        assert not readable(port, 0)
        port.set_receive_ids({0x603})
        other.send(message(0x601))
        other.send(message(0x603))
        assert receive(port, 1) == [CanFrame(0x603, b"")]


def test_a_call_takes_a_bounded_number_of_the_threads_frames_and_stays_readable() -> None:
    with virtual() as (port, other):
        port.set_receive_ids({1})
        for n in range(100):
            other.send(message(1, bytes((n,))))
        reader = port._reader
        assert reader is not None
        wait_for(lambda: len(reader._frames) == 100, "100 frames")
        assert readable(port)
        assert len(port.receive()) == RECEIVE_LIMIT
        assert readable(port, 0)
        assert len(port.receive()) == 100 - RECEIVE_LIMIT
        assert not readable(port, 0)
        assert port.receive() == []


def test_the_threads_queue_is_bounded_keeps_the_oldest_and_tells_the_loss() -> None:
    with virtual() as (port, other):
        port.set_receive_ids({1})
        reader = port._reader
        assert reader is not None
        for n in range(QUEUE_LENGTH + 20):
            other.send(message(1, n.to_bytes(2, "little")))
        wait_for(lambda: reader.dropped == 20, "20 dropped frames")
        frames = receive(port, QUEUE_LENGTH)
        assert [int.from_bytes(frame.data, "little") for frame in frames] == list(range(QUEUE_LENGTH))
        assert port.overruns == 1


def test_what_waits_can_be_thrown_away() -> None:
    with virtual() as (port, other):
        port.set_receive_ids({1})
        reader = port._reader
        assert reader is not None
        for _ in range(200):
            other.send(message(1, b"old"))
        wait_for(lambda: len(reader._frames) == 200, "200 frames")
        port.discard()
        other.send(message(1, b"new"))
        assert receive(port, 1) == [CanFrame(1, b"new")]


def test_own_frames_do_not_come_back_even_where_the_driver_is_told_to_return_them() -> None:
    channel = f"own-{os.getpid()}"
    config = CanConfig("virtual", channel, options={"receive_own_messages": True})
    port = CanPort(config)
    try:
        with can.Bus(interface="virtual", channel=channel) as other:
            port.set_receive_ids({0x581})
            assert port.send(CanFrame(0x581, b"own")) is Sent.OK
            other.send(message(0x581, b"other"))
            assert receive(port, 1) == [CanFrame(0x581, b"other")]
            seen = other.recv(1)
            assert seen is not None
            assert bytes(seen.data) == b"own"
    finally:
        port.close()


@pytest.mark.parametrize("error", [can.CanOperationError("unplugged"), OSError(errno.EIO, "I/O"), TypeError("closed")])
def test_an_adapter_that_fails_in_the_thread_is_gone(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    with virtual() as (port, other):
        port.set_receive_ids({1})
        other.send(message(1, b"before"))
        assert receive(port, 1) == [CanFrame(1, b"before")]

        def failing(timeout: float | None) -> None:
            raise error

        monkeypatch.setattr(port._bus, "recv", failing)
        assert readable(port), "the loop is woken"
        assert port.receive() == []
        assert (port.gone, port.state) == (True, CanState.DOWN)
        wait_for(lambda: readers() == [], "the thread's end")
        assert port.send(CanFrame(2, b"")) is Sent.GONE


def test_a_driver_that_cannot_filter_gets_no_filters_and_one_that_fails_is_gone(
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
        assert not port.gone
        other.send(message(2))
        other.send(message(1))
        assert receive(port, 1) == [CanFrame(1, b"")]
        port.set_receive_ids({2})
        assert port.gone


def test_closing_ends_a_thread_that_waits_and_gives_back_every_descriptor() -> None:
    def descriptors() -> int:
        return len(os.listdir("/proc/self/fd"))

    with virtual():
        pass  # what is imported late
    before = descriptors()
    for _ in range(5):
        with virtual() as (port, _other):
            port.set_receive_ids({1})
            port.close()
            assert readers() == []
    assert descriptors() == before


def test_a_thread_that_a_driver_holds_is_left_behind_without_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    held = threading.Event()
    with virtual() as (port, other):
        other.send(message(1))
        monkeypatch.setattr("kontronik_can_gw.runtime.bus_reader._LONGEST_END_S", 0.01)
        waiting = threading.Event()

        def holding(timeout: float | None) -> can.Message:
            waiting.set()
            held.wait(600)
            return message(1, b"late")

        monkeypatch.setattr(port._bus, "recv", holding)
        port.set_receive_ids({1})
        assert waiting.wait(120)
        port.close()
        others = [os.eventfd(0, os.EFD_NONBLOCK) for _ in range(8)]  # one has the number that the thread's had
        (left,) = readers()
        held.set()
        left.join(120)
        for fd in others:
            with pytest.raises(BlockingIOError):
                os.eventfd_read(fd)
            os.close(fd)


# --- the loop


class Node(Gateway):
    """A gateway that answers each received frame by a queued one."""

    def __init__(self, *ids: int) -> None:
        super().__init__([EscSettings("esc1")], NO_MESSAGES, 0)
        self.ids = frozenset(ids)
        self.received: list[tuple[int, CanFrame]] = []
        self.overruns = 0
        self.waiting: list[CanFrame] = []

    @property
    def receive_ids(self) -> frozenset[int]:
        return self.ids

    def receive_frame(self, frame: CanFrame, now: int, at: int) -> None:
        self.received.append((now, frame))
        self.waiting.append(CanFrame(frame.can_id - 0x80, frame.data, queued=True))

    def receive_overrun(self, now: int) -> None:
        self.overruns += 1

    @property
    def frames_wait(self) -> bool:
        return bool(self.waiting) or super().frames_wait

    def take_frames(self) -> list[CanFrame]:
        frames = [*self.waiting, *super().take_frames()]
        self.waiting = []
        return frames


@contextmanager
def running(node: Node, channel: str) -> Iterator[Loop]:
    with PtyEsc() as esc:
        loop = Loop(node, [esc.path], CanConfig("virtual", channel))
        loop.open()
        thread = threading.Thread(target=loop.run)
        thread.start()
        try:
            yield loop
        finally:
            loop.stop()
            thread.join(120)
            assert not thread.is_alive()
    assert readers() == []


def test_the_loop_answers_requests_and_follows_ids_that_change() -> None:
    node, channel = Node(0x601), f"loop-{os.getpid()}"
    with can.Bus(interface="virtual", channel=channel) as other, running(node, channel) as loop:
        for n in range(20):
            other.send(message(0x601, bytes((n,))))
        for n in range(20):
            answer = other.recv(120)
            assert answer is not None
            assert (answer.arbitration_id, bytes(answer.data)) == (0x581, bytes((n,)))
        assert node.status.received_frames == 20
        node.ids = frozenset({0x602})
        os.write(loop._wake_write, b"\0")
        port = loop.can.port
        assert port is not None
        wait_for(lambda: port._ids == node.ids, "the new ids")
        other.send(message(0x601))
        other.send(message(0x602, b"x"))
        answer = other.recv(120)
        assert answer is not None
        assert (answer.arbitration_id, bytes(answer.data)) == (0x582, b"x")
        assert node.status.dropped_frames == 0


def test_the_loop_opens_an_adapter_anew_when_its_reader_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    node, channel = Node(0x601), f"anew-{os.getpid()}"
    with can.Bus(interface="virtual", channel=channel) as other, running(node, channel) as loop:
        first = loop.can.port
        assert first is not None

        def failing(timeout: float | None) -> None:
            raise can.CanOperationError("unplugged")

        monkeypatch.setattr(first._bus, "recv", failing)
        wait_for(lambda: loop.can.port not in (None, first), "another port")
        other.send(message(0x601, b"x"))
        answer = other.recv(120)
        assert answer is not None
        assert (answer.arbitration_id, bytes(answer.data)) == (0x581, b"x")
        assert len(readers()) == 1


class ScriptedPort:
    """A CAN port under a loop that is turned by hand."""

    tells_busy_from_gone = True

    def __init__(self) -> None:
        self.state = CanState.ERROR_ACTIVE
        self.gone = False
        self.bus_off_count = self.overruns = 0
        self.inbox: list[CanFrame] = []
        self.answer = Sent.OK
        self.sent: list[CanFrame] = []
        self.discarded = 0

    def fileno(self) -> None:
        return None

    def set_receive_ids(self, ids: object) -> None:
        pass

    def receive(self) -> list[tuple[CanFrame, int | None]]:
        frames, self.inbox = self.inbox[:RECEIVE_LIMIT], self.inbox[RECEIVE_LIMIT:]
        self.drained = not self.inbox
        return [(frame, None) for frame in frames]

    def note_state(self, state: CanState) -> None:
        self.bus_off_count += state is CanState.BUS_OFF
        self.state = state

    def discard(self) -> None:
        self.discarded += len(self.inbox)
        self.inbox = []

    def send(self, frame: CanFrame) -> Sent:
        if self.answer is Sent.OK:
            self.sent.append(frame)
        else:
            self.state = CanState.DOWN
        return self.answer

    def send_all(self, frames: Sequence[CanFrame], clock: Callable[[], int], latest: int) -> tuple[int, Sent]:
        return one_by_one(self.send, frames, clock, latest)

    def close(self) -> None:
        pass


@pytest.fixture
def scripted() -> Iterator[tuple[Loop, Node, ScriptedPort]]:
    node, port = Node(0x601), ScriptedPort()
    with PtyEsc() as esc:
        loop = Loop(node, [esc.path], CanConfig("virtual", f"scripted-{os.getpid()}"), clock=lambda: 0)
        loop.open()
        loop.can._close_port()
        loop.can.port = port  # type: ignore[assignment]
        yield loop, node, port
        loop.close()


def test_bus_off_and_lost_frames_are_told_once(scripted: tuple[Loop, Node, ScriptedPort]) -> None:
    loop, node, port = scripted
    port.bus_off_count, port.overruns, port.state = 2, 1, CanState.BUS_OFF
    for now in (MS, 2 * MS):
        loop.can.serve(now)
    assert (node.status.bus_off_count, node.overruns, node.status.can_state) == (2, 1, CanState.BUS_OFF)


def test_answers_that_an_interface_that_is_down_does_not_take_are_dropped_and_counted(
    scripted: tuple[Loop, Node, ScriptedPort],
) -> None:
    loop, node, port = scripted
    port.answer = Sent.DOWN
    for n in range(3):
        node.waiting.append(CanFrame(0x581, bytes((n,)), queued=True))
    loop.can.transmit(MS)
    assert (node.status.dropped_frames, node.status.can_state) == (3, CanState.DOWN)
    node.waiting.append(CanFrame(0x581, b"", queued=True))
    loop.can.transmit(2 * MS)
    assert node.status.dropped_frames == 4
    assert len(loop.can.mailboxes) == 0


def test_what_the_kernel_tells_of_the_interface_ends_the_pause_after_an_outage(
    scripted: tuple[Loop, Node, ScriptedPort], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, node, port = scripted
    port.answer = Sent.DOWN
    node.waiting.append(CanFrame(0x581, b"", queued=True))
    loop.can.transmit(0)
    assert loop.can.port is None
    back = ScriptedPort()
    monkeypatch.setattr(can_side, "CanPort", lambda _config: back)
    loop.can._follow(LinkFacts(exists=True, up=False), MS)
    loop._reopen(MS)
    assert loop.can.port is None
    loop.can._follow(LinkFacts(exists=True, up=True), 2 * MS)
    loop._reopen(2 * MS)
    node.waiting.append(CanFrame(0x581, b"x", queued=True))
    loop.can.transmit(2 * MS)
    assert back.sent == [CanFrame(0x581, b"x", queued=True)]


def test_a_link_that_goes_down_or_away_is_an_outage_at_once(scripted: tuple[Loop, Node, ScriptedPort]) -> None:
    loop, node, _port = scripted
    loop.can._follow(LinkFacts(exists=True, up=True), 0)
    assert loop.can.is_open
    loop.can._follow(LinkFacts(exists=True, up=False), MS)
    assert (loop.can.is_open, node.status.can_state) == (False, CanState.DOWN)
    assert loop.can.complaint.endswith("the adapter has failed. Trying again.")


def test_in_bus_off_nothing_is_handed_to_the_controller_and_the_newest_goes_first_afterwards(
    scripted: tuple[Loop, Node, ScriptedPort],
) -> None:
    loop, node, port = scripted
    loop.can._follow(LinkFacts(exists=True, up=True, state=CanState.BUS_OFF, restart_ms=0), 0)
    assert (node.status.can_state, node.status.bus_off_count) == (CanState.BUS_OFF, 1)
    assert "restart-ms is 0" in loop.can.complaint
    for n in range(5):
        loop.can.mailboxes.put(CanFrame(0x100, bytes((n,))))
        loop.can.transmit(n * MS)
    assert port.sent == []
    loop.can._follow(LinkFacts(exists=True, up=True, state=CanState.ERROR_ACTIVE, restart_ms=0), 9 * MS)
    loop.can.mailboxes.put(CanFrame(0x100, b"new"))
    loop.can.transmit(10 * MS)
    assert [frame.data for frame in port.sent] == [b"new"]
    assert (node.status.can_state, loop.can.complaint) == (CanState.ERROR_ACTIVE, "")


def test_a_port_that_was_closed_in_this_round_is_not_served(scripted: tuple[Loop, Node, ScriptedPort]) -> None:
    loop, node, port = scripted
    port.inbox = [CanFrame(0x601, b"")]
    loop.can._lost(Sent.GONE, 0)
    loop.can.serve(MS)
    assert node.received == []
