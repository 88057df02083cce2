"""The CAN interface: any of python-can's; SocketCAN without waiting, by its own socket.

``send`` never blocks on SocketCAN and never raises: it says what became of the frame. ``receive`` never blocks and never raises. Data
frames come only with ids that were asked for, so that foreign traffic does not wake the process. Ids here are as SocketCAN has them:
bit 31 marks a 29-bit one.
"""

import contextlib
import difflib
import errno
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.config.keys import CanConfig
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.esc.telemetry import SECOND
from kontronik_can_gw.esc.values import CanState
from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.runtime.bus_reader import QUEUE_LENGTH, BusReader
from kontronik_can_gw.transmit_queue import Sent

if TYPE_CHECKING:
    import can

RECEIVE_LIMIT = 64
"""Frames, error frames among them, that one call of ``receive`` takes at most."""
_DISCARD_LIMIT = 4096
_RECEIVE_BUFFER = 1 << 20
"""Bytes asked for; the kernel grants what net.core.rmem_max allows, by default twice the usual 278 frames."""
_SEND_BUFFER = 1
"""Bytes asked for; the kernel gives its least, about six frames: what waits in there cannot be overtaken by newer values."""

_CLASSIC = struct.Struct("=IB3x8s")
_FD = struct.Struct("=IBB2x64s")
_FD_BRS = 0x01
_REMOTE = 0x40000000
_ERROR_FLAG = 0x20000000
_STANDARD_ID, _EXTENDED_ID = 0x7FF, 0x1FFFFFFF
_FILTER = struct.Struct("=II")
_MAX_FILTERS = 512
"""CAN_RAW_FILTER_MAX: the kernel takes no more for one socket."""
_ERR_CONTROLLER, _ERR_BUS_OFF, _ERR_RESTARTED = 0x04, 0x40, 0x100
_CTRL_RX_OVERFLOW, _CTRL_WARNING, _CTRL_PASSIVE, _CTRL_ACTIVE = 0x01, 0x0C, 0x30, 0x40
_OK = Sent.OK
_DOWN, _UNKNOWN = CanState.DOWN, CanState.UNKNOWN
_CAN_RAW_ERR_FILTER = 2
_SO_TIMESTAMPNS, _SO_TIMESTAMPNS_OLD = 64, 35
"""Times of reception, of two 64-bit numbers on every machine; and of kernels before 5.1, of the machine's own."""
_TIMES = {16: struct.Struct("=qq"), 8: struct.Struct("=ii")}
_ANCILLARY_SIZE = 64
_SO_MEMINFO, _MEMINFO = 55, struct.Struct("=9I")
"""The kernel's figures of a socket; the last one counts what it dropped for want of room."""


