"""The SDO server: one transfer at a time, expedited, segmented or block (``sdo_transfers``), by CiA 301 v4.2 clause 7.2.4.

Request frames and time in, answer frames out through ``send``; the object dictionary says what is there. Byte 0 of a
request holds the client command specifier in its three highest bits; index, sub-index and all numbers are little endian.

Choices where the standard leaves room:

* A request whose length is not 8 is ignored without an answer: every SDO frame has 8 bytes (7.2.4.3), so it is none, and what it
  lacks could be the very bytes that an answer would have to name.
* An initiate request in the midst of a transfer starts the new one and drops the old one without an abort: the client has
  evidently given it up (it was restarted, say), and an abort would be taken for the answer to its new request.
* Within a sub-block of a block download every frame is a segment, except 80h, which no segment can begin with: 40h is segment 64
  there. When such a sub-block is cut short by us, the segments that the client had already sent are swallowed as long as they
  follow one another in number and time; taken as requests they could write to any object.
* More data than the indicated size or than the object holds ends in 06070012h as soon as it is certain, less than the indicated
  size in 06070013h after the last segment. 06070010h ("does not match") is left to the dictionary: here it is always known in
  which way the length is wrong.
* Both answers to a block initiate say that the server supports a CRC, whatever the client does; there is one only if the client
  supports it too. Without, the field is 0 in a block upload and not looked at in a block download.
* An unused bit ("x") of a command is ignored, so any command with specifier 4 is an abort; an abort is never answered.
"""

from collections import deque
from collections.abc import Callable

from kontronik_can_gw.canopen.dictionary import Abort, Dictionary, SdoAbort
from kontronik_can_gw.canopen.sdo_transfers import (
    BLOCK_SIZE,
    SubBlock,
    Transfer,
    block_download,
    block_upload,
    check_block_size,
    segmented_download,
    segmented_upload,
)
from kontronik_can_gw.times import NEVER

TIMEOUT_NS = 2_000_000_000
"""A transfer ends with 05040000h this long after the last frame of either side.

A segment of a block download that is out of sequence does not count: it may be the request of a
new master, after the one that began the transfer has died.
"""
BURST = 4
"""Paced block upload segments sent without a pause."""

_CLIENT_ABORT = 0x80
_NO_MULTIPLEXER = b"\0\0\0"


