"""A loop in a world without a clock: serial wires, the kernel's buffers, a bus, a process.

Time passes only while the loop waits, and while a test holds the process up.
"""

import os
import select
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence

import native_world
import pytest
from dbc_bench import compiled
from packer_oracle import Msg, Sig, dbc_text

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.core.output_setup import OutputMaker
from kontronik_can_gw.core.settings import CoreSettings
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.esc.kontronik.codec import WireLayout, encode
from kontronik_can_gw.esc.kontronik.fields import LiveData
from kontronik_can_gw.esc.kontronik.protocol import KONTRONIK
from kontronik_can_gw.esc.telemetry import EscSettings
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.gateway.gate_state import Restarts
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.native import load
from kontronik_can_gw.runtime.can import can_opener
from kontronik_can_gw.runtime.can.can_port import RECEIVE_LIMIT, CanPort, Received
from kontronik_can_gw.runtime.loop import Loop
from kontronik_can_gw.runtime.poller import Handler, Poller
from kontronik_can_gw.runtime.ports import esc_port as esc_input
from kontronik_can_gw.runtime.ports.serial_port import PortLost
from kontronik_can_gw.runtime.ports.usb_adapters import UsbIdentity
from kontronik_can_gw.runtime.system.sd_notify import Notifier
from kontronik_can_gw.signals.plan import MessageLayout
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import MS, NEVER, SECOND

NS_PER_BYTE = KONTRONIK.byte_ns

NOT_AVAILABLE = 0xFFFFFFFF
_FIRST_PORT = 1000
CAN_FD = 2000
_MAX_READ = 4096
TIMES = """BA_DEF_DEF_ "GenMsgCycleTime" 20;
BA_DEF_DEF_ "GenMsgSendType" "CyclicAndEvent";
"""


def speed_and_age(esc: str = "") -> list[Sig]:
    """Return the signals of an ESC's speed and of the age of its data in ms."""
    speed = Sig(f"{esc}ElectricalSpeed", 0, 32, unit="1/min")
    return [speed, Sig(f"{esc}DataAge", 32, 16, unit="ms")]


def layout_of(escs: Sequence[EscSettings]) -> MessageLayout:
    """Return a layout with a message 100h, 101h … of speed and age for each ESC.

    Each frame of the ESC sends its message, and so does a cycle of 20 ms.
    """
    messages = []
    for n, esc in enumerate(escs):
        name = esc.name if len(escs) > 1 else ""
        messages.append(Msg(f"M{n}", 256 + n, 8, speed_and_age(name)))
    return compiled(dbc_text(messages, TIMES), [esc.name for esc in escs])


def live(speed: int) -> bytes:
    data = LiveData(electrical_speed=speed, battery_voltage=2400, battery_current=100)
    return encode(data, WireLayout.V4)


