"""A simple SDO client with expedited and segmented transfers (CiA 301, 7.2.4).

``ask`` sends a request and returns its answer.
"""

from collections.abc import Callable

Ask = Callable[[bytes], bytes]


class Refused(Exception):
    """The server aborted the transfer."""

    def __init__(self, answer: bytes) -> None:
        self.code = int.from_bytes(answer[4:], "little")
        super().__init__(f"{self.code:08X}h")


def multiplexer(index: int, sub: int) -> bytes:
    return index.to_bytes(2, "little") + bytes((sub,))


def answer_to(ask: Ask, request: bytes) -> bytes:
    """Return the answer to a request, which is padded with zeros. Raise Refused for an abort."""
    answer = ask(request.ljust(8, b"\0"))
    if answer[0] == 0x80:
        assert request[0] < 0x40 or request[0] >= 0x60 or answer[1:4] == request[1:4]
        raise Refused(answer)
    return answer


def upload(ask: Ask, index: int, sub: int) -> bytes:
    """Return the data of an object."""
    answer = answer_to(ask, b"\x40" + multiplexer(index, sub))
    assert answer[1:4] == multiplexer(index, sub)
    return uploaded(ask, answer)


def uploaded(ask: Ask, answer: bytes) -> bytes:
    """Return the data that the first answer of an upload has or announces."""
    if answer[0] & 2:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    assert answer[0] == 0x41
    size = int.from_bytes(answer[4:], "little")
    data = b""
    toggle = 0
    while True:
        part = answer_to(ask, bytes((0x60 | toggle,)))
        assert part[0] & 0xF0 == toggle
        unused = part[0] >> 1 & 7
        assert not any(part[8 - unused :])
        data += part[1 : 8 - unused]
        toggle ^= 0x10
        if part[0] & 1:
            assert len(data) == size
            return data


def download(
    ask: Ask,
    index: int,
    sub: int,
    data: bytes,
    tell_size: bool = True,
) -> None:
    """Write an object. Up to four bytes are expedited, more are sent in segments."""
    where = multiplexer(index, sub)
    if 1 <= len(data) <= 4:
        answer = answer_to(ask, bytes((0x23 | 4 - len(data) << 2,)) + where + data)
        assert answer == b"\x60" + where + bytes(4)
        return
    size = len(data).to_bytes(4, "little") if tell_size else b""
    initiate = bytes((0x20 | tell_size,))
    answer = answer_to(ask, initiate + where + size)
    assert answer == b"\x60" + where + bytes(4)
    toggle = 0
    parts = [data[at : at + 7] for at in range(0, len(data), 7)] or [b""]
    for number, part in enumerate(parts, 1):
        command = toggle | (7 - len(part)) << 1 | (number == len(parts))
        answer = answer_to(ask, bytes((command,)) + part)
        assert answer == bytes((0x20 | toggle,)) + bytes(7)
        toggle ^= 0x10
