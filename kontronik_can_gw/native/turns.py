"""Whole turns of the loop in C (linux.c), by ctypes: the structures of linux.h, and what is left of a turn."""

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
"""Found: time is to pass for the outputs."""
_ENTRY = struct.Struct("=qqIBBxx")
_CLASSIC = struct.Struct("=IB3x8s")
_FRAME_SIZE = c.sizeof(Frame)


Input, _PollFd = structure("kcg_input"), structure("pollfd")
_Turns = structure("kcg_turns")
_FRAMES, _ENTRIES = _Turns.frames.offset, _Turns.ring.offset


class Turns:
    """Turns of a loop whose core is in C. ``state``: kcg_turns, of which the owner sets times, socket and limits before ``run``."""

    def __init__(self, library: Any, core: Any, escs: int) -> None:
        self.inputs: Any = (Input * escs)()
        for esc, one in enumerate(self.inputs):
            one.esc, one.undrained_ns = esc, NEVER
        self.state = _Turns(core=core, inputs=c.addressof(self.inputs), epoll=-1)
        self._address = address = c.byref(self.state)
        self._watch = library.kcg_watch
        self.begin = partial(library.kcg_begin, address)
        """To be called before the first ``run``."""
        self.run: Callable[[], int] = partial(library.kcg_turn, address)
        """Turn until there is something for the loop: 0; or an event is to be followed: then it is to be called again, or ``leave``."""
        self.leave = partial(library.kcg_leave, address)
        """The rest of the turn is the loop's."""
        self._raw = memoryview(self.state).cast("B")
        self._spoken: list[CanFrame] = []
        """The last frames of ``speak``: at least those that are not sent."""

    def watch(self, descriptors: Sequence[tuple[int, int, int | None]]) -> bool:
        """(descriptor, what to wait for, ESC whose port it is) from now on. False: that cannot be."""
        if len(descriptors) > KCG.FDS:
            return False
        state = self.state
        state.count = len(descriptors)
        for place, (fd, events, esc) in enumerate(descriptors):
            state.fds[place] = _PollFd(fd, events, 0)
            state.input_of[place] = -1 if esc is None else esc
        return bool(self._watch(self._address))

    def close(self) -> None:
        """Wait for nothing any more."""
        self.watch(())

    def speak(self, frames: Sequence[CanFrame]) -> bool:
        """Let what outputs have made of an event be sent before the core's frames. False where that is the loop's."""
        state, raw = self.state, self._raw
        waiting = state.unsent
        count = waiting + len(frames)
        if waiting != state.spoken or count > KCG.MADE:
            return False
        at = _FRAMES + waiting * _FRAME_SIZE
        for can_id, data, extended, fd, _, remote, _ in frames:
            if fd or remote:
                return False
            _CLASSIC.pack_into(raw, at, can_id | EXTENDED if extended else can_id, len(data), data)
            at += _FRAME_SIZE
        if not waiting:  # when the bus was full before says nothing of these
            state.full_since = state.now
            self._spoken = []
        self._spoken += frames
        state.unsent = state.spoken = count
        state.taken += len(frames)
        return True

    def read(self) -> tuple[int, bytes, int, int]:
        """What the core has been given and not taken yet, as the arguments of Core.receive."""
        state = self.state
        esc = state.input_of[state.place[state.at]]
        return esc, bytes(state.data[: state.size]), state.now, state.since

    def ready(self) -> list[tuple[int, int]]:
        """The descriptors that are ready, with what happened."""
        ready = [each for each in self.state.fds[: self.state.count] if each.revents]
        return [(each.fd, each.revents) for each in ready]

    def unsent(self) -> list[CanFrame]:
        """The frames that the bus did not take, in their order."""
        state = self.state
        frames = frames_in(self._raw, _FRAMES, state.unsent)
        spoken = self._spoken[-state.spoken :] if state.spoken else []
        return spoken + frames[state.spoken :]

    def entries(self) -> Iterator[tuple[int, int, int, bytes, int | None]]:
        """What was recorded: (time, kind, ESC, data, since when it can have come), in its order."""
        at, raw = _ENTRIES, self._raw
        end = at + self.state.recorded
        while at < end:
            now, came, size, kind, esc = _ENTRY.unpack_from(raw, at)
            at += _ENTRY.size
            yield now, kind, esc, bytes(raw[at : at + size]), None if came == NEVER else came
            at += -(-size // 8) * 8