class Wire:
    """A serial port with scheduled bytes. The speed in a frame is the number of the frame."""

    is_drained = True
    settings = bytes(range(64))

    def __init__(self, world: "World", number: int) -> None:
        self.path = f"/fake/{number}"
        self.arrivals: list[int] = []
        """Times at which each byte was in the kernel's buffer."""
        self.frames: list[int] = []
        """Times at which each frame was complete."""
        self.now_set = self.settings
        self.looks: list[int] = []
        """Times at which the settings were read or set."""
        self.fails_at: int | None = None
        """After this time the port is readable and each read fails, which takes a millisecond."""
        self.hangs_up = False
        """A failing read returns no bytes instead of an I/O error."""
        self._world = world
        self._number = number
        self._bytes = bytearray()
        self._read = 0

    def send(self, at: int, bundled: bool = False) -> None:
        """Let the next frame begin ``at`` this time.

        If it is bundled, an adapter delivers all its bytes at once, when the last one is there.
        """
        data = live(len(self.frames) + 1)
        times = [at + (n + 1) * NS_PER_BYTE for n in range(len(data))]
        if bundled:
            times = times[-1:] * len(data)
        self.put(data, times)
        self.frames.append(self.arrivals[-1])

    def put(self, data: bytes, times: Iterable[int]) -> None:
        self._bytes += data
        self.arrivals += times

    def stream(
        self,
        begin: int,
        end: int,
        period: int,
        bundled: bool = False,
    ) -> None:
        for at in range(begin, end, period):
            self.send(at, bundled)

    @property
    def waiting(self) -> int:
        return bisect_right(self.arrivals, self._world.now) - self._read

    @property
    def next_arrival(self) -> int | None:
        """The time at which the port becomes readable. In the past if it is readable."""
        times = self.arrivals[self._read : self._read + 1]
        if self.fails_at is not None:
            times.append(self.fails_at)
        return min(times, default=None)

    # methods of SerialPort

    def fileno(self) -> int:
        return _FIRST_PORT + self._number

    def read(self, most: int = _MAX_READ) -> bytes:
        if self._has_failed:
            self._world.now += MS
            raise PortLost("unplugged" if self.hangs_up else "Input/output error")
        count = min(self.waiting, most)
        data = bytes(self._bytes[self._read : self._read + count])
        self._read += count
        self.is_drained = not self.waiting
        return data

    @property
    def waits_to_be_read(self) -> bool:
        return self._has_failed or bool(self.waiting)

    @property
    def _has_failed(self) -> bool:
        return self.fails_at is not None and self.fails_at <= self._world.now

    def discard(self) -> None:
        self._read += self.waiting

    def identity(self) -> UsbIdentity | None:
        return None

    def line_errors(self) -> dict[str, int]:
        return {}

    def settings_hold(self) -> bool:
        self.looks.append(self._world.now)
        held = self.now_set == self.settings
        self.now_set = self.settings
        return held

    def close(self) -> None:
        """Close the port. It works again when it is opened again."""
        self.fails_at = None


