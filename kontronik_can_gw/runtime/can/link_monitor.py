"""Reads the state of one network interface and its CAN controller from the kernel by rtnetlink.

It changes nothing and needs no privilege. The numbers are defined in linux/rtnetlink.h,
linux/if_link.h and linux/can/netlink.h.
"""

import contextlib
import errno
import socket
import struct
import sys
from collections.abc import Iterator
from typing import NamedTuple

from kontronik_can_gw.status import CanState

_ROUTE = 0
_LINK_GROUP = 1
_HEADER = struct.Struct("=IHHII")
_INTERFACE = struct.Struct("=BxHiII")
_ATTRIBUTE = struct.Struct("=HH")
# Types of messages
_ERROR = 2
_NEW_LINK = 16
_DELETED_LINK = 17
_GET_LINK = 18
_REQUEST = 1
_UP = 0x1
_RUNS = 0x40 | 0x10000
"""IFF_RUNNING, which the kernel may report a second late, and IFF_LOWER_UP (controller is on)."""
# Attributes of an interface
_NAME = 3
_LINK_INFO = 18
_EXT_MASK = 29
_WITHOUT_STATISTICS = struct.pack("=I", 8)
"""Omits the traffic counters, so that most answers are identical to the one before."""
# Attributes in _LINK_INFO
_INFO_KIND = 1
_INFO_DATA = 2
# Attributes in _INFO_DATA of a CAN interface
_BIT_TIMING = 1
_STATE = 4
_RESTART_MS = 6
_ERROR_COUNTERS = 8
_TYPE_MASK = 0x3FFF
_BUFFER = 1 << 16
_STATES = (
    CanState.ERROR_ACTIVE,
    CanState.ERROR_WARNING,
    CanState.ERROR_PASSIVE,
    CanState.BUS_OFF,
)
"""States of the controller by their number in the kernel."""


class LinkFacts(NamedTuple):
    """The kernel's report on an interface. A field is None if the driver does not report it."""

    exists: bool
    up: bool = False
    kind: str = ""
    state: CanState | None = None
    """State of the controller. None if it does not run, or if there is no controller (vcan)."""
    bitrate: int | None = None
    """Bit rate in bit/s."""
    restart_ms: int | None = None
    """Time from bus-off to an automatic restart. 0: the controller stays in bus-off."""
    error_counters: tuple[int, int] | None = None
    """Transmit and receive error counter of the controller."""
    running: bool = True
    """False if sent frames are lost without an error.

    The controller is off, or its queue has not been started again.
    """


class LinkMonitor:
    """Receives the kernel's reports on one interface, and asks for values not reported unasked.

    Raises OSError if the system has no rtnetlink.
    """

    def __init__(self, name: str) -> None:
        self._name = name.encode()
        body = _INTERFACE.pack(0, 0, 0, 0, 0)
        body += _attribute(_NAME, self._name + b"\0")
        body += _attribute(_EXT_MASK, _WITHOUT_STATISTICS)
        size = _HEADER.size + len(body)
        self._question = _HEADER.pack(size, _GET_LINK, _REQUEST, 0, 0) + body
        self._heard: tuple[bytes, list[LinkFacts]] = b"", []
        """The last datagram and its reports, because most answers are identical."""
        kind = socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        self._socket = socket.socket(socket.AF_NETLINK, kind, _ROUTE)
        try:
            self._socket.bind((0, _LINK_GROUP))
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def ask(self) -> None:
        """Ask the kernel for the present state. ``take`` returns the answer immediately."""
        with contextlib.suppress(OSError):
            self._socket.send(self._question)

    def take(self) -> list[LinkFacts]:
        """Return the reports on the interface since the last call, oldest first."""
        found: list[LinkFacts] = []
        while True:
            try:
                data = self._socket.recv(_BUFFER)
            except BlockingIOError:
                return found
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    return found
                self.ask()  # reports were lost, so the present state is needed
                continue
            last_data, reports = self._heard
            if data != last_data:
                reports = []
                for kind, body in _messages(data):
                    facts = self._facts(kind, body)
                    if facts is not None:
                        reports.append(facts)
                self._heard = (data, reports)
            found += reports

    def close(self) -> None:
        self._socket.close()

    def _facts(self, kind: int, body: bytes) -> LinkFacts | None:
        if kind == _ERROR and len(body) >= 4:
            (code,) = struct.unpack_from("=i", body)
            if -code in (errno.ENODEV, errno.ENXIO):
                return LinkFacts(exists=False)
            return None
        if kind not in (_NEW_LINK, _DELETED_LINK) or len(body) < _INTERFACE.size:
            return None
        attributes = _attributes(body, _INTERFACE.size)
        if attributes.get(_NAME, b"").rstrip(b"\0") != self._name:
            return None
        if kind == _DELETED_LINK:
            return LinkFacts(exists=False)
        flags = _INTERFACE.unpack_from(body)[3]
        info = _attributes(attributes.get(_LINK_INFO, b""))
        link_kind = info.get(_INFO_KIND, b"").rstrip(b"\0")
        can = _attributes(info.get(_INFO_DATA, b""))
        return LinkFacts(
            exists=True,
            up=bool(flags & _UP),
            kind=link_kind.decode("ascii", "replace"),
            state=_state(can.get(_STATE)),
            bitrate=_number(can.get(_BIT_TIMING)),
            restart_ms=_number(can.get(_RESTART_MS)),
            error_counters=_counters(can.get(_ERROR_COUNTERS)),
            running=flags & _RUNS == _RUNS,
        )


def link_monitor(name: str) -> LinkMonitor | None:
    """Return a monitor for an interface, or None if the system has no rtnetlink."""
    try:
        return LinkMonitor(name)
    except OSError:
        return None


def _number(value: bytes | None) -> int | None:
    if value is None or len(value) < 4:
        return None
    return int.from_bytes(value[:4], sys.byteorder)


def _state(value: bytes | None) -> CanState | None:
    number = _number(value)
    if number is None or number >= len(_STATES):
        return None
    return _STATES[number]


def _counters(value: bytes | None) -> tuple[int, int] | None:
    if value is None or len(value) < 4:
        return None
    transmit, receive = struct.unpack_from("=HH", value)
    return transmit, receive


def _attribute(kind: int, value: bytes) -> bytes:
    head = _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind)
    padding = bytes(-len(value) % 4)
    return head + value + padding


def _messages(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and body of each netlink message in a datagram."""
    while len(data) >= _HEADER.size:
        size, kind = _HEADER.unpack_from(data)[:2]
        if not _HEADER.size <= size <= len(data):
            return
        yield kind, data[_HEADER.size : size]
        data = data[size + (-size % 4) :]


def _attributes(data: bytes, offset: int = 0) -> dict[int, bytes]:
    """Return the attributes that begin at an offset, by their type."""
    found = {}
    while offset + _ATTRIBUTE.size <= len(data):
        size, kind = _ATTRIBUTE.unpack_from(data, offset)
        if not _ATTRIBUTE.size <= size <= len(data) - offset:
            break
        found[kind & _TYPE_MASK] = data[offset + _ATTRIBUTE.size : offset + size]
        offset += size + (-size % 4)
    return found
