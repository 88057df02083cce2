"""What the kernel reports of one network interface by rtnetlink: whether it is there, up, and how its CAN controller is.

Nothing is changed by it and no privilege is needed. Source of the numbers: linux/rtnetlink.h, if_link.h, can/netlink.h.
"""

import contextlib
import errno
import socket
import struct
import sys
from collections.abc import Iterator
from typing import NamedTuple

from kontronik_can_gw.status import CanState

_ROUTE, _LINK_GROUP = 0, 1
_HEADER = struct.Struct("=IHHII")
_INTERFACE = struct.Struct("=BxHiII")
_ATTRIBUTE = struct.Struct("=HH")
_NEW_LINK, _DELETED_LINK, _GET_LINK, _ERROR = 16, 17, 18, 2
_REQUEST = 1
_UP = 0x1
_RUNS = 0x40 | 0x10000
"""IFF_RUNNING, which the kernel may report a second late, and IFF_LOWER_UP: the controller is on."""
_NAME, _LINK_INFO, _INFO_KIND, _INFO_DATA = 3, 18, 1, 2
_BIT_TIMING, _STATE, _RESTART_MS, _ERROR_COUNTERS = 1, 4, 6, 8
_EXT_MASK, _WITHOUT_STATISTICS = 29, struct.pack("=I", 8)
"""What is left out of an answer: counters of traffic. Without them it is the same as before, as a rule."""
_TYPE_MASK = 0x3FFF
_BUFFER = 1 << 16
_STATES = (CanState.ERROR_ACTIVE, CanState.ERROR_WARNING, CanState.ERROR_PASSIVE, CanState.BUS_OFF)


class LinkFacts(NamedTuple):
    """An interface as the kernel knows it. ``state`` is None where there is no controller (vcan) or it does not run.

    ``bitrate`` in bit/s, ``restart_ms`` 0: a controller in bus-off stays there; None where the driver does not report it.
    """

    exists: bool
    up: bool = False
    kind: str = ""
    state: CanState | None = None
    bitrate: int | None = None
    restart_ms: int | None = None
    error_counters: tuple[int, int] | None = None
    """Transmit and receive error counter of the controller."""
    running: bool = True
    """False while what is sent is dropped unseen: the controller is off, or its queue not started again."""


class LinkMonitor:
    """Receives every change of one interface; asks for what is not reported unasked. OSError where the system has no rtnetlink."""

    def __init__(self, name: str) -> None:
        self._name = name.encode()
        body = _INTERFACE.pack(0, 0, 0, 0, 0) + _attribute(_NAME, self._name + b"\0")
        body += _attribute(_EXT_MASK, _WITHOUT_STATISTICS)
        self._question = _HEADER.pack(_HEADER.size + len(body), _GET_LINK, _REQUEST, 0, 0) + body
        self._heard: tuple[bytes, list[LinkFacts]] = b"", []
        """The last datagram and what it says."""
        self._socket = socket.socket(
            socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, _ROUTE
        )
        try:
            self._socket.bind((0, _LINK_GROUP))
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def ask(self) -> None:
        """Let the kernel report how the interface is now: ``take`` gives the answer, at once."""
        with contextlib.suppress(OSError):
            self._socket.send(self._question)

    def take(self) -> list[LinkFacts]:
        """What was reported of the interface since the last call, oldest first."""
        found: list[LinkFacts] = []
        while True:
            try:
                data = self._socket.recv(_BUFFER)
            except BlockingIOError:
                return found
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    return found
                self.ask()  # more was reported than we read: what counts is how it is now
                continue
            if data != self._heard[0]:
                facts = [self._facts(kind, body) for kind, body in _messages(data)]
                self._heard = data, [each for each in facts if each is not None]
            found += self._heard[1]

    def close(self) -> None:
        self._socket.close()

    def _facts(self, kind: int, body: bytes) -> LinkFacts | None:
        if kind == _ERROR and len(body) >= 4:
            (code,) = struct.unpack_from("=i", body)
            return LinkFacts(exists=False) if -code in (errno.ENODEV, errno.ENXIO) else None
        if kind not in (_NEW_LINK, _DELETED_LINK) or len(body) < _INTERFACE.size:
            return None
        attributes = _attributes(body, _INTERFACE.size)
        if attributes.get(_NAME, b"").rstrip(b"\0") != self._name:
            return None
        if kind == _DELETED_LINK:
            return LinkFacts(exists=False)
        flags = _INTERFACE.unpack_from(body)[3]
        info = _attributes(attributes.get(_LINK_INFO, b""))
        can = _attributes(info.get(_INFO_DATA, b""))
        state = _number(can.get(_STATE))
        counters = can.get(_ERROR_COUNTERS)
        return LinkFacts(
            True,
            bool(flags & _UP),
            info.get(_INFO_KIND, b"").rstrip(b"\0").decode("ascii", "replace"),
            _STATES[state] if state is not None and state < len(_STATES) else None,
            _number(can.get(_BIT_TIMING)),
            _number(can.get(_RESTART_MS)),
            struct.unpack_from("=HH", counters)
            if counters is not None and len(counters) >= 4
            else None,
            flags & _RUNS == _RUNS,
        )


def link_monitor(name: str) -> LinkMonitor | None:
    """A monitor; None where the system does not offer one."""
    try:
        return LinkMonitor(name)
    except OSError:
        return None


def _number(value: bytes | None) -> int | None:
    return (
        int.from_bytes(value[:4], sys.byteorder) if value is not None and len(value) >= 4 else None
    )


def _attribute(kind: int, value: bytes) -> bytes:
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value + bytes(-len(value) % 4)


def _messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(type, body) of each netlink message in a datagram."""
    while len(data) >= _HEADER.size:
        size, kind = _HEADER.unpack_from(data)[:2]
        if not _HEADER.size <= size <= len(data):
            return
        yield kind, data[_HEADER.size : size]
        data = data[size + (-size % 4) :]


def _attributes(data: bytes, at: int = 0) -> dict[int, bytes]:
    """The attributes from a place on, by their type."""
    found = {}
    while at + _ATTRIBUTE.size <= len(data):
        size, kind = _ATTRIBUTE.unpack_from(data, at)
        if not _ATTRIBUTE.size <= size <= len(data) - at:
            break
        found[kind & _TYPE_MASK] = data[at + _ATTRIBUTE.size : at + size]
        at += size + (-size % 4)
    return found
