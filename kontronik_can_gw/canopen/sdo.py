"""The SDO server: one transfer at a time, expedited, segmented or block, by CiA 301 v4.2 clause 7.2.4.

Request frames and time in, answer frames out through ``send``; the object dictionary is asked through ``Objects``. Byte 0 of a
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

from binascii import crc_hqx
from collections.abc import Callable
from enum import Enum, auto
from typing import NoReturn, Protocol

from kontronik_can_gw.canopen.abort import Abort, SdoAbort

TIMEOUT_NS = 2_000_000_000
"""A transfer ends with 05040000h this long after the last frame of either side."""
UNLIMITED_SIZE = 65536
"""Bytes taken for an object that states no limit."""
BLOCK_SIZE = 127
"""Segments of one sub-block of a block download, the most there can be."""
BURST = 4
"""Paced block upload segments sent without a pause."""
IN_FLIGHT_NS = 50_000_000
"""Segments sent before the client saw our abort follow one another more closely than this."""

_TOGGLE = 0x10
_LAST_SEGMENT = 0x80
_CLIENT_ABORT = 0x80
_NO_MULTIPLEXER = b"\0\0\0"


class Objects(Protocol):
    """What the server needs of the object dictionary. All methods raise ``SdoAbort`` to refuse."""

    def upload(self, index: int, sub: int, now: int) -> bytes:
        """The whole value, as one snapshot."""

    def check_download(self, index: int, sub: int, size: int | None) -> None:
        """Existence, access and length, before data moves. ``size`` in bytes; None: not indicated."""

    def download(self, index: int, sub: int, data: bytes, now: int) -> bool:
        """Write a value. False: the confirmation comes later through ``SdoServer.confirm``."""

    def max_size(self, index: int, sub: int) -> int | None:
        """Bytes that a download may have at most; None: no limit of the object's own."""


class _State(Enum):
    IDLE = auto()
    DOWNLOAD = auto()
    UPLOAD = auto()
    BLOCK_DOWNLOAD = auto()
    BLOCK_DOWNLOAD_END = auto()
    BLOCK_UPLOAD_START = auto()
    BLOCK_UPLOAD = auto()
    BLOCK_UPLOAD_END = auto()
    CONFIRM = auto()
    """All data is here, the dictionary owes the result."""


