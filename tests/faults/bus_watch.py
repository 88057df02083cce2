"""Judges every frame on a bus.

A value is right if it is marked as not available, or if an ESC sent it within the timeout. Any
other value is wrong.

``Judge`` is pure: it gets frames and times. ``BusWatch`` reads a socket in a thread. Its times are
monotonic nanoseconds at which it has read a frame. A frame that it loses itself counts against the
gateway, never in favour of it.
"""

import contextlib
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple, Self

from feeder import CURRENT, SPEED, FedEsc
from raw_bus import EXTENDED, FRAME, SO_RCVBUFFORCE
from signals import Message, Table

MS = 1_000_000
SECOND = 1000 * MS
TIMEOUT_NS = 250 * MS
INFO_TIMEOUT_NS = 10 * SECOND
LOOKED_BACK = 3000
"""Number of frames that are searched for the origin of a wrong value."""
KEPT = 100

_FOLLOWS = {"Speed": SPEED, "Current": CURRENT}


class Wrong(NamedTuple):
    """A value that should not have been on the bus."""

    at_ns: int
    what: str


class Fresh(NamedTuple):
    """A frame with right values: its time, and the number of the live frame it is based on."""

    at_ns: int
    n: int


class Emergency(NamedTuple):
    at_ns: int
    node: int
    code: int


class Received(NamedTuple):
    """A frame with an ESC's values: time, message and the available values."""

    at_ns: int
    message: Message
    esc: int
    present: list[tuple[str, float, float]]
    """Name, value and half a step of each available signal."""
    flags: int | None
    """The error bits, or None if the message has no valid ones."""

    def __str__(self) -> str:
        values = ", ".join(f"{name} {value:g}" for name, value, _ in self.present)
        return f"{self.message.name}: {values}"

    def has_values(self, values: dict[str, float]) -> bool:
        same = all(abs(values[name] - value) <= half for name, value, half in self.present)
        return same and (self.flags is None or self.flags == values["flags"])


class Judge:
    """Compares received frames with the frames that the ESCs sent.

    ``slack_ns`` is the time that the machine may take in addition to the timeout.
    """

    def __init__(
        self,
        table: Table,
        escs: Sequence[FedEsc],
        slack_ns: int = 60 * MS,
    ) -> None:
        self.table = table
        self.escs = escs
        self.slack_ns = slack_ns
        self.more_ns = 0
        """Additional slack for a while: frames in a bus or an adapter cannot be taken back."""
        self.by_more = 0
        """Values that were right only because of the additional slack."""
        self.wrong: deque[Wrong] = deque(maxlen=KEPT)
        """The newest wrong values."""
        self.wrong_count = 0
        self.values = 0
        """Number of frames whose values were right."""
        self.marked = 0
        """Number of frames whose values were all marked as not available."""
        self.boot_ups: list[tuple[int, int]] = []
        """Time and node of each boot-up."""
        self.emergencies: list[Emergency] = []
        self.fresh: list[deque[Fresh]] = [deque(maxlen=5_000) for _ in escs]
        """The right EscSpeed frames of each ESC."""
        self._newest: dict[int, int] = {}
        """Number of the newest live frame that each CAN id has carried."""
        self._bits: dict[str, tuple[Message, int]] = {}
        """Newest message and content by name of the message."""
        self._nodes = set(range(1, len(escs) + 1))
        self._devices: list[int | None] = [None for _ in escs]

    def take(self, can_id: int, data: bytes, at_ns: int) -> None:
        """Judge a classic frame with an 11-bit identifier that the gateway has sent."""
        bits = int.from_bytes(data, "little")
        if can_id - 0x700 in self._nodes and data == b"\0":
            self.boot_ups.append((at_ns, can_id - 0x700))
        elif can_id - 0x80 in self._nodes and len(data) == 8:
            self.emergencies.append(Emergency(at_ns, can_id - 0x80, bits & 0xFFFF))
        elif message := self.table.get(can_id):
            if message.kind != "other":
                self._judge_values(message, bits, at_ns)
                return
            self._bits[message.name] = message, bits
            if message.stem == "Link":
                self._judge_age(message, at_ns)

    def value(self, message: str, signal: str) -> int | None:
        """Return the newest raw value of a signal, or None before the first frame.

        The message is one of the gateway's own messages or ``EscNLink``.
        """
        found = self._bits.get(message)
        if found is None:
            return None
        definition, bits = found
        return next(place.raw(bits) for place in definition.places if place.name == signal)

    def info_device(self, esc: int) -> int | None:
        """Return the device number of an ESC's newest right EscInfo."""
        return self._devices[esc]

    def first_fresh(
        self,
        esc: int,
        after_ns: int,
        sent_after_ns: int = 0,
    ) -> Fresh | None:
        """Return the first frame with right values of an ESC after a time, or None.

        Its live frame was sent at ``sent_after_ns`` or later.
        """
        found = None
        for fresh in reversed(tuple(self.fresh[esc])):  # a copy, because the judge continues
            if fresh.at_ns <= after_ns:
                break
            if self.escs[esc].sent[fresh.n] >= sent_after_ns:
                found = fresh
        return found

    def _is_wrong(self, at_ns: int, what: str) -> None:
        self.wrong.append(Wrong(at_ns, what))
        self.wrong_count += 1

    # --- judging

    def _judge_values(self, message: Message, bits: int, at_ns: int) -> None:
        present = []
        for place in message.places:
            raw = place.raw(bits)
            if raw != place.not_available:
                present.append((place.name, raw * place.scale, place.scale / 2 + 1e-9))
        if not present:
            self.marked += 1
            return
        start, mask = message.flags
        are_valid = mask and any(name in ("operating_state", "device") for name, _, _ in present)
        flags = (bits >> start & mask) if are_valid else None
        assert message.esc is not None
        received = Received(at_ns, message, message.esc, present, flags)
        if message.kind == "info":
            self._judge_info(received)
        else:
            self._judge_live(received)

    def _judge_live(self, received: Received) -> None:
        fed = self.escs[received.esc]
        at_ns = received.at_ns
        can_id = received.message.can_id
        limit_ns = TIMEOUT_NS + self.slack_ns
        n = newest = fed.newest(at_ns + MS)
        while n >= 0 and at_ns - fed.sent[n] <= limit_ns + self.more_ns:
            if received.has_values(fed.values(n)):
                break
            n -= 1
        else:
            self._is_wrong(at_ns, f"{received}: {self._origin(received, n, newest)}")
            return
        # If frames may arrive seconds late, several of them had these values, and their order is
        # unknown.
        if not self.more_ns:
            newer = self._newest.get(can_id, -1)
            if n < newer:
                self._is_wrong(
                    at_ns,
                    f"{received}: values of frame {n} after those of frame {newer}",
                )
                return
            self._newest[can_id] = n
        self.values += 1
        self.by_more += at_ns - fed.sent[n] > limit_ns
        follows = _FOLLOWS.get(received.message.stem, 0)
        fed.seen[n] |= follows
        if follows == SPEED:
            self.fresh[received.esc].append(Fresh(at_ns, n))

    def _origin(self, received: Received, older: int, newest: int) -> str:
        """Describe the origin of values that the newest frames did not have."""
        fed = self.escs[received.esc]
        for n in range(older, max(-1, newest - LOOKED_BACK), -1):
            if received.has_values(fed.values(n)):
                return (
                    f"old: frame {n}, sent {(received.at_ns - fed.sent[n]) / SECOND:.3f} s before"
                )
        return f"never sent; newest frame {newest}"

    def _judge_info(self, received: Received) -> None:
        fed = self.escs[received.esc]
        m = newest = fed.newest_info(received.at_ns + MS)
        limit_ns = INFO_TIMEOUT_NS + self.slack_ns
        while m >= 0 and received.at_ns - fed.info_sent[m] <= limit_ns + self.more_ns:
            values = fed.values_of_info(m)
            if received.has_values(values):
                self.values += 1
                self.by_more += received.at_ns - fed.info_sent[m] > limit_ns
                if received.message.stem == "Info":
                    self._devices[received.esc] = int(values["device"])
                return
            m -= 1
        self._is_wrong(received.at_ns, f"{received}: no info of the last 10 s; newest {newest}")

    def _judge_age(self, message: Message, at_ns: int) -> None:
        """Check that the age of the data is not lower than the age of the newest frame."""
        age = self.value(message.name, "data_age")
        assert message.esc is not None
        assert age is not None
        if age >= 65_000:
            return
        fed = self.escs[message.esc]
        newest = fed.newest(at_ns + MS)
        true_age = (at_ns - fed.sent[newest]) / MS if newest >= 0 else 1e9
        excess = int((true_age - age - 5) * MS) - self.slack_ns
        if excess > self.more_ns:
            what = f"{message.name}: an age of {age} ms; the newest is {true_age:.0f} ms old"
            self._is_wrong(at_ns, what)
        self.by_more += 0 < excess <= self.more_ns


