"""Plays ESCs into whatever takes bytes, in real time, and keeps when each frame was sent and whether it was sent whole.

What may touch what: the feeder's thread writes the records; everybody may read them and set ``on``, ``write``, ``mangle``, ``rate_hz``.
"""

import contextlib
import threading
import time
from array import array
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Self

from encoding import Identity, info, info_values, live, live_values

from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import LiveData

SECOND = 1_000_000_000
SLOW_WRITE_NS = 5_000_000
SPEED, CURRENT = 1, 2
"""Bits of ``seen``: the messages that follow each live frame."""


class FedEsc:
    """One ESC: who it is, what it has sent; where its bytes go is the matter of those that are made of it.

    ``mangle`` gets the bytes of a frame and returns what goes on the line and whether the frame is still whole in it. ``rate_hz``
    frames a second, every ``info_every``-th of them an info frame.
    """

    path: str
    """What the gateway opens."""

    def __init__(self, identity: Identity, rate_hz: float = 50, info_every: int = 100) -> None:
        self.rate_hz = rate_hz
        self.info_every = info_every
        self.on = True
        self.mangle: Callable[[bytes], tuple[bytes, bool]] | None = None
        self.sent = array("q")
        """Monotonic nanoseconds at which live frame n was handed over."""
        self._left: dict[int, int] = {}
        self.whole = bytearray()
        """1 where live frame n left whole."""
        self.seen = bytearray()
        """Which messages with live frame n came to the bus; written by the bus watch."""
        self.info_sent = array("q")
        self.identity = identity
        """Who is on the line; another one from the next frame on where it is set."""
        self._was: list[Identity] = []
        """Who sent live frame n."""
        self._was_of_info: list[Identity] = []
        self._ticks = 0
        self.due_ns = 0

    def write(self, data: bytes) -> bool:
        """Bytes to the line; False where not all were taken."""
        raise NotImplementedError

    def received(self) -> int:
        """Bytes that came to the ESC so far but for the kernel's echo between a plug-in and the gateway's setting of the port."""
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def live(self, n: int) -> LiveData:
        return live(self._was[n], n)

    def values(self, n: int) -> dict[str, float]:
        """What live frame n means."""
        return live_values(self._was[n], n)

    def values_of_info(self, m: int) -> dict[str, float]:
        return info_values(self._was_of_info[m], m)

    def left(self, n: int) -> int:
        """When live frame n had left at the latest: the feeder may have been held up between its look at the clock and the write."""
        return self._left.get(n, self.sent[n])

    def newest(self, at_ns: int) -> int:
        """The number of the newest live frame sent until then, -1 if there is none."""
        return bisect_right(self.sent, at_ns) - 1

    def newest_info(self, at_ns: int) -> int:
        return bisect_right(self.info_sent, at_ns) - 1

    def send_one(self) -> None:
        """Send the next frame now."""
        self._ticks += 1
        is_info = self._ticks % self.info_every == 3  # the first one soon
        identity = self.identity
        data = info(identity, len(self.info_sent)) if is_info else live(identity, len(self.sent))
        wire, whole = encode(data, identity.layout), True
        if self.mangle is not None:
            wire, whole = self.mangle(wire)
        now = time.monotonic_ns()
        self.note(now, is_info)
        taken = self.write(wire)
        if not is_info:
            self.whole[-1] = taken and whole
            if (left := time.monotonic_ns()) - now > SLOW_WRITE_NS:
                self._left[len(self.sent) - 1] = left

    def note(self, at_ns: int, is_info: bool = False) -> None:
        """A frame is sent at that time; ``sent`` last, for whoever finds a frame there looks at the rest."""
        if is_info:
            self._was_of_info.append(self.identity)
            self.info_sent.append(at_ns)
        else:
            self._was.append(self.identity)
            self.seen.append(0)
            self.whole.append(0)
            self.sent.append(at_ns)


class Feeder:
    """The thread that sends. Frames are never sent closer than 0.8 of their distance: nothing is made up for."""

    def __init__(self, escs: Sequence[FedEsc]) -> None:
        self.escs = list(escs)
        self.error: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feeder", daemon=True)

    def start(self) -> Self:
        now = time.monotonic_ns()
        for i, esc in enumerate(self.escs):
            esc.due_ns = now + int(SECOND / esc.rate_hz * i / len(self.escs))
        self._thread.start()
        return self

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                now = time.monotonic_ns()
                for esc in self.escs:
                    if esc.due_ns > now:
                        continue
                    period = int(SECOND / esc.rate_hz)
                    if esc.on:
                        with contextlib.suppress(OSError):
                            esc.send_one()
                    esc.due_ns = max(esc.due_ns + period, time.monotonic_ns() + period * 8 // 10)
                pause = (min(esc.due_ns for esc in self.escs) - time.monotonic_ns()) / SECOND
                if pause > 0:
                    self._stop.wait(pause) if pause > 0.05 else time.sleep(pause)
        except BaseException as error:
            self.error = error
            raise

    def close(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(5)
