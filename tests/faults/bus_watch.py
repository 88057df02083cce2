"""Judges every frame on a bus: a value is marked not available, or it is what an ESC sent a moment ago. Everything else is a wrong value.

``Judge`` is pure: frames and times in. ``BusWatch`` reads a socket in a thread; times are monotonic nanoseconds at which it has read a
frame, so what it loses itself counts against the gateway: never the other way.
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
"""So many frames are searched to say where a wrong value comes from."""
KEPT = 100

_FOLLOWS = {"Speed": SPEED, "Current": CURRENT}


class Wrong(NamedTuple):
    """A value that should not have been on the bus."""

    at_ns: int
    what: str


class Fresh(NamedTuple):
    """A right value frame: when, and the number of the live frame that it is from."""

    at_ns: int
    n: int


class Emergency(NamedTuple):
    at_ns: int
    node: int
    code: int


class Said(NamedTuple):
    """A frame with an ESC's values: the time, the message, and what is not marked as not available."""

    at_ns: int
    message: Message
    esc: int
    present: list[tuple[str, float, float]]
    """Name, value and half a step."""
    flags: int | None
    """The error bits, where the message has any and they hold."""

    def __str__(self) -> str:
        values = ", ".join(f"{name} {value:g}" for name, value, _ in self.present)
        return f"{self.message.name}: {values}"

    def is_of(self, values: dict[str, float]) -> bool:
        same = all(abs(values[name] - value) <= half for name, value, half in self.present)
        return same and (self.flags is None or self.flags == values["flags"])


class Judge:
    """What was sent, what came, and whether it is right. ``slack_ns``: what the machine is given on top of the time-out."""

    def __init__(self, table: Table, escs: Sequence[FedEsc], slack_ns: int = 60 * MS) -> None:
        self.table = table
        self.escs = escs
        self.slack_ns = slack_ns
        self.more_ns = 0
        """Slack besides, for a while: what a bus or an adapter holds nobody can take back."""
        self.by_more = 0
        """Values that were right only because of it."""
        self.wrong: deque[Wrong] = deque(maxlen=KEPT)
        """The newest ones."""
        self.wrong_count = 0
        self.values = 0
        """Frames with values that were compared and right."""
        self.marked = 0
        """Frames in which all values were marked not available."""
        self.boot_ups: list[tuple[int, int]] = []
        """(time, node)"""
        self.emergencies: list[Emergency] = []
        self.fresh: list[deque[Fresh]] = [deque(maxlen=5_000) for _ in escs]
        """The EscSpeed frames that were right."""
        # CAN id -> number of the newest live frame that it has carried
        self._newest: dict[int, int] = {}
        self._bits: dict[str, tuple[Message, int]] = {}  # message name -> message, content
        self._nodes = set(range(1, len(escs) + 1))
        self._devices: list[int | None] = [None for _ in escs]

    def take(self, can_id: int, data: bytes, at_ns: int) -> None:
        """A classic frame with an 11-bit identifier that the gateway has sent."""
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
        """The newest raw value of a signal of the gateway's own messages or of ``EscNLink``; None before the first."""
        found = self._bits.get(message)
        if found is None:
            return None
        return next(place.raw(found[1]) for place in found[0].places if place.name == signal)

    def info_device(self, esc: int) -> int | None:
        """The device number that an ESC's newest right EscInfo told."""
        return self._devices[esc]

    def first_fresh(self, esc: int, after_ns: int, sent_after_ns: int = 0) -> Fresh | None:
        """The first right value frame of an ESC after a time, of a live frame that was sent after another."""
        found = None
        for fresh in reversed(tuple(self.fresh[esc])):  # a copy: the judge goes on meanwhile
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
        holds = mask and any(name in ("operating_state", "device") for name, _, _ in present)
        assert message.esc is not None
        said = Said(at_ns, message, message.esc, present, (bits >> start & mask) if holds else None)
        (self._judge_info if message.kind == "info" else self._judge_live)(said)

    def _judge_live(self, said: Said) -> None:
        fed = self.escs[said.esc]
        at_ns = said.at_ns
        can_id = said.message.can_id
        limit_ns = TIMEOUT_NS + self.slack_ns
        n = newest = fed.newest(at_ns + MS)
        while n >= 0 and at_ns - fed.sent[n] <= limit_ns + self.more_ns:
            if said.is_of(fed.values(n)):
                break
            n -= 1
        else:
            self._is_wrong(at_ns, f"{said}: {self._origin(said, n, newest)}")
            return
        # where frames may come seconds late, several of them had these values: their order is not known
        if not self.more_ns:
            newer = self._newest.get(can_id, -1)
            if n < newer:
                self._is_wrong(at_ns, f"{said}: values of frame {n} after those of frame {newer}")
                return
            self._newest[can_id] = n
        self.values += 1
        self.by_more += at_ns - fed.sent[n] > limit_ns
        follows = _FOLLOWS.get(said.message.stem, 0)
        fed.seen[n] |= follows
        if follows == SPEED:
            self.fresh[said.esc].append(Fresh(at_ns, n))

    def _origin(self, said: Said, older: int, newest: int) -> str:
        """Where values come from that none of the newest frames had."""
        fed = self.escs[said.esc]
        for n in range(older, max(-1, newest - LOOKED_BACK), -1):
            if said.is_of(fed.values(n)):
                return f"old: frame {n}, sent {(said.at_ns - fed.sent[n]) / SECOND:.3f} s before"
        return f"never sent; newest frame {newest}"

    def _judge_info(self, said: Said) -> None:
        fed = self.escs[said.esc]
        m = newest = fed.newest_info(said.at_ns + MS)
        while m >= 0 and said.at_ns - fed.info_sent[m] <= INFO_TIMEOUT_NS + self.slack_ns:
            values = fed.values_of_info(m)
            if said.is_of(values):
                self.values += 1
                if said.message.stem == "Info":
                    self._devices[said.esc] = int(values["device"])
                return
            m -= 1
        self._is_wrong(said.at_ns, f"{said}: no info of the last 10 s; newest {newest}")

    def _judge_age(self, message: Message, at_ns: int) -> None:
        """The age of the data must not be told younger than what was sent last."""
        age = self.value(message.name, "data_age")
        assert message.esc is not None and age is not None
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
    """A judge with a socket on all interfaces, of which one is listened to: it may be deleted and made again meanwhile.

    ``ignore_local``: frames that were sent on the watched interface itself are foreign traffic and not judged. That is so where
    the gateway is at the other end: of a vxcan pair, of a controller pair, of two adapters.
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

    def _run(self) -> None:
        try:
            while not self._closed:
                # an OSError: time out, or an interface went down or away; the socket is still good
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
        """Wait until all that has come by now was judged."""
        while self.failure is None and select.select([self._socket], [], [], 0)[0]:
            time.sleep(0.005)
        time.sleep(0.02)

    def close(self) -> None:
        self._closed = True
        if self._thread.is_alive():
            self._thread.join(5)
        self._socket.close()