class BusWatch(Judge):
    """A judge with a socket that receives frames of one interface.

    The socket is bound to all interfaces, so the watched one may be deleted and created again.
    If ``ignore_local`` is set, frames that were sent on the watched interface itself are foreign
    traffic and are not judged. That is the case if the gateway is at the other end of a vxcan pair,
    a controller pair or two adapters.
    """

    def __init__(
        self,
        interface: str,
        table: Table,
        escs: Sequence[FedEsc],
        *,
        slack_ns: int = 60 * MS,
        ignore_local: bool = True,
    ) -> None:
        super().__init__(table, escs, slack_ns)
        self.interface = interface
        self.failure: BaseException | None = None
        self._ignore_local = ignore_local
        self._open()

    def _open(self) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        for option in (SO_RCVBUFFORCE, socket.SO_RCVBUF):
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, option, 48 << 20)
                break
        self._socket.bind(("",))
        self._socket.settimeout(0.1)
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="bus watch", daemon=True)

    def start(self) -> Self:
        self._thread.start()
        return self

    def pause(self) -> None:
        """Judge no frames until ``resume``."""
        self.close()

    def resume(self) -> None:
        """Judge frames again. Does nothing if the judge is not paused."""
        if self._closed:
            self._open()
            self._thread.start()

    def _run(self) -> None:
        try:
            while not self._closed:
                # An OSError is a timeout or a lost interface. The socket remains usable.
                with contextlib.suppress(OSError):
                    data, _, flags, address = self._socket.recvmsg(16)
                    self._received(data, flags, address[0])
        except BaseException as error:
            self.failure = error
            raise

    def _received(self, data: bytes, flags: int, interface: str) -> None:
        if interface != self.interface or len(data) != FRAME.size:
            return
        can_id, size, content = FRAME.unpack(data)
        local = self._ignore_local and flags & socket.MSG_DONTROUTE
        if not local and not can_id & EXTENDED:
            self.take(can_id & 0x7FF, content[:size], time.monotonic_ns())

    def catch_up(self) -> None:
        """Wait until all frames received so far were judged."""
        while self.failure is None and select.select([self._socket], [], [], 0)[0]:
            time.sleep(0.005)
        time.sleep(0.02)

    def close(self) -> None:
        self._closed = True
        if self._thread.is_alive():
            self._thread.join(5)
        self._socket.close()
