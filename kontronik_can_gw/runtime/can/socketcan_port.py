"""Sends and receives through a raw SocketCAN socket, without waiting.

It also finds the reason why an interface cannot be used.
"""

import contextlib
import errno
import os
import socket
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError
from kontronik_can_gw.frames import EXTENDED, MAX_EXTENDED_ID, CanFrame, id_and_mask
from kontronik_can_gw.gateway.transmit_queue import Sent
from kontronik_can_gw.gateway.under_way import UNCOUNTED
from kontronik_can_gw.runtime.can.can_port import (
    MAX_STANDARD_ID,
    RECEIVE_LIMIT,
    CanPort,
    Received,
)
from kontronik_can_gw.runtime.can.link_commands import (
    VIRTUAL,
    add_virtual,
    enable_fd,
    kind_of,
    set_up,
)
from kontronik_can_gw.status import CanState
from kontronik_can_gw.times import SECOND

_RECEIVE_BUFFER = 1 << 20
"""Size in bytes that is requested. The kernel limits it to net.core.rmem_max.

By default, the socket then holds twice the usual 278 frames.
"""
_SEND_BUFFER = 1
"""Size in bytes that is requested. The kernel grants its minimum, about six frames.

Newer values cannot replace frames in this buffer, so it should be short.
"""

_CLASSIC = struct.Struct("=IB3x8s")
_FD = struct.Struct("=IBB2x64s")
_FD_BRS = 0x01
_REMOTE = 0x40000000
_ERROR_FLAG = 0x20000000
_FILTER = struct.Struct("=II")
_MAX_FILTERS = 512
"""CAN_RAW_FILTER_MAX, the kernel's limit for one socket."""
# Classes of error frames (linux/can/error.h)
_ERR_CONTROLLER = 0x04
_ERR_BUS_OFF = 0x40
_ERR_RESTARTED = 0x100
# Details of _ERR_CONTROLLER
_CTRL_RX_OVERFLOW = 0x01
_CTRL_WARNING = 0x0C
_CTRL_PASSIVE = 0x30
_CTRL_ACTIVE = 0x40
_CAN_RAW_ERR_FILTER = 2
_SO_TIMESTAMPNS = 64
"""Requests times of reception. Kernels before 5.1 do not have it: the time of the read is used."""
_TIME = struct.Struct("=qq")
_ANCILLARY_SIZE = 64
_MAX_DIGITS = 32
"""Bytes that are read of a number in /sys."""
_SO_MEMINFO = 55
"""Requests the kernel's figures of a socket."""
_MEMINFO = struct.Struct("=9I")
_QUEUED_BYTES = 2
"""Place of the memory of the frames that were accepted and that no driver has taken."""
_DROPPED = 8
"""Place of the number of frames that a full queue has dropped."""


