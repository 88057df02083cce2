"""Whole iterations of the loop in C (linux.c), through ctypes.

The structures are those of linux.h, which describes their fields.
"""

import ctypes as c
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from kontronik_can_gw.frames import EXTENDED, CanFrame
from kontronik_can_gw.native.binding import Frame, frames_in
from kontronik_can_gw.native.header import KCG, structure
from kontronik_can_gw.times import NEVER

OUTPUTS = 1 << 29
"""The event KCG_OUTPUTS: let time pass for the outputs."""
_ENTRY = struct.Struct("=qqIBBxx")
_CLASSIC = struct.Struct("=IB3x8s")
_FRAME_SIZE = c.sizeof(Frame)


Input = structure("kcg_input")
_PollFd = structure("pollfd")
_Turns = structure("kcg_turns")
_FRAMES = _Turns.queue.offset + structure("kcg_turn_queue").frame.offset
"""Offset of the waiting frames in kcg_turns."""
_ENTRIES = _Turns.ring.offset
"""Offset of the recorded calls in kcg_turns."""


class Turns:
    """Iterations of a loop whose core is in C.

    The owner fills ``request`` and ``times``, then calls ``begin`` and ``run``, and reads
    ``result``.
    """

    def __init__(self, library: Any, core: Any, escs: int) -> None:
        self.inputs: Any = (Input * escs)()
        for esc, port_input in enumerate(self.inputs):
            port_input.esc = esc
            port_input.undrained_ns = NEVER
        self._state = _Turns(core=core, inputs=c.addressof(self.inputs))
        self.request: Any = self._state.request
        self.times: Any = self._state.times
        self.result: Any = self._state.result
        self.departures: Any = self._state.departures
        self.reads: Any = self._state.reads
        self.queue: Any = self._state.queue
        self._ports: Any = self._state.ports
        self._ports.epoll = -1
        address = c.byref(self._state)
        self._address = address
        self._watch = library.kcg_watch
        self.begin = partial(library.kcg_begin, address)
        """Start a run. To be called before the first ``run``."""
        self.run: Callable[[], int] = partial(library.kcg_turn, address)
        """Make turns until the loop has something to do (0), or an event is to be followed (1).

        After an event call it again, or call ``leave``.
        """
        self.leave = partial(library.kcg_leave, address)
        """Leave the rest of the iteration to the loop."""
        self._raw = memoryview(self._state).cast("B")
        self._output_frames: list[CanFrame] = []
        """The last frames of ``add_output_frames``: at least those that were not sent."""

    def watch(self, descriptors: Sequence[tuple[int, int, int | None]]) -> bool:
        """Watch these descriptors from now on. Return False if that is impossible.

        Each is a descriptor, the events of poll, and the number of the ESC whose port it is.
        """
        if len(descriptors) > KCG.FDS:
            return False
        ports = self._ports
        ports.count = len(descriptors)
        for place, (fd, events, esc) in enumerate(descriptors):
            ports.fds[place] = _PollFd(fd, events, 0)
            ports.input_of[place] = -1 if esc is None else esc
        return bool(self._watch(self._address))

    def close(self) -> None:
        """Watch nothing any more."""
        self.watch(())

    def add_output_frames(self, frames: list[CanFrame]) -> bool:
        """Move frames of outputs into the queue, before the core's.

        Return False, without moving them, if the loop must send them.
        """
        if not frames:
            return True
        queue = self.queue
        raw = self._raw
        waiting = queue.count
        count = waiting + len(frames)
        if waiting != queue.from_outputs or count > KCG.MADE:
            return False
        at = _FRAMES + waiting * _FRAME_SIZE
        for can_id, data, extended, fd, _, remote, _ in frames:
            if fd or remote:
                return False
            key = can_id | EXTENDED if extended else can_id
            _CLASSIC.pack_into(raw, at, key, len(data), data)
            at += _FRAME_SIZE
        if not waiting:  # how long the bus was full before does not count for these
            queue.full_since = self.times.now
            self._output_frames = []
        self._output_frames += frames
        queue.count = count
        queue.from_outputs = count
        self.result.taken += len(frames)
        frames.clear()
        return True

    def read(self) -> tuple[int, bytes, int, int]:
        """Return the bytes that the core has not processed, as arguments of Core.receive."""
        reads = self.reads
        esc = self._ports.input_of[reads.place[reads.at]]
        data = bytes(reads.data[: reads.size])
        return esc, data, self.times.now, reads.since

    def ready(self) -> list[tuple[int, int]]:
        """Return the descriptors that are ready, with the events of poll."""
        ports = self._ports
        ready = [each for each in ports.fds[: ports.count] if each.revents]
        return [(each.fd, each.revents) for each in ready]

    def unsent(self) -> list[CanFrame]:
        """Return the frames that the bus did not take, in their order."""
        queue = self.queue
        if not queue.count:
            return []
        frames = frames_in(self._raw, _FRAMES, queue.count)
        from_outputs = queue.from_outputs
        first = self._output_frames[-from_outputs:] if from_outputs else []
        return first + frames[from_outputs:]

    def entries(self) -> Iterator[tuple[int, int, int, bytes, int | None]]:
        """Yield the recorded calls in their order: time, kind, ESC, data, since when it can be."""
        at = _ENTRIES
        raw = self._raw
        end = at + self.result.recorded
        while at < end:
            now, came, size, kind, esc = _ENTRY.unpack_from(raw, at)
            at += _ENTRY.size
            data = bytes(raw[at : at + size])
            since = None if came == NEVER else came
            yield now, kind, esc, data, since
            at += -(-size // 8) * 8
