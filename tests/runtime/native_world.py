"""The World for a loop that runs in C: it answers the system calls of linux.c.

tests/native/fake_kernel.c passes the calls on to the World.
"""

import ctypes as c
import errno
import struct
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from built import there

from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.gateway.gateway import Gateway
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.native.binding import load
from kontronik_can_gw.native.compile import compile_core
from kontronik_can_gw.native.objects import OPTIONS
from kontronik_can_gw.runtime.can.can_link import CanLink
from kontronik_can_gw.runtime.native_poller import NativePoller
from kontronik_can_gw.runtime.poller import Handler, Work
from kontronik_can_gw.runtime.ports.serial_port import PortLost

if TYPE_CHECKING:
    from wire_world import World

FRAME_SIZE = 768
"""Memory of a frame in the kernel's queue, in bytes."""
_CALLS = (
    "clock_gettime",
    "epoll_create1",
    "epoll_ctl",
    "epoll_wait",
    "close",
    "getsockopt",
    "poll",
    "pread",
    "read",
    "ioctl",
)
_KERNEL = Path(__file__).parents[1] / "native" / "fake_kernel.c"
_HEAD = struct.Struct("=IB3B")
_REFUSALS = {
    Sent.OK: 0,
    Sent.FULL: errno.EAGAIN,
    Sent.BUSY: errno.ENOBUFS,
    Sent.DOWN: errno.ENETDOWN,
    Sent.GONE: errno.ENODEV,
}
"""The errno of a socket for each answer of a bus."""


class _Kernel(c.Structure):
    _fields_ = (
        ("now", c.CFUNCTYPE(c.c_int64)),
        ("wait", c.CFUNCTYPE(None, c.c_int64, c.c_int)),
        ("look", c.CFUNCTYPE(c.c_int, c.c_int)),
        ("ready", c.CFUNCTYPE(c.c_int, c.c_int)),
        ("size", c.CFUNCTYPE(c.c_int, c.c_int, c.c_int)),
        ("send", c.CFUNCTYPE(c.c_int, c.POINTER(c.c_uint8), c.c_int)),
        ("left", c.CFUNCTYPE(c.c_int64)),
        ("queued", c.CFUNCTYPE(c.c_int)),
        ("settings", c.CFUNCTYPE(None, c.c_int, c.POINTER(c.c_uint8), c.c_int)),
    )


def library(flags: tuple[str, ...] = ("-O1",)) -> Any:
    """Return the C core with the fake kernel. It is compiled once."""
    there()  # also for a test that is not the first one
    return _compiled(flags)


@cache
def _compiled(flags: tuple[str, ...]) -> Any:
    names = [f"-D{call}=fake_{call}" for call in (*_CALLS, "sendmmsg")]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, "core.so")
        assert compile_core(target, (*flags, *OPTIONS, *names, str(_KERNEL))) is None
        return load(target)


class FakeNativePoller(NativePoller):
    """A poller that waits by the time of the World, in Python and in C."""

    def __init__(self, world: "World", gateway: Gateway) -> None:
        super().__init__(gateway, world.clock)
        self._world = world
        self._data = (c.c_uint8 * (1 << 16)).in_dll(library(), "fake_data")
        kinds: list[Any] = [kind for _, kind in _Kernel._fields_]
        calls: list[Any] = [
            world.clock,
            world.pass_until,
            self._look,
            world.ready,
            self._read,
            self._send,
            lambda: world.bus.frames_left(),
            lambda: world.bus.frames_queued() * FRAME_SIZE,
            self._settings,
        ]
        pairs = zip(kinds, calls, strict=True)
        self._kernel = _Kernel(*(kind(call) for kind, call in pairs))
        library().fake_use(c.byref(self._kernel))

    def register(
        self,
        fd: int,
        handler: Handler,
        events: int = 1,
        esc: int | None = None,
    ) -> None:
        self._world.register(fd, handler, events)
        if fd >= 1000:  # smaller numbers are real descriptors
            self._watched[fd] = (handler, events, esc)
            self.changes += 1

    def unregister(self, fd: int) -> None:
        self._watched.pop(fd, None)
        self._world.unregister(fd)
        self.changes += 1

    def run(self, can: CanLink, due: int, leave: int, period: int) -> Work:
        return super().run(can, min(due, self._world.until), leave, period)

    def wait(self, due: int) -> list[tuple[Handler, int]]:
        times = self.times
        ready = self._world.wait(times.now, due)
        times.before = self._world.before
        times.polled = self._world.looked
        self.late = self._world.late
        return ready

    def _look(self, is_all: int) -> int:
        if is_all:
            self._world.look()
        return self._world.poll_fault(bool(is_all))

    def _read(self, fd: int, most: int) -> int:
        wire = self._world.wires[fd - 1000]
        try:
            data = wire.read(most)
        except PortLost:
            return -1 if wire.hangs_up else -errno.EIO
        c.memmove(self._data, data, len(data))
        return len(data)

    def _settings(self, fd: int, at: Any, is_set: int) -> None:
        wire = self._world.wires[fd - 1000]
        wire.looks.append(self._world.now)
        if is_set:
            wire.now_set = bytes(at[: len(wire.settings)])
        else:
            c.memmove(at, wire.now_set, len(wire.settings))

    def _send(self, frame: Any, size: int) -> int:
        raw = bytes(frame[:size])
        number, length, *rest = _HEAD.unpack_from(raw)
        is_fd = size > 16
        assert rest == [int(is_fd), 0, 0], "the flags of CAN FD, and reserved bytes"
        data = raw[8 : 8 + length]
        sent = CanFrame(number & ~EXTENDED, data, number >= EXTENDED, is_fd)
        return _REFUSALS[self._world.bus.send(sent)]
