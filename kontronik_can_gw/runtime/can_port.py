"""The CAN interface: any of python-can's; SocketCAN without waiting, by its own socket.

``send`` never blocks on SocketCAN and never raises: it says what became of the frame.
"""

import contextlib
import difflib
import errno
import socket
import struct
import sys
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kontronik_can_gw.config import CanConfig
from kontronik_can_gw.errors import RunError, UserError
from kontronik_can_gw.frames import CanFrame
from kontronik_can_gw.lean import without_asammdf
from kontronik_can_gw.sources import CanState

if TYPE_CHECKING:
    import can

_CLASSIC = struct.Struct("=IB3x8s")
_FD = struct.Struct("=IBB2x64s")
_FD_BRS = 0x01
_EXTENDED = 0x80000000
_ERROR_FLAG = 0x20000000
_ERR_CONTROLLER, _ERR_BUS_OFF, _ERR_RESTARTED = 0x04, 0x40, 0x100
_CTRL_WARNING, _CTRL_PASSIVE, _CTRL_ACTIVE = 0x0C, 0x30, 0x40


class Sent(Enum):
    """What became of a frame: accepted, not now (queue full), or the interface is down or gone."""

    OK = 1
    BUSY = 2
    DOWN = 3
    GONE = 4


class CanPort:
    """An open interface. RunError with one clear line where it cannot be opened."""

    def __init__(self, config: CanConfig) -> None:
        self.config = config
        self.state = CanState.UNKNOWN
        self._bus = _open(config)
        self._socket: socket.socket | None = (
            getattr(self._bus, "socket", None) if config.interface == "socketcan" else None
        )
        if self._socket is not None:
            # no data frame is of interest: only error frames (python-can asks for them) wake the process
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
            self._socket.setblocking(False)

    def fileno(self) -> int | None:
        """Readable when ``receive_errors`` has something to do; None where the interface has no descriptor."""
        return None if self._socket is None else self._socket.fileno()

    def send(self, frame: CanFrame) -> Sent:
        """Hand a frame to the interface. An interface that was down and is up again reports its old error once: retried."""
        result = self._send(frame)
        if result is Sent.DOWN:
            result = self._send(frame)
        if result is Sent.OK and self.state in (CanState.UNKNOWN, CanState.DOWN):
            self.state = CanState.ERROR_ACTIVE
        elif result in (Sent.DOWN, Sent.GONE):
            self.state = CanState.DOWN
        return result

    def receive_errors(self) -> None:
        """Follow the controller's state from error frames; what else has come is dropped."""
        if self._socket is None:
            return
        for _ in range(64):
            try:
                data = self._socket.recv(72)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in (errno.ENETDOWN, errno.ENODEV):
                    self.state = CanState.DOWN
                return
            if len(data) < 16:
                return
            can_id, detail = int.from_bytes(data[:4], sys.byteorder), data[9]
            if can_id & _ERROR_FLAG:
                self._follow(can_id, detail)

    def close(self) -> None:
        with contextlib.suppress(
            Exception
        ):  # an interface that is gone may fail in its own ways; nothing is left to do
            self._bus.shutdown()

    def _follow(self, can_id: int, detail: int) -> None:
        if can_id & _ERR_BUS_OFF:
            self.state = CanState.BUS_OFF
        elif can_id & _ERR_RESTARTED:
            self.state = CanState.ERROR_ACTIVE
        elif can_id & _ERR_CONTROLLER:
            if detail & _CTRL_PASSIVE:
                self.state = CanState.ERROR_PASSIVE
            elif detail & _CTRL_WARNING:
                self.state = CanState.ERROR_WARNING
            elif detail & _CTRL_ACTIVE:
                self.state = CanState.ERROR_ACTIVE

    def _send(self, frame: CanFrame) -> Sent:
        if self._socket is None:
            return self._send_message(frame)
        can_id = frame.can_id | _EXTENDED if frame.extended else frame.can_id
        size = len(frame.data)
        if frame.fd:
            packet = _FD.pack(can_id, size, _FD_BRS, frame.data)
        else:
            packet = _CLASSIC.pack(can_id, size, frame.data)
        try:
            self._socket.send(packet)
        except OSError as error:
            if error.errno in (errno.ENOBUFS, errno.EAGAIN, errno.ENOMEM):
                return Sent.BUSY
            return Sent.GONE if error.errno in (errno.ENXIO, errno.ENODEV, errno.EBADF) else Sent.DOWN
        return Sent.OK

    def _send_message(self, frame: CanFrame) -> Sent:
        import can

        message = can.Message(
            arbitration_id=frame.can_id,
            data=frame.data,
            is_extended_id=frame.extended,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
        )
        try:
            self._bus.send(message, timeout=0)
        except can.CanError:
            return Sent.BUSY
        except Exception:  # what a driver lets out when its adapter has gone: OSError, termios.error ...
            return Sent.GONE
        return Sent.OK


def check_interface(config: CanConfig) -> None:
    """UserError for an interface that python-can does not know."""
    with without_asammdf():
        import can
    if config.interface not in can.VALID_INTERFACES:
        near = difflib.get_close_matches(config.interface, can.VALID_INTERFACES, n=1)
        hint = f" Did you mean {near[0]}?" if near else f" Known: {', '.join(sorted(can.VALID_INTERFACES))}."
        raise UserError(f"can.interface: {config.interface!r} is no interface of python-can.{hint}")


def _open(config: CanConfig) -> "can.BusABC":
    with without_asammdf():
        import can

    check_interface(config)
    options: dict[str, Any] = {}
    mtu = Path("/sys/class/net", config.channel, "mtu")
    if config.interface == "socketcan" and config.fd and mtu.exists() and int(mtu.read_text()) < _FD.size:
        name = config.channel
        raise RunError(
            f"CAN interface {name}: does not do CAN FD. Adapter: sudo ip link set {name} up type can bitrate {config.bitrate} "
            f"dbitrate {config.data_bitrate} fd on; vcan: sudo ip link set {name} mtu {_FD.size}; or set can.fd = false."
        )
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
            raise _socketcan_error(config, error) from None
        raise RunError(f"CAN {config.interface} {config.channel}: cannot be opened: {error}") from None
    except (
        Exception
    ) as error:  # each of python-can's drivers fails in its own ways, a missing vendor library as NameError
        raise RunError(f"CAN {config.interface} {config.channel}: cannot be opened: {error}") from None


def _socketcan_error(config: CanConfig, error: OSError) -> RunError:
    name = config.channel
    make = f"sudo ip link set {name} up type can bitrate {config.bitrate} restart-ms 100"
    if error.errno in (errno.ENODEV, errno.ENXIO):
        virtual = f"sudo ip link add {name} type vcan && sudo ip link set {name} up"
        return RunError(
            f"CAN interface {name}: there is none. With an adapter plugged in: {make}. For a virtual one: {virtual}."
        )
    if error.errno in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        return RunError(f"CAN interface {name}: this kernel has no SocketCAN. Try: sudo modprobe can_raw vcan.")
    if error.errno == errno.ENETDOWN:
        return RunError(f"CAN interface {name}: is down. Start it: {make}.")
    return RunError(f"CAN interface {name}: cannot be opened: {error.strerror or error}")
