"""The SDO server: one transfer at a time (CiA 301 v4.2, clause 7.2.4).

Expedited transfers are served here, transfers of several requests in ``sdo_transfers``. Byte 0 of a
request holds the client command specifier in its three highest bits. Index, sub-index and all
numbers are little endian.

The standard leaves room for these choices:

* A request whose length is not 8 is ignored without an answer. Every SDO frame has 8 bytes
  (7.2.4.3), and the missing bytes could be the ones that an answer would have to repeat.
* An initiate request during a transfer starts the new one and drops the old one without an abort.
  The client has evidently given it up, for example because it was restarted, and would take an
  abort for the answer to its new request.
* Within a sub-block of a block download every frame is a segment, except 80h, with which a segment
  cannot begin: 40h is segment 64 there. If the server ends such a sub-block early, it ignores the
  segments that the client had already sent, while their numbers are consecutive and their distance
  in time is short. As requests they could write to any object.
* More data than the indicated size, or than the object can hold, ends in 06070012h as soon as it is
  certain. Less than the indicated size ends in 06070013h after the last segment. 06070010h ("does
  not match") is not used here, because it is always known whether data is too long or too short.
* Both answers to a block initiate report that the server supports a CRC. A CRC is used only if the
  client supports it too. Otherwise the field is 0 in a block upload, and ignored in a block
  download.
* An unused bit ("x") of a command is ignored, so any command with specifier 4 is an abort. An abort
  is never answered.
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
    """The SDO server of one node. ``send`` is called with the 8 bytes of each answer.

    ``segment_ns`` is the average distance of block upload segments, which ``advance`` sends in
    bursts of up to four. With 0 a whole sub-block is sent at once. No input raises.
    """

    def __init__(
        self,
        objects: Dictionary,
        send: Callable[[bytes], None],
        segment_ns: int = 0,
    ) -> None:
        self._objects = objects
        self._send = send
        self._segment_ns = segment_ns
        self._transfer: Transfer | None = None
        self._is_confirming = False
        """All data has arrived, and the dictionary's result is pending."""
        self._deadline = NEVER
        self._multiplexer = _NO_MULTIPLEXER
        self._confirmation = b""
        """The answer that confirms the download."""
        self._ticket = 0
        self._outgoing: deque[bytes] = deque()
        """Segments of a block upload's sub-block."""
        self._next_burst = 0
        """Earliest time of the next burst.

        A new upload does not reset it, so that restarted uploads get no more of the bus.
        """
        self._sub_block = SubBlock()

    @property
    def busy(self) -> bool:
        """True while a transfer runs or waits for its confirmation."""
        return self._transfer is not None or self._is_confirming

    @property
    def waiting(self) -> int | None:
        """The ticket of the download that waits for ``confirm``, or None. Each has another."""
        return self._ticket if self._is_confirming else None

    def receive(self, data: bytes, now: int) -> None:
        """Serve the data of one request frame. Other lengths than 8 bytes are ignored."""
        if len(data) != 8:
            return
        if now >= self._deadline:
            self._abort(Abort.TIMEOUT)
        is_segment = self._sub_block.next_segment is not None and data[0] != _CLIENT_ABORT
        try:
            if is_segment:
                self._sub_block.note_segment(now)
                self._continue(data, now)
            elif not self._sub_block.swallow(data[0], now):
                self._serve(data, now)
        except SdoAbort as abort:
            self._abort(abort.code)
        if self._transfer is None:
            self._deadline = NEVER
        elif not is_segment or self._sub_block.is_in_sequence:
            self._deadline = now + TIMEOUT_NS

    def confirm(self, code: Abort | None, ticket: int | None = None) -> None:
        """Answer a download for which the dictionary returned False.

        ``code`` is the reason of its failure, or None if it succeeded. The call is ignored if the
        transfer is no longer waiting. A caller that can have several results under way passes the
        ``ticket`` that ``waiting`` returned, so that the result of a dropped transfer does not
        confirm the next one.
        """
        if not self._is_confirming:
            return
        if ticket is not None and ticket != self._ticket:
            return
        if code is not None:
            self._abort(code)
            return
        confirmation = self._confirmation
        self.reset()
        self._send(confirmation)

    def advance(self, now: int) -> None:
        """Send paced segments of a block upload that are due, or end a transfer that timed out."""
        if now < self.due:
            return
        if self._outgoing:
            self._send_burst(now)
            self._deadline = now + TIMEOUT_NS
        else:
            self._abort(Abort.TIMEOUT)

    @property
    def due(self) -> int:
        """Earliest time at which ``advance`` acts. NEVER if there is no transfer."""
        return self._next_burst if self._outgoing else self._deadline

    def reset(self) -> None:
        """Drop any transfer without an answer."""
        self._transfer = None
        self._is_confirming = False
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
                self._begin(data)
                self._start_upload(self._read_value(now))
            case 4:
                self.reset()
                self._sub_block.forget()
            case 5 if not command & 3:
                self._initiate_block_upload(data, now)
            case 6 if not command & 1:
                self._initiate_block_download(data, now)
            case _:
                self._continue(data, now)

    def _start(self, transfer: Transfer) -> None:
        self._transfer = transfer
        self._send(next(transfer))

    def _continue(self, data: bytes, now: int) -> None:
        """Pass a request to the present transfer. SdoAbort 05040001h if there is none."""
        if self._transfer is None:
            raise SdoAbort(Abort.COMMAND)
        try:
            answer = self._transfer.send(data)
        except StopIteration as end:
            downloaded, answer = end.value
            if downloaded is not None:
                self._store(downloaded, answer, now)
                return
            self.reset()
        if answer:
            self._send(answer)
        self._send_burst(now)

    def _begin(self, data: bytes) -> None:
        """Drop any transfer, and take the multiplexer of an initiate request."""
        self.reset()
        self._multiplexer = data[1:4]

    @property
    def _index(self) -> int:
        return int.from_bytes(self._multiplexer[:2], "little")

    @property
    def _sub(self) -> int:
        return self._multiplexer[2]

    def _initiated(self, command: int, data: bytes = b"") -> bytes:
        """Return an answer with the multiplexer of the present transfer."""
        head = bytes((command,)) + self._multiplexer
        return head + data.ljust(4, b"\0")

    def _abort(self, code: Abort) -> None:
        """Send 80h, the multiplexer of the present transfer (0 without one) and the code."""
        answer = self._initiated(0x80, code.to_bytes(4, "little"))
        self.reset()
        self._send(answer)

    # ---- download

    def _check_download(
        self,
        data: bytes,
        is_size_indicated: bool,
    ) -> tuple[int | None, int]:
        """Begin a download of several segments.

        Returns the size that the client indicates, or None, and the maximum number of bytes.
        """
        size = int.from_bytes(data[4:8], "little") if is_size_indicated else None
        self._begin(data)
        limit = self._objects.check_download(self._index, self._sub, size)
        if size is None:
            return None, limit
        return size, size

    def _initiate_download(self, data: bytes, now: int) -> None:
        """Serve 001n nnes, multiplexer, data or size. Answer: 60h, multiplexer, 0 (4)."""
        command = data[0]
        is_expedited = bool(command & 2)
        is_size_indicated = bool(command & 1)
        if not is_expedited:
            size, limit = self._check_download(data, is_size_indicated)
            answer = self._initiated(0x60)
            self._start(segmented_download(answer, size, limit))
            return
        size = 4 - (command >> 2 & 3) if is_size_indicated else None
        self._begin(data)
        limit = self._objects.check_download(self._index, self._sub, size)
        if size is None:
            # "unspecified number of bytes" (e = 1, s = 0): the object's own length counts
            size = min(4, limit)
        value = data[4 : 4 + size]
        answer = self._initiated(0x60)
        self._store(value, answer, now)

    def _initiate_block_download(self, data: bytes, now: int) -> None:
        """Serve 110x xCs0 (C: CRC, s: size indicated), multiplexer, size.

        Answer: A4h (CRC supported), multiplexer, block size, 0 (3).
        """
        is_size_indicated = bool(data[0] & 2)
        with_crc = bool(data[0] & 4)
        size, limit = self._check_download(data, is_size_indicated)
        self._sub_block.note_segment(now)
        answer = self._initiated(0xA4, bytes((BLOCK_SIZE,)))
        transfer = block_download(answer, size, limit, with_crc, self._sub_block)
        self._start(transfer)

    def _store(self, data: bytes, answer: bytes, now: int) -> None:
        """Pass all data to the dictionary. ``answer`` confirms the download."""
        # set before the call, because the dictionary may confirm or reset from within it
        self._transfer = None
        self._is_confirming = True
        self._ticket += 1
        self._confirmation = answer
        ticket = self._ticket
        if self._objects.download(self._index, self._sub, data, now):
            self.confirm(None, ticket)

    # ---- upload

    def _read_value(self, now: int) -> bytes:
        return self._objects.upload(self._index, self._sub, now)

    def _start_upload(self, data: bytes) -> None:
        """Serve 010x xxxx, multiplexer, 0 (4). Answer: 0100 nnes, multiplexer, data or size."""
        if 1 <= len(data) <= 4:
            unused = 4 - len(data)
            self._send(self._initiated(0x43 | unused << 2, data))
            self.reset()
        else:
            size = len(data).to_bytes(4, "little")
            answer = self._initiated(0x41, size)
            self._start(segmented_upload(answer, data))

    def _initiate_block_upload(self, data: bytes, now: int) -> None:
        """Serve 101x xC00 (C: CRC), multiplexer, block size, threshold, 0 (2).

        Answer: C6h (CRC, size), multiplexer, size. With a threshold other than 0, a value of at
        most that many bytes is sent by an expedited or segmented upload instead.
        """
        self._begin(data)
        block_size = data[4]
        threshold = data[5]
        check_block_size(block_size)
        value = self._read_value(now)
        if threshold and len(value) <= threshold:
            self._start_upload(value)
        else:
            size = len(value).to_bytes(4, "little")
            answer = self._initiated(0xC6, size)
            with_crc = bool(data[0] & 4)
            transfer = block_upload(answer, value, block_size, with_crc, self._outgoing)
            self._start(transfer)

    def _send_burst(self, now: int) -> None:
        """Send the segments of a sub-block that are due."""
        if not self._outgoing or now < self._next_burst:
            return
        count = len(self._outgoing)
        if self._segment_ns:
            count = min(count, BURST)
        for _ in range(count):
            self._send(self._outgoing.popleft())
        self._next_burst = now + count * self._segment_ns