class CanPort:
    """An open interface that is up. RunError with one clear line where it cannot be opened, or is down."""

    def __init__(self, config: CanConfig) -> None:
        self.config = config
        self.state = CanState.UNKNOWN
        self.bus_off_count = 0
        """How often the controller went to bus-off; who counts them may set it back to 0."""
        self.overruns = 0
        """How often received frames were lost, in the controller or because we were late; who counts them may set it back to 0."""
        self.drained = True
        """Whether the last ``receive`` left nothing: what it did not return may have been taken, as error frames are."""
        self._known_drops = 0
        self._bus: Any = _open(config)
        self._ids: frozenset[int] = frozenset()
        self._reader: BusReader | None = None
        self._removed = False
        self._socket: socket.socket | None = (
            getattr(self._bus, "socket", None) if config.interface == "socketcan" else None
        )
        if self._socket is not None:
            # until ids are asked for only error frames (the socket asks for them) wake the process
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 0)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            for option in (_SO_TIMESTAMPNS, _SO_TIMESTAMPNS_OLD):
                with contextlib.suppress(OSError):
                    self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
                    break
            self._socket.setblocking(False)

    def fileno(self) -> int | None:
        """Readable when ``receive`` has something to do; None where nothing can come. ``set_receive_ids`` may change it."""
        if self._socket is not None:
            return self._socket.fileno()
        return None if self._reader is None else self._reader.fileno()

    @property
    def tells_busy_from_gone(self) -> bool:
        """False where a send that fails for want of room and one on a dead adapter look the same: without a socket of our own."""
        return self._socket is not None

    @property
    def gone(self) -> bool:
        """True when reception found that the interface was removed or its driver failed: close it and open it anew."""
        return self._removed or (self._reader is not None and self._reader.failed)

    @property
    def waits_to_be_read(self) -> bool:
        """True while ``receive`` would find something."""
        fd = self.fileno()
        return fd is not None and _is_readable(fd)

    def note_state(self, state: CanState) -> None:
        """What else is known of the controller (rtnetlink)."""
        self.bus_off_count += state is CanState.BUS_OFF and self.state is not CanState.BUS_OFF
        self.state = state

    def set_receive_ids(self, ids: Collection[int]) -> None:
        """From now on receive data frames with these ids and no others. ValueError for what is no id.

        On SocketCAN by the kernel's filters; elsewhere by python-can's, with a thread that reads as soon as there is an id.
        """
        if any(
            not 0 <= can_id <= _STANDARD_ID and not EXTENDED <= can_id <= EXTENDED | _EXTENDED_ID
            for can_id in ids
        ):
            raise ValueError(f"no identifiers: {sorted(ids)}")
        self._ids = frozenset(ids)
        if self._socket is not None:
            packed = b"".join(_FILTER.pack(*each) for each in _kernel_filters(self._ids))
            try:
                self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
            except OSError:  # of an interface that was removed a moment ago
                self._removed = True
        elif self._reader is not None or self._ids:
            self._filter_bus()
            if self._reader is None:
                self._reader = BusReader(self._bus, self._ids)
            self._reader.ids = self._ids

    def receive(self) -> list[tuple[CanFrame, int | None]]:
        """The data frames that have come, oldest first, at most RECEIVE_LIMIT; follow the controller's state from error frames.

        With each the time at which it came, on the monotonic clock; None where that is not known.
        """
        return self._receive(RECEIVE_LIMIT)

    def discard(self) -> None:
        """Throw away the data frames that wait to be received. What error frames say still counts; data frames lost before do not."""
        self._receive(_DISCARD_LIMIT if self._reader is None else QUEUE_LENGTH)
        self._known_drops = self._drops()

    def send(self, frame: CanFrame) -> Sent:
        """Hand one frame to the interface."""
        return self.send_all((frame,))[1]

    def send_all(
        self,
        frames: Sequence[CanFrame],
        clock: Callable[[], int] = time.monotonic_ns,
        latest: int = sys.maxsize,
    ) -> tuple[int, Sent]:
        """Hand frames to the interface until it does not take one, or ``clock`` is beyond ``latest``.

        Returns how many went and the last answer. An interface that was down and is up again reports its old error once: retried.
        """
        send = self._send_message if self._socket is None else self._send_packed
        count, answer = (0, Sent.GONE) if self.gone else one_by_one(send, frames, clock, latest)
        if count and (self.state is _DOWN or self.state is _UNKNOWN):
            self.state = CanState.ERROR_ACTIVE
        if answer is Sent.DOWN or answer is Sent.GONE:
            self.state = _DOWN
        return count, answer

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()  # before the driver is shut down: few of them bear both at once
        with contextlib.suppress(
            Exception
        ):  # an interface that is gone may fail in its own ways; nothing is left to do
            self._bus.shutdown()

    def _receive(self, limit: int) -> list[tuple[CanFrame, int | None]]:
        frames: list[tuple[CanFrame, int | None]] = []
        if self._reader is not None:
            frames += self._reader.take(limit)
            self.drained = len(frames) < limit
            if self._reader.failed:
                self.state = CanState.DOWN
            self._note_drops()
            return frames
        self.drained = True
        if self._socket is None:
            return frames
        for _ in range(limit):
            try:
                data, ancillary, _, _ = self._socket.recvmsg(_FD.size, _ANCILLARY_SIZE)
            except BlockingIOError:
                break
            except OSError as error:
                if error.errno in (errno.ENETDOWN, errno.ENODEV):
                    self.state = CanState.DOWN
                    self._removed = self._removed or error.errno == errno.ENODEV
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
            elif can_id in self._ids:
                # with another flag set, of a remote frame, it is none of ours
                frame = CanFrame(can_id & ~EXTENDED, content[:size], bool(can_id & EXTENDED), is_fd)
                frames.append((frame, _monotonic(ancillary)))
        else:
            self.drained = False
            self._note_drops()  # there was more than we take at once: perhaps more than the kernel holds
        return frames

    def _note_drops(self) -> None:
        drops = self._drops()
        self.overruns += drops != self._known_drops
        self._known_drops = drops

    def _drops(self) -> int:
        """Received frames that were dropped since opening because too many waited for us."""
        if self._reader is not None:
            return self._reader.dropped
        if self._socket is None:
            return 0
        try:
            return int(
                _MEMINFO.unpack(
                    self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
                )[-1]
            )
        except (OSError, struct.error):  # an old kernel, which has fewer figures
            return 0

    def _filter_bus(self) -> None:
        """Ask python-can's driver for our ids; one that cannot filter is left to the thread."""
        filters = [
            {"can_id": each & ~EXTENDED, "can_mask": _EXTENDED_ID, "extended": True}
            if each & EXTENDED
            else {"can_id": each, "can_mask": _STANDARD_ID, "extended": False}
            for each in sorted(self._ids)
        ]
        for wanted in (filters, None):
            with contextlib.suppress(Exception):  # each driver fails in its own way
                self._bus.set_filters(wanted)
                return
        self._removed = True

    def _follow(self, can_id: int, detail: int) -> None:
        if can_id & _ERR_BUS_OFF:
            self.bus_off_count += self.state is not CanState.BUS_OFF
            self.state = CanState.BUS_OFF
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

    def _send_packed(self, frame: CanFrame) -> Sent:
        can_id, data, extended, fd, _, remote, _ = frame
        if extended:
            can_id |= EXTENDED
        if remote:
            can_id |= _REMOTE
        packed = (
            _FD.pack(can_id, len(data), _FD_BRS, data)
            if fd
            else _CLASSIC.pack(can_id, len(data), data)
        )
        try:
            self._socket.send(packed)  # type: ignore[union-attr]  # there is one where this is called
        except OSError as error:
            answer = _meaning(error)
            return self._send_again(packed) if answer is Sent.DOWN else answer
        return _OK

    def _send_again(self, packed: bytes) -> Sent:
        try:
            self._socket.send(packed)  # type: ignore[union-attr]
        except OSError as error:
            return _meaning(error)
        return _OK

    def _send_message(self, frame: CanFrame) -> Sent:
        import can

        message = can.Message(
            arbitration_id=frame.can_id,
            data=frame.data,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
        )
        try:
            self._bus.send(message, timeout=0)
        except can.CanError:
            return Sent.BUSY
        except Exception:
            # what a driver lets out when its adapter has gone: OSError, termios.error ...
            return Sent.GONE
        return Sent.OK