class Bus(CanPort):
    """A CAN interface. ``sent`` and ``inbox`` have the frames with their times."""

    is_socket = True

    def __init__(self, world: "World") -> None:
        super().__init__()
        self.state = CanState.ERROR_ACTIVE
        self.sent: list[tuple[int, CanFrame]] = []
        self.inbox: list[tuple[CanFrame, int]] = []
        self.clock_error = 0
        """Error in ns of the times that the kernel reports."""
        self.answer = Sent.OK
        self.refused: list[int] = []
        """Times at which a frame was refused with ``answer``. A refusal takes 0.1 ms."""
        self.frame_ns = 0
        """Duration of a frame on the bus. Unless it is 0, the kernel buffers six frames."""
        self.arrived: list[tuple[int, CanFrame]] = []
        """The frames that have left the interface, with their times, if ``frame_ns`` is not 0."""
        self.count_fd = CAN_FD + 1
        self.frame_size = native_world.FRAME_SIZE
        self._out: list[tuple[int, CanFrame]] = []
        """The frames in the kernel, and the times at which they will have been sent."""
        self._is_blocked = False
        self.passes = 0
        """Number of frames that a blocked interface still takes."""
        self.count = 1
        """Number of frames that have left the interface."""
        self.on_send: Callable[[CanFrame], None] = lambda _frame: None
        self._world = world

    def came(
        self,
        can_id: int,
        data: bytes = b"",
        at: int | None = None,
    ) -> None:
        self.inbox.append((CanFrame(can_id, data), self._world.now if at is None else at))

    def take(self) -> list[tuple[int, bytes]]:
        """Return the frames that were sent since the last call."""
        sent = self.sent
        self.sent = []
        return [(frame.can_id, frame.data) for _, frame in sent]

    # methods of CanPort

    def fileno(self) -> int:
        return CAN_FD

    @property
    def waits_to_be_read(self) -> bool:
        return bool(self.inbox) and self.inbox[0][1] <= self._world.now

    def receive(self, limit: int = RECEIVE_LIMIT) -> Received:
        found: Received = []
        while self.waits_to_be_read and len(found) < limit:
            frame, at = self.inbox.pop(0)
            found.append((frame, at + self.clock_error))
        self.is_drained = not self.waits_to_be_read
        return found

    @property
    def room_at(self) -> int:
        """The time at which the socket becomes writable: its buffer is less than half full."""
        return self._out[-3][0] if len(self._out) > 2 else 0

    def frames_left(self) -> int:
        self._pass_time()
        return self.count

    def frames_queued(self) -> int:
        """Return how many frames wait behind the one in the controller."""
        self._pass_time()
        return max(0, len(self._out) - 1)

    def block(self) -> None:
        """Let no frame leave the interface until ``free`` is called. ``frame_ns`` must be set."""
        self._pass_time()
        self._is_blocked = True
        self._out = [(NEVER, frame) for _, frame in self._out]

    def free(self) -> None:
        """Let frames leave the interface again, first those in the kernel."""
        self._is_blocked = False
        frames = [frame for _, frame in self._out]
        self._out = []
        for frame in frames:
            self._add(frame)

    def let_pass(self, ns: int) -> None:
        """Let time pass for an interface with a World of its own."""
        self._world.now += ns

    def discard_waiting(self) -> None:
        """Discard the frames in the kernel, as setting the interface down does."""
        self._pass_time()
        self._out.clear()

    def _add(self, frame: CanFrame) -> None:
        begin = max([self._world.now, *[at for at, _ in self._out[-1:]]])
        at = NEVER if self._is_blocked else begin + self.frame_ns
        self._out.append((at, frame))

    def _pass_time(self) -> None:
        """Move the frames that have been sent by now to ``arrived``."""
        now = self._world.now
        if self._is_blocked and self.passes:
            passed = self._out[: self.passes]
            self.passes -= len(passed)
            self._out[: len(passed)] = [(now, frame) for _, frame in passed]
        sent = [each for each in self._out if each[0] <= now]
        self.arrived += sent
        self.count += len(sent)
        self._out = self._out[len(sent) :]

    def _send_each(
        self,
        frames: Sequence[CanFrame],
        clock: Callable[[], int],
        latest: int,
    ) -> tuple[int, Sent]:
        for count, frame in enumerate(frames):
            if clock() > latest:
                return count, Sent.LATE
            if self.frame_ns:
                self._pass_time()
                if len(self._out) == 6:
                    return count, Sent.FULL
                self._add(frame)
            if self.answer is not Sent.OK:
                self.refused.append(self._world.now)
                self._world.now += MS // 10
                return count, self.answer
            self.count += not self.frame_ns
            self.sent.append((self._world.now, frame))
            self.on_send(frame)
        return len(frames), Sent.OK

    def _filter(self) -> None:
        pass

    def _drops(self) -> int:
        return 0

    def close(self) -> None:
        pass


