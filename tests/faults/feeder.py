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

from encoding import Identity, info, live

from kontronik_can_gw.esc.kontronik.codec import encode
from kontronik_can_gw.esc.kontronik.fields import InfoData, LiveData

SECOND = 1_000_000_000
SLOW_WRITE_NS = 5_000_000
SPEED, CURRENT = 1, 2
"""Bits of ``seen``: the messages that follow each live frame."""


class FedEsc:
    """One ESC: who it is, where its bytes go, what it has sent.

    ``write`` returns False where not all bytes were taken. ``mangle`` gets the bytes of a frame and returns what goes on the
    line and whether the frame is still whole in it. ``rate_hz`` frames a second, every ``info_every``-th of them an info frame.
    """

    def __init__(
        self,
        write: Callable[[bytes], bool],
        identity: Identity,
        rate_hz: float = 50,
        info_every: int = 100,
    ) -> None:
        self.write = write
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
        self._identities = [(0, 0, identity)]
        self._ticks = 0
        self.due_ns = 0

    @property
    def identity(self) -> Identity:
        return self._identities[-1][2]

    def become(self, identity: Identity) -> None:
        """From the next frame on another ESC is on the line."""
        self._identities.append((len(self.sent), len(self.info_sent), identity))

    def identity_of_live(self, n: int) -> Identity:
        return self._identities[bisect_right(self._identities, n, key=lambda entry: entry[0]) - 1][
            2
        ]

    def identity_of_info(self, m: int) -> Identity:
        return self._identities[bisect_right(self._identities, m, key=lambda entry: entry[1]) - 1][
            2
        ]

    def live(self, n: int) -> LiveData:
        return live(self.identity_of_live(n), n)

    def info(self, m: int) -> InfoData:
        return info(self.identity_of_info(m), m)

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
        if is_info:
            wire = encode(info(identity, len(self.info_sent)), identity.layout)
        else:
            wire = encode(live(identity, len(self.sent)), identity.layout)
        whole = True
        if self.mangle is not None:
            wire, whole = self.mangle(wire)
        now = time.monotonic_ns()
        if is_info:
            self.info_sent.append(now)
        else:
            self.seen.append(0)
            self.whole.append(0)
            self.sent.append(now)
        taken = self.write(wire)
        if not is_info:
            self.whole[-1] = taken and whole
            if (left := time.monotonic_ns()) - now > SLOW_WRITE_NS:
                self._left[len(self.sent) - 1] = left


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