def _monotonic(ancillary: Sequence[tuple[int, int, bytes]]) -> int | None:
    """The time of reception that came with a frame, on the monotonic clock."""
    for level, kind, data in ancillary:
        if (
            level == socket.SOL_SOCKET
            and kind in (_SO_TIMESTAMPNS, _SO_TIMESTAMPNS_OLD)
            and len(data) in _TIMES
        ):
            seconds, ns = _TIMES[len(data)].unpack(data)
            return int(seconds * SECOND + ns - time.time_ns() + time.monotonic_ns())
    return None


def one_by_one(
    send: Callable[[CanFrame], Sent],
    frames: Sequence[CanFrame],
    clock: Callable[[], int],
    latest: int,
) -> tuple[int, Sent]:
    """Send frames until one is not taken, or ``clock`` is beyond ``latest``: how many went, and the last answer."""
    for count, frame in enumerate(frames):
        if clock() > latest:  # the process was stopped in the middle of its turn
            return count, Sent.LATE
        answer = send(frame)
        if answer is not _OK:
            return count, answer
    return len(frames), _OK


def _meaning(error: OSError) -> Sent:
    """What it says that the kernel did not take a frame."""
    if error.errno == errno.EAGAIN:
        return Sent.FULL
    if error.errno in (errno.ENOBUFS, errno.ENOMEM):
        return Sent.BUSY
    return Sent.GONE if error.errno in (errno.ENXIO, errno.ENODEV, errno.EBADF) else Sent.DOWN