class SdoServer:
    """One SDO server. ``send`` is called with the 8 bytes of each answer, from within any method that takes ``now``.

    ``segment_ns``: distance that block upload segments keep on average, in bursts of up to four, driven by ``advance``; 0: a whole
    sub-block at once. No input raises.
    """

    def __init__(
        self, objects: Objects, send: Callable[[bytes], None], segment_ns: int = 0
    ) -> None:
        self._objects = objects
        self._send = send
        self._segment_ns = segment_ns
        self._state = _State.IDLE
        self._deadline: int | None = None
        self._multiplexer = _NO_MULTIPLEXER
        self._index = 0
        self._sub = 0
        # downloads
        self._received = bytearray()
        self._size: int | None = None  # as indicated by the client
        self._limit = 0  # bytes from which on a download is too long
        self._too_long = Abort.TOO_LONG
        self._answer = b""  # what confirms a download
        self._ticket = 0
        # uploads
        self._data = b""
        self._offset = 0
        # segmented, both ways
        self._toggle = 0
        # block, both ways
        self._crc = False  # both sides use it
        # block download: number of the last segment in sequence and of the last one seen
        self._accepted = 0
        self._seen = 0
        # segments of a sub-block that was cut short: number of the next one, 0: none; and until when it is one
        self._in_flight = 0
        self._in_flight_until = 0
        # block upload, in segments: of the whole, confirmed, of this sub-block, of this sub-block sent
        self._segments = 0
        self._confirmed = 0
        self._sub_block = 0
        self._sent = 0
        self._next_burst = 0

    @property
    def busy(self) -> bool:
        """True while a transfer runs or waits for its confirmation."""
        return self._state is not _State.IDLE

    @property
    def waiting(self) -> int | None:
        """The ticket of the download that waits for ``confirm``, different for each; None: none waits."""
        return self._ticket if self._state is _State.CONFIRM else None

    def receive(self, data: bytes, now: int) -> None:
        """The data of one request frame, of any length."""
        if len(data) != 8:
            return
        if self._deadline is not None and now >= self._deadline:
            self._abort(Abort.TIMEOUT)
        try:
            if self._state is _State.BLOCK_DOWNLOAD and data[0] != _CLIENT_ABORT:
                self._take_block_segment(data, now)
            elif not self._was_in_flight(data[0], now):
                self._serve(data, now)
        except SdoAbort as abort:
            self._abort(abort.code)
        self._restart_timeout(now)

    def confirm(self, code: Abort | None, now: int, ticket: int | None = None) -> None:
        """The result of a download that returned False: ``code`` is why it failed, None that it is done.

        Ignored if the transfer is no longer waiting. Whoever can have several results under way passes the ``ticket`` that
        ``waiting`` gave, so that the result of a dropped transfer does not confirm the one after it.
        """
        del now  # nothing follows a confirmation; taken for the sake of one form of all inputs
        if self._state is not _State.CONFIRM or (ticket is not None and ticket != self._ticket):
            return
        if code is not None:
            self._abort(code)
            return
        answer = self._answer
        self._end()
        self._send(answer)

    def reset(self) -> None:
        """Drop any transfer without a word."""
        self._end()

    def advance(self, now: int) -> None:
        """Let time pass: the time-out of a transfer, and the paced segments of a block upload."""
        if self._state is _State.BLOCK_UPLOAD and self._sent < self._sub_block:
            if now >= self._next_burst:
                self._send_burst(now)
        elif self._deadline is not None and now >= self._deadline:
            self._abort(Abort.TIMEOUT)

    def next_deadline(self) -> int | None:
        """When ``advance`` has something to do."""
        if self._state is _State.BLOCK_UPLOAD and self._sent < self._sub_block:
            return self._next_burst
        return self._deadline

    # ---- requests

    def _serve(self, data: bytes, now: int) -> None:
        command = data[0]
        match command >> 5:
            case 0:
                self._take_segment(data, now)
            case 1:
                self._initiate_download(data, now)
            case 2:
                self._begin(data)
                self._start_upload(self._objects.upload(self._index, self._sub, now))
            case 3:
                self._give_segment(command)
            case 4:
                self._end()
                self._in_flight = 0  # whoever aborts sends no more segments
            case 5:
                (
                    self._initiate_block_upload,
                    self._end_block_upload,
                    self._acknowledge,
                    self._start_block_upload,
                )[command & 3](data, now)
            case 6:
                (self._initiate_block_download, self._end_block_download)[command & 1](data, now)
            case _:
                _refuse(Abort.COMMAND)

    def _begin(self, data: bytes) -> None:
        """Leave what is going on for the transfer that an initiate request names."""
        self._end()
        self._multiplexer = data[1:4]
        self._index = int.from_bytes(data[1:3], "little")
        self._sub = data[3]

    def _expect(self, state: _State) -> None:
        if self._state is not state:
            _refuse(Abort.COMMAND)

    # ---- download, expedited and segmented

    def _initiate_download(self, data: bytes, now: int) -> None:
        """001n nnes, multiplexer, data or size. Answer: 60h, multiplexer, 0 (4)."""
        self._begin(data)
        command = data[0]
        expedited, indicated = command & 2, command & 1
        if expedited:
            size = 4 - (command >> 2 & 3) if indicated else None
            self._prepare_download(size)
            # without a size the object's own length counts (e = 1, s = 0: "unspecified number of bytes")
            self._store(
                data[4 : 4 + (min(4, self._limit) if size is None else size)],
                self._initiated(0x60),
                now,
            )
            return
        self._prepare_download(int.from_bytes(data[4:8], "little") if indicated else None)
        self._toggle = 0
        self._state = _State.DOWNLOAD
        self._send(self._initiated(0x60))

    def _prepare_download(self, size: int | None) -> None:
        """Have everything checked that can be before data moves; set size and limit."""
        self._objects.check_download(self._index, self._sub, size)
        limit = self._objects.max_size(self._index, self._sub)
        self._too_long = Abort.MEMORY if limit is None else Abort.TOO_LONG
        self._limit = UNLIMITED_SIZE if limit is None else limit
        if size is not None:
            if size > self._limit:
                _refuse(self._too_long)
            self._limit, self._too_long = size, Abort.TOO_LONG
        self._size = size

    def _take_segment(self, data: bytes, now: int) -> None:
        """000t nnnc, data (7). Answer: 001t 0000, 0 (7)."""
        self._expect(_State.DOWNLOAD)
        command = data[0]
        if command & _TOGGLE != self._toggle:
            _refuse(Abort.TOGGLE)
        self._received += data[1 : 8 - (command >> 1 & 7)]
        if len(self._received) > self._limit:
            _refuse(self._too_long)
        answer = bytes((0x20 | self._toggle, 0, 0, 0, 0, 0, 0, 0))
        self._toggle ^= _TOGGLE
        if command & 1:
            self._check_length()
            self._store(bytes(self._received), answer, now)
        else:
            self._send(answer)

    def _check_length(self) -> None:
        """What was received against what was indicated or fits."""
        if len(self._received) > self._limit:
            _refuse(self._too_long)
        if self._size is not None and len(self._received) < self._size:
            _refuse(Abort.TOO_SHORT)

    def _store(self, data: bytes, answer: bytes, now: int) -> None:
        """Hand all data to the dictionary; ``answer`` confirms it."""
        # waiting before the dictionary is asked, so that it may confirm or reset from within the call
        self._state = _State.CONFIRM
        self._ticket += 1
        self._answer = answer
        ticket = self._ticket
        if self._objects.download(self._index, self._sub, data, now):
            self.confirm(None, now, ticket)

    # ---- upload, expedited and segmented

    def _start_upload(self, data: bytes) -> None:
        """Request 010x xxxx, multiplexer, 0 (4). Answer: 0100 nnes, multiplexer, data or size."""
        if 1 <= len(data) <= 4:
            self._send(self._initiated(0x43 | (4 - len(data)) << 2, data))
            self._end()
            return
        self._data = data
        self._offset = 0
        self._toggle = 0
        self._state = _State.UPLOAD
        self._send(self._initiated(0x41, len(data).to_bytes(4, "little")))

    def _give_segment(self, command: int) -> None:
        """011t xxxx, 0 (7). Answer: 000t nnnc, data (7)."""
        self._expect(_State.UPLOAD)
        if command & _TOGGLE != self._toggle:
            _refuse(Abort.TOGGLE)
        segment = self._data[self._offset : self._offset + 7]
        self._offset += 7
        last = self._offset >= len(self._data)
        self._send(
            bytes((self._toggle | (7 - len(segment)) << 1 | last,)) + segment.ljust(7, b"\0")
        )
        self._toggle ^= _TOGGLE
        if last:
            self._end()

    # ---- block download

    def _initiate_block_download(self, data: bytes, now: int) -> None:
        """110x xCs0 (C: CRC), multiplexer, size. Answer: A4h (CRC supported), multiplexer, block size, 0 (3)."""
        self._begin(data)
        command = data[0]
        self._prepare_download(int.from_bytes(data[4:8], "little") if command & 2 else None)
        self._crc = bool(command & 4)
        self._accepted = self._seen = 0
        self._in_flight_until = now + IN_FLIGHT_NS
        self._state = _State.BLOCK_DOWNLOAD
        self._send(self._initiated(0xA4, bytes((BLOCK_SIZE,))))

    def _take_block_segment(self, data: bytes, now: int) -> None:
        """cnnn nnnn (c: last, n: number), data (7). Answer after the last one of a sub-block: A2h, accepted, block size, 0 (5).

        Only segments in sequence are taken; the client repeats what follows the last accepted one.
        """
        number = data[0] & 0x7F
        last = data[0] & _LAST_SEGMENT
        self._seen = number
        self._in_flight_until = now + IN_FLIGHT_NS
        if not number:
            _refuse(Abort.SEQUENCE)
        taken = number == self._accepted + 1
        if taken:
            self._accepted = number
            self._received += data[1:]
            # how many bytes of the last segment count is not known before the end request
            if not last and len(self._received) > self._limit:
                _refuse(self._too_long)
        if not last and number < BLOCK_SIZE:
            return
        answer = bytes((0xA2, self._accepted, BLOCK_SIZE, 0, 0, 0, 0, 0))
        self._accepted = self._seen = 0
        if last and taken:
            self._state = _State.BLOCK_DOWNLOAD_END
        self._send(answer)

    def _end_block_download(self, data: bytes, now: int) -> None:
        """110n nnx1 (n: bytes of the last segment that are none), CRC (2), 0 (5). Answer: A1h, 0 (7)."""
        self._expect(_State.BLOCK_DOWNLOAD_END)
        del self._received[len(self._received) - (data[0] >> 2 & 7) :]
        self._check_length()  # before the CRC, which over a wrong length is wrong anyway
        if self._crc and crc_hqx(self._received, 0) != int.from_bytes(data[1:3], "little"):
            _refuse(Abort.CRC)
        self._store(bytes(self._received), b"\xa1\0\0\0\0\0\0\0", now)

    def _was_in_flight(self, command: int, now: int) -> bool:
        """True for a segment that the client sent before it saw that we had cut its sub-block short."""
        if not self._in_flight:
            return False
        if command & 0x7F != self._in_flight or now > self._in_flight_until:
            self._in_flight = 0
            return False
        done = command & _LAST_SEGMENT or self._in_flight == BLOCK_SIZE
        self._in_flight = 0 if done else self._in_flight + 1
        self._in_flight_until = now + IN_FLIGHT_NS
        return True

    # ---- block upload

    def _initiate_block_upload(self, data: bytes, now: int) -> None:
        """101x xC00 (C: CRC), multiplexer, block size, threshold, 0 (2). Answer: C6h (CRC, size), multiplexer, size.

        With a threshold other than 0 a value of at most that many bytes goes by expedited or segmented upload instead.
        """
        self._begin(data)
        block_size, threshold = data[4], data[5]
        _check_block_size(block_size)
        value = self._objects.upload(self._index, self._sub, now)
        if threshold and len(value) <= threshold:
            self._start_upload(value)
            return
        self._data = value
        self._crc = bool(data[0] & 4)
        # no bytes still need one segment to say that it is the last
        self._segments = max(1, -(-len(value) // 7))
        self._confirmed = self._sent = 0
        self._sub_block = min(block_size, self._segments)
        self._state = _State.BLOCK_UPLOAD_START
        self._send(self._initiated(0xC6, len(value).to_bytes(4, "little")))

    def _start_block_upload(self, data: bytes, now: int) -> None:
        """1010 0011, 0 (7). Answer: the first sub-block."""
        del data
        self._expect(_State.BLOCK_UPLOAD_START)
        self._state = _State.BLOCK_UPLOAD
        self._send_sub_block(now)

    def _acknowledge(self, data: bytes, now: int) -> None:
        """1010 0010, last segment received, next block size, 0 (5). Answer: the next sub-block, or the end frame.

        It may come before the sub-block is out, when the client saw a gap. End frame: 110n nn01 (n: bytes of the last segment
        that are none), CRC (2), 0 (5).
        """
        self._expect(_State.BLOCK_UPLOAD)
        accepted, block_size = data[1], data[2]
        if accepted > self._sent:
            _refuse(Abort.SEQUENCE)
        # also after the last segment, where no block follows: the field is bound to 1..127 without exception
        _check_block_size(block_size)
        self._confirmed += accepted
        if self._confirmed < self._segments:
            self._sub_block = min(block_size, self._segments - self._confirmed)
            self._sent = 0
            self._send_sub_block(now)
            return
        unused = 7 * self._segments - len(self._data)
        crc = crc_hqx(self._data, 0) if self._crc else 0
        self._state = _State.BLOCK_UPLOAD_END
        self._send(bytes((0xC1 | (unused << 2),)) + crc.to_bytes(2, "little") + bytes(5))

    def _end_block_upload(self, data: bytes, now: int) -> None:
        """1010 0001, 0 (7). No answer."""
        del data, now
        self._expect(_State.BLOCK_UPLOAD_END)
        self._end()

    def _send_sub_block(self, now: int) -> None:
        """Send a sub-block, as far as its time has come."""
        if now >= self._next_burst:
            self._send_burst(now)

    def _send_burst(self, now: int) -> None:
        count = self._sub_block - self._sent
        if self._segment_ns:
            count = min(count, BURST)
        for _ in range(count):
            at = self._confirmed + self._sent
            self._sent += 1
            last = _LAST_SEGMENT if at + 1 == self._segments else 0
            self._send(
                bytes((last | self._sent,)) + self._data[7 * at : 7 * at + 7].ljust(7, b"\0")
            )
        self._next_burst = now + count * self._segment_ns
        self._restart_timeout(now)

    # ---- all transfers

    def _initiated(self, command: int, data: bytes = b"") -> bytes:
        """An answer with the multiplexer of the present transfer."""
        return bytes((command,)) + self._multiplexer + data.ljust(4, b"\0")

    def _restart_timeout(self, now: int) -> None:
        waits_for_client = self._state not in (_State.IDLE, _State.CONFIRM)
        self._deadline = now + TIMEOUT_NS if waits_for_client else None

    def _abort(self, code: Abort) -> None:
        """80h, multiplexer of the present transfer or 0, code."""
        answer = self._initiated(0x80, code.to_bytes(4, "little"))
        self._end()
        self._send(answer)

    def _end(self) -> None:
        if self._state is _State.BLOCK_DOWNLOAD:
            self._in_flight = self._seen + 1 if self._seen < BLOCK_SIZE else 0
        self._state = _State.IDLE
        self._deadline = None
        self._multiplexer = _NO_MULTIPLEXER
        self._data = b""
        self._received = bytearray()


def _refuse(code: Abort) -> NoReturn:
    raise SdoAbort(code)


def _check_block_size(block_size: int) -> None:
    if not 1 <= block_size <= 127:
        _refuse(Abort.BLOCK_SIZE)