class SdoServer:
    """One SDO server. ``send`` is called with the 8 bytes of each answer.

    ``segment_ns``: distance that block upload segments keep on average, in bursts of up to four, driven by ``advance``; 0: a whole
    sub-block at once. No input raises.
    """

    def __init__(
        self, objects: Dictionary, send: Callable[[bytes], None], segment_ns: int = 0
    ) -> None:
        self._objects = objects
        self._send = send
        self._segment_ns = segment_ns
        self._transfer: Transfer | None = None
        self._confirming = False
        """All data is here, the result of the dictionary is pending."""
        self._deadline = NEVER
        self._multiplexer = _NO_MULTIPLEXER
        self._answer = b""  # what confirms a download
        self._ticket = 0
        self._outgoing: deque[bytes] = deque()
        """Segments of a block upload's sub-block."""
        self._next_burst = 0
        """When more of them may be sent; of all uploads: one that begins anew has not more of the bus."""
        self._sub_block = SubBlock()

    @property
    def busy(self) -> bool:
        """True while a transfer runs or waits for its confirmation."""
        return self._transfer is not None or self._confirming

    @property
    def waiting(self) -> int | None:
        """The ticket of the download that waits for ``confirm``, different for each; None: none waits."""
        return self._ticket if self._confirming else None

    def receive(self, data: bytes, now: int) -> None:
        """The data of one request frame, of any length."""
        if len(data) != 8:
            return
        if now >= self._deadline:
            self._abort(Abort.TIMEOUT)
        is_segment = self._sub_block.next_segment is not None and data[0] != _CLIENT_ABORT
        try:
            if is_segment:
                self._sub_block.seen(now)
                self._go_on(data, now)
            elif not self._sub_block.swallow(data[0], now):
                self._serve(data, now)
        except SdoAbort as abort:
            self._abort(abort.code)
        if self._transfer is None:
            self._deadline = NEVER
        elif not is_segment or self._sub_block.is_in_sequence:
            self._deadline = now + TIMEOUT_NS

    def confirm(self, code: Abort | None, ticket: int | None = None) -> None:
        """The result of a download that returned False: ``code`` is why it failed, None that it is done.

        Ignored if the transfer is no longer waiting. A caller that can have several results under way passes the ``ticket`` that
        ``waiting`` gave, so that the result of a dropped transfer does not confirm the one after it.
        """
        if not self._confirming or (ticket is not None and ticket != self._ticket):
            return
        if code is not None:
            self._abort(code)
            return
        answer = self._answer
        self.reset()
        self._send(answer)

    def advance(self, now: int) -> None:
        """Let time pass: the time-out of a transfer, and the paced segments of a block upload."""
        if now < self.due:
            return
        if self._outgoing:
            self._send_burst(now)
            self._deadline = now + TIMEOUT_NS
        else:
            self._abort(Abort.TIMEOUT)

    @property
    def due(self) -> int:
        """When ``advance`` has something to do."""
        return self._next_burst if self._outgoing else self._deadline

    def reset(self) -> None:
        """Drop any transfer without an answer."""
        self._transfer, self._confirming = None, False
        self._sub_block.close()
        self._outgoing.clear()
        self._deadline = NEVER
        self._multiplexer = _NO_MULTIPLEXER

    # ---- requests

    def _serve(self, data: bytes, now: int) -> None:
        command = data[0]
        match command >> 5:
            case 1:
                self._initiate_download(data, now)
            case 2:
                self._start_upload(self._upload(data, now))
            case 4:
                self.reset()
                self._sub_block.forget()
            case 5 if not command & 3:
                self._initiate_block_upload(data, now)
            case 6 if not command & 1:
                # 110x xCs0 (C: CRC), multiplexer, size. Answer: A4h (CRC supported), multiplexer, block size, 0 (3)
                sizes = self._check_download(data, bool(command & 2))
                self._sub_block.seen(now)
                answer = self._initiated(0xA4, bytes((BLOCK_SIZE,)))
                self._start(block_download(answer, *sizes, bool(command & 4), self._sub_block))
            case _:
                self._go_on(data, now)

    def _start(self, transfer: Transfer) -> None:
        self._transfer = transfer
        self._send(next(transfer))

    def _go_on(self, data: bytes, now: int) -> None:
        """A request that belongs to the present transfer; 05040001h where there is none."""
        if self._transfer is None:
            raise SdoAbort(Abort.COMMAND)
        try:
            answer = self._transfer.send(data)
        except StopIteration as end:
            whole, answer = end.value
            if whole is not None:
                self._store(whole, answer, now)
                return
            self.reset()
        if answer:
            self._send(answer)
        self._send_burst(now)

    def _begin(self, data: bytes) -> tuple[int, int]:
        """Leave what is going on for the transfer that an initiate request names: index and sub-index."""
        self.reset()
        self._multiplexer = data[1:4]
        return self._place

    @property
    def _place(self) -> tuple[int, int]:
        return int.from_bytes(self._multiplexer[:2], "little"), self._multiplexer[2]

    def _initiated(self, command: int, data: bytes = b"") -> bytes:
        """An answer with the multiplexer of the present transfer."""
        return bytes((command,)) + self._multiplexer + data.ljust(4, b"\0")

    def _abort(self, code: Abort) -> None:
        """80h, multiplexer of the present transfer or 0, code."""
        answer = self._initiated(0x80, code.to_bytes(4, "little"))
        self.reset()
        self._send(answer)

    # ---- download

    def _check_download(self, data: bytes, indicated: bool) -> tuple[int | None, int]:
        """Begin a download of several segments: the size that the client indicates, and how many bytes there can be."""
        size = int.from_bytes(data[4:8], "little") if indicated else None
        limit = self._objects.check_download(*self._begin(data), size)
        return size, limit if size is None else size

    def _initiate_download(self, data: bytes, now: int) -> None:
        """001n nnes, multiplexer, data or size. Answer: 60h, multiplexer, 0 (4)."""
        command = data[0]
        if not command & 2:
            sizes = self._check_download(data, bool(command & 1))
            self._start(segmented_download(self._initiated(0x60), *sizes))
            return
        size = 4 - (command >> 2 & 3) if command & 1 else None
        limit = self._objects.check_download(*self._begin(data), size)
        # without a size the object's own length counts (e = 1, s = 0: "unspecified number of bytes")
        value = data[4 : 4 + (min(4, limit) if size is None else size)]
        self._store(value, self._initiated(0x60), now)

    def _store(self, data: bytes, answer: bytes, now: int) -> None:
        """Hand all data to the dictionary; ``answer`` confirms it."""
        # waiting before the dictionary is asked, so that it may confirm or reset from within the call
        self._transfer, self._confirming = None, True
        self._ticket += 1
        self._answer = answer
        ticket = self._ticket
        if self._objects.download(*self._place, data, now):
            self.confirm(None, ticket)

    # ---- upload

    def _upload(self, data: bytes, now: int) -> bytes:
        """Begin an upload: the value."""
        return self._objects.upload(*self._begin(data), now)

    def _start_upload(self, data: bytes) -> None:
        """Request 010x xxxx, multiplexer, 0 (4). Answer: 0100 nnes, multiplexer, data or size."""
        if 1 <= len(data) <= 4:
            self._send(self._initiated(0x43 | (4 - len(data)) << 2, data))
            self.reset()
        else:
            answer = self._initiated(0x41, len(data).to_bytes(4, "little"))
            self._start(segmented_upload(answer, data))

    def _initiate_block_upload(self, data: bytes, now: int) -> None:
        """101x xC00 (C: CRC), multiplexer, block size, threshold, 0 (2). Answer: C6h (CRC, size), multiplexer, size.

        With a threshold other than 0 a value of at most that many bytes goes by expedited or segmented upload instead.
        """
        self._begin(data)
        block_size, threshold = data[4], data[5]
        check_block_size(block_size)
        value = self._upload(data, now)
        if threshold and len(value) <= threshold:
            self._start_upload(value)
        else:
            answer = self._initiated(0xC6, len(value).to_bytes(4, "little"))
            with_crc = bool(data[0] & 4)
            self._start(block_upload(answer, value, block_size, with_crc, self._outgoing))

    def _send_burst(self, now: int) -> None:
        """Send of a sub-block what its time has come for."""
        if not self._outgoing or now < self._next_burst:
            return
        count = len(self._outgoing)
        if self._segment_ns:
            count = min(count, BURST)
        for _ in range(count):
            self._send(self._outgoing.popleft())
        self._next_burst = now + count * self._segment_ns