class World:
    """The world around a loop. ``now`` is the clock, and waiting lets time pass.

    ``hold_up`` returns for how long the process does not run after a wait. Descriptors in
    ``blind`` are never reported to the loop.
    """

    def __init__(self, wires: int = 1) -> None:
        self.now = self.looked = self.before = 7 * SECOND
        self.wires = [Wire(self, n) for n in range(wires)]
        self.bus = Bus(self)
        self.looks: list[int] = [self.now]
        self.hold_up: Callable[[], int] = lambda: 0
        """Returns in ns how long the process is held up after a wait, before it reads the clock."""
        self.poll_fault: Callable[[bool], int] = lambda _is_all: 0
        """Returns the errno of a failing poll in C, or 0.

        Its argument is True if the poll is for all descriptors.
        """
        self.until = 1 << 62
        """The time at which iterations in C end."""
        self.opening_ns = 0
        self.there = True
        self.blind: set[int] = set()
        self.handlers: dict[int, Handler] = {}
        self._events: dict[int, int] = {}
        self.late = 0
        self.poller = FakePoller(self)

    def clock(self) -> int:
        return self.now

    def register(self, fd: int, handler: Handler, events: int) -> None:
        self.handlers[fd] = handler
        self._events[fd] = events

    def unregister(self, fd: int) -> None:
        del self.handlers[fd]
        del self._events[fd]

    def wait(
        self,
        last: int,
        due: int,
    ) -> list[tuple[Handler, int]]:
        pause = max(0, due - self.now)
        whole_ms = -(-pause // MS) * MS
        for_room = self._events.get(CAN_FD, 0) & select.POLLOUT
        self.pass_until(self.now + whole_ms, for_room)
        self.look()
        self.late = self.now - last - pause
        found = [(fd, self.ready(fd) & self._events[fd]) for fd in self.handlers]
        return [(self.handlers[fd], bits) for fd, bits in found if bits]

    def pass_until(self, until: int, for_room: int) -> None:
        """Let time pass until bytes or frames arrive, or the bus takes frames.

        The process may be held up after that.
        """
        watched = self.handlers.keys() - self.blind
        found = [wire.next_arrival for wire in self.wires if wire.fileno() in watched]
        if CAN_FD in watched and self.bus.inbox:
            found.append(self.bus.inbox[0][1])
        if for_room:
            found.append(self.bus.room_at)
        first = min([until, *(at for at in found if at is not None)])
        self.now = max(self.now, first)
        self.now += self.hold_up()

    def look(self) -> None:
        """Note the time of a check for ready descriptors."""
        self.before = self.looked
        self.looked = self.now
        self.looks.append(self.now)

    def ready(self, fd: int) -> int:
        """Return the events that poll reports for a descriptor."""
        if fd in self.blind:
            return 0
        if fd == CAN_FD:
            has_room = self.bus.room_at <= self.now
            return select.POLLIN * self.bus.waits_to_be_read | select.POLLOUT * has_room
        found = [wire for wire in self.wires if wire.fileno() == fd and wire.waits_to_be_read]
        return select.POLLIN * len(found)


class FakePoller(Poller):
    """The World as the loop's poller."""

    def __init__(self, world: World) -> None:
        super().__init__(world.clock)
        self._world = world

    def register(
        self,
        fd: int,
        handler: Handler,
        events: int = select.POLLIN,
        esc: int | None = None,
    ) -> None:
        self._world.register(fd, handler, events)

    def unregister(self, fd: int) -> None:
        self._world.unregister(fd)

    def wait(self, due: int) -> list[tuple[Handler, int]]:
        times = self.times
        ready = self._world.wait(times.now, due)
        times.before = self._world.before
        times.polled = self._world.looked
        self.late = self._world.late
        return ready


def loop_in(
    world: World,
    patch: pytest.MonkeyPatch,
    escs: Sequence[EscSettings] = (EscSettings("esc1"),),
    layout: MessageLayout | None = None,
    notifier: Notifier | None = None,
    outputs: Sequence[OutputMaker] = (),
    quiet_after_s: int = 0,
    restart_after_s: float = 0,
) -> Loop:
    """Return a loop whose ports, bus and time are the World's. It is not open yet."""

    def open_bus(_config: object) -> Bus:
        world.now += world.opening_ns
        if not world.there:
            raise RunError("can0: there is none.")
        return world.bus

    by_path = {wire.path: wire for wire in world.wires}
    patch.setattr(can_opener, "open_can", open_bus)
    patch.setattr(esc_input, "SerialPort", lambda path, _protocol: by_path[path])
    in_c = os.environ.get(load.PURE, "1") != "1"
    if in_c:
        patch.setattr(load, "library", lambda: (native_world.library(), ""))
    layout = layout or layout_of(escs)
    config = CanConfig(
        interface="virtual",
        channel="world",
        quiet_after_s=quiet_after_s,
        restart_after_s=restart_after_s,
    )
    gateway = Gateway(
        CoreSettings(escs, layout, quiet_after_ns=config.quiet_after_ns), world.now, outputs=outputs
    )
    paths = list(by_path)
    poller = native_world.FakeNativePoller(world, gateway) if in_c else world.poller
    loop = Loop(
        gateway,
        paths,
        config,
        True,
        clock=world.clock,
        poller=poller,
        notifier=notifier,
    )
    if restart_after_s:  # the gate of a SocketCAN interface
        after_ns = round(restart_after_s * SECOND)
        loop.can.gate.restart = Restarts(after_ns, after_ns)
    return loop


def run(loop: Loop, world: World, until: int) -> None:
    world.until = until
    while world.now < until:
        loop.turn()
    world.until = 1 << 62
