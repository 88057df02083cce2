"""A plain CAN socket of the bench with a few CANopen services.

The bench sends with it as a master, a foreign node or a vandal.
"""

import contextlib
import errno
import select
import socket
import struct
import time
from typing import Self

FRAME = struct.Struct("=IB3x8s")
ERROR_FLAG = 0x20000000
EXTENDED = 0x80000000
REMOTE = 0x40000000
INVERTED = 0x20000000
"""Flag of a filter that rejects only this id."""
SO_RCVBUFFORCE = 33


class RawBus:
    """A context manager with a socket on one interface that has room for bursts.

    It receives frames that pass a filter (id, mask).
    """

    def __init__(self, interface: str, *filters: tuple[int, int]) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 4_000_000)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        self._filter(*filters)
        self._socket.bind((interface,))
        self._socket.settimeout(0.05)

    def _filter(self, *filters: tuple[int, int]) -> None:
        packed = b"".join(struct.pack("=II", *each) for each in filters)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)

    def send(
        self,
        can_id: int,
        data: bytes = b"",
        wait: bool = True,
    ) -> bool:
        """Send a frame. Return False if the queue is full and ``wait`` is False."""
        return self._send(FRAME.pack(can_id, len(data), data), wait)

    def send_fd(self, can_id: int, data: bytes) -> None:
        self._send(struct.pack("=IBB2x64s", can_id, len(data), 1, data))

    def _send(self, frame: bytes, wait: bool = True) -> bool:
        while True:
            try:
                self._socket.send(frame)
                return True
            except OSError as error:
                is_full = error.errno in (errno.EAGAIN, errno.ENOBUFS, None)
                if not wait or not is_full:
                    return False
                time.sleep(0.001)

    def receive(self, seconds: float) -> tuple[int, bytes] | None:
        """Return id and data (at most eight bytes) of the next frame, or None after the time."""
        if not select.select([self._socket], [], [], seconds)[0]:
            return None
        can_id, size, data = FRAME.unpack(self._socket.recv(72)[: FRAME.size])
        return can_id, data[:size]

    def _ask(self, node: int, request: bytes, seconds: float) -> bytes | None:
        """Return the answer to an SDO request, or None without an answer."""
        self._filter((0x580 + node, 0xDFFFFFFF))
        while self.receive(0.05):  # discard late answers to earlier requests
            pass
        self.send(0x600 + node, request)
        answer = self.receive(seconds)
        self._filter()
        return answer and answer[1]

    def write(
        self,
        node: int,
        index: int,
        sub: int,
        value: int,
        size: int,
        seconds: float = 2,
    ) -> int | None:
        """Write a number by SDO download. Return 0, the abort code, or None without an answer."""
        request = struct.pack(
            "<BHBI",
            0x23 | (4 - size) << 2,
            index,
            sub,
            value,
        )
        answer = self._ask(node, request, seconds)
        if answer is None:
            return None
        return 0 if answer[0] == 0x60 else int.from_bytes(answer[4:8], "little")

    def read(
        self,
        node: int,
        index: int,
        sub: int,
        seconds: float = 2,
    ) -> int | None:
        """Read a number of at most four bytes by SDO upload. Return None if that fails."""
        answer = self._ask(node, struct.pack("<BHB4x", 0x40, index, sub), seconds)
        if answer is None or answer[0] >> 5 != 2:
            return None
        size = 4 - (answer[0] >> 2 & 3) if answer[0] & 1 else 4
        return int.from_bytes(answer[4 : 4 + size], "little")

    def store(self, node: int, seconds: float = 8) -> int | None:
        """Write "save" to 1010h:1. Return the same as ``write``."""
        return self.write(
            node,
            0x1010,
            1,
            int.from_bytes(b"save", "little"),
            4,
            seconds,
        )

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