def _kernel_filters(ids: frozenset[int]) -> list[tuple[int, int]]:
    """(id, mask) pairs that let these data frames through; with too many ids blocks of 2, 4 ... of which one is wanted.

    The flags are part of the mask, so that remote frames, and those of the other length, with the same number stay out.
    """
    step = 1
    while len({can_id // step for can_id in ids}) > _MAX_FILTERS:
        step *= 2
    blocks = sorted({can_id // step * step for can_id in ids})
    flags, low = EXTENDED | _REMOTE, step - 1
    return [
        (first, flags | (_EXTENDED_ID if first & EXTENDED else _STANDARD_ID) & ~low)
        for first in blocks
    ]


def check_interface(config: CanConfig) -> None:
    """UserError for an interface that python-can does not know."""
    if config.interface == "socketcan":
        return
    with without_asammdf():
        import can
    if config.interface not in can.VALID_INTERFACES:
        near = difflib.get_close_matches(config.interface, can.VALID_INTERFACES, n=1)
        hint = (
            f" Did you mean {near[0]}?"
            if near
            else f" Known: {', '.join(sorted(can.VALID_INTERFACES))}."
        )
        raise UserError(f"can.interface: {config.interface!r} is no interface of python-can.{hint}")


def fault_of(name: str) -> int:
    """Why a network interface cannot be used, as in errno: ENODEV, ENETDOWN; 0 where it is up or there is no way to know."""
    interfaces = Path("/sys/class/net")
    try:
        return 0 if int((interfaces / name / "flags").read_text(), 16) & 1 else errno.ENETDOWN
    except OSError:
        return (
            errno.ENODEV if (interfaces / "lo").exists() and not (interfaces / name).exists() else 0
        )
    except ValueError:
        return 0


def _has_socketcan() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        return False
    return True


def _is_readable(fd: int) -> bool:
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(0))


class _SocketCan:
    """A raw socket on a CAN interface: what CanPort uses of python-can's bus, without 8 MB and 80 ms of python-can."""

    def __init__(self, config: CanConfig) -> None:
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            if config.fd:
                self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            self.socket.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _EXTENDED_ID)
            self.socket.bind((config.channel,))
        except OSError:
            self.socket.close()
            raise

    def shutdown(self) -> None:
        self.socket.close()


def _open(config: CanConfig) -> "can.BusABC | _SocketCan":
    mtu = Path("/sys/class/net", config.channel, "mtu")
    if (
        config.interface == "socketcan"
        and config.fd
        and mtu.exists()
        and int(mtu.read_text()) < _FD.size
    ):
        name = config.channel
        raise RunError(
            f"CAN interface {name}: does not do CAN FD. Adapter: sudo ip link set {name} up type can bitrate {config.bitrate} "
            f"dbitrate {config.data_bitrate} fd on; vcan: sudo ip link set {name} mtu {_FD.size}; or set can.fd = false."
        )
    if config.interface == "socketcan" and (
        number := fault_of(config.channel)
    ):  # before it is tried, which takes a while
        raise socketcan_error(config, number if _has_socketcan() else errno.EAFNOSUPPORT)
    if config.interface == "socketcan" and not config.options:
        try:
            return _SocketCan(config)
        except OSError as error:
            raise socketcan_error(config, error.errno or 0, error.strerror or str(error)) from None
        except AttributeError:  # a Python that was built without it
            raise socketcan_error(config, errno.EAFNOSUPPORT) from None
    with without_asammdf():
        import can

    check_interface(config)
    options: dict[str, Any] = {}
    if config.interface != "socketcan":
        options["bitrate"] = config.bitrate
    if config.fd:
        options["fd"] = True
        if config.interface != "socketcan":
            options["data_bitrate"] = config.data_bitrate
    options.update(config.options)
    try:
        return can.Bus(interface=config.interface, channel=config.channel, **options)
    except OSError as error:
        if config.interface == "socketcan":
            raise socketcan_error(config, error.errno or 0, error.strerror or str(error)) from None
        raise RunError(
            f"CAN {config.interface} {config.channel}: cannot be opened: {error}"
        ) from None
    except Exception as error:  # each of python-can's drivers fails in its own ways, a missing vendor library as NameError
        raise RunError(
            f"CAN {config.interface} {config.channel}: cannot be opened: {error}"
        ) from None


def socketcan_error(config: CanConfig, number: int, text: str = "") -> RunError:
    """What is said of an interface that cannot be used, with the remedy. ``number`` as in errno."""
    name = config.channel
    make = f"sudo ip link set {name} up type can bitrate {config.bitrate} restart-ms 100"
    if number in (errno.ENODEV, errno.ENXIO):
        virtual = f"sudo ip link add {name} type vcan && sudo ip link set {name} up"
        return RunError(
            f"CAN interface {name}: there is none. With an adapter plugged in: {make}. For a virtual one: {virtual}."
        )
    if number in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        return RunError(
            f"CAN interface {name}: this kernel has no SocketCAN. Try: sudo modprobe -a can_raw vcan."
        )
    if number == errno.ENETDOWN:
        return RunError(f"CAN interface {name}: is down. Start it: {make}.")
    return RunError(f"CAN interface {name}: cannot be opened: {text}")
