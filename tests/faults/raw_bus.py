"""A plain CAN socket of the bench's own, and the few CANopen services it needs: what a master, a foreign node or a vandal sends."""

import contextlib
import socket
import struct
import time
from typing import Self

_FRAME = struct.Struct("=IB3x8s")
ERROR_FLAG = 0x20000000


class RawBus:
    """A socket on one interface, as context manager."""

    def __init__(self, interface: str) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.bind((interface,))
        self._socket.settimeout(0.05)
        self._filter(None)

    def _filter(self, can_id: int | None) -> None:
        packed = b"" if can_id is None else struct.pack("=II", can_id, 0xDFFFFFFF)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)

    def send(self, can_id: int, data: bytes = b"", wait: bool = True) -> bool:
        """Send a frame; False if the queue is full and we are not to wait."""
        while True:
            try:
                self._socket.send(_FRAME.pack(can_id, len(data), data.ljust(8, b"\0")))
                return True
            except (BlockingIOError, TimeoutError, OSError) as error:
                if not wait or getattr(error, "errno", None) not in (11, 105, None):
                    return False
                time.sleep(0.001)

    def _answer(self, seconds: float) -> bytes | None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with contextlib.suppress(TimeoutError):
                _, size, content = _FRAME.unpack(self._socket.recv(16))
                return bytes(content[:size])
        return None

    def _ask(self, node: int, request: bytes, seconds: float) -> bytes | None:
        """The answer to an SDO request, None if none came."""
        self._filter(0x580 + node)
        with contextlib.suppress(TimeoutError):
            while self._socket.recv(16):  # what came late for an earlier one
                pass
        self._socket.settimeout(0.005)
        self.send(0x600 + node, request)
        self._socket.settimeout(0.05)
        answer = self._answer(seconds)
        self._filter(None)
        return answer

    def write(
        self, node: int, index: int, sub: int, value: int, size: int, seconds: float = 2
    ) -> int | None:
        """SDO download of a number: 0, the abort code, or None without an answer."""
        request = (
            bytes([0x23 | (4 - size) << 2])
            + struct.pack("<HB", index, sub)
            + value.to_bytes(4, "little")
        )
        answer = self._ask(node, request, seconds)
        if answer is None:
            return None
        return 0 if answer[0] == 0x60 else int.from_bytes(answer[4:8], "little")

    def read(self, node: int, index: int, sub: int, seconds: float = 2) -> int | None:
        """SDO upload of a number of at most four bytes; None without an answer or with an abort."""
        answer = self._ask(node, b"\x40" + struct.pack("<HB", index, sub) + bytes(4), seconds)
        if answer is None or answer[0] >> 5 != 2:
            return None
        size = 4 - (answer[0] >> 2 & 3) if answer[0] & 1 else 4
        return int.from_bytes(answer[4 : 4 + size], "little")

    def store(self, node: int, seconds: float = 8) -> int | None:
        """Write "save" to 1010h:1; as ``write``."""
        return self.write(node, 0x1010, 1, int.from_bytes(b"save", "little"), 4, seconds)

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