class SocketCanPort(CanPort):
    """A raw socket that is bound to an interface."""

    is_socket = True

    def __init__(self, opened: socket.socket, count_fd: int = -1) -> None:
        """Use a bound socket. ``count_fd``, unless it is -1, is closed with it."""
        super().__init__()
        self._socket = opened
        self.count_fd = count_fd
        # Until ``set_receive_ids`` is called, only error frames wake the process.
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 0)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        with contextlib.suppress(OSError):
            opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        opened.setblocking(False)

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()
        if self.count_fd >= 0:
            os.close(self.count_fd)
            self.count_fd = -1

    def frames_left(self) -> int:
        try:
            return int(os.pread(self.count_fd, _MAX_DIGITS, 0))
        except (OSError, ValueError):  # the interface was removed, or its kernel does not count
            return UNCOUNTED

    def frames_queued(self) -> int:
        size = self._meminfo(_QUEUED_BYTES)
        if size:
            self.frame_size = min(size, self.frame_size or size)
        return -(-size // self.frame_size) if size else 0

    def _meminfo(self, place: int) -> int:
        """Return one of the kernel's figures of the socket. 0 if an old kernel does not have it."""
        try:
            found = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
            return int(_MEMINFO.unpack(found)[place])
        except (OSError, struct.error):
            return 0

    def _filter(self) -> None:
        packed = b"".join(_FILTER.pack(*each) for each in kernel_filters(self._ids))
        try:
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
        except OSError:  # the interface was removed
            self.is_gone = True

    def receive(self, limit: int = RECEIVE_LIMIT) -> Received:
        frames: Received = []
        self.is_drained = True
        for _ in range(limit):
            try:
                data, ancillary, _, _ = self._socket.recvmsg(_FD.size, _ANCILLARY_SIZE)
            except BlockingIOError:
                break
            except OSError as error:
                if error.errno in (errno.ENETDOWN, errno.ENODEV):
                    self.state = CanState.DOWN
                    self.is_gone = self.is_gone or error.errno == errno.ENODEV
                break
            is_fd = len(data) != _CLASSIC.size
            if is_fd:
                if len(data) != _FD.size:
                    continue
                can_id, size, _, content = _FD.unpack(data)
            else:
                can_id, size, content = _CLASSIC.unpack(data)
            if can_id & _ERROR_FLAG:
                self._follow(can_id, content[1])
            elif self._is_wanted(can_id):
                # The flag of a remote frame is a part of ``can_id``, so such a frame is not wanted.
                frame = CanFrame(can_id & ~EXTENDED, content[:size], bool(can_id & EXTENDED), is_fd)
                frames.append((frame, _monotonic(ancillary)))
        else:
            self.is_drained = False
            self._note_drops()  # so many frames may have overflowed the kernel's queue
        return frames

    def _drops(self) -> int:
        return self._meminfo(_DROPPED)

    def _follow(self, can_id: int, detail: int) -> None:
        if can_id & _ERR_BUS_OFF:
            self.note_state(CanState.BUS_OFF)
        elif can_id & _ERR_RESTARTED:
            self.state = CanState.ERROR_ACTIVE
        elif can_id & _ERR_CONTROLLER:
            self.overruns += bool(detail & _CTRL_RX_OVERFLOW)
            if detail & _CTRL_PASSIVE:
                self.state = CanState.ERROR_PASSIVE
            elif detail & _CTRL_WARNING:
                self.state = CanState.ERROR_WARNING
            elif detail & _CTRL_ACTIVE:
                self.state = CanState.ERROR_ACTIVE

    def _send_each(
        self,
        frames: Sequence[CanFrame],
        clock: Callable[[], int],
        latest: int,
    ) -> tuple[int, Sent]:
        count = 0
        for can_id, data, extended, fd, _, remote, _ in frames:
            if clock() > latest:
                return count, Sent.LATE
            if extended:
                can_id |= EXTENDED
            if remote:
                can_id |= _REMOTE
            if fd:
                packed = _FD.pack(can_id, len(data), _FD_BRS, data)
            else:
                packed = _CLASSIC.pack(can_id, len(data), data)
            try:
                self._socket.send(packed)
            except OSError as error:
                answer = self._send_again(packed, error)
                if answer is not Sent.OK:
                    return count, answer
            count += 1
        return count, Sent.OK

    def _send_again(self, packed: bytes, refused: OSError) -> Sent:
        """Return the result of a refused frame.

        An interface that was down and is up again reports its old error once. In this case the
        frame is sent again.
        """
        answer = _meaning(refused)
        if answer is not Sent.DOWN:
            return answer
        try:
            self._socket.send(packed)
        except OSError as error:
            return _meaning(error)
        return Sent.OK


def _monotonic(ancillary: Sequence[tuple[int, int, bytes]]) -> int | None:
    """Return a frame's time of reception on the monotonic clock, or None if it is unknown."""
    for level, kind, data in ancillary:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS, _TIME.size):
            seconds, ns = _TIME.unpack(data)
            return int(seconds * SECOND + ns - time.time_ns() + time.monotonic_ns())
    return None


def _meaning(error: OSError) -> Sent:
    """Return the result for a frame that the kernel refused with this error."""
    if error.errno == errno.EAGAIN:
        return Sent.FULL
    if error.errno in (errno.ENOBUFS, errno.ENOMEM):
        return Sent.BUSY
    if error.errno in (errno.ENXIO, errno.ENODEV, errno.EBADF):
        return Sent.GONE
    return Sent.DOWN


