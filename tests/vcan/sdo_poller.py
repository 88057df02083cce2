"""A light CANopen master as a process of its own: expedited and block uploads by a raw socket, nothing but the standard library.

python sdo_poller.py INTERFACE poll SECONDS PAUSE_MS NODES OBJECTS
    ask each node for each object in turn; NODES as 1,2,3 and OBJECTS as 2000:1,2000:2. Prints the number of answers and of
    requests that got none within 2 s.
python sdo_poller.py INTERFACE block NODE OBJECT
    one block upload, sub-blocks of 127 segments. Prints the bytes in hexadecimal.
"""

import select
import socket
import struct
import sys
import time

FRAME = struct.Struct("=IB3x8s")
FILTER = struct.Struct("=II")
EXACT = 0xC00007FF
"""Mask of a filter: the id, no 29-bit and no remote frames."""


class Sdo:
    """SDO clients of some nodes on one socket."""

    def __init__(self, interface: str, *others: int) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        filters = b"".join(FILTER.pack(can_id, EXACT) for can_id in others)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        self._socket.bind((interface,))

    def send(self, node: int, *content: int) -> None:
        self._socket.send(FRAME.pack(0x600 + node, 8, bytes(content).ljust(8, b"\0")))

    def send_raw(self, frame: bytes) -> None:
        """A frame as the kernel has it, see FRAME."""
        self._socket.send(frame)

    def receive(self, seconds: float) -> tuple[int, bytes] | None:
        """The next frame's id and data, None if none comes in time."""
        if not select.select([self._socket], [], [], seconds)[0]:
            return None
        can_id, size, data = FRAME.unpack(self._socket.recv(FRAME.size))
        return can_id, data[:size]

    def upload(self, node: int, index: int, sub: int, seconds: float = 2.0) -> bytes | None:
        """The first frame of the answer to an upload request, None if none comes. Answers to other masters are passed over."""
        name = bytes((index & 0xFF, index >> 8, sub))
        self.send(node, 0x40, *name)
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            found = self.receive(left)
            if found is not None and found[0] == 0x580 + node and found[1][1:4] == name:
                return found[1]
        return None

    def close(self) -> None:
        self._socket.close()


def poll(
    interface: str, seconds: float, pause_s: float, nodes: list[int], objects: list[tuple[int, int]]
) -> tuple[int, int]:
    """Answers, requests without one."""
    sdo = Sdo(interface, *(0x580 + node for node in nodes))
    answered = unanswered = 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for index, sub in objects:
            for node in nodes:
                if sdo.upload(node, index, sub) is None:
                    unanswered += 1
                else:
                    answered += 1
                if pause_s:
                    time.sleep(pause_s)
    sdo.close()
    return answered, unanswered


def segmented_upload(interface: str, node: int, index: int, sub: int) -> bytes:
    """The whole value. RuntimeError when the transfer goes wrong."""
    sdo = Sdo(interface, 0x580 + node)
    first = sdo.upload(node, index, sub)
    if first is None or first[0] != 0x41:
        raise RuntimeError(f"segmented upload: {first!r}")
    data = bytearray()
    toggle = last = 0
    while not last:
        sdo.send(node, 0x60 | toggle)
        found = sdo.receive(2)
        if found is None or found[1][0] & 0xF0 != toggle:
            raise RuntimeError(f"segmented upload: {found}")
        segment = found[1]
        data += segment[1 : 8 - (segment[0] >> 1 & 7)]
        last = segment[0] & 1
        toggle ^= 0x10
    sdo.close()
    if len(data) != int.from_bytes(first[4:8], "little"):
        raise RuntimeError(f"segmented upload: {len(data)} bytes instead of {first[4:8].hex()}")
    return bytes(data)


def block_upload(interface: str, node: int, index: int, sub: int) -> bytes:
    """The whole value. RuntimeError when the transfer goes wrong."""
    sdo = Sdo(interface, 0x580 + node)

    def next_frame() -> bytes:
        found = sdo.receive(2)
        if found is None or found[1][0] == 0x80:
            raise RuntimeError(f"block upload: {found}")
        return found[1]

    sdo.send(node, 0xA4, index & 0xFF, index >> 8, sub, 127)
    size = int.from_bytes(next_frame()[4:8], "little")
    sdo.send(node, 0xA3)
    data = bytearray()
    last = False
    while not last:
        for number in range(1, 128):
            segment = next_frame()
            if segment[0] & 0x7F != number:
                raise RuntimeError(f"block upload: segment {segment[0] & 0x7F} instead of {number}")
            data += segment[1:]
            last = bool(segment[0] & 0x80)
            if last:
                break
        sdo.send(node, 0xA2, number, 127)
    next_frame()
    sdo.send(node, 0xA1)
    sdo.close()
    return bytes(data[:size])


def _object(text: str) -> tuple[int, int]:
    index, _, sub = text.partition(":")
    return int(index, 16), int(sub or "0", 16)


if __name__ == "__main__":
    interface, what, *rest = sys.argv[1:]
    if what == "poll":
        seconds, pause_ms, node_list, object_list = rest
        nodes = [int(node) for node in node_list.split(",")]
        print(
            *poll(
                interface, float(seconds), float(pause_ms) / 1000, nodes, [_object(o) for o in object_list.split(",")]
            )
        )
    else:
        print(block_upload(interface, int(rest[0]), *_object(rest[1])).hex())