def kernel_filters(ids: frozenset[int]) -> list[tuple[int, int]]:
    """Return the (id, mask) pairs of a filter that lets data frames with these ids pass.

    If there are too many ids, each pair lets a block of 2, 4, 8 or more ids pass that contains at
    least one of them. The flags are a part of the mask. So remote frames, and frames of the other
    id length with the same number, do not pass.
    """
    flags = EXTENDED | _REMOTE
    wanted_blocks = [id_and_mask(each) for each in sorted(ids) if each >> 32]
    found = [(first, flags | mask & MAX_EXTENDED_ID) for first, mask in wanted_blocks]
    ids = frozenset(each for each in ids if not each >> 32)
    step = 1
    while len({can_id // step for can_id in ids}) > _MAX_FILTERS - len(found):
        step *= 2
    low_bits = step - 1
    for first in sorted({can_id // step * step for can_id in ids}):
        id_bits = MAX_EXTENDED_ID if first & EXTENDED else MAX_STANDARD_ID
        found.append((first, flags | id_bits & ~low_bits))
    return found


def fault_of(name: str) -> int:
    """Return the reason why a network interface cannot be used, as errno: ENODEV or ENETDOWN.

    0 if the interface is up, or if the reason is unknown.
    """
    interfaces = Path("/sys/class/net")
    try:
        flags = int((interfaces / name / "flags").read_text(), 16)
    except OSError:
        is_missing = (interfaces / "lo").exists() and not (interfaces / name).exists()
        return errno.ENODEV if is_missing else 0
    except ValueError:
        return 0
    return 0 if flags & 1 else errno.ENETDOWN


def open_socketcan(config: CanConfig) -> SocketCanPort:
    """Open an interface without python-can, which would take 8 MB and 80 ms.

    Raises RunError with the remedy if that fails, or if the interface is down.
    """
    name = config.channel
    mtu = Path("/sys/class/net", name, "mtu")
    if config.fd and mtu.exists() and int(mtu.read_text()) < _FD.size:
        command = enable_fd(config, kind_of(name))
        raise RunError(
            f"CAN interface {name}: CAN FD is not switched on. "
            f"Switch it on: {command}. Otherwise set can.fd = false."
        )
    try:
        with contextlib.ExitStack() as undone:
            opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            undone.enter_context(opened)
            number = fault_of(name)
            if number:
                raise OSError(number, os.strerror(number))
            if config.fd:
                opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            opened.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, MAX_EXTENDED_ID)
            opened.bind((name,))
            port = SocketCanPort(opened, _open_count(name))
            undone.pop_all()
            return port
    except OSError as error:
        raise socketcan_error(config, error.errno or 0, error.strerror or str(error)) from None
    except AttributeError:  # this Python was built without SocketCAN
        raise socketcan_error(config, errno.EAFNOSUPPORT) from None


def _open_count(name: str) -> int:
    """Open the file with an interface's number of sent frames. Returns -1 if there is none."""
    try:
        return os.open(f"/sys/class/net/{name}/statistics/tx_packets", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return -1


def socketcan_error(config: CanConfig, number: int, text: str = "") -> RunError:
    """Return the error for an interface that cannot be used, with the remedy.

    ``number`` is an errno. ``text`` describes errors for which there is no remedy.
    """
    name = config.channel
    if number in (errno.ENODEV, errno.ENXIO):
        kind = kind_of(name)
        virtual = add_virtual(config)
        if kind in VIRTUAL:
            return RunError(f"CAN interface {name}: does not exist. Create it: {virtual}.")
        return RunError(
            f"CAN interface {name}: does not exist. "
            f"If its adapter is plugged in: {set_up(config, kind)}. "
            f"For a virtual interface: {virtual}."
        )
    if number in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        return RunError(
            f"CAN interface {name}: this kernel has no SocketCAN. "
            "Try: sudo modprobe -a can_raw vcan."
        )
    if number == errno.ENETDOWN:
        command = set_up(config, kind_of(name))
        return RunError(f"CAN interface {name}: is down. Start it: {command}.")
    return RunError(f"CAN interface {name}: cannot be opened: {text}")
